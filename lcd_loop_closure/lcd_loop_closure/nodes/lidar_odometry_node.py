"""Follow a LiDAR from sweep to sweep.

    ros2 run lcd_loop_closure lidar_odometry --ros-args -r points:=/velodyne_points

Subscribes  points (sensor_msgs/PointCloud2: x y z, and point time where the driver gives it),
            /tf_static (where the LiDAR sits on the vehicle)
Publishes   odom (nav_msgs/Odometry), /tf odom -> base_link (with publish_tf), /diagnostics
Services    ~/reset (std_srvs/Trigger): start again at the origin of odom

The pose's covariance grows along the drive: that of the motion between two messages is the later
one less the earlier one carried along (`lcd_common.se3.compose_covariance`). The twist is the mean
velocity since the last sweep, in base_link, with its own covariance. Parameters: see
config/lidar_odometry.yaml or `ros2 param describe`.
"""

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
from lcd_common.settings import config, setting
from lcd_loop_closure.lidar_odometry import LidarOdometry, OdometryConfig, OdometryEstimate
from lcd_loop_closure.nodes.stream_watch import StreamWatch

# Of the first pose: it defines the odometry frame and is exact, but ROS takes zeros for unknown.
_EXACT = 1e-12


@config
class LidarOdometryNodeConfig:
    """How the node runs; how sweeps are registered stands beside it."""

    odom_frame: str = setting('odom', 'frame of the poses')
    base_frame: str = setting(
        'base_link', "body that is followed; the cloud's own frame needs no /tf_static"
    )
    publish_tf: bool = setting(True, 'own odom -> base_link; false when something else does')
    reliable_points: bool = setting(False, 'ask for reliable clouds (replay); else best effort')
    waiting_sweeps: int = setting(5, 'sweeps that may wait for registration', low=1)
    on_time_jump: str = setting(
        'restart', 'what to do when the clock jumps back', choices=('restart', 'refuse')
    )
    threaded: bool = setting(True, 'work beside the callbacks; false: inside, for lock-step replay')


