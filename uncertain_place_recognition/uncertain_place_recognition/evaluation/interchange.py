"""See whether members share a feature space: database by one, queries by another (Table 4.1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from uncertain_place_recognition.embedded_run import EmbeddedRun, ordered_pairs
from uncertain_place_recognition.evaluation.pairs import PairConfig
from uncertain_place_recognition.evaluation.ranking import rank_single


@dataclass(frozen=True)
class Interchange:
    """Recall at 1 between members.

    Attributes:
        recall: [M x M], 0 .. 1, mean over pairs of runs; rows are the database's member.
        chance: recall of a match drawn at random.
    """

    recall: NDArray[np.float64]
    chance: float

    @property
    def diagonal(self) -> float:
        """Mean recall of members with themselves."""
        return float(np.diag(self.recall).mean())

    @property
    def off_diagonal(self) -> float | None:
        """Mean recall of one member's queries in another's database; None for a single member."""
        number = len(self.recall)
        if number < 2:
            return None
        return float(self.recall[~np.eye(number, dtype=bool)].mean())


def interchange(
    runs: Sequence[EmbeddedRun], ensemble: str, settings: PairConfig | None = None
) -> Interchange | None:
    """Search the queries of every member in the database of every member.

    Returns:
        None when no query has its place in a database.
    """
    s = settings or PairConfig()
    matrices, chances = [], []
    for m, n in ordered_pairs(runs):
        asking = runs[n].queries()
        tree = cKDTree(runs[m].positions)
        true = np.array([len(f) for f in tree.query_ball_point(asking.positions, s.radius)])
        known = true > 0
        if not known.any():
            continue
        database, queries = runs[m].of(ensemble), asking.of(ensemble)[known]
        here = asking.positions[known]
        matrices.append(
            [
                [
                    _recall(database[:, [i]], queries[:, [j]], runs[m].positions, here, s)
                    for j in range(queries.shape[1])
                ]
                for i in range(database.shape[1])
            ]
        )
        chances.append(np.mean(true[known] / len(database)))
    if not matrices:
        return None
    return Interchange(np.mean(matrices, axis=0), float(np.mean(chances)))


def _recall(
    database: NDArray[np.float32],
    queries: NDArray[np.float32],
    where: NDArray[np.float64],
    here: NDArray[np.float64],
    settings: PairConfig,
) -> float:
    best = rank_single(database, queries, settings.metric, 1).entry[:, 0]
    return float((np.linalg.norm(where[best] - here, axis=1) <= settings.radius).mean())
