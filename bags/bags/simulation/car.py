"""Mount the sensors of the simulated car as KITTI's are (calibration of 2011-10-03)."""

import numpy as np

from bags.kitti_car import mounted
from bags.records import CameraModel, Mounting
from lcd_common import se3

# Projections of the rectified cameras 0 and 2 (grey and colour, left) and the velodyne in camera 0:
# calib.txt of KITTI odometry's sequence 00.
P0 = np.array([[718.856, 0.0, 607.1928, 0.0], [0.0, 718.856, 185.2157, 0.0], [0.0, 0.0, 1.0, 0.0]])
P2 = P0 + np.array([[0, 0, 0, 45.38225], [0, 0, 0, -0.1130887], [0, 0, 0, 0.003779761]])
TR = np.array(
    [
        [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03, -1.198459927713e-02],
        [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01, -5.403984729748e-02],
        [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03, -2.921968648686e-01],
    ]
)
IMAGE_SIZE = (1241, 376)


def _rigid(matrix: np.ndarray) -> se3.Array:
    """Make the rotation of a printed matrix exact."""
    u, _, vt = np.linalg.svd(matrix[:, :3])
    return se3.from_rotation_translation(u @ vt, matrix[:, 3])


T_CAM0_LIDAR = _rigid(TR)
_T_CAM2_CAM0 = se3.from_rotation_translation(np.eye(3), np.linalg.solve(P2[:, :3], P2[:, 3]))
_T_LIDAR_IMU = _rigid(
    np.array(
        [
            [9.999976e-01, 7.553071e-04, -2.035826e-03, -8.086759e-01],
            [-7.854027e-04, 9.998898e-01, -1.482298e-02, 3.195559e-01],
            [2.024406e-03, 1.482454e-02, 9.998881e-01, -7.997231e-01],
        ]
    )
)

LIDAR = mounted('lidar', np.eye(4))
CAMERA = mounted('camera', se3.inverse(_T_CAM2_CAM0 @ T_CAM0_LIDAR))
IMU = mounted('imu', _T_LIDAR_IMU)
# KITTI gives the fix at the inertial unit; so it is here.
GPS = Mounting('base_link', 'gps', IMU.T_parent_child)


def camera_model() -> CameraModel:
    """Return the calibration of KITTI's left colour camera, rectified."""
    return CameraModel('camera', *IMAGE_SIZE, P2[:, :3].copy())
