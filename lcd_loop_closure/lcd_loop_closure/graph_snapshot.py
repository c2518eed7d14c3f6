"""Hold all that a pose graph has measured, as arrays to be saved, sent and solved elsewhere."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure.gnss import GnssDatum, GnssFactor
from lcd_loop_closure.loop import LoopConstraint


class LoopState(IntEnum):
    """What the graph does with a loop."""

    HELD = 0  # measured, contradicts the estimate, waits outside the graph for the solver
    TENTATIVE = 1  # agrees with the estimate, in the graph behind a robust kernel
    CONFIRMED = 2  # found right by the solver, in the graph
    REJECTED = 3  # found wrong by the solver, outside the graph
    BY_HAND = 4  # put in by a person, in the graph; the solver does not judge it
    UNUSED = 5  # rejected before it came here, or taken out by a person; only remembered


IN_GRAPH = frozenset({LoopState.TENTATIVE, LoopState.CONFIRMED, LoopState.BY_HAND})
LoopKey = tuple[int, int]


@dataclass(frozen=True)
class GraphLoop:
    """A loop with its covariance as the graph uses it, and what the graph does with it.

    serial counts the loops of a session as they arrive; one that comes again gets a new one.
    """

    constraint: LoopConstraint
    covariance: se3.Array
    state: LoopState
    serial: int = 0

    @property
    def key(self) -> LoopKey:
        """The ids of both keyframes, match first."""
        return self.constraint.match_id, self.constraint.query_id

    @property
    def T_match_query(self) -> se3.Array:
        """The measured transform; only loops that are never used may lack it."""
        assert self.constraint.T_match_query is not None
        return self.constraint.T_match_query


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
        arrivals: how many loops had arrived, repeated ones included.
        gnss: satellite fixes tied to keyframes.
        gnss_datum: origin of the ENU frame; None before the first fix.
        T_enu_map: where the map lies in it; None before it is known, and the fixes do not act.
    """

    ids: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    T_odom_base: se3.Array
    T_map_base: se3.Array
    motions: se3.Array
    motion_covariances: se3.Array
    broken_links: tuple[int, ...] = ()
    loops: tuple[GraphLoop, ...] = ()
    arrivals: int = 0
    gnss: tuple[GnssFactor, ...] = ()
    gnss_datum: GnssDatum | None = None
    T_enu_map: se3.Array | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def row(self, keyframe_id: int) -> int:
        """Return the row of a keyframe; an unknown id raises KeyError."""
        row = int(np.searchsorted(self.ids, keyframe_id))
        if row == len(self.ids) or self.ids[row] != keyframe_id:
            raise KeyError(keyframe_id)
        return row
