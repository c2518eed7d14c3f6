"""Measure live ROS nodes."""
