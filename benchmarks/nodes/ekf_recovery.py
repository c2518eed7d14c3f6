"""Let the ekf node live through mishaps: no camera, wrong poses, a clock that jumps back."""

from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from benchmarks.ekf_consistency import CAMERA_SIGMAS, MOTION, imu_of
from benchmarks.ekf_drive import RATE_HZ, reference_drive
from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_common.nodes.parameters import overrides

_SECONDS = 40.0
# Recovered: three standard deviations of the camera's position at the end.
_GOOD_M = 3.0 * float(np.linalg.norm(CAMERA_SIGMAS[:3]))


class _Vehicle:
    """A node with an IMU and a camera that see the drive with noise."""

    def __init__(self) -> None:
        self.node = EkfNode(
            parameter_overrides=overrides(
                odometry='',
                fixes='',
                publish_rate=10.0,
                camera__correlation_time=0.0,  # the errors made here are independent
                motion__accelerometer_noise=MOTION.accelerometer_noise,
                motion__gyroscope_noise=MOTION.gyroscope_noise,
                motion__accelerometer_walk=MOTION.accelerometer_walk,
                motion__gyroscope_walk=MOTION.gyroscope_walk,
            )
        )
        self.drive = reference_drive(_SECONDS, start_ns=1_000_000_000_000)
        self._rng = np.random.default_rng(0)
        self._imu = imu_of(self.drive, self._rng)
        self.lockstep = LockStep([self.node])
        self._outputs: dict[int, se3.Array] = {}
        self.lockstep.listen('/odometry/filtered', self._take)
        mount = TransformStamped(
            header=messages.header(0, 'base_link'),
            child_frame_id='imu',
            transform=messages.transform_message(np.eye(4)),
        )
        self.lockstep.feed('/tf_static', TFMessage(transforms=[mount]))

    def go(self, begin_s: float, end_s: float, camera: str = 'right') -> None:
        """Drive a stretch; the camera is `right`, `wrong` (anywhere within 30 m) or `away`."""
        for k in range(round(begin_s * RATE_HZ), round(end_s * RATE_HZ)):
            stamp_ns = int(self.drive.stamps_ns[k])
            message = Imu(header=messages.header(stamp_ns, 'imu'))
            rates, forces = self._imu.turn_rates[k], self._imu.forces[k]
            message.angular_velocity = Vector3(x=rates[0], y=rates[1], z=rates[2])
            message.linear_acceleration = Vector3(x=forces[0], y=forces[1], z=forces[2])
            self.lockstep.feed('/imu', message)
            if k % 10 == 0 and camera != 'away':
                T = self.drive.T_map_body[k] @ se3.exp(-self._rng.normal(size=6) * CAMERA_SIGMAS)
                if camera == 'wrong':
                    T[:2, 3] += self._rng.uniform(-30, 30, 2)
                covariance = np.diag(CAMERA_SIGMAS**2)
                pose = messages.pose_with_covariance(T, covariance)
                header = messages.header(stamp_ns, 'map')
                self.lockstep.feed(
                    '/camera_pose', PoseWithCovarianceStamped(header=header, pose=pose)
                )

    def errors(self, begin_s: float, end_s: float) -> se3.Array:
        """Return the errors of what it published about a stretch, metres."""
        stamps = self.drive.stamps_ns[round(begin_s * RATE_HZ) : round(end_s * RATE_HZ)]
        off = [
            se3.distance(self._outputs[stamp], self.drive.T_map_body[k])[0]
            for k, stamp in enumerate(stamps.tolist(), start=round(begin_s * RATE_HZ))
            if stamp in self._outputs
        ]
        return np.array(off)

    def _take(self, message: Odometry) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._outputs[stamp_ns] = messages.transform_from_pose(message.pose.pose)


def recoveries() -> dict[str, dict[str, Any]]:
    """Return, for each mishap, the largest error in it and the error five seconds after it."""
    cases: dict[str, Callable[[_Vehicle], tuple[float, float, float]]] = {
        'five_seconds_without_camera': _without_camera,
        'hundred_wrong_poses': _wrong_poses,
        'clock_jump_back': _jump,
    }
    if not rclpy.ok():
        rclpy.init()
    figures = {}
    for name, case in cases.items():
        vehicle = _Vehicle()
        begin, end, after = case(vehicle)
        during = vehicle.errors(begin, end)
        left = float(vehicle.errors(after, after + 1.0).max())
        figures[name] = {
            'largest_error_m': float(during.max()) if len(during) else None,
            'error_after_m': left,
            'recovered': left < _GOOD_M,
        }
        vehicle.node.destroy_node()
    return figures


def _without_camera(vehicle: _Vehicle) -> tuple[float, float, float]:
    vehicle.go(0.0, 10.0)
    vehicle.go(10.0, 15.0, camera='away')
    vehicle.go(15.0, 21.0)
    return 10.0, 15.0, 20.0


def _wrong_poses(vehicle: _Vehicle) -> tuple[float, float, float]:
    vehicle.go(0.0, 10.0)
    vehicle.go(10.0, 20.0, camera='wrong')  # 100 poses
    vehicle.go(20.0, 26.0)
    return 10.0, 20.0, 25.0


def _jump(vehicle: _Vehicle) -> tuple[float, float, float]:
    vehicle.go(15.0, 25.0)
    vehicle.go(0.0, 6.0)
    return 0.0, 5.0, 5.0
