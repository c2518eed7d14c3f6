"""Locate a camera in a LiDAR map with uncertainty, and fuse that with the vehicle's sensors."""
