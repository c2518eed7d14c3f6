"""Feed pose_graph by hand and hear what it publishes."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from lcd_common.nodes import messages
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode

Make = Callable[..., Any]
ROUND = 126  # steps of one round
DRIFT = 3e-4


class Fed:
    """Nodes in lock-step, and what they published by topic."""

    def __init__(self, *nodes: PoseGraphNode, prefix: str = '/') -> None:
        self.node, self.prefix = nodes[0], prefix
        self.lockstep = LockStep(nodes)
        self.heard: dict[str, list[Any]] = defaultdict(list)
        for topic in ('path', 'pose', 'graph/keyframes', 'loops', 'loop_markers', 'map'):
            self.lockstep.listen(prefix + topic, self.heard[topic].append)
        self.lockstep.listen('/tf', self.heard['tf'].append)
        self.lockstep.feed('/tf_static', drive.static_transform())

    def feed(self, topic: str, message: Any) -> None:
        """Feed a message on a relative topic."""
        self.lockstep.feed(self.prefix + topic, message)

    def drive(self, steps: range, drift: float = 0.0, first_id: int = 0) -> None:
        """Feed odometry and the keyframe of every step."""
        for step in steps:
            self.feed('odom', drive.odom_message(step, drift) if step % 10 == 0 else odom(step))
            self.feed('keyframe', drive.keyframe(step, drift, first_id))

    def settle(self) -> None:
        """Deliver what was published outside of a feed."""
        self.lockstep.feed('/nothing', TFMessage())

    def refresh(self) -> None:
        """Do what the node's timer does."""
        self.node.refresh()
        self.settle()

    def path(self) -> np.ndarray:
        """Return the poses of the last path."""
        self.settle()
        poses = self.heard['path'][-1].poses
        return np.array([messages.transform_from_pose(p.pose) for p in poses]).reshape(-1, 4, 4)

    def counted(self, cause: str) -> int:
        """Return a counter of the node."""
        return self.node.diagnostics.counted(cause)


def odom(step: int) -> Any:
    """Return odometry without its covariance, which takes long to add up."""
    return drive.odom_message(step, covariance=False)


def second_round(fed: Fed, loops: list[tuple[int, int]], wrong_by_m: float = 0.0) -> None:
    for step in range(ROUND + 6):
        fed.feed('keyframe', drive.keyframe(step, DRIFT))
    for match, query in loops:
        fed.feed('loop_constraint', drive.loop(match, query, wrong_by_m))


TRUE_LOOPS = [(0, ROUND), (2, ROUND + 2), (4, ROUND + 4)]


def errors(fed: Fed) -> np.ndarray:
    truth = np.array([drive.true_pose(k) for k in range(len(fed.path()))])
    return np.linalg.norm(fed.path()[:, :3, 3] - truth[:, :3, 3], axis=1)
