"""Follow the LiDAR and say where the vehicle is, with an honest covariance.

    ros2 run lcd_loop_closure lidar_odometry --ros-args --params-file config/lidar_odometry.yaml
    ros2 run lcd_loop_closure lidar_odometry --ros-args -r points:=/velodyne -p min_range:=3.0

Subscribes  points (sensor_msgs/PointCloud2: x y z; deskewed where points carry their time),
            /tf_static (where the LiDAR sits; none is needed for a cloud that is in the base frame)
Publishes   odom (nav_msgs/Odometry), /tf odom -> base_link (publish_tf), /diagnostics
Services    ~/reset (std_srvs/Trigger): start again at the origin

Stamps are those of the clouds. The first pose is the origin of odom.
pose.covariance accumulates along the path: the covariance of the motion between two poses is what
it gained between them (lcd_common.se3.relative_covariance). twist is the mean motion since the last
cloud; its covariance times dt^2 is that of this one motion. Between successive poses the latter is
the exact one: successive errors partly cancel, so that a path gains less than the sum of its steps.
A cloud that does not fit the map shows as a motion with a very large covariance.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.parameters import declare_config
from lcd_common.nodes.spin import run_node
from lcd_common.nodes.transforms import StaticTransforms, TransformAuthority
from lcd_common.nodes.worker import Worker
from lcd_common.settings import config, describe, setting
from lcd_loop_closure.lidar_odometry import LidarOdometry, OdometryEstimate
from lcd_loop_closure.nodes.stream_watch import StreamWatch
from lcd_loop_closure.odometry_config import OdometryConfig

# The first pose is exact; zeros would mean unknown in ROS.
_START_COVARIANCE = 1e-12 * np.eye(6)


@config
class LidarOdometryNodeConfig:
    """How the node runs; how sweeps are registered stands beside these."""

    odom_frame: str = setting('odom', 'frame of the poses')
    base_frame: str = setting('base_link', 'frame of the vehicle whose pose is published')
    publish_tf: bool = setting(True, 'broadcast odom_frame -> base_frame on /tf')
    reliable_points: bool = setting(False, 'ask for reliable clouds (replay); else best effort')
    waiting_clouds: int = setting(
        10, 'clouds that may wait for registration; of more the oldest is dropped', low=1
    )
    on_time_jump: str = setting(
        'restart', 'what to do when the clock jumps back', choices=('restart', 'refuse')
    )
    threaded: bool = setting(True, 'work beside the callbacks; false: inside, for lock-step replay')


@dataclass(frozen=True)
class _Scan:
    session: int
    points: PointCloud2


class LidarOdometryNode(Node):
    """See the module's documentation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('lidar_odometry', **node_options)
        self.config = declare_config(self, LidarOdometryNodeConfig)
        self._odometry = LidarOdometry(declare_config(self, OdometryConfig))
        self.diagnostics = Diagnostics(self)
        self._transforms = StaticTransforms(self)
        self._tf: TransformAuthority | None = None
        if self.config.publish_tf:
            self._tf = TransformAuthority(self, self.config.odom_frame, self.config.base_frame)
        # The callbacks count sessions up; the worker starts again when it meets a new one.
        self._session = self._odometry_session = 0
        self._last_ns = 0
        self._covariance = _START_COVARIANCE
        self._watch = StreamWatch(
            self, self.diagnostics, 'points', self.config.on_time_jump, self._restart
        )
        self._worker: Worker[_Scan] = Worker(
            self._register,
            capacity=self.config.waiting_clouds,
            threaded=self.config.threaded,
            on_drop=self._drop,
            on_error=lambda error: self._reject('registration failed', repr(error)),
            name=f'{self.get_name()} registration',
        )
        self._odom_out = self.create_publisher(Odometry, 'odom', qos.RELIABLE)
        self.create_subscription(
            PointCloud2, 'points', self.on_points, qos.sensor(self.config.reliable_points)
        )
        self.create_service(Trigger, '~/reset', self.on_reset)
        self.diagnostics.watch('clouds waiting', self._worker.waiting)

    def on_points(self, message: PointCloud2) -> None:
        """Queue a cloud for registration."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if self._watch.takes(stamp_ns):
            self.diagnostics.tick('points', stamp_ns)
            self._worker.put(_Scan(self._session, message))

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start again at the origin with the next cloud."""
        self._restart(0)
        self._watch.reset()
        response.success, response.message = True, 'lidar odometry starts again at the origin'
        return response

    def destroy_node(self) -> None:
        """Stop the worker, then the node."""
        self._worker.stop()
        super().destroy_node()

    def _restart(self, stamp_ns: int) -> None:
        self._session += 1
        self._worker.clear()

    def _register(self, scan: _Scan) -> None:
        if scan.session != self._session:  # a reset came while it waited
            return
        if scan.session != self._odometry_session:
            self._odometry.reset()
            self._covariance = _START_COVARIANCE
            self._odometry_session = scan.session
        frame_id = scan.points.header.frame_id
        T_base_lidar = self._mounting(frame_id)
        if T_base_lidar is None:
            return
        stamp_ns = messages.stamp_ns(scan.points.header.stamp)
        try:
            with self.diagnostics.stage('convert'):
                cloud = messages.cloud_from_message(scan.points)
                finite = cloud.finite()
            with self.diagnostics.stage('registration'):
                estimate = self._odometry.locate(finite, stamp_ns)
        except DataError as error:
            self._reject('unusable cloud', str(error))
            return
        if len(finite) < len(cloud):
            self.diagnostics.count('points without coordinates (NaN)', len(cloud) - len(finite))
        with self.diagnostics.stage('publish'):
            self._publish(estimate, T_base_lidar)
        with self.diagnostics.stage('map'):
            self._odometry.absorb()
        self._tell(estimate)

    def _mounting(self, frame_id: str) -> se3.Array | None:
        """Return T_base_lidar; None, counted and said, when /tf_static does not know it."""
        base_frame = self.config.base_frame
        T_base_lidar = self._transforms.lookup(base_frame, frame_id)
        problem = None
        if T_base_lidar is None:
            problem = (
                f'/tf_static does not connect {base_frame} with {frame_id}: clouds are dropped; '
                f'publish it, or set base_frame to {frame_id}'
            )
            self._reject('no transform', problem)
        self.diagnostics.error('transform', problem)
        return T_base_lidar

    def _publish(self, estimate: OdometryEstimate, T_base_lidar: se3.Array) -> None:
        T_lidar_base = se3.inverse(T_base_lidar)
        T_odom_base = T_base_lidar @ estimate.T_odom_lidar @ T_lidar_base
        message = Odometry(
            header=messages.header(estimate.stamp_ns, self.config.odom_frame),
            child_frame_id=self.config.base_frame,
        )
        if estimate.T_previous_this is not None:
            assert estimate.covariance is not None and estimate.growth is not None
            to_base = se3.adjoint(T_base_lidar)
            motion = T_base_lidar @ estimate.T_previous_this @ T_lidar_base
            self._covariance = se3.compose_covariance(
                self._covariance, motion, to_base @ estimate.growth @ to_base.T
            )
            seconds = (estimate.stamp_ns - self._last_ns) * 1e-9
            twist = se3.log(motion) / seconds
            linear, angular = message.twist.twist.linear, message.twist.twist.angular
            linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = map(float, twist)
            step = to_base @ estimate.covariance @ to_base.T
            message.twist.covariance = (step / seconds**2).ravel()
        message.pose = messages.pose_with_covariance(T_odom_base, self._covariance)
        self._last_ns = estimate.stamp_ns
        self._odom_out.publish(message)
        if self._tf is not None:
            self._tf.send(T_odom_base, estimate.stamp_ns)

    def _tell(self, estimate: OdometryEstimate) -> None:
        """Put an estimate's health into diagnostics and log."""
        self.diagnostics.count('scans')
        self.diagnostics.tick('odom', estimate.stamp_ns)
        if not estimate.healthy:
            self.diagnostics.count('failed registrations')
        if estimate.recovered:
            self.diagnostics.count('recovered registrations')
        if estimate.reason:
            self.get_logger().warning(estimate.reason, throttle_duration_sec=1.0)
        self.diagnostics.warn('fit', None if estimate.healthy else estimate.reason)
        if self._tf is not None and self._tf.rivals:
            edge = f'{self.config.odom_frame} -> {self.config.base_frame}'
            self.diagnostics.error('rival', f'another node publishes {edge} on /tf as well')

    def _drop(self, scan: _Scan) -> None:
        self.diagnostics.count('dropped points: queue full')
        self.get_logger().warning(
            'registration does not keep up: the oldest waiting cloud was dropped; '
            'a smaller max_range or a larger voxel_size is faster',
            throttle_duration_sec=5.0,
        )

    def _reject(self, cause: str, text: str) -> None:
        self.diagnostics.count(f'rejected points: {cause}')
        self.get_logger().warning(text, throttle_duration_sec=5.0)


def help_text() -> str:
    """Return the node's documentation with its parameters."""
    rows = describe(LidarOdometryNodeConfig) + describe(OdometryConfig)
    lines = [
        f'  {name + " = " + default:34} {text}' + (f' [{unit}]' if unit else '')
        for name, default, unit, _, text in rows
    ]
    return '\n'.join([__doc__ or '', 'Parameters', *lines])


def main(argv: list[str] | None = None) -> int:
    """Run the node alone."""
    return run_node(LidarOdometryNode, help_text(), argv)
