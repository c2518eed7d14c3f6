"""Connect place recognition to ROS 2."""
