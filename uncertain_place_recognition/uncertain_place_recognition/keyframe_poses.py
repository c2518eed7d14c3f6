"""Know where the pose graph has the keyframes, orientation included."""

from collections.abc import Iterable

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.radius_search import GraphPositions, RadiusSearch
from uncertain_place_recognition.place import Place

_MOVED_M = 0.05


class KeyframePoses:
    """Follow the graph's positions; they bring no orientation, which odometry has, turned with it.

    Keyframes of a loaded map come from another odometry than those of this session: each side is
    aligned for itself (`RadiusSearch.pose`).
    """

    def __init__(self, loaded: Iterable[Place] = ()) -> None:
        """Start a session; `loaded` are the places of the map that it continues."""
        self._loaded = {p.id: _keyframe(p.id, p.stamp_ns, p.T_map_base) for p in loaded}
        self._session: dict[int, Keyframe] = {}
        self._search = RadiusSearch()
        self._graph: GraphPositions | None = None
        self._seen: dict[int, se3.Array] = {}
        self.located = not self._loaded  # whether the graph knows where this session lies

    def add(self, id: int, stamp_ns: int, T_odom_base: se3.Array) -> None:
        """Take in a keyframe of this session."""
        self._session[id] = _keyframe(id, stamp_ns, T_odom_base)
        self._note_located()

    def pose(self, id: int) -> se3.Array | None:
        """Return T_map_base of a keyframe; None when it is unknown or the session not located."""
        keyframes = self._session if id in self._session else self._loaded
        keyframe = keyframes.get(id)
        if keyframe is None or not self.located:
            return None
        if self._graph is None:
            return keyframe.T_odom_base
        return self._search.pose(keyframe, keyframes, self._graph)

    def corrected(self, graph: GraphPositions) -> dict[int, se3.Array]:
        """Take in the graph's positions; return T_map_base by id of the keyframes that moved.

        Before the first keyframe of this session nobody knows whether it is the graph of this map.
        """
        if not self._session:
            return {}
        self._graph = graph
        self._note_located()
        moved = {}
        for id, xyz in zip(graph.ids.tolist(), graph.xyz, strict=True):
            if id not in self._session and id not in self._loaded:
                continue
            last = self._seen.get(id)
            if last is None or float(np.abs(xyz - last).max()) > _MOVED_M:
                self._seen[id] = xyz
                T_map_base = self.pose(id)
                if T_map_base is not None:
                    moved[id] = T_map_base
        return moved

    def _note_located(self) -> None:
        if not self.located and self._graph is not None:
            session = np.fromiter(self._session, np.int64)
            self.located = bool(np.isin(self._graph.ids, session).any())


def _keyframe(id: int, stamp_ns: int, T_odom_base: se3.Array) -> Keyframe:
    return Keyframe(id, stamp_ns, T_odom_base, np.eye(4), None, _NO_POINTS)


_NO_POINTS = PointCloud(np.empty((0, 3), np.float32))
