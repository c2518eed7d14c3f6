"""Subscribe the EKF's poses, odometry, twists and fixes, and make observations of them."""

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import NavSatFix

from cmrnet_ekf.ekf.covariance_check import used_covariance
from cmrnet_ekf.ekf.gnss_start import GnssStart, GnssStartConfig
from cmrnet_ekf.ekf.observations import (
    PoseObservation,
    PositionObservation,
    RelativeObservation,
    TwistObservation,
)
from cmrnet_ekf.nodes.ekf_inputs import (
    FixInputConfig,
    OdometryInputConfig,
    PoseInputConfig,
    TwistInputConfig,
    axes_of,
    odometry_growth,
    pose_covariance,
    twist_vector,
)
from cmrnet_ekf.nodes.gnss_datum import GnssDatumConfig, MapDatum
from lcd_common import se3
from lcd_common.errors import ConfigError, DataError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.parameters import declare_config
from lcd_common.settings import config, setting
from lcd_common.stamp_buffer import StampedPose
from lcd_common.stamps import StampGuard, StampVerdict
from lcd_loop_closure.gnss import GnssConfig, usable_covariance
from lcd_loop_closure.nodes.fix_message import fix_from_message

if TYPE_CHECKING:
    from cmrnet_ekf.nodes.ekf_node import EkfNode

Axes = tuple[bool, ...]


@config
class EkfInputsConfig:
    """Names of the inputs of each kind, separated by blanks; each has a group of its name."""

    poses: str = setting('camera', 'names of the inputs that give poses')
    odometry: str = setting('odom', 'names of the inputs that give odometry')
    twists: str = setting('', 'names of the inputs that give twists')
    fixes: str = setting('gps', 'names of the inputs that give satellite fixes')


