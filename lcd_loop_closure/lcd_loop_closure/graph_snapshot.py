"""Hold all that a pose graph has measured, as arrays that can be saved, sent and solved elsewhere."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import MapError
from lcd_loop_closure.gnss import GnssAlignment, GnssFactor
from lcd_loop_closure.loop import LoopConstraint, LoopStatus


class LoopState(IntEnum):
    """What the graph does with a loop."""

    HELD = 0  # measured, contradicts the estimate, waits outside the graph for the solver
    TENTATIVE = 1  # agrees with the estimate, in the graph behind a robust kernel
    CONFIRMED = 2  # found right by the solver, in the graph
    REJECTED = 3  # found wrong by the solver, outside the graph
    BY_HAND = 4  # put in by a person, in the graph; the solver does not judge it


IN_GRAPH = frozenset({LoopState.TENTATIVE, LoopState.CONFIRMED, LoopState.BY_HAND})
LoopKey = tuple[int, int]


@dataclass(frozen=True)
class GraphLoop:
    """A loop with its covariance as the graph uses it, and what the graph does with it."""

    constraint: LoopConstraint
    covariance: se3.Array
    state: LoopState

    @property
    def key(self) -> LoopKey:
        """The ids of both keyframes, match first."""
        return self.constraint.match_id, self.constraint.query_id


@dataclass(frozen=True)
class GraphSnapshot:
    """A pose graph at one moment; nothing in it changes when the graph goes on.

    Attributes:
        ids: [N] int64, increasing.
        stamps_ns: [N] int64.
        T_odom_base: [N x 4 x 4] as odometry had them.
        T_map_base: [N x 4 x 4] as the graph estimates them.
        motions: [N x 4 x 4] T_previous_this; the identity in row 0.
        motion_covariances: [N x 6 x 6] as the graph uses them, body axes, translation first.
        broken_links: ids of keyframes whose link to their predecessor was found broken.
        loops: every loop that was offered, in order of arrival.
        gnss: satellite fixes tied to keyframes.
        gnss_alignment: datum and T_enu_map, None before it is known.
    """

    ids: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    T_odom_base: se3.Array
    T_map_base: se3.Array
    motions: se3.Array
    motion_covariances: se3.Array
    broken_links: tuple[int, ...] = ()
    loops: tuple[GraphLoop, ...] = ()
    gnss: tuple[GnssFactor, ...] = ()
    gnss_alignment: GnssAlignment | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def row(self, keyframe_id: int) -> int:
        """Return the row of a keyframe; an unknown id raises KeyError."""
        row = int(np.searchsorted(self.ids, keyframe_id))
        if row == len(self.ids) or self.ids[row] != keyframe_id:
            raise KeyError(keyframe_id)
        return row
