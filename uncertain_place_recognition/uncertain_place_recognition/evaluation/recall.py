"""Count found places by the rules of the PointNetVLAD benchmark (Uy and Lee, CVPR 2018)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_place_recognition.evaluation.bootstrap import mean_interval
from uncertain_place_recognition.evaluation.pairs import JudgedPair

RANKS = (1, 5, 10)


@dataclass(frozen=True)
class Recall:
    """Shares of queries with a right match among the best, 0 .. 1.

    Queries whose place the database does not have are left out; pairs of runs count alike, however
    long they are.

    Attributes:
        at: mean over pairs by N of RANKS.
        one_percent: mean over pairs for N = 1 % of each database.
        interval: 95 % interval of each of `at` over runs; None with too few runs.
        pairs: that have queries.
        queries: of all pairs.
    """

    at: dict[int, float]
    one_percent: float
    interval: dict[int, tuple[float, float] | None]
    pairs: int
    queries: int


def recall(judged: Sequence[JudgedPair]) -> Recall | None:
    """Return the recall of judged pairs; None when no query has its place in a database."""
    counted = [pair for pair in judged if pair.known.any()]
    if not counted:
        return None
    names = [(pair.database, pair.queries) for pair in counted]
    by_rank = {n: recall_at(counted, n) for n in RANKS}
    one = np.mean([pair.hit(pair.one_percent)[pair.known].mean() for pair in counted])
    return Recall(
        {n: float(values.mean()) for n, values in by_rank.items()},
        float(one),
        {n: mean_interval(names, values) for n, values in by_rank.items()},
        len(counted),
        sum(int(pair.known.sum()) for pair in counted),
    )


def recall_at(judged: Sequence[JudgedPair], n: int) -> NDArray[np.float64]:
    """Return the recall at n [P] of each pair; NaN for a pair without queries that count."""
    return np.array(
        [
            pair.hit(n)[pair.known].mean() if pair.known.any() else np.nan
            for pair in judged
        ]
    )  # fmt: skip
