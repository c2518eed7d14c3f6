"""The ekf node in lock-step, with a drive to follow."""

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from benchmarks.ekf_drive import ReferenceDrive, reference_drive
from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_loop_closure.gnss import GnssDatum

START_NS = 1_000_000_000_000
DRIVE = reference_drive(30.0, start_ns=START_NS)
# The IMU is mounted askew, away from base_link.
T_BASE_IMU = se3.from_rotation_translation(se3.so3_exp([0.1, -0.05, 0.8]), [0.3, -0.2, 0.9])
T_BASE_ANTENNA = se3.from_rotation_translation(np.eye(3), [-0.4, 0.1, 1.5])
CAMERA = np.diag(np.array([0.2, 0.1, 0.1, 0.004, 0.004, 0.006]) ** 2)
# A noise-free drive: its samples are never frozen, however smooth they are.
# The errors that these inputs are given are independent.
QUIET = {'frozen_imu': 0, 'fixes': '', 'odometry': '', 'camera.correlation_time': 0.0}


def base_pose(k: int) -> se3.Array:
    """Return the truth: the drive is that of the IMU."""
    return DRIVE.T_map_body[k] @ se3.inverse(T_BASE_IMU)


def stamp(k: int) -> int:
    return int(DRIVE.stamps_ns[k])


def imu(k: int, drive: ReferenceDrive = DRIVE, **changes: Any) -> Imu:
    message = Imu(header=messages.header(int(drive.stamps_ns[k]), 'imu'))
    rates, forces = drive.turn_rates[k], drive.forces[k]
    message.angular_velocity = Vector3(x=rates[0], y=rates[1], z=rates[2])
    message.linear_acceleration = Vector3(x=forces[0], y=forces[1], z=forces[2])
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def camera(k: int, *, off: Any = 0.0, frame: str = 'map') -> PoseWithCovarianceStamped:
    T = base_pose(k).copy()
    T[:3, 3] += off
    return PoseWithCovarianceStamped(
        header=messages.header(stamp(k), frame), pose=messages.pose_with_covariance(T, CAMERA)
    )


class Bench:
    """A node in lock-step, and what it published."""

    def __init__(self, node: EkfNode, namespace: str = '') -> None:
        self.node, self.prefix = node, namespace
        self.lockstep = LockStep([node])
        self.odometry: list[Odometry] = []
        self.tf: list[TransformStamped] = []
        self.lockstep.listen(f'{namespace}/odometry/filtered', self.odometry.append)
        self.lockstep.listen('/tf', lambda message: self.tf.extend(message.transforms))
        mounts = [
            TransformStamped(
                header=messages.header(0, 'base_link'),
                child_frame_id=child,
                transform=messages.transform_message(T),
            )
            for child, T in (('imu', T_BASE_IMU), ('gps', T_BASE_ANTENNA))
        ]
        self.lockstep.feed('/tf_static', TFMessage(transforms=mounts))

    def feed(self, topic: str, message: Any) -> None:
        self.lockstep.feed(f'{self.prefix}/{topic}', message)

    def drive(self, first: int, last: int, *, camera_every: int = 10) -> None:
        for k in range(first, last):
            if k % 100 == 0:
                self.lockstep.set_time(stamp(k))
            self.feed('imu', imu(k))
            if camera_every and k % camera_every == 0:
                self.feed('camera_pose', camera(k))

    def off(self, k: int) -> float:
        """Return how far the last output, which must be at sample k, is off the truth."""
        message = self.odometry[-1]
        assert messages.stamp_ns(message.header.stamp) == stamp(k)
        T = messages.transform_from_pose(message.pose.pose)
        return se3.distance(T, base_pose(k))[0]

    def problems(self) -> tuple[bytes, str]:
        self.node.check()
        status = self.node.diagnostics.status()
        return status.level, status.message


def odom(k: int, T_map_odom: se3.Array, covariance: se3.Array | None) -> Odometry:
    T = se3.inverse(T_map_odom) @ base_pose(k)
    return Odometry(
        header=messages.header(stamp(k), 'odom'),
        child_frame_id='base_link',
        pose=messages.pose_with_covariance(T, covariance),
    )


def fix(k: int, datum: GnssDatum) -> NavSatFix:
    east, north, up = (base_pose(k) @ T_BASE_ANTENNA)[:3, 3]
    radius = 6371000.0
    where = np.array(
        [
            datum.latitude_deg + np.degrees(north / radius),
            datum.longitude_deg
            + np.degrees(east / radius / np.cos(np.radians(datum.latitude_deg))),
            datum.altitude_m + up,
        ]
    )
    for _ in range(4):  # onto the ellipsoid
        off = np.array([east, north, up]) - datum.enu(*where)
        where += off * [0, 0, 1]
        where[0] += np.degrees(off[1] / radius)
        where[1] += np.degrees(off[0] / radius / np.cos(np.radians(datum.latitude_deg)))
    return NavSatFix(
        header=messages.header(stamp(k), 'gps'),
        status=NavSatStatus(status=NavSatStatus.STATUS_FIX),
        latitude=where[0],
        longitude=where[1],
        altitude=where[2],
        position_covariance=(0.5**2 * np.eye(3)).ravel(),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN,
    )
