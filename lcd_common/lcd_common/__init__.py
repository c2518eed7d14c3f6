"""Share SE(3), clouds, settings, trajectories and ROS plumbing between the packages."""