class EkfSources:
    """Read inputs for a node, and start it where its parameter `start_from` says so."""

    def __init__(self, node: 'EkfNode', gnss_start: GnssStartConfig) -> None:
        self._node = node
        self._names: list[str] = []
        self._start = GnssStart(gnss_start)
        self._datum = MapDatum(declare_config(node, GnssDatumConfig, 'datum'))
        self._last_odometry: dict[str, StampedPose] = {}
        self._guards: dict[str, StampGuard] = {}
        inputs = declare_config(node, EkfInputsConfig)
        kinds: list[tuple[str, Any, Any, Callable[..., None], int]] = [
            (inputs.poses, PoseInputConfig, PoseWithCovarianceStamped, self.on_pose, 6),
            (inputs.odometry, OdometryInputConfig, Odometry, self.on_odometry, 6),
            (inputs.twists, TwistInputConfig, TwistWithCovarianceStamped, self.on_twist, 6),
            (inputs.fixes, FixInputConfig, NavSatFix, self.on_fix, 3),
        ]
        for names, cls, message_class, callback, rows in kinds:
            for name in names.split():
                self._subscribe(name, cls, message_class, callback, rows)

    def clear(self) -> None:
        """Forget what was on the way (after a clock jump, a reset)."""
        self._start.clear()
        self._last_odometry.clear()
        self._guards = {
            name: StampGuard(guard.tolerance_ns) for name, guard in self._guards.items()
        }

    def on_pose(
        self, name: str, settings: PoseInputConfig, axes: Axes, message: PoseWithCovarianceStamped
    ) -> None:
        """Observe an absolute pose; the first full one may start the filter."""
        node = self._node
        frame, expected = message.header.frame_id, node.config.world_frame
        if frame != expected:
            text = f'{name} is in {frame!r}, expected {expected}: set world_frame'
            node.reject(name, 'wrong frame', text)
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        T_map_base = messages.transform_from_pose(message.pose.pose)
        sigmas = settings.sigma_position, settings.sigma_rotation
        covariance = pose_covariance(T_map_base, message.pose.covariance, sigmas, axes, name)
        waiting = node.ekf is not None and not node.ekf.started
        if waiting and node.config.start_from == 'pose' and all(axes):
            node.start(stamp_ns, T_map_base, covariance)
            return
        node.observe(
            PoseObservation(
                stamp_ns,
                name,
                T_map_base,
                settings.covariance_scale * covariance,
                node.T_body_base,
                axes,
                settings.correlation_time,
            )
        )

    def on_odometry(
        self, name: str, settings: OdometryInputConfig, axes: Axes, message: Odometry
    ) -> None:
        """Observe the motion since the last message, or the twist; correct odom by the estimate."""
        node = self._node
        T_body_child = self._mounting(name, message.child_frame_id or node.config.base_frame)
        if T_body_child is None:
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        pose = StampedPose(stamp_ns, *odometry_growth(message))
        last = self._last_odometry.get(name)
        if last is None or stamp_ns > last.stamp_ns:
            self._last_odometry[name] = pose
        running = node.ekf is not None and node.ekf.started
        if settings.use in ('motion', 'both') and running and last is not None:
            self._observe_motion(name, settings, axes, (last, pose), T_body_child)
        if settings.use in ('twist', 'both') and running:
            self._observe_twist(
                name, settings.correlation_time, axes, stamp_ns, message.twist, T_body_child
            )
        if node.ekf is not None and name == next(iter(self._last_odometry)):
            estimate = node.ekf.estimate(stamp_ns)
            if estimate is not None:
                T_odom_base = pose.T_odom_base @ se3.inverse(T_body_child) @ node.T_body_base
                node.outputs.correct_odometry(estimate, node.T_body_base, T_odom_base)

    def on_twist(
        self, name: str, settings: TwistInputConfig, axes: Axes, message: TwistWithCovarianceStamped
    ) -> None:
        """Observe a twist."""
        T_body_sensor = self._mounting(name, message.header.frame_id)
        if T_body_sensor is not None:
            stamp_ns = messages.stamp_ns(message.header.stamp)
            self._observe_twist(
                name, settings.correlation_time, axes, stamp_ns, message.twist, T_body_sensor
            )

    def on_fix(self, name: str, settings: FixInputConfig, axes: Axes, message: NavSatFix) -> None:
        """Observe the antenna's position; two fixes may start the filter."""
        node = self._node
        T_body_antenna = self._mounting(name, message.header.frame_id)
        if T_body_antenna is None:
            return
        fix = fix_from_message(message)
        limits = GnssConfig(
            minimum_sigma=settings.minimum_sigma, maximum_sigma=settings.maximum_sigma
        )
        position, covariance = self._datum.in_map(fix, usable_covariance(fix, limits))
        lever = T_body_antenna[:3, 3]
        if node.ekf is not None and not node.ekf.started:
            if node.config.start_from == 'gnss':
                arm = (se3.inverse(node.T_body_base) @ T_body_antenna)[:3, 3]
                start = self._start.add(fix.stamp_ns, position, covariance, arm)
                if start is not None:
                    node.start(start.stamp_ns, start.T_map_base, start.covariance, start)
            return
        node.observe(
            PositionObservation(
                fix.stamp_ns, name, position, covariance, lever, axes, settings.correlation_time
            )
        )

    def _observe_motion(
        self,
        name: str,
        settings: OdometryInputConfig,
        axes: Axes,
        poses: tuple[StampedPose, StampedPose],
        T_body_child: se3.Array,
    ) -> None:
        last, pose = poses
        motion = se3.inverse(last.T_odom_base) @ pose.T_odom_base
        if settings.sigma_position:
            sigmas = settings.sigma_position, settings.sigma_rotation
            covariance: se3.Array | None = pose_covariance(motion, np.zeros(36), sigmas, axes, name)
        elif last.covariance is None or pose.covariance is None:
            covariance = None
        else:
            covariance = se3.relative_covariance(last.covariance, motion, pose.covariance)
        if covariance is None:
            text = (
                f'{name}: the covariance does not grow along the way, so that of the motion is '
                f'unknown: set {name}.sigma_position and {name}.sigma_rotation'
            )
            self._node.reject(name, 'covariance unknown', text)
            return
        self._node.observe(
            RelativeObservation(
                pose.stamp_ns,
                name,
                last.stamp_ns,
                motion,
                covariance,
                T_body_child,
                axes,
                settings.correlation_time,
            )
        )

    def _observe_twist(
        self,
        name: str,
        correlation_s: float,
        axes: Axes,
        stamp_ns: int,
        twist: Any,
        T_body_sensor: se3.Array,
    ) -> None:
        given = np.asarray(twist.covariance, np.float64).reshape(6, 6)
        self._node.observe(
            TwistObservation(
                stamp_ns,
                f'{name} twist' if f'{name} twist' in self._names else name,
                np.where(axes, twist_vector(twist.twist), 0.0),
                used_covariance(given, np.array(axes), name),
                T_body_sensor,
                axes,
                correlation_s,
                self._node.settings.motion.gyroscope_noise,
            )
        )

    def _subscribe(
        self, name: str, cls: Any, message_class: Any, callback: Callable[..., None], rows: int
    ) -> None:
        if name in self._names:
            raise ConfigError(f'two inputs are called {name}: each needs a name of its own')
        node = self._node
        settings = declare_config(node, cls, name)
        axes = axes_of(settings.axes, rows, name)
        absolute = cls in (PoseInputConfig, FixInputConfig)
        self._names.append(name)
        idle = cls is OdometryInputConfig and settings.use == 'nothing'
        needed = not idle or node.config.tf == 'map_to_odom'
        node.health.add(name, settings.timeout if needed else math.inf, absolute=absolute)
        if cls is OdometryInputConfig and settings.use == 'both':
            # Two kinds of observation of one message are two inputs to the gate, but only one can
            # be silent.
            self._names.append(f'{name} twist')
            node.health.add(f'{name} twist', math.inf)
        tolerance_ns = max(round(node.settings.history.length * 1e9), 1_000_000_000)
        self._guards[name] = StampGuard(tolerance_ns)
        profile = qos.SENSOR_FAST if message_class is NavSatFix else qos.RELIABLE
        take = partial(self.take, name, partial(callback, name, settings, axes))
        node.create_subscription(message_class, settings.topic, take, profile)

    def take(self, name: str, read: Callable[[Any], None], message: Any) -> None:
        """Hand a message to its reader; what that cannot use is counted."""
        node = self._node
        if not node.enabled:
            node.diagnostics.count(f'ignored {name}: disabled')
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        node.health.came(name, stamp_ns)
        if node.is_ahead(stamp_ns):
            text = f'{name} is stamped far ahead of imu: are the clocks the same?'
            node.reject(name, 'ahead of imu', text)
            return
        jumped = self._guards[name].check(stamp_ns) is StampVerdict.JUMPED_BACK
        if jumped and not node.config.use_imu:
            node.jumped_back(stamp_ns)
        try:
            read(message)
        except DataError as error:
            node.reject(name, 'unusable', str(error))

    def _mounting(self, name: str, frame: str) -> se3.Array | None:
        """Return T_body_frame; None, counted and said, when /tf_static does not know it."""
        node = self._node
        T_base_frame = node.transforms.lookup(node.config.base_frame, frame)
        if T_base_frame is None:
            base_frame = node.config.base_frame
            text = f'/tf_static does not connect {base_frame} with {frame!r} ({name})'
            node.reject(name, 'no transform', text)
            return None
        return node.T_body_base @ T_base_frame
