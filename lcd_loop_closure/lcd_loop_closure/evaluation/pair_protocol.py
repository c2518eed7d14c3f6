"""Protocol 2: judge every pair of scans by its descriptor distance (thesis section 3.3.3)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_loop_closure.evaluation.detection_protocols import PrecisionRecall


@dataclass(frozen=True)
class PairScores:
    """Descriptor distances of all pairs of a drive, four bytes a pair.

    Attributes:
        positive: [P] float32, of the pairs that show one place.
        reverse: [P] which of them were passed in another direction.
        negative: float32 chunks of the others, in any order.
    """

    positive: NDArray[np.float32]
    reverse: NDArray[np.bool_]
    negative: tuple[NDArray[np.float32], ...]

    @property
    def pairs(self) -> int:
        """All of them."""
        return len(self.positive) + sum(len(chunk) for chunk in self.negative)


def protocol_2(scores: PairScores, chosen: NDArray[np.bool_] | None = None) -> PrecisionRecall:
    """Return precision and recall of accepting every pair up to a distance.

    The average precision is scikit-learn's: the sum of (R_k - R_k-1) P_k over all distinct
    distances, from recall 0 on. Recall only grows at distances that a positive pair has, so the
    curve has these alone, and the negatives need counting but no sorting: ten million pairs take
    a second and 40 MB.

    Args:
        scores: of all pairs.
        chosen: [P] positive pairs that count; the others are left out, not taken for negatives.
    """
    positive = scores.positive if chosen is None else scores.positive[chosen]
    threshold, times = np.unique(positive, return_counts=True)
    counts = np.zeros(len(threshold) + 1, np.int64)
    for chunk in scores.negative:
        # A negative is accepted from the first threshold that is not below its distance on.
        first = np.searchsorted(threshold, chunk, side='left')
        counts += np.bincount(first, minlength=len(counts))
    true = np.cumsum(times).astype(np.float64)
    false = np.cumsum(counts)[:-1]
    precision = true / np.maximum(true + false, 1)
    recall = true / max(len(positive), 1)
    area = float(np.sum(np.diff(recall, prepend=0.0) * precision))
    return PrecisionRecall(threshold.astype(np.float64), precision, recall, area, len(positive))
