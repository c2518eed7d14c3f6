"""Choose the pairs of scans that registration is judged on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lcd_common import se3
from lcd_loop_closure.evaluation.detection import passed_reverse
from lcd_loop_closure.revisits import RevisitConfig


@dataclass(frozen=True)
class Band:
    """Pairs by their true distance, metres: above `low_m` (or from 0 on) and up to `high_m`."""

    low_m: float
    high_m: float

    @property
    def name(self) -> str:
        """How results name it, e.g. 0_4."""
        return f'{self.low_m:g}_{self.high_m:g}'


BANDS = (Band(0.0, 4.0), Band(4.0, 10.0), Band(10.0, 15.0))


@dataclass(frozen=True)
class RegistrationPairs:
    """Pairs of scans and where they truly lie to each other.

    Attributes:
        match, query: [P] scans, ordered by the query.
        T_match_query: [P x 4 x 4].
        reverse: [P] passed in another direction.
        total: pairs there were to draw from.
    """

    match: NDArray[np.intp]
    query: NDArray[np.intp]
    T_match_query: se3.Array
    reverse: NDArray[np.bool_]
    total: int

    def __len__(self) -> int:
        return len(self.match)


def choose_pairs(
    T_world_base: se3.Array,
    band: Band = BANDS[0],
    settings: RevisitConfig | None = None,
    *,
    count: int | None = None,
    seed: int = 0,
) -> RegistrationPairs:
    """Return all pairs (i, j) with i >= `first_scan`, j <= i - `excluded_scans` in a distance band.

    Args:
        T_world_base: [N x 4 x 4] true poses.
        band: of true distances.
        settings: which scans count; its `distance` does not.
        count: at most so many, drawn at random; None: all.
        seed: of the draw.
    """
    s = settings or RevisitConfig()
    T_world_base = np.asarray(T_world_base, np.float64)
    positions = T_world_base[:, :3, 3]
    tree = cKDTree(positions) if len(positions) else None
    found = [np.empty((0, 2), np.intp)]
    for i in range(s.first_scan, len(positions)):
        assert tree is not None
        near = np.array(sorted(tree.query_ball_point(positions[i], band.high_m)), np.intp)
        near = near[near <= i - s.excluded_scans]
        if band.low_m > 0.0 and len(near):
            away = np.linalg.norm(positions[near] - positions[i], axis=1)
            near = near[away > band.low_m]
        found.append(np.column_stack([near, np.full(len(near), i, np.intp)]))
    pairs = np.concatenate(found)
    total = len(pairs)
    if count is not None and total > count:
        drawn = np.random.default_rng([seed, 17]).choice(total, count, replace=False)
        pairs = pairs[np.sort(drawn)]
    return pairs_of(T_world_base, pairs[:, 0], pairs[:, 1], total)


def pairs_of(
    T_world_base: se3.Array,
    match: NDArray[np.intp],
    query: NDArray[np.intp],
    total: int | None = None,
) -> RegistrationPairs:
    """Return given pairs with their true poses."""
    heading = np.arctan2(T_world_base[:, 1, 0], T_world_base[:, 0, 0])
    return RegistrationPairs(
        match,
        query,
        se3.inverse(T_world_base[match]) @ T_world_base[query],
        passed_reverse(heading[match], heading[query]),
        len(match) if total is None else total,
    )
