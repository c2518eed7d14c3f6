"""See a point cloud map as a camera would: projection, z-buffer, occlusion filter."""
