"""Know where KITTI's car carries its sensors, and when its clocks start."""

import numpy as np

from bags.calibration_file import CalibrationFile
from bags.records import CameraModel, Mounting
from lcd_common import se3

# Height of the velodyne's origin above the road (KITTI's sensor setup drawing).
LIDAR_HEIGHT_M = 1.73
# Stamps of sequences whose clock starts at zero are shifted here, 2001-09-09: ROS reads a stamp of
# zero as "not set".
EPOCH_NS = 1_000_000_000 * 1_000_000_000


def base_from_lidar() -> se3.Array:
    """Return T_base_lidar: base_link on the ground straight below the velodyne, same axes."""
    return se3.from_rotation_translation(np.eye(3), [0.0, 0.0, LIDAR_HEIGHT_M])


def mounted(child: str, T_lidar_child: se3.Array) -> Mounting:
    """Return the mounting of a sensor whose pose is known relative to the velodyne."""
    return Mounting('base_link', child, base_from_lidar() @ T_lidar_child)


def camera_of_projection(
    calibration: CalibrationFile, entry: str, size: tuple[int, int]
) -> tuple[CameraModel, se3.Array]:
    """Split a rectified projection P [3x4] into a pinhole model and T_camera_rectified0.

    P = K [I | t], t being where the rectified camera 0 lies in this camera.
    """
    P = calibration.matrix(entry, 3, 4)
    K = P[:, :3]
    offset = np.linalg.solve(K, P[:, 3])
    model = CameraModel('camera', size[0], size[1], K.copy())
    return model, se3.from_rotation_translation(np.eye(3), offset)
