"""Judge networks while they are trained, on runs of towns that they are not trained on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError
from uncertain_place_recognition.runs import SubmapRun
from uncertain_place_recognition.uncertainty import total_uncertainty

RADIUS_M = 25.0  # of a true match, as in the benchmark
_GAP_NS = 30_000_000_000

Embeddings = Sequence[NDArray[np.float32]]


@dataclass(frozen=True)
class Recall:
    """Recall@1 over validation runs.

    Attributes:
        recall_1: mean over the runs that queries come from.
        queries: of all runs that have a true match.
        chance: recall@1 of a match drawn at random.
    """

    recall_1: float
    queries: int
    chance: float


def recall(
    runs: Sequence[SubmapRun],
    database: Embeddings,
    queries: Embeddings,
    radius: float = RADIUS_M,
) -> Recall:
    """Return how often the nearest embedding is a true match.

    Every submap asks among all others, of other runs and of its own run at least 30 s away; a
    true match lies within the radius [m] in the same world. Submaps without one are left out.
    Database and queries [N x D] of each run may come from two networks.

    Raises:
        DataError: no submap has a true match.
    """
    xy = np.concatenate([run.positions for run in runs])
    stamp = np.concatenate([run.stamps_ns for run in runs])
    number = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
    worlds = np.array([run.world for run in runs])
    vectors = np.concatenate(list(database)).astype(np.float32)
    squared = np.square(vectors).sum(1)
    shares, chances, total = [], [], 0
    for k, (run, asking) in enumerate(zip(runs, queries, strict=True)):
        allowed = (number != k) | (np.abs(stamp - run.stamps_ns[:, None]) >= _GAP_NS)
        distance = np.linalg.norm(run.positions[:, None] - xy, axis=2)
        true = allowed & (worlds[number] == run.world) & (distance <= radius)
        asked = true.any(axis=1)
        if not asked.any():
            continue
        # The query's own square is the same for all, so it does not matter.
        score = squared - 2.0 * asking @ vectors.T
        nearest = np.where(allowed, score, np.inf).argmin(axis=1)
        shares.append(float(true[np.arange(len(run)), nearest][asked].mean()))
        chances.append(float((true.sum(1) / np.maximum(allowed.sum(1), 1))[asked].mean()))
        total += int(asked.sum())
    if not shares:
        raise DataError(
            f'no submap of {len(runs)} validation runs has a true match within {radius:g} m: '
            'give two runs of each world'
        )
    return Recall(float(np.mean(shares)), total, float(np.mean(chances)))


@dataclass(frozen=True)
class Interchange:
    """What members make of one another's maps (thesis tables 4.1 and 4.2).

    Attributes:
        recall_1: [M x M], the row's member embeds the database, the column's the queries.
        chance: recall@1 of a match drawn at random.
        diversity: mean u_EV divided by the squared norm of the mean embedding.
    """

    recall_1: NDArray[np.float64]
    chance: float
    diversity: float

    @property
    def diagonal(self) -> float:
        """Mean recall@1 of members on their own maps."""
        return float(np.diag(self.recall_1).mean())

    @property
    def off_diagonal(self) -> float:
        """Mean recall@1 on one another's maps; that of the own maps where there is one member."""
        mask = ~np.eye(len(self.recall_1), dtype=bool)
        return float(self.recall_1[mask].mean()) if mask.any() else self.diagonal


def interchange(
    runs: Sequence[SubmapRun], members: Sequence[Embeddings], radius: float = RADIUS_M
) -> Interchange:
    """Return how well members [M] understand one another, from their embeddings of each run."""
    table = np.zeros((len(members), len(members)))
    chance = 0.0
    for row, database in enumerate(members):
        for column, queries in enumerate(members):
            found = recall(runs, database, queries, radius)
            table[row, column], chance = found.recall_1, found.chance
    stacked = np.stack([np.concatenate(list(one)) for one in members], axis=1)
    return Interchange(table, chance, float(np.mean(total_uncertainty(stacked, normalised=True))))
