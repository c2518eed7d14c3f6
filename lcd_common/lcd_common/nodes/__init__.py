"""Connect cores to ROS 2: the only modules of this package that import rclpy or messages."""
