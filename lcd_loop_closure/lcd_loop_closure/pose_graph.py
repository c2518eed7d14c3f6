"""Keep the corrected poses of all keyframes (skeleton of the interface; the body follows)."""

from dataclasses import dataclass

import numpy as np

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.gnss import GnssAlignment, GnssFix
from lcd_loop_closure.graph_snapshot import GraphSnapshot, LoopKey
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.robust_solver import Verdict


@config
class PoseGraphConfig:
    """How the graph is kept."""

    admission_probability: float = setting(
        0.9999, 'share of true loops that agree with the estimate and enter at once', low=0.5
    )


@dataclass(frozen=True)
class GraphUpdate:
    """What one update did.

    Attributes:
        keyframes: how many keyframes came in.
        loops_in: loops that entered the graph (new, or restored by a verdict).
        loops_out: loops that left the graph (a verdict, or by hand).
        broken_links: ids of keyframes whose link to their predecessor was loosened.
        max_shift_m: how far the farthest older keyframe moved.
        seconds: wall time.
    """

    keyframes: int
    loops_in: tuple[LoopKey, ...]
    loops_out: tuple[LoopKey, ...]
    broken_links: tuple[int, ...]
    max_shift_m: float
    seconds: float


class PoseGraph:
    """Keep the corrected poses of all keyframes by iSAM2. Not thread-safe."""

    def __init__(self, settings: PoseGraphConfig) -> None:
        self.settings = settings

    def __len__(self) -> int:
        raise NotImplementedError

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Append a keyframe, tied to the last one by odometry; its cloud is not kept.

        Raises:
            DataError: the id or stamp does not increase, or a pose is not finite.
        """
        raise NotImplementedError

    def add_loop(self, loop: LoopConstraint, *, by_hand: bool = False) -> LoopConstraint:
        """Offer a loop; return it with the graph's first verdict.

        One that agrees with the estimate enters at the next update behind a robust kernel; one that
        does not waits outside (REJECTED_INCONSISTENT) for the solver. A loop that came rejected is
        only remembered. By hand: enters as it is and is never judged.

        Raises:
            DataError: a keyframe is unknown or the loop has no transform.
        """
        raise NotImplementedError

    def remove_loop(self, match_id: int, query_id: int) -> bool:
        """Take a loop out for good (REJECTED_BY_HAND); False when there is none."""
        raise NotImplementedError

    def add_gnss(
        self, fix: GnssFix, T_base_antenna: se3.Array, T_keyframe_base: se3.Array | None = None
    ) -> bool:
        """Tie the last keyframe to a fix; False when the fix cannot be used (says why in a log).

        T_keyframe_base: motion by odometry from the last keyframe to the fix; identity when None.
        """
        raise NotImplementedError

    def update(self) -> GraphUpdate:
        """Take in all that came since the last update."""
        raise NotImplementedError

    def apply(self, verdict: Verdict) -> GraphUpdate:
        """Remove and restore loops by a solver's verdict; later loops stay as they are."""
        raise NotImplementedError

    @property
    def needs_verdict(self) -> bool:
        """True when loops came since the snapshot of the last applied verdict."""
        raise NotImplementedError

    @property
    def ids(self) -> np.ndarray:
        """Keyframe ids [N] int64, in the order of poses()."""
        raise NotImplementedError

    @property
    def stamps_ns(self) -> np.ndarray:
        """Stamps [N] int64, in the order of poses()."""
        raise NotImplementedError

    def poses(self) -> se3.Array:
        """Return T_map_base [N x 4 x 4] of all keyframes after the last update (do not write)."""
        raise NotImplementedError

    @property
    def T_map_odom(self) -> se3.Array:
        """The correction of odometry at the last keyframe; identity of an empty graph."""
        raise NotImplementedError

    def covariance(self, keyframe_id: int) -> se3.Array:
        """Return the 6x6 of T_map_base, body axes, translation first."""
        raise NotImplementedError

    def loops(self) -> list[LoopConstraint]:
        """Return every loop that was offered, each with the latest verdict, in order of arrival."""
        raise NotImplementedError

    @property
    def gnss_alignment(self) -> GnssAlignment | None:
        """Datum and T_enu_map; None before the fixes span a long enough baseline."""
        raise NotImplementedError

    def trajectory(self) -> Trajectory:
        """Return stamps and corrected poses (write_tum, write_kitti)."""
        raise NotImplementedError

    def snapshot(self) -> GraphSnapshot:
        """Return a copy of everything, for the solver or for saving (to_arrays, from_arrays)."""
        raise NotImplementedError

    @classmethod
    def restore(cls, settings: PoseGraphConfig, snapshot: GraphSnapshot) -> 'PoseGraph':
        """Rebuild a graph from a snapshot."""
        raise NotImplementedError
