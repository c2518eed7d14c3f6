"""Publish what people look at: loops, markers and the map cloud, beside the callbacks."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.worker import Worker
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.map_cloud import MapCloud, MapCloudConfig
from lcd_loop_closure.nodes.conversions import loop_message
from lcd_loop_closure.nodes.loop_markers import loop_markers
from lcd_msgs.msg import LoopConstraintArray

PointsOf = Callable[[int], NDArray[np.floating]]


@dataclass(frozen=True)
class Shown:
    """A graph at one moment, as far as it is shown.

    Attributes:
        graph: stands for the graph that it is; another one starts a new map cloud.
        points_of: returns a keyframe's points [N x 3] in its base frame, by id.
        ids: [N] int64.
        T_map_base: [N x 4 x 4] of them; a copy.
        loops: that the graph knows, with its verdicts.
        candidates: that never reached it.
        stamp_ns: of the messages.
        base_frame: body frame of the loops.
        map_cloud: whether the map cloud is due.
    """

    graph: object
    points_of: PointsOf
    ids: NDArray[np.int64]
    T_map_base: se3.Array
    loops: tuple[LoopConstraint, ...]
    candidates: tuple[LoopConstraint, ...]
    stamp_ns: int
    base_frame: str
    map_cloud: bool


class GraphDisplay:
    """Publish `loops`, `loop_markers` and `map`, latched; the newest state wins, older ones wait.

    The map cloud is assembled only while somebody listens: ten thousand keyframes are a hundred
    megabytes.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: Diagnostics,
        settings: MapCloudConfig,
        map_frame: str,
        *,
        threaded: bool,
    ) -> None:
        self._settings, self._map_frame, self._diagnostics = settings, map_frame, diagnostics
        self._log = node.get_logger()
        self._cloud: tuple[object, MapCloud] | None = None
        self._loops: tuple[LoopConstraint, ...] = ()
        self._loops_out = node.create_publisher(LoopConstraintArray, 'loops', qos.LATCHED)
        self._markers_out = node.create_publisher(MarkerArray, 'loop_markers', qos.LATCHED)
        self._map_out = node.create_publisher(PointCloud2, 'map', qos.LATCHED)
        self._worker: Worker[Shown] = Worker(
            self._show,
            capacity=1,
            threaded=threaded,
            on_drop=lambda shown: None,  # a newer state stands for it
            on_error=self._on_error,
            name=f'{node.get_name()} display',
        )
        diagnostics.watch('states waiting to be shown', self._worker.waiting)

    @property
    def map_wanted(self) -> bool:
        """True when somebody listens to the map cloud."""
        return self._map_out.get_subscription_count() > 0

    def show(self, shown: Shown) -> None:
        """Publish a state, beside the caller when threaded."""
        self._worker.put(shown)

    def stop(self) -> None:
        """End the worker."""
        self._worker.stop()

    def _show(self, shown: Shown) -> None:
        if not _same(shown.loops, self._loops):
            self._loops = shown.loops
            array = LoopConstraintArray(
                header=messages.header(shown.stamp_ns, self._map_frame),
                loops=[loop_message(loop, shown.base_frame) for loop in shown.loops],
            )
            self._loops_out.publish(array)
        with self._diagnostics.stage('markers'):
            xyz_map = dict(zip(shown.ids.tolist(), shown.T_map_base[:, :3, 3], strict=True))
            drawn = (*shown.candidates, *shown.loops)
            self._markers_out.publish(loop_markers(drawn, xyz_map, shown.stamp_ns, self._map_frame))
        if shown.map_cloud:
            with self._diagnostics.stage('map cloud'):
                self._show_map(shown)

    def _show_map(self, shown: Shown) -> None:
        fresh = self._cloud is None or self._cloud[0] is not shown.graph
        if self._cloud is None or fresh:
            self._cloud = shown.graph, MapCloud(self._settings, shown.points_of)
        cloud = self._cloud[1]
        if cloud.update(dict(zip(shown.ids.tolist(), shown.T_map_base, strict=True))) or fresh:
            points = PointCloud(cloud.points())
            self._map_out.publish(messages.cloud_message(points, shown.stamp_ns, self._map_frame))

    def _on_error(self, error: Exception) -> None:
        self._diagnostics.count('display failed')
        self._log.error(f'the map could not be shown: {error!r}', throttle_duration_sec=10.0)


def _same(a: tuple[LoopConstraint, ...], b: tuple[LoopConstraint, ...]) -> bool:
    """Compare by identity: a loop that got another verdict is another object."""
    return len(a) == len(b) and all(x is y for x, y in zip(a, b, strict=True))
