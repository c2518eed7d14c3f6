"""Build a LiDAR map in tiles on the disk, and load what is around the vehicle."""
