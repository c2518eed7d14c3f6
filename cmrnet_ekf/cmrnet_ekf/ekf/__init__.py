"""The vehicle's EKF: an error-state filter on the group of poses and velocities."""
