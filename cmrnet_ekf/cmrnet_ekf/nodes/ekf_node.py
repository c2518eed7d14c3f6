"""Fuse an IMU with poses, odometry, twists and satellite fixes: where the vehicle is, how surely.

    ros2 run cmrnet_ekf ekf --ros-args --params-file config/ekf.yaml
    ros2 run cmrnet_ekf ekf --ros-args -p "poses:=''" -p "odometry:=''" -p start_from:=gnss

Subscribes  imu (sensor_msgs/Imu), /tf_static (where the sensors sit), initialpose
            (geometry_msgs/PoseWithCovarianceStamped: where the vehicle is, as ~/set_pose), and the
            inputs that the parameters poses, odometry, twists and fixes name; the topic of each and
            how it is used are in a group of parameters of its name:
            poses     camera: camera_pose (geometry_msgs/PoseWithCovarianceStamped)
            odometry  odom: odom (nav_msgs/Odometry)
            twists    (geometry_msgs/TwistWithCovarianceStamped)
            fixes     gps: gps/fix (sensor_msgs/NavSatFix)
Publishes   odometry/filtered (nav_msgs/Odometry), filtered_pose
            (geometry_msgs/PoseWithCovarianceStamped), /tf (tf: world_to_base, or map_to_odom with
            an odometry input), /diagnostics
Services    ~/set_pose (lcd_msgs/SetPose), ~/reset (std_srvs/Trigger: forget everything and start
            anew), ~/enable (std_srvs/SetBool)

Input may be late by history.length: it counts as if it had come in time. What cannot be used is
dropped, counted by cause in the diagnostics, and said. Parameters: config/ekf.yaml.
"""

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import Imu
from std_srvs.srv import SetBool, Trigger

from cmrnet_ekf.ekf.ekf_settings import EkfSettings
from cmrnet_ekf.ekf.frozen_imu import FrozenImu
from cmrnet_ekf.ekf.gnss_start import GnssStartConfig, StartPose
from cmrnet_ekf.ekf.observations import Observation
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf
from cmrnet_ekf.nodes.ekf_health import EkfHealth, EkfHealthConfig
from cmrnet_ekf.nodes.ekf_inputs import imu_sample, pose_covariance, stated_covariance
from cmrnet_ekf.nodes.ekf_outputs import EkfOutputs
from cmrnet_ekf.nodes.ekf_sources import EkfSources
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.parameters import declare_config
from lcd_common.nodes.spin import run_node
from lcd_common.nodes.transforms import StaticTransforms
from lcd_common.settings import config, setting
from lcd_common.stamps import StampGuard, StampVerdict
from lcd_loop_closure.nodes.group_parameters import declare_groups
from lcd_msgs.srv import SetPose

_ALL = (True,) * 6
# So many samples in a row that are older than the history are a clock that jumped.
_LATE_SAMPLES = 20


@config
class EkfNodeConfig:
    """How the node runs; groups beside these say how the vehicle moves and what its inputs are."""

    world_frame: str = setting('map', 'frame of the estimate and of pose inputs')
    odom_frame: str = setting('odom', 'frame of odometry, for tf: map_to_odom')
    base_frame: str = setting('base_link', 'frame of the vehicle')
    tf: str = setting(
        'world_to_base',
        'edge that this node owns: world_frame -> base_frame, world_frame -> odom_frame, or none',
        choices=('world_to_base', 'map_to_odom', 'none'),
    )
    use_imu: bool = setting(True, 'move by imu; false: coast from observation to observation')
    frozen_imu: int = setting(
        10,
        'samples in a row that repeat or lie on a line, after which imu is frozen: its samples are '
        'guesses then; 0 for a simulated sensor without noise',
        low=0,
    )
    publish_rate: float = setting(
        50.0, 'outputs a second, at the stamps of the input; 0: at each', unit='Hz', low=0.0
    )
    predict_to_now: bool = setting(
        False, 'publish for the current time by a timer (publish_rate) instead'
    )
    start_from: str = setting(
        'pose',
        'start with the first full pose input, with the course between two fixes, or only by '
        'set_pose',
        choices=('pose', 'gnss', 'set_pose'),
    )
    on_time_jump: str = setting(
        'restart',
        'when the clock jumps back: start anew, or go on at the last pose, less sure of it',
        choices=('restart', 'keep'),
    )
    enabled: bool = setting(True, 'whether it takes input before ~/enable is called')


