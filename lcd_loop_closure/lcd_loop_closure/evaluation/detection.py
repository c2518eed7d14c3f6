"""Judge a descriptor by both protocols, on all revisits and on those of each direction."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure.evaluation.detection_protocols import (
    Candidates,
    DistancesTo,
    PrecisionRecall,
    candidate,
    joined,
    protocol_1,
)
from lcd_loop_closure.evaluation.pair_protocol import PairScores, protocol_2
from lcd_loop_closure.revisits import RevisitConfig

CLASSES = ('all', 'same_way', 'reverse')
# The authors' rule for pairs passed in another direction, of the difference of two headings.
_REVERSE_RAD = (0.79, 5.5)
_BLOCK_PAIRS = 1_000_000


@dataclass(frozen=True)
class Detection:
    """How well a descriptor tells places apart; keys of the curves are CLASSES.

    Attributes:
        found: most similar scans, of protocol 1.
        reverse: [Q] whether the place of a query was passed in another direction only.
        protocol_1: curve of each class: queries of the other class are left out.
        protocol_2: curve of each class: positive pairs of the other class are left out.
        pairs: that protocol 2 judged.
    """

    found: Candidates
    reverse: NDArray[np.bool_]
    protocol_1: dict[str, PrecisionRecall]
    protocol_2: dict[str, PrecisionRecall]
    pairs: int

    def plain(self) -> dict[str, Any]:
        """Return the single figures; None for a class without revisits."""
        by_protocol = {'protocol_1': self.protocol_1, 'protocol_2': self.protocol_2}
        figures: dict[str, Any] = {
            name: {kind: _plain(curve) for kind, curve in curves.items()}
            for name, curves in by_protocol.items()
        }
        figures['recall_1'] = self.found.recall_1
        figures['pairs'] = self.pairs
        return figures


def judge_descriptor(
    distances_to: DistancesTo,
    T_world_base: se3.Array,
    settings: RevisitConfig | None = None,
    *,
    progress: Callable[[], None] = lambda: None,
) -> Detection:
    """Judge a descriptor on a drive.

    Args:
        distances_to: `distances_to(i, m)` gives the descriptor distances [m] of scan i to the scans
            0 .. m - 1; asked once for each scan.
        T_world_base: [N x 4 x 4] true poses.
        settings: which scans count, and which pairs are of one place.
        progress: called after each scan from `first_scan` on.
    """
    s = settings or RevisitConfig()
    positions = np.asarray(T_world_base)[:, :3, 3]
    heading = np.arctan2(T_world_base[:, 1, 0], T_world_base[:, 0, 0])
    rows, positive, turned, reverse_query = [], [], [], []
    negative: list[NDArray[np.float32]] = []
    block: list[NDArray[np.float32]] = []
    for i in range(s.first_scan, len(positions)):
        earlier = i - s.excluded_scans
        if earlier >= 1:
            distance = np.asarray(distances_to(i, earlier), np.float32)
            rows.append(candidate(i, distance, positions, s.distance))
            away = np.linalg.norm(positions[:earlier] - positions[i], axis=1)
            near = away <= s.distance
            is_reverse = passed_reverse(heading[i], heading[:earlier])
            reverse_query.append(bool(near.any() and is_reverse[near].all()))
            positive.append(distance[near])
            turned.append(is_reverse[near])
            block.append(distance[~near])
            if sum(map(len, block)) >= _BLOCK_PAIRS:
                negative.append(np.concatenate(block))
                block = []
        progress()
    scores = PairScores(
        np.concatenate([*positive, np.empty(0, np.float32)]),
        np.concatenate([*turned, np.empty(0, bool)]),
        (*negative, np.concatenate([*block, np.empty(0, np.float32)])),
    )
    found, reverse = joined(rows), np.array(reverse_query, bool)
    of_class = {
        'all': (np.ones(len(found), bool), None),
        'same_way': (~found.loop | ~reverse, ~scores.reverse),
        'reverse': (~found.loop | reverse, scores.reverse),
    }
    return Detection(
        found,
        reverse,
        {kind: protocol_1(found.select(mask)) for kind, (mask, _) in of_class.items()},
        {kind: protocol_2(scores, chosen) for kind, (_, chosen) in of_class.items()},
        scores.pairs,
    )


def passed_reverse(
    heading: float | NDArray[np.floating], others: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Tell which headings (radians) differ from one as those of a place passed the other way."""
    apart = np.abs(np.asarray(others) - heading) % (2.0 * np.pi)
    return (apart >= _REVERSE_RAD[0]) & (apart <= _REVERSE_RAD[1])


def _plain(curve: PrecisionRecall) -> dict[str, Any] | None:
    if not curve.loops:
        return None
    return {
        'average_precision': curve.average_precision,
        'f1_max': curve.f1_max,
        'recall_without_error': curve.recall_without_error,
        'loops': curve.loops,
    }
