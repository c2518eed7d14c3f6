"""Bring satellite fixes and inertial measurements to the graph, where they are wanted."""

from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Imu, NavSatFix

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.parameters import declare_config
from lcd_common.nodes.transforms import StaticTransforms
from lcd_common.stamp_buffer import Paired, StampBuffer, StampedPose
from lcd_loop_closure.gnss import GnssFix
from lcd_loop_closure.imu_preintegration import ImuConfig, ImuSample
from lcd_loop_closure.nodes.fix_message import fix_from_message
from lcd_loop_closure.online_map import OnlineMap

Reject = Callable[[str, str, str], None]


class ExtraSensors:
    """Subscribe `gps/fix` and `imu` for a pose graph node."""

    def __init__(
        self,
        node: Node,
        online_map: OnlineMap,
        transforms: StaticTransforms,
        reject: Reject,
        *,
        use_gps: bool,
        use_imu: bool,
        max_gap_ns: int,
    ) -> None:
        """Subscribe what is wanted.

        Args:
            node: that subscribes.
            online_map: that the measurements belong to.
            transforms: where the sensors sit.
            reject: called with topic, cause and text of what cannot be used.
            use_gps, use_imu: what is wanted.
            max_gap_ns: longest time between odometry messages to interpolate over.
        """
        self._map, self._transforms, self._reject = online_map, transforms, reject
        self._imu_settings = declare_config(node, ImuConfig, 'imu')
        self._fixes: StampBuffer[tuple[GnssFix, se3.Array]] = StampBuffer(100, max_gap_ns)
        self.base_frame = 'base_link'
        if use_gps:
            node.create_subscription(NavSatFix, 'gps/fix', self.on_gps_fix, qos.SENSOR)
        if use_imu:
            node.create_subscription(Imu, 'imu', self.on_imu, qos.SENSOR_FAST)

    @property
    def waiting_fixes(self) -> int:
        """Number of satellite fixes whose odometry has not come."""
        return len(self._fixes)

    def on_gps_fix(self, message: NavSatFix) -> None:
        """Let a fix wait for the odometry at its stamp."""
        try:
            fix = fix_from_message(message)
        except DataError as error:
            self._reject('gps/fix', 'unusable', str(error))
            return
        T_base_antenna = self._mounting('gps/fix', message.header.frame_id)
        if T_base_antenna is not None:
            self._tie(self._fixes.add_item(fix.stamp_ns, (fix, T_base_antenna)))

    def on_imu(self, message: Imu) -> None:
        """Hand a sample to the graph; the first one tells the graph where the sensor sits."""
        T_base_imu = self._mounting('imu', message.header.frame_id)
        if T_base_imu is None:
            return
        if not self._map.use_imu(self._imu_settings, T_base_imu):
            self._reject('imu', 'too late', 'imu: not used in a map that has begun without it')
            return
        turn, force = message.angular_velocity, message.linear_acceleration
        sample = ImuSample(
            messages.stamp_ns(message.header.stamp),
            np.array([turn.x, turn.y, turn.z]),
            np.array([force.x, force.y, force.z]),
        )
        if not self._map.graph.add_imu(sample):
            self._reject('imu', 'unusable', 'imu: a sample is not finite or not newer')

    def add_odometry(self, odometry: StampedPose) -> None:
        """Give waiting fixes their poses."""
        self._tie(self._fixes.add_pose(odometry))

    def rewind(self, stamp_ns: int) -> None:
        """Forget what came before the clock jumped back to a stamp."""
        self._fixes.rewind(stamp_ns)

    def _mounting(self, topic: str, frame_id: str) -> se3.Array | None:
        T_base_sensor = self._transforms.lookup(self.base_frame, frame_id)
        if T_base_sensor is None:
            text = f'/tf_static does not connect {self.base_frame} with {frame_id} ({topic})'
            self._reject(topic, 'no transform', text)
        return T_base_sensor

    def _tie(self, paired: list[Paired[tuple[GnssFix, se3.Array]]]) -> None:
        """Tie satellite fixes to the newest keyframe."""
        for _, why in self._fixes.unpaired:
            self._reject('gps/fix', why.value, f'a fix was dropped: {why.value}')
        self._fixes.unpaired.clear()
        for pair in paired:
            try:
                self._map.add_gnss(*pair.item, pair.pose.T_odom_base)
            except DataError as error:
                self._reject('gps/fix', 'unusable', str(error))
