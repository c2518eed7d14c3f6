"""Replay KITTI 00's real IMU and GPS through the ekf node, in lock-step."""

from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TransformStamped, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from benchmarks.ekf_kitti import DATUM, GPS_SIGMA, KittiRecording, Outages, Track
from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_common.nodes.parameters import overrides

# OXTS stands 5 cm behind the rear axle (KITTI's sensor setup drawing).
_AXLE_X = 0.05


def replay(
    drive: KittiRecording, outages: Outages | None, **parameters: object
) -> tuple[Track, dict[str, int]]:
    """Return where the node says that the vehicle is, ten times a second, and its counters."""
    if not rclpy.ok():
        rclpy.init()
    node = EkfNode(
        namespace='/kitti',
        parameter_overrides=overrides(
            poses='',
            odometry='',
            start_from='gnss',
            publish_rate=10.0,
            constraint__axle_x=_AXLE_X,
            datum__latitude=DATUM.latitude_deg,
            datum__longitude=DATUM.longitude_deg,
            datum__altitude=DATUM.altitude_m,
            **parameters,
        ),
    )
    try:
        return _through(node, drive, outages)
    finally:
        node.destroy_node()


def _through(
    node: EkfNode, drive: KittiRecording, outages: Outages | None
) -> tuple[Track, dict[str, int]]:
    lockstep = LockStep([node])
    stamps: list[int] = []
    positions: list[list[float]] = []

    def take(message: Odometry) -> None:
        p = message.pose.pose.position
        stamps.append(messages.stamp_ns(message.header.stamp))
        positions.append([p.x, p.y, p.z])

    lockstep.listen('/kitti/odometry/filtered', take)
    mounts = [
        TransformStamped(
            header=messages.header(0, 'base_link'),
            child_frame_id=child,
            transform=messages.transform_message(np.eye(4)),
        )
        for child in ('imu', 'gps')
    ]
    lockstep.feed('/tf_static', TFMessage(transforms=mounts))
    lost = np.zeros(len(drive.gps_ns), np.bool_)
    if outages is not None:
        lost = outages.lost(drive.gps_ns)
    fixes = [i for i in range(len(drive.gps_ns)) if not lost[i]]
    following = 0
    for k, stamp_ns in enumerate(drive.imu_ns.tolist()):
        while following < len(fixes) and drive.gps_ns[fixes[following]] < stamp_ns:
            i = fixes[following]
            lockstep.feed('/kitti/gps/fix', _fix(int(drive.gps_ns[i]), drive.positions[i]))
            following += 1
        if k % 100 == 0:
            lockstep.set_time(stamp_ns)
        # The callback itself: what the node answers is carried with the next tick of the clock.
        node.on_imu(_imu(stamp_ns, drive.turn_rates[k], drive.forces[k]))
    lockstep.set_time(int(drive.imu_ns[-1]))
    return Track(np.array(stamps), np.array(positions)), node.diagnostics.counts()


def _imu(stamp_ns: int, turn_rate: se3.Array, force: se3.Array) -> Imu:
    message = Imu(header=messages.header(stamp_ns, 'imu'))
    message.angular_velocity = _vector(turn_rate)
    message.linear_acceleration = _vector(force)
    return message


def _vector(values: se3.Array) -> Vector3:
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _fix(stamp_ns: int, position_enu: se3.Array) -> NavSatFix:
    latitude, longitude, altitude = _on_earth(position_enu)
    return NavSatFix(
        header=messages.header(stamp_ns, 'gps'),
        status=NavSatStatus(status=NavSatStatus.STATUS_FIX),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        position_covariance=(GPS_SIGMA**2 * np.eye(3)).ravel(),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN,
    )


def _on_earth(position_enu: se3.Array) -> list[float]:
    """Return latitude, longitude and altitude of a position about the datum (Newton)."""
    where = np.array([DATUM.latitude_deg, DATUM.longitude_deg, DATUM.altitude_m])
    steps: Any = np.diag([1e-5, 1e-5, 1.0])
    for _ in range(4):
        here = DATUM.enu(*where)
        J = np.array([(DATUM.enu(*(where + step)) - here) / step.max() for step in steps]).T
        where = where + np.linalg.solve(J, position_enu - here)
    return [float(v) for v in where]
