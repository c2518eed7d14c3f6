"""Connect recorded drives to ROS 2."""
