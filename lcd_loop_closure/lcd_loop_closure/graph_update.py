"""Tell what an update of the pose graph did."""

from dataclasses import dataclass

from lcd_loop_closure.graph_snapshot import LoopKey


@dataclass(frozen=True)
class GraphUpdate:
    """What one update did.

    Attributes:
        keyframes: how many keyframes came in.
        loops_in: loops that entered the graph (new, or restored by a verdict).
        loops_out: loops that left the graph (by a verdict, or by hand).
        loops_held: loops that contradict the estimate and wait for the solver.
        links_changed: ids of keyframes whose link to their predecessor was given up or believed
            again.
        max_shift_m: how far the farthest older keyframe moved.
        seconds: wall time.
    """

    keyframes: int
    loops_in: tuple[LoopKey, ...]
    loops_out: tuple[LoopKey, ...]
    loops_held: tuple[LoopKey, ...]
    links_changed: tuple[int, ...]
    max_shift_m: float
    seconds: float
