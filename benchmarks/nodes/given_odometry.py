"""Drive through loop closure and pose graph on the odometry of somebody else."""

from collections.abc import Mapping
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from bags.records import Drive
from lcd_common import se3
from lcd_common.nodes import messages, qos
from lcd_loop_closure.nodes.offline_slam import OfflineSlam, own_context
from lcd_loop_closure.report.result import DriveResult


class GivenOdometryNode(Node):
    """Answer every cloud with the pose that odometry of another source has for its stamp.

    Without a covariance, as most odometry comes: the pose graph then has only its own model of how
    odometry drifts, and nothing tells that it broke.
    """

    def __init__(self, T_odom_base: Mapping[int, se3.Array], **node_options: Any) -> None:
        super().__init__('given_odometry', **node_options)
        self._T_odom_base = T_odom_base
        self._odom_out = self.create_publisher(Odometry, 'odom', qos.RELIABLE)
        self.create_subscription(PointCloud2, 'points', self.on_points, qos.SENSOR)

    def on_points(self, message: PointCloud2) -> None:
        """Publish the pose at the stamp of a cloud, where there is one."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        T_odom_base = self._T_odom_base.get(stamp_ns)
        if T_odom_base is not None:
            header = messages.header(stamp_ns, 'odom')
            odometry = Odometry(header=header, child_frame_id='base_link')
            odometry.pose = messages.pose_with_covariance(T_odom_base, None)
            self._odom_out.publish(odometry)


def drive_on(
    T_odom_base: Mapping[int, se3.Array], drive: Drive, *, source: str
) -> tuple[DriveResult, tuple[int, ...]]:
    """Drive a recording through the suite with poses by stamp in the place of its odometry.

    Returns:
        What came of it, and the ids of the keyframes whose link to their predecessor the pose graph
        found to be wrong.
    """
    with own_context() as context:
        slam = OfflineSlam(context, [], threads=0)
        # The suite's own odometry stays silent: no cloud reaches it.
        for subscription in list(slam.odometry.subscriptions):
            if subscription.topic_name == '/points':
                slam.odometry.destroy_subscription(subscription)
        given = GivenOdometryNode(T_odom_base, context=context, use_global_arguments=False)
        slam.lockstep.add(given)
        try:
            wall_s, interrupted = slam.drive(drive, 0.0, None, True)
            result = slam.result(drive, source, wall_s, interrupted)
            return result, slam.pose_graph.map.graph.broken_links
        finally:
            for node in (*slam.nodes, given):
                node.destroy_node()