class EkfNode(Node):
    """See the module's documentation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('ekf', **node_options)
        self.config = declare_config(self, EkfNodeConfig)
        self.settings = declare_groups(self, EkfSettings())
        self.diagnostics = Diagnostics(self)
        self.health = EkfHealth(
            self, self.diagnostics, declare_config(self, EkfHealthConfig, 'health')
        )
        self.transforms = StaticTransforms(self)
        self.enabled = self.config.enabled
        self.ekf: VehicleEkf | None = None
        self.T_body_base = np.eye(4)
        self._imu_frame = ''
        self._imu_astray = False
        self._frozen = FrozenImu(self.config.frozen_imu)
        self._guard = self._new_guard()
        self._late_samples = 0
        self._published_ns: int | None = None
        frames = (self.config.world_frame, self.config.odom_frame, self.config.base_frame)
        self.outputs = EkfOutputs(self, self.diagnostics, frames, self.config.tf)
        self.sources = EkfSources(self, declare_config(self, GnssStartConfig, 'gnss_start'))
        if self.config.use_imu:
            self.health.add('imu', self.health.settings.imu_timeout)
            self.create_subscription(Imu, 'imu', self.on_imu, qos.SENSOR_FAST)
        else:
            self._make_filter(np.eye(4))
        self.create_subscription(
            PoseWithCovarianceStamped, 'initialpose', self.on_initialpose, qos.RELIABLE
        )
        self.create_service(SetPose, '~/set_pose', self.on_set_pose)
        self.create_service(Trigger, '~/reset', self.on_reset)
        self.create_service(SetBool, '~/enable', self.on_enable)
        self.create_timer(1.0, self.check)
        if self.config.predict_to_now:
            rate = self.config.publish_rate or 50.0
            self.create_timer(1.0 / rate, self.publish_now)
        self.diagnostics.watch('entries replayed', lambda: self.ekf.replayed if self.ekf else 0)

    def on_imu(self, message: Imu) -> None:
        """Move the estimate."""
        if not self.enabled:
            self.diagnostics.count('ignored imu: disabled')
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self.health.came('imu', stamp_ns)
        if not self._knows_imu(message.header.frame_id):
            return
        if self._guard.check(stamp_ns) is StampVerdict.JUMPED_BACK:
            self._jump(stamp_ns)
        assert self.ekf is not None
        try:
            sample = imu_sample(message)
            frozen = self._frozen.check(*sample)
            self.diagnostics.count('imu samples frozen', int(frozen))
            self.ekf.add_imu(stamp_ns, *sample, doubtful=frozen)
            self.diagnostics.error(
                'frozen', 'imu is frozen: its samples repeat' if frozen else None
            )
        except DataError as error:
            self.reject('imu', 'unusable', str(error))
            self._late_samples += 'older' in str(error)
            if self._late_samples >= _LATE_SAMPLES:
                self._jump(stamp_ns)
            return
        self._late_samples = 0
        self.publish_due()

    def on_initialpose(self, message: PoseWithCovarianceStamped) -> None:
        """Start at a pose that a person or another localization gives."""
        try:
            self.set_pose(message)
        except DataError as error:
            self.reject('initialpose', 'unusable', str(error))

    def on_set_pose(self, request: SetPose.Request, response: SetPose.Response) -> SetPose.Response:
        """Start at a pose, and say whether that was possible."""
        try:
            self.set_pose(request.pose)
        except DataError as error:
            response.success, response.message = False, str(error)
            return response
        response.success, response.message = True, 'the estimate starts from this pose'
        return response

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget everything; the next start is as the first."""
        self.restart()
        response.success, response.message = True, self._waits_for() or 'started'
        return response

    def on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Take input, or ignore it (then the estimate is forgotten: it would be out of date)."""
        if self.enabled and not request.data:
            self.restart()
        elif request.data and not self.enabled:
            self.health.restarted()  # nothing was heard meanwhile
        self.enabled = request.data
        response.success = True
        response.message = 'enabled' if self.enabled else 'disabled: all input is ignored'
        return response

    def set_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Start at a pose of base_frame in world_frame; a stamp of zero is the newest input's.

        Raises:
            DataError: the frame is another one, the pose or its covariance is none, or there is no
                time to start at yet.
        """
        frame, expected = message.header.frame_id, self.config.world_frame
        if frame != expected:
            raise DataError(f'a start pose must be in {expected}, got one in {frame!r}')
        if self.ekf is None:
            raise DataError(self._waits_for() or 'no filter yet')
        T_map_base = messages.transform_from_pose(message.pose.pose)
        covariance = None
        if np.any(message.pose.covariance):
            start = self.ekf.settings.start
            stated = stated_covariance(message.pose.covariance, start.position, start.rotation)
            covariance = pose_covariance(T_map_base, stated, (0.0, 0.0), _ALL, 'start pose')
        stamp_ns = messages.stamp_ns(message.header.stamp)
        newest_ns = self.ekf.newest_ns or self._guard.newest_ns
        # What a person clicks carries the time of the screen: it means now.
        if newest_ns is not None and not 0 <= newest_ns - stamp_ns <= self._history_ns():
            stamp_ns = newest_ns
        if stamp_ns == 0:
            raise DataError('a start pose without a stamp needs some input before it')
        self.start(stamp_ns, T_map_base, covariance)

    def start(
        self,
        stamp_ns: int,
        T_map_base: se3.Array,
        covariance: se3.Array | None,
        start: StartPose | None = None,
    ) -> None:
        """Start the filter at a pose of the base, covariance in the base's axes."""
        assert self.ekf is not None
        T_body_base = self.T_body_base
        if covariance is not None:
            A = se3.adjoint(T_body_base)
            covariance = A @ covariance @ A.T
        velocity = None if start is None else start.velocity_map
        sigma = None if start is None else start.velocity_sigma
        T_map_body = T_map_base @ se3.inverse(T_body_base)
        self.ekf.start(stamp_ns, T_map_body, covariance, velocity, sigma)
        self.health.restarted()
        self.diagnostics.count('starts')
        x, y, z = T_map_base[:3, 3]
        self.get_logger().info(
            f'starting at x {x:.1f} y {y:.1f} z {z:.1f}, yaw {np.degrees(se3.yaw(T_map_base)):.0f}°'
        )
        self.publish_due()

    def observe(self, seen: Observation) -> None:
        """Correct by an observation; one that cannot be used is counted."""
        if self.ekf is None:
            self.reject(seen.source, 'not started', self._waits_for() or 'no filter yet')
            return
        try:
            verdict = self.ekf.observe(seen)
        except DataError as error:
            cause = 'unusable' if self.ekf.started else 'not started'
            self.reject(seen.source, cause, str(error))
            return
        self.health.judged(verdict)
        if not self.config.use_imu:
            self.publish_due()

    def publish_due(self) -> None:
        """Publish the newest estimate, if it is time for that."""
        newest_ns = None if self.ekf is None else self.ekf.newest_ns
        if newest_ns is None or self.config.predict_to_now:
            return
        if self._published_ns is not None and self.config.publish_rate:
            period_ns = 1e9 / self.config.publish_rate
            # Half a period of tolerance: stamps jitter about the rate.
            if 0 <= newest_ns - self._published_ns < 0.95 * period_ns:
                return
        self._published_ns = newest_ns
        self._publish(None)

    def publish_now(self) -> None:
        """Publish the estimate predicted to the node's clock."""
        self._publish(int(self.get_clock().now().nanoseconds))

    def check(self) -> None:
        """Keep the diagnostics true."""
        self.outputs.check_authority()
        self.health.check(self.ekf, enabled=self.enabled, waits_for=self._waits_for())

    def restart(self) -> None:
        """Forget the estimate and everything on the way."""
        if self.ekf is not None:
            self.ekf.reset()
        self._guard = self._new_guard()
        self._frozen.clear()
        self._late_samples, self._published_ns = 0, None
        self.sources.clear()
        self.health.restarted()

    def reject(self, what: str, cause: str, text: str) -> None:
        """Count and say what cannot be used."""
        self.diagnostics.count(f'rejected {what}: {cause}')
        self.get_logger().warning(text, throttle_duration_sec=5.0)

    def is_ahead(self, stamp_ns: int) -> bool:
        """Tell whether a stamp is further ahead of a living IMU than input may be late.

        The estimate would run ahead with it, and the samples would come too late.
        """
        newest_ns = self._guard.newest_ns
        if not self.config.use_imu or newest_ns is None or self.health.is_silent('imu'):
            return False
        return stamp_ns - newest_ns > self._history_ns()

    def jumped_back(self, stamp_ns: int) -> None:
        """Act on a clock that jumped back, seen by an input where there is no imu."""
        self._jump(stamp_ns)

    def _publish(self, stamp_ns: int | None) -> None:
        estimate = None if self.ekf is None else self.ekf.estimate(stamp_ns)
        if estimate is not None:
            self.outputs.publish(estimate, self.T_body_base)

    def _knows_imu(self, frame: str) -> bool:
        if self.ekf is not None and frame == self._imu_frame:
            if self._imu_astray:
                self._imu_astray = False
                self.diagnostics.error('imu transform', None)
            return True
        base_frame = self.config.base_frame
        T_body_base = self.transforms.lookup(frame, base_frame)
        problem = None
        if T_body_base is None:
            problem = f'/tf_static does not connect {base_frame} with {frame} (imu): no estimate'
            self.reject('imu', 'no transform', problem)
        elif self.ekf is not None:
            problem = f'imu is in {frame}, but it began in {self._imu_frame}: one imu only'
            self.reject('imu', 'other frame', problem)
        else:
            self._imu_frame = frame
            self._make_filter(T_body_base)
        self._imu_astray = problem is not None
        self.diagnostics.error('imu transform', problem)
        return problem is None

    def _make_filter(self, T_body_base: se3.Array) -> None:
        self.T_body_base = T_body_base
        self.ekf = VehicleEkf(self.settings, T_body_base)

    def _jump(self, stamp_ns: int) -> None:
        assert self.ekf is not None
        last = self.ekf.estimate()
        self.diagnostics.count('clock jumps')
        self.get_logger().warning(
            'the stamps jumped back (a looped bag, a restarted simulation): '
            + ('starting again' if self.config.on_time_jump == 'restart' else 'going on')
            + f' (on_time_jump: {self.config.on_time_jump})'
        )
        self.restart()
        self._guard.check(stamp_ns)
        if last is not None and self.config.on_time_jump == 'keep':
            self.start(stamp_ns, last.T_map_body @ self.T_body_base, None)

    def _waits_for(self) -> str | None:
        if self.ekf is None:
            return 'waiting for imu and for its place on /tf_static (or set use_imu to false)'
        if self.ekf.started:
            return None
        wanted = {
            'pose': 'a full pose input, initialpose or ~/set_pose',
            'gnss': 'two fixes some way apart, initialpose or ~/set_pose',
            'set_pose': 'initialpose or ~/set_pose',
        }
        return f'waiting for {wanted[self.config.start_from]}'

    def _history_ns(self) -> int:
        return round(self.settings.history.length * 1e9)

    def _new_guard(self) -> StampGuard:
        return StampGuard(max(self._history_ns(), 1_000_000_000))


def main(argv: list[str] | None = None) -> int:
    """Run the node alone."""
    return run_node(EkfNode, __doc__ or '', argv)
