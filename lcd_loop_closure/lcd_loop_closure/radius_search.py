"""Find keyframes near the current estimate.

LIO-SAM's loop detection, which is the thesis's SLAM baseline.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.settings import config, setting
from lcd_loop_closure.keyframes import Keyframe


@config
class RadiusSearchConfig:
    """How far a revisit is looked for."""

    radius: float = setting(
        15.0, 'keyframes nearer than this by the current estimate are candidates', unit='m', low=0.0
    )
    window: int = setting(
        20, 'neighbouring keyframes that tell how the graph moved odometry', low=2
    )


@dataclass(frozen=True)
class GraphPositions:
    """Where the pose graph now believes the keyframes to be.

    Attributes:
        ids: [N] int64 of keyframes; need not hold the newest ones.
        xyz: [N x 3] float64, metres, map frame.
    """

    ids: NDArray[np.int64]
    xyz: se3.Array

    def __post_init__(self) -> None:
        if self.ids.ndim != 1 or self.xyz.shape != (len(self.ids), 3):
            raise DataError(
                f'{len(self.ids)} keyframe ids need as many positions x y z, got the shape '
                f'{self.xyz.shape}'
            )


@dataclass(frozen=True)
class NearbyKeyframe:
    """A keyframe that lies near by the current estimate.

    Attributes:
        id: of the keyframe.
        distance_m: from the query, by the estimate.
        T_match_query: relative pose by the estimate.
    """

    id: int
    distance_m: float
    T_match_query: se3.Array


class RadiusSearch:
    """Search the graph's positions; orientations come from odometry, turned as the graph did.

    The graph publishes positions alone. Around any keyframe, the path by odometry and the path by
    the graph have the same shape, so aligning both over a short window (yaw and translation) gives
    the local map -> odom transform and with it the full pose.
    """

    def __init__(self, settings: RadiusSearchConfig | None = None) -> None:
        self.settings = settings or RadiusSearchConfig()

    def nearest(
        self,
        query: Keyframe,
        keyframes: Mapping[int, Keyframe],
        eligible: Sequence[int],
        graph: GraphPositions | None,
        count: int,
    ) -> list[NearbyKeyframe]:
        """Return up to `count` of the `eligible` keyframes within the radius, nearest first.

        `eligible` are ids of `keyframes`. Without a graph, odometry's own poses are the estimate.
        """
        if graph is None:
            positions = [keyframe.T_odom_base[:3, 3] for keyframe in keyframes.values()]
            graph = GraphPositions(
                np.fromiter(keyframes, np.int64), np.array(positions).reshape(-1, 3)
            )
        at = np.flatnonzero(np.isin(graph.ids, np.asarray(eligible, np.int64)))
        if not len(at) or count < 1:
            return []
        T_map_query = self.pose(query, keyframes, graph)
        away = np.linalg.norm(graph.xyz[at] - T_map_query[:3, 3], axis=1)
        found = []
        for nearest in np.argsort(away, kind='stable')[:count]:
            if away[nearest] > self.settings.radius:
                break
            match = keyframes[int(graph.ids[at[nearest]])]
            T_match_map = se3.inverse(self.pose(match, keyframes, graph))
            found.append(NearbyKeyframe(match.id, float(away[nearest]), T_match_map @ T_map_query))
        return found

    def pose(
        self, keyframe: Keyframe, keyframes: Mapping[int, Keyframe], graph: GraphPositions
    ) -> se3.Array:
        """Return T_map_base of a keyframe, even of one that the graph does not hold yet."""
        window = np.flatnonzero(np.abs(graph.ids - keyframe.id) <= self.settings.window // 2)
        window = np.array([i for i in window if int(graph.ids[i]) in keyframes], np.int64)
        if not len(window):
            # The graph knows nothing near: as far as is known it has not moved odometry.
            return keyframe.T_odom_base
        ids, placed = graph.ids[window], graph.xyz[window]
        odom = np.array([keyframes[int(i)].T_odom_base[:3, 3] for i in ids])
        T_map_odom = _align(odom, placed)
        T_map_base = T_map_odom @ keyframe.T_odom_base
        # The alignment is a mean over the window; the nearest known keyframe is exact.
        closest = int(np.argmin(np.abs(ids - keyframe.id)))
        aligned = T_map_odom[:3, :3] @ odom[closest] + T_map_odom[:3, 3]
        T_map_base[:3, 3] += placed[closest] - aligned
        return T_map_base


def _align(xyz_b: se3.Array, xyz_a: se3.Array) -> se3.Array:
    """Return T_a_b of yaw and translation that brings points [N x 3] onto their twins."""
    mean_a, mean_b = xyz_a.mean(axis=0), xyz_b.mean(axis=0)
    a, b = xyz_a - mean_a, xyz_b - mean_b
    sine = float(np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]))
    cosine = float(np.sum(b[:, 0] * a[:, 0] + b[:, 1] * a[:, 1]))
    T_a_b = se3.rotation_z(np.arctan2(sine, cosine) if np.hypot(sine, cosine) > 1e-9 else 0.0)
    T_a_b[:3, 3] = mean_a - T_a_b[:3, :3] @ mean_b
    return T_a_b
