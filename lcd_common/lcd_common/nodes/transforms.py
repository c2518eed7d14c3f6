"""Follow /tf_static and broadcast transforms with nothing but the standard message."""

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.nodes import qos
from lcd_common.nodes.messages import (
    header,
    stamp_ns,
    transform_from_message,
    transform_message,
)


class StaticTransforms:
    """Answer where sensors sit on the vehicle, from /tf_static alone.

    tf2's buffer would do this too, but it also follows /tf at full rate, and a lookup that waits
    blocks the executor. Static mounting needs neither.
    """

    def __init__(self, node: Node) -> None:
        self._parent: dict[str, tuple[str, se3.Array]] = {}
        self._log = node.get_logger()
        node.create_subscription(TFMessage, '/tf_static', self.on_tf_static, qos.TF_STATIC)

    def on_tf_static(self, message: TFMessage) -> None:
        """Remember the transforms of a message; a broken one is logged and left out."""
        for stamped in message.transforms:
            child = stamped.child_frame_id.lstrip('/')
            parent = stamped.header.frame_id.lstrip('/')
            try:
                self._parent[child] = (parent, transform_from_message(stamped.transform))
            except DataError as error:
                self._log.error(f'/tf_static {parent} -> {child}: {error}')

    def lookup(self, target: str, source: str) -> se3.Array | None:
        """Return T_target_source, or None when /tf_static does not connect the two frames."""
        T_root_target, roots_target = self._to_root(target)
        T_root_source, roots_source = self._to_root(source)
        if roots_target[-1] != roots_source[-1]:
            return None
        return se3.inverse(T_root_target) @ T_root_source

    def _to_root(self, frame: str) -> tuple[se3.Array, list[str]]:
        T, seen = np.eye(4), [frame.lstrip('/')]
        while seen[-1] in self._parent:
            parent, T_parent_child = self._parent[seen[-1]]
            if parent in seen:  # a cycle is a broken tree: stop where it closes
                break
            T = T_parent_child @ T
            seen.append(parent)
        return T, seen


class TransformAuthority:
    """Broadcast one edge of the tree on /tf and notice when somebody else moves its child too.

    A frame has one parent: the same edge from another node is a rival, and so is another parent of
    the child, between which tf would jump.
    """

    def __init__(self, node: Node, parent: str, child: str) -> None:
        self.parent, self.child = parent, child
        self.rivals = 0
        self._sent: dict[int, bytes] = {}
        self._log = node.get_logger()
        self._publisher = node.create_publisher(TFMessage, '/tf', qos.TF)
        node.create_subscription(TFMessage, '/tf', self.on_tf, qos.TF)

    def send(self, T_parent_child: se3.Array, stamp: int) -> None:
        """Broadcast the edge at a stamp in nanoseconds."""
        stamped = TransformStamped(
            header=header(stamp, self.parent),
            child_frame_id=self.child,
            transform=transform_message(T_parent_child),
        )
        self._sent[stamp] = _digits(stamped)
        while len(self._sent) > 200:
            del self._sent[next(iter(self._sent))]
        self._publisher.publish(TFMessage(transforms=[stamped]))

    def on_tf(self, message: TFMessage) -> None:
        """Count the transforms to the same child that are not this node's own."""
        for stamped in message.transforms:
            if stamped.child_frame_id.lstrip('/') != self.child.lstrip('/'):
                continue
            parent = stamped.header.frame_id.lstrip('/')
            same = parent == self.parent.lstrip('/')
            if same and self._sent.get(stamp_ns(stamped.header.stamp)) == _digits(stamped):
                continue
            self.rivals += 1
            text = 'two authorities' if same else f'two parents, {parent} and {self.parent},'
            self._log.error(
                f'another node publishes {parent} -> {self.child} on /tf: {text} make the vehicle '
                'jump; let one of them own it (publish_tf:=false, or tf:=none of ekf)',
                throttle_duration_sec=10.0,
            )


def _digits(stamped: TransformStamped) -> bytes:
    t, q = stamped.transform.translation, stamped.transform.rotation
    return np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]).tobytes()
