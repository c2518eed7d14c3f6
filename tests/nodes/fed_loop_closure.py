"""Feed loop_closure by hand and hear what it publishes."""

from typing import Any

import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive

from bags.nodes.lockstep import LockStep
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode


class Fed:
    """A node in lock-step, and what it published."""

    def __init__(self, node: LoopClosureNode, prefix: str = '/', transform: bool = True) -> None:
        self.node, self.prefix = node, prefix
        self.lockstep = LockStep([node])
        self.keyframes: list[Any] = []
        self.loops: list[Any] = []
        self.lockstep.listen(prefix + 'keyframe', lambda m: self.keyframes.append(m))
        self.lockstep.listen(prefix + 'loop_constraint', lambda m: self.loops.append(m))
        if transform:
            self.lockstep.feed('/tf_static', drive.static_transform())

    def step(self, step: int, **options: Any) -> None:
        """Feed the scan of a step, then its odometry."""
        self.lockstep.feed(self.prefix + 'points', drive.scan(step))
        self.lockstep.feed(self.prefix + 'odom', drive.odom_message(step, **options))

    def counted(self, cause: str) -> int:
        """Return a counter of the node."""
        return self.node.diagnostics.counted(cause)
