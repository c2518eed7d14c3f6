"""Find the odometry link that many loops contradict together.

Odometry that fails at an abrupt turn goes on with full confidence, and every later loop then
contradicts it in the same way. So do loops of a street that looks like another. They differ in what
else is known: giving up one link explains the first with a small displacement at that link, and no
accepted loop spans it; a look-alike street would need a jump of its own distance, or contradicts
the loops around it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure import pairwise_consistency as pairs

_SAMPLE = 40
_MOST = 0.7
_CONTRADICTING = 0.1


@dataclass(frozen=True)
class LinkSuspect:
    """A link that may have broken: its row, what it should have been, and how far it was off."""

    row: int
    T_previous_this: se3.Array
    jump_m: float


def spanning(ends: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return for each row of `count` how many loops span the link to its previous row."""
    change = np.zeros(count + 1, np.int64)
    np.add.at(change, ends.min(axis=1) + 1, 1)
    np.add.at(change, ends.max(axis=1) + 1, -1)
    return np.cumsum(change)[:count]


def implied_links(poses: se3.Array, loops: pairs.LoopMeasurements, row: int) -> se3.Array:
    """Return T_previous_this [K x 4 x 4] of a row's link as each loop that spans it would have it.

    poses: [N x 4 x 4], right up to the link and, among themselves, after it.
    """
    earlier, later = loops.ends.min(axis=1), loops.ends.max(axis=1)
    forward = (loops.ends[:, 0] == earlier)[:, None, None]
    T = np.where(forward, loops.T_match_query, se3.inverse(loops.T_match_query))
    before = se3.inverse(poses[row - 1]) @ poses[earlier]
    after = se3.inverse(poses[later]) @ poses[row]
    return before @ T @ after


def suspect_link(
    poses: se3.Array,
    motions: se3.Array,
    contradicting: pairs.LoopMeasurements,
    accepted_ends: NDArray[np.int64],
    minimum_loops: int,
    jump_m: float,
) -> LinkSuspect | None:
    """Return the link whose failure best explains the contradicting loops, or None.

    Args:
        poses: solved without the contradicting loops [N x 4 x 4].
        motions: odometry's T_previous_this [N x 4 x 4].
        contradicting: rejected loops that agree with each other in groups.
        accepted_ends: [A x 2] rows of the accepted loops.
        minimum_loops: fewer contradicting loops across a link say nothing.
        jump_m: farthest translation by which a link may have been wrong.
    """
    if len(contradicting.ends) < minimum_loops:
        return None
    against = spanning(contradicting.ends, len(poses))
    for_it = spanning(accepted_ends, len(poses)) if len(accepted_ends) else np.zeros_like(against)
    enough = max(minimum_loops, int(_MOST * against.max()))
    rows = np.nonzero((against >= enough) & (for_it <= _CONTRADICTING * against))[0]
    best: LinkSuspect | None = None
    for row in rows:
        ends = contradicting.ends
        spans = np.nonzero((ends.min(axis=1) < row) & (ends.max(axis=1) >= row))[0]
        # Evenly spaced, so that one look-alike stretch does not speak for all.
        chosen = spans[np.linspace(0, len(spans) - 1, min(_SAMPLE, len(spans))).astype(int)]
        links = implied_links(
            poses,
            pairs.LoopMeasurements(
                ends[chosen], contradicting.T_match_query[chosen], contradicting.covariances[chosen]
            ),
            int(row),
        )
        jumps = np.linalg.norm(links[:, :3, 3] - motions[row, :3, 3], axis=1)
        jump = float(np.median(jumps))
        if best is None or jump < best.jump_m:
            # A loop in the middle of the field stands for all.
            middle = int(np.argmin(np.abs(jumps - jump)))
            best = LinkSuspect(int(row), links[middle], jump)
    return best if best is not None and best.jump_m <= jump_m else None


def moved(poses: se3.Array, row: int, T_previous_this: se3.Array) -> se3.Array:
    """Return the poses with all from `row` on moved rigidly, so that its link becomes the given."""
    T_new_old = poses[row - 1] @ T_previous_this @ se3.inverse(poses[row])
    out = poses.copy()
    out[row:] = T_new_old @ poses[row:]
    return out
