"""Connect the cores of loop closure to ROS 2."""
