"""A place_recognition node in lock-step: shared by its tests."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import made_up_drive as drive
from geometry_msgs.msg import PoseWithCovarianceStamped

from bags.nodes.lockstep import LockStep
from lcd_msgs.msg import PlaceMatchArray
from lcd_msgs.srv import LoadMap, SaveMap
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode

SPACING = {'asked__distance': 0.5, 'places__distance': 0.5, 'recognizer__delay': 0}


class Fed:
    """A node in lock-step, and what it published."""

    def __init__(self, node: PlaceRecognitionNode, prefix: str = '/', transform: bool = True):
        self.node, self.prefix = node, prefix
        self.lockstep = LockStep([node])
        self.answers: list[PlaceMatchArray] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        self.markers: list[Any] = []
        self.lockstep.listen(prefix + 'place_matches', lambda m: self.answers.append(m))
        self.lockstep.listen(prefix + 'initialpose', lambda m: self.poses.append(m))
        self.lockstep.listen(prefix + 'place_markers', lambda m: self.markers.append(m))
        if transform:
            self.lockstep.feed('/tf_static', drive.static_transform())

    def step(self, step: int, seen: int | None = None, **options: Any) -> None:
        """Feed the scan of a step (or what another step sees), then its odometry."""
        scan = drive.scan(step if seen is None else seen, stamp_ns=drive.stamp(step), **options)
        self.lockstep.feed(self.prefix + 'points', scan)
        self.lockstep.feed(self.prefix + 'odom', drive.odom_message(step))

    def counted(self, cause: str) -> int:
        """Return a counter of the node."""
        return self.node.diagnostics.counted(cause)

    def service(self, name: str, request: Any, response: Any) -> Any:
        """Call a service of the node."""
        return getattr(self.node.place_services, name)(request, response)

    def save(self, path: Path) -> Any:
        """Save the places."""
        call = self.service('on_save_map', SaveMap.Request(path=str(path)), SaveMap.Response())
        return asyncio.run(call)

    def load(self, path: Path | str) -> Any:
        """Load places."""
        return self.service('on_load_map', LoadMap.Request(path=str(path)), LoadMap.Response())


def fed_by(make: Callable[..., Any], small_weights: Path) -> Callable[..., Fed]:
    """Return what makes a fed node with small weights."""

    def construct(transform: bool = True, **parameters: Any) -> Fed:
        values = {'threaded': False, 'weights': str(small_weights), **SPACING, **parameters}
        return Fed(make(PlaceRecognitionNode, **values), transform=transform)

    return construct
