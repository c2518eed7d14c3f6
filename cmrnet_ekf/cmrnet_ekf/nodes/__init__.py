"""Connect the filters and the localization in a map to ROS 2."""