class LidarOdometryNode(Node):
    """See the module's documentation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('lidar_odometry', **node_options)
        self.config = declare_config(self, LidarOdometryNodeConfig)
        self._odometry = LidarOdometry(declare_config(self, OdometryConfig))
        self._covariance = _EXACT * np.eye(6)
        self._session = self._registered_session = 0
        self._stamp_ns: int | None = None
        self.diagnostics = Diagnostics(self)
        self._transforms = StaticTransforms(self)
        frames = (self.config.odom_frame, self.config.base_frame)
        self._authority = TransformAuthority(self, *frames) if self.config.publish_tf else None
        self._watch = StreamWatch(
            self, self.diagnostics, 'points', self.config.on_time_jump, self._restart
        )
        self._worker: Worker[tuple[int, PointCloud2, se3.Array]] = Worker(
            self._register,
            capacity=self.config.waiting_sweeps,
            threaded=self.config.threaded,
            on_drop=lambda item: self._reject('dropped sweeps: machine too slow', ''),
            on_error=lambda error: self._reject('rejected points: failed', repr(error)),
            name=f'{self.get_name()} registration',
        )
        self._odometry_out = self.create_publisher(Odometry, 'odom', qos.RELIABLE)
        self.create_subscription(
            PointCloud2, 'points', self.on_points, qos.sensor(self.config.reliable_points)
        )
        self.create_service(Trigger, '~/reset', self.on_reset)
        self.diagnostics.watch('sweeps waiting', self._worker.waiting)

    def on_points(self, message: PointCloud2) -> None:
        """Hand a sweep over to registration."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if not self._watch.takes(stamp_ns):
            return
        self.diagnostics.tick('points', stamp_ns)
        base, frame_id = self.config.base_frame, message.header.frame_id
        T_base_lidar = self._transforms.lookup(base, frame_id)
        problem = None
        if T_base_lidar is None:
            problem = (
                f'/tf_static does not connect {base} with {frame_id}: sweeps are dropped; publish '
                f'the mounting, or set base_frame:={frame_id}'
            )
            self._reject('rejected points: no transform', problem)
        self.diagnostics.error('transform', problem)
        if T_base_lidar is not None:
            self._worker.put((self._session, message, T_base_lidar))

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start again at the origin of odom."""
        self._restart(0)
        self._watch.reset()
        response.success, response.message = True, 'odometry starts again'
        return response

    def destroy_node(self) -> None:
        """Stop the worker, then the node."""
        self._worker.stop()
        super().destroy_node()

    def _restart(self, stamp_ns: int) -> None:
        # Registration notices by the session: it may be at work on a sweep right now.
        self._worker.clear()
        self._session += 1

    def _register(self, item: tuple[int, PointCloud2, se3.Array]) -> None:
        session, message, T_base_lidar = item
        if session != self._session:
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if self._stamp_ns is None or session != self._registered_session:
            self._odometry.reset()
            self._covariance = _EXACT * np.eye(6)
            self._registered_session = session
        try:
            with self.diagnostics.stage('registration'):
                cloud = messages.cloud_from_message(message)
                finite = cloud.finite()
                estimate = self._odometry.register(finite, stamp_ns)
        except DataError as error:
            self._reject('rejected points: broken', str(error))
            return
        if len(finite) < len(cloud):
            self.diagnostics.count('rejected points: not finite', len(cloud) - len(finite))
        self._note(estimate)
        self._publish(estimate, T_base_lidar)
        self._stamp_ns = stamp_ns

    def _note(self, estimate: OdometryEstimate) -> None:
        self.diagnostics.warn('registration', None if estimate.healthy else estimate.reason)
        if estimate.recovered:
            self.diagnostics.count('sweeps found by a search over headings')
        if not estimate.healthy:
            self.diagnostics.count('sweeps that fit badly: pose is a guess')
        if estimate.reason:
            self.get_logger().warning(estimate.reason, throttle_duration_sec=5.0)

    def _publish(self, estimate: OdometryEstimate, T_base_lidar: se3.Array) -> None:
        T_lidar_base = se3.inverse(T_base_lidar)
        T_odom_base = T_base_lidar @ estimate.T_odom_lidar @ T_lidar_base
        message = Odometry(
            header=messages.header(estimate.stamp_ns, self.config.odom_frame),
            child_frame_id=self.config.base_frame,
        )
        motion, covariance, growth = estimate.T_previous_this, estimate.covariance, estimate.growth
        if motion is not None and covariance is not None and growth is not None:
            assert self._stamp_ns is not None
            to_base = se3.adjoint(T_base_lidar)
            step = T_base_lidar @ motion @ T_lidar_base
            self._covariance = se3.compose_covariance(
                self._covariance, step, to_base @ growth @ to_base.T
            )
            seconds = (estimate.stamp_ns - self._stamp_ns) * 1e-9
            velocity = se3.log(step) / seconds
            twist = message.twist.twist
            twist.linear.x, twist.linear.y, twist.linear.z = velocity[:3].tolist()
            twist.angular.x, twist.angular.y, twist.angular.z = velocity[3:].tolist()
            message.twist.covariance = (to_base @ covariance @ to_base.T / seconds**2).ravel()
        message.pose = messages.pose_with_covariance(T_odom_base, self._covariance)
        self._odometry_out.publish(message)
        if self._authority is not None:
            self._authority.send(T_odom_base, estimate.stamp_ns)

    def _reject(self, cause: str, text: str) -> None:
        self.diagnostics.count(cause)
        if text:
            self.get_logger().warning(text, throttle_duration_sec=5.0)


def main(argv: list[str] | None = None) -> int:
    """Run the node alone."""
    return run_node(LidarOdometryNode, __doc__ or '', argv)
