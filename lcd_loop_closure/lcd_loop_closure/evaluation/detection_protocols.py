"""Protocol 1: judge the most similar earlier scan of each scan (thesis section 3.3.3)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_loop_closure.revisits import RevisitConfig

# Distances [M] from scan i to the scans 0..M-1.
DistancesTo = Callable[[int, int], NDArray[np.floating]]


@dataclass(frozen=True)
class PrecisionRecall:
    """A precision-recall curve and the area under it.

    Attributes:
        threshold: [K] increasing; a candidate is accepted when its distance is at most this.
        precision, recall: [K] at these thresholds.
        average_precision: sum of (R_k - R_k-1) P_k, by protocol 1 from the second threshold on, as
            in the thesis's evaluation.
        loops: scans that do return to a place; by protocol 2 pairs of one place.
    """

    threshold: NDArray[np.float64]
    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    average_precision: float
    loops: int

    @property
    def f1(self) -> NDArray[np.float64]:
        """F1 score [K] at the thresholds."""
        both = self.precision + self.recall
        return np.divide(
            2.0 * self.precision * self.recall, both, out=np.zeros_like(both), where=both > 0
        )

    @property
    def f1_max(self) -> float:
        """Largest F1 score; zero without a curve."""
        return float(self.f1.max(initial=0.0))

    @property
    def best_threshold(self) -> float | None:
        """Threshold of the largest F1 score; None without a curve."""
        return float(self.threshold[int(np.argmax(self.f1))]) if len(self.threshold) else None

    @property
    def recall_without_error(self) -> float:
        """Largest recall while all that is accepted is right."""
        return float(self.recall[self.precision >= 1.0].max(initial=0.0))


@dataclass(frozen=True)
class Candidates:
    """The most similar earlier scan of each scan.

    Attributes:
        query, match: [Q] scans.
        distance: [Q] of their descriptors.
        right: [Q] whether the match is near in truth.
        loop: [Q] whether any earlier scan is.
    """

    query: NDArray[np.intp]
    match: NDArray[np.intp]
    distance: NDArray[np.float64]
    right: NDArray[np.bool_]
    loop: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.query)

    def select(self, mask: NDArray[np.bool_]) -> 'Candidates':
        """Return the chosen ones."""
        return Candidates(
            self.query[mask],
            self.match[mask],
            self.distance[mask],
            self.right[mask],
            self.loop[mask],
        )

    @property
    def recall_1(self) -> float | None:
        """Share of the scans that return to a place whose match shows it; None without any."""
        return float(self.right[self.loop].mean()) if self.loop.any() else None


def candidates(
    distances_to: DistancesTo,
    positions: NDArray[np.floating],
    settings: RevisitConfig | None = None,
) -> Candidates:
    """Return what protocol 1 accepts or rejects: the best j < i - `excluded_scans` of each scan i.

    Args:
        distances_to: `distances_to(i, m)` gives the descriptor distances [m] of scan i to the scans
            0 .. m - 1.
        positions: [N x 3] true positions, metres.
        settings: which scans count.
    """
    s = settings or RevisitConfig()
    rows = []
    for i in range(s.first_scan, len(positions)):
        # As in the authors' compute_PR; Table 3.1 also counts j = i - excluded_scans.
        earlier = i - s.excluded_scans
        if earlier < 1:
            continue
        rows.append(candidate(i, np.asarray(distances_to(i, earlier)), positions, s.distance))
    return joined(rows)


def candidate(
    i: int, distance: NDArray[np.floating], positions: NDArray[np.floating], near_m: float
) -> tuple[int, int, float, bool, bool]:
    """Return the most similar of the first scans to scan i, as a row for `joined`."""
    best = int(np.argmin(distance))
    near = np.linalg.norm(positions[: len(distance)] - positions[i], axis=1) <= near_m
    return i, best, float(distance[best]), bool(near[best]), bool(near.any())


def joined(rows: list[tuple[int, int, float, bool, bool]]) -> Candidates:
    """Return rows (query, match, distance, right, loop) as arrays."""
    query, match, distance, right, loop = zip(*rows, strict=True) if rows else ([],) * 5
    return Candidates(
        np.array(query, np.intp),
        np.array(match, np.intp),
        np.array(distance, np.float64),
        np.array(right, bool),
        np.array(loop, bool),
    )


def protocol_1(found: Candidates) -> PrecisionRecall:
    """Return precision and recall of the nearest candidates.

    A wrong candidate at a real loop is a false positive when accepted, and a missed loop otherwise.
    A scan without a candidate, at an infinite distance, is never accepted.
    """
    threshold = np.unique(found.distance[np.isfinite(found.distance)])
    order = np.argsort(found.distance, kind='stable')
    distance, right, loop = found.distance[order], found.right[order], found.loop[order]
    accepted = np.searchsorted(distance, threshold, side='right')
    before = np.concatenate([[0], np.cumsum(right & loop)])
    missed = np.concatenate([[0], np.cumsum(loop)])
    true = before[accepted].astype(np.float64)
    false = np.concatenate([[0], np.cumsum(~right)])[accepted]
    not_found = missed[-1] - missed[accepted]
    precision = np.divide(true, true + false, out=np.ones_like(true), where=true + false > 0)
    recall = np.divide(true, true + not_found, out=np.zeros_like(true), where=true + not_found > 0)
    area = float(np.sum(np.diff(recall) * precision[1:]))
    return PrecisionRecall(threshold, precision, recall, area, int(loop.sum()))
