"""Say where the vehicle is: map -> odom on /tf, and its pose in the map."""

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.transforms import TransformAuthority
from lcd_common.stamp_buffer import StampBuffer, StampedPose
from lcd_loop_closure.corrected_pose import CorrectedPose
from lcd_loop_closure.graph_noise import GraphNoise
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.online_map import OnlineMap


class PoseOutput:
    """Correct odometry, message by message, by what the graph says of its newest keyframe."""

    def __init__(
        self,
        node: Node,
        diagnostics: Diagnostics,
        noise: GraphNoise,
        *,
        frames: tuple[str, str],
        publish_tf: bool,
        max_gap_ns: int,
    ) -> None:
        """Make the publishers.

        Args:
            node: that publishes.
            diagnostics: hears of other owners of map -> odom.
            noise: of odometry that gives no covariance.
            frames: of the map and of odometry.
            publish_tf: whether map -> odom is this node's.
            max_gap_ns: longest time between odometry messages to interpolate over.
        """
        self._diagnostics, self._noise, self._frames = diagnostics, noise, frames
        self._authority = TransformAuthority(node, *frames) if publish_tf else None
        self._pose_out = node.create_publisher(PoseWithCovarianceStamped, 'pose', qos.RELIABLE)
        self._keyframes: StampBuffer[int] = StampBuffer(100, max_gap_ns)
        self._rivals = 0
        self.forget()

    def forget(self) -> None:
        """Forget odometry (after a clock jump)."""
        self._keyframes.clear()
        self._at_keyframe: tuple[int, StampedPose] | None = None
        self._corrected: CorrectedPose | None = None

    def changed(self) -> None:
        """Ask the graph anew: it has moved."""
        self._corrected = None

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Look up odometry, with its covariance, at a new keyframe."""
        for pair in self._keyframes.add_item(keyframe.stamp_ns, keyframe.id):
            self._at_keyframe, self._corrected = (pair.item, pair.pose), None

    def publish(self, odometry: StampedPose, online_map: OnlineMap) -> None:
        """Publish the correction and the pose at the stamp of odometry, where they are known."""
        for pair in self._keyframes.add_pose(odometry):
            self._at_keyframe, self._corrected = (pair.item, pair.pose), None
        self._keyframes.unpaired.clear()
        T_map_odom = online_map.T_map_odom
        if T_map_odom is None:
            return
        if self._authority is not None:
            self._authority.send(T_map_odom, odometry.stamp_ns)
        if online_map.last is None:
            return
        if self._corrected is None:
            self._corrected = online_map.corrected_pose(self._at_keyframe)
        T_map_base, covariance = self._corrected.at(odometry, self._noise)
        self._pose_out.publish(
            PoseWithCovarianceStamped(
                header=messages.header(odometry.stamp_ns, self._frames[0]),
                pose=messages.pose_with_covariance(T_map_base, covariance),
            )
        )

    def check_authority(self) -> None:
        """Report whether somebody else broadcast map -> odom since the last call."""
        rivals = 0 if self._authority is None else self._authority.rivals
        text = (
            f'another node publishes {self._frames[0]} -> {self._frames[1]}: set publish_tf to '
            'false on one of them'
        )
        self._diagnostics.error('authority', text if rivals > self._rivals else None)
        self._rivals = rivals
