"""Publish what the EKF says: odometry, pose and one edge of the transform tree."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from cmrnet_ekf.ekf.vehicle_ekf import Estimate
from lcd_common import se3
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.transforms import TransformAuthority


class EkfOutputs:
    """Publish estimates of the base frame.

    Args:
        node: that publishes.
        diagnostics: hears of other owners of the edge.
        frames: of the world, of odometry and of the vehicle.
        tf: 'world_to_base', 'map_to_odom' (world -> odom) or 'none'.
    """

    def __init__(
        self, node: Node, diagnostics: Diagnostics, frames: tuple[str, str, str], tf: str
    ) -> None:
        self._diagnostics, self._tf = diagnostics, tf
        self._world, self._odom, self._base = frames
        self._rivals = 0
        self._authority: TransformAuthority | None = None
        if tf != 'none':
            child = self._base if tf == 'world_to_base' else self._odom
            self._authority = TransformAuthority(node, self._world, child)
        self._odom_out = node.create_publisher(Odometry, 'odometry/filtered', qos.RELIABLE)
        self._pose_out = node.create_publisher(
            PoseWithCovarianceStamped, 'filtered_pose', qos.RELIABLE
        )

    def publish(self, estimate: Estimate, T_body_base: se3.Array) -> None:
        """Publish the base's pose and twist at the estimate's stamp."""
        T_map_base, covariance = base_pose(estimate, T_body_base)
        to_base = se3.adjoint(se3.inverse(T_body_base))
        header = messages.header(estimate.stamp_ns, self._world)
        message = Odometry(header=header, child_frame_id=self._base)
        message.pose = messages.pose_with_covariance(T_map_base, covariance)
        twist = to_base @ estimate.twist
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = map(float, twist)
        message.twist.covariance = (to_base @ estimate.twist_covariance @ to_base.T).ravel()
        self._odom_out.publish(message)
        self._pose_out.publish(PoseWithCovarianceStamped(header=header, pose=message.pose))
        if self._authority is not None and self._tf == 'world_to_base':
            self._authority.send(T_map_base, estimate.stamp_ns)

    def correct_odometry(
        self, estimate: Estimate, T_body_base: se3.Array, T_odom_base: se3.Array
    ) -> None:
        """Broadcast world -> odom at an odometry message's stamp, if that is this node's edge."""
        if self._authority is not None and self._tf == 'map_to_odom':
            T_map_base, _ = base_pose(estimate, T_body_base)
            self._authority.send(T_map_base @ se3.inverse(T_odom_base), estimate.stamp_ns)

    def check_authority(self) -> None:
        """Report whether somebody else broadcast the same edge since the last call."""
        if self._authority is None:
            return
        edge = f'{self._authority.parent} -> {self._authority.child}'
        text = f'another node publishes {edge} on /tf: set tf to none on one of them'
        self._diagnostics.error('tf', text if self._authority.rivals > self._rivals else None)
        self._rivals = self._authority.rivals


def base_pose(estimate: Estimate, T_body_base: se3.Array) -> tuple[se3.Array, se3.Array]:
    """Return T_map_base and its covariance in the base's axes."""
    to_base = se3.adjoint(se3.inverse(T_body_base))
    return estimate.T_map_body @ T_body_base, to_base @ estimate.covariance @ to_base.T


def largest_position_sigma(estimate: Estimate) -> float:
    """Return the standard deviation of the position in its worst direction, metres."""
    return float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1]))
