"""Watch the live suite from outside: what arrived, and how long after its scan was published."""

from collections.abc import Mapping

from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from lcd_common import se3
from lcd_common.nodes import messages, qos
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.nodes.conversions import keyframe_from_message, loop_from_message
from lcd_msgs.msg import Keyframe as KeyframeMessage
from lcd_msgs.msg import LoopConstraint as LoopConstraintMessage
from lcd_msgs.msg import LoopConstraintArray


class LiveRecorder(Node):
    """Record odometry, keyframes, loops and the path of a live run.

    Latency is publisher's clock to publisher's clock (DDS source timestamps on one machine), so a
    recorder that is scheduled late does not add to it.
    """

    def __init__(self, **node_options: object) -> None:
        super().__init__('live_recorder', **node_options)
        self.scan_published_ns: dict[int, int] = {}
        self.odometry_published_ns: dict[int, int] = {}
        self.T_odom_base: dict[int, se3.Array] = {}
        self.keyframes: dict[int, Keyframe] = {}
        self.candidates: list[LoopConstraint] = []
        self._loops = self._path = b''
        self.create_subscription(
            PointCloud2, 'points', self.on_points, qos.SENSOR_RELIABLE, raw=True
        )
        self.create_subscription(Odometry, 'odom', self.on_odom, qos.RELIABLE)
        self.create_subscription(KeyframeMessage, 'keyframe', self.on_keyframe, qos.RELIABLE)
        self.create_subscription(
            LoopConstraintMessage, 'loop_constraint', self.on_loop_constraint, qos.RELIABLE
        )
        # They grow with the drive and only the last one counts: read when the drive is over.
        self.create_subscription(LoopConstraintArray, 'loops', self.on_loops, qos.LATCHED, raw=True)
        self.create_subscription(Path, 'path', self.on_path, qos.LATCHED, raw=True)

    def on_points(self, serialized: bytes, info: Mapping[str, int]) -> None:
        """Note when a scan was published; only the stamp is read from its bytes."""
        # CDR: 4 bytes of encapsulation, then the stamp's seconds and nanoseconds.
        stamp = int.from_bytes(serialized[4:8], 'little') * 1_000_000_000
        stamp += int.from_bytes(serialized[8:12], 'little')
        self.scan_published_ns[stamp] = info['source_timestamp']

    def on_odom(self, message: Odometry, info: Mapping[str, int]) -> None:
        """Note when the odometry of a scan was published."""
        stamp = messages.stamp_ns(message.header.stamp)
        self.odometry_published_ns[stamp] = info['source_timestamp']
        self.T_odom_base[stamp] = messages.transform_from_pose(message.pose.pose)

    def on_keyframe(self, message: KeyframeMessage) -> None:
        """Remember a keyframe."""
        keyframe = keyframe_from_message(message)
        self.keyframes[keyframe.id] = keyframe

    def on_loop_constraint(self, message: LoopConstraintMessage) -> None:
        """Remember what the detector said of a candidate."""
        self.candidates.append(loop_from_message(message))

    def on_loops(self, serialized: bytes) -> None:
        """Keep the graph's latest verdicts."""
        self._loops = serialized

    def on_path(self, serialized: bytes) -> None:
        """Keep the corrected trajectory."""
        self._path = serialized

    def loops(self) -> list[LoopConstraint]:
        """Return the graph's last verdicts; none without any."""
        if not self._loops:
            return []
        message = deserialize_message(self._loops, LoopConstraintArray)
        return [loop_from_message(loop) for loop in message.loops]

    def T_map_base(self) -> dict[int, se3.Array]:
        """Return the last corrected trajectory by stamp; empty without any."""
        if not self._path:
            return {}
        return {
            messages.stamp_ns(pose.header.stamp): messages.transform_from_pose(pose.pose)
            for pose in deserialize_message(self._path, Path).poses
        }

    def latencies_ms(self) -> list[float]:
        """Return milliseconds from a scan's publication to its odometry's."""
        return [
            (published - self.scan_published_ns[stamp]) * 1e-6
            for stamp, published in self.odometry_published_ns.items()
            if stamp in self.scan_published_ns
        ]
