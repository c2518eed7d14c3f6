"""Search every run in every other run of its world, and see which answers are right."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lcd_common.settings import config, setting
from uncertain_place_recognition.embedded_run import EmbeddedRun, ordered_pairs
from uncertain_place_recognition.evaluation.ranking import (
    Method,
    Ranking,
    rank_aleatoric,
    rank_mean,
    rank_per_member,
    rank_single,
)

# Of each method: how it ranks, by whose embeddings, and which doubt its authors propose.
METHODS = {
    'teacher': (rank_single, 'teacher', 'similarity'),
    'student': (rank_single, 'students', 'similarity'),
    'shared': (rank_mean, 'students', 'u_norm'),
    'naive': (rank_mean, 'naive', 'u_norm'),
    'mason': (rank_per_member, 'naive', 'variance'),
    'dropout': (rank_mean, 'dropout', 'u_norm'),
    'stun': (None, 'stun', 'variance'),
}
STUN_VARIANCE = 'stun_variance'


@config
class PairConfig:
    """What counts as the same place, and how matches are ranked."""

    radius: float = setting(25.0, 'a match nearer than this is right', unit='m', low=0.0)
    excluded: float = setting(
        50.0, 'of a query without its place, entries nearer than this are taken away',
        unit='m', low=0.0,
    )  # fmt: skip
    metric: str = setting('cosine', 'ranking', choices=('cosine', 'euclidean'))
    matches: int = setting(25, 'matches that are kept', low=1)


@dataclass(frozen=True)
class JudgedPair:
    """Queries of one run, searched in another.

    Attributes:
        database, queries: numbers of the runs.
        size: entries of the database.
        ranking: of the method.
        right: [Q x K] whether a match lies within the radius.
        known: [Q] whether the database has an entry within the radius at all.
        where: [Q x K x 2] positions of the matches, metres; NaN where there is none.
        one_percent: entries that the first hundredth of the database has, at least one.
    """

    database: int
    queries: int
    size: int
    ranking: Ranking
    right: NDArray[np.bool_]
    known: NDArray[np.bool_]
    where: NDArray[np.float64]
    one_percent: int

    def hit(self, n: int) -> NDArray[np.bool_]:
        """Return [Q] whether one of the n best matches is right."""
        found: NDArray[np.bool_] = np.asarray(self.right[:, :n].any(axis=1))
        return found

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """Whether the best match [Q] is of another place."""
        return ~self.right[:, 0]


def judge_pairs(
    runs: Sequence[EmbeddedRun],
    method: str,
    settings: PairConfig | None = None,
    no_match_share: float = 0.0,
    seed: int = 0,
) -> list[JudgedPair]:
    """Judge a method of METHODS on all ordered pairs of runs of one world (`ordered_pairs`).

    Args:
        runs: all.
        method: of METHODS.
        settings: radius and metric.
        no_match_share: of queries, drawn, from whose database their place is taken away.
        seed: of the draw; the same queries for every method.

    Raises:
        DataError: a run lacks the embeddings, or no two runs are of one world.
    """
    s = settings or PairConfig()
    judged = []
    for m, n in ordered_pairs(runs):
        drawn = np.random.default_rng([seed, m, n]).random(len(runs[n]))
        masked = drawn < no_match_share if no_match_share > 0.0 else None
        judged.append(judge_pair(runs, (m, n), method, s, masked))
    return judged


def judge_pair(
    runs: Sequence[EmbeddedRun],
    pair: tuple[int, int],
    method: str,
    settings: PairConfig,
    masked: NDArray[np.bool_] | None = None,
) -> JudgedPair:
    """Judge one pair (database, queries).

    Args:
        runs: all.
        pair: numbers of two of them.
        method: of METHODS.
        settings: radius and metric.
        masked: [N] submaps of the second from whose database their place is taken away: they have
            no match.

    Returns:
        One row for every submap of the second run that asks.
    """
    s = settings
    database, queries = runs[pair[0]], runs[pair[1]].queries()
    asking = runs[pair[1]].asking
    if masked is not None and asking is not None:
        masked = masked[asking]
    tree = cKDTree(database.positions)
    known = tree.query(queries.positions)[0] <= s.radius
    allowed = None
    if masked is not None:
        allowed = np.ones((len(queries), len(database)), bool)
        near = tree.query_ball_point(queries.positions[masked], s.excluded)
        for query, entries in zip(np.flatnonzero(masked), near, strict=True):
            allowed[query, entries] = False
        known = known & ~masked
    rank, group = _rule(method, queries)
    # The share of the benchmark asks for 1 % of the database, whatever is kept otherwise.
    one_percent = max(round(len(database) / 100.0), 1)
    kept = max(s.matches, one_percent)
    ranking = rank(database.of(group), queries.of(group), s.metric, kept, allowed)
    where = np.where(ranking.entry[..., None] >= 0, database.positions[ranking.entry], np.nan)
    apart = np.linalg.norm(where - queries.positions[:, None], axis=-1)
    right = apart <= s.radius
    return JudgedPair(
        pair[0], pair[1], len(database), ranking, right, known, where, one_percent
    )  # fmt: skip


def available(runs: Sequence[EmbeddedRun]) -> list[str]:
    """Return the methods for which all runs have embeddings."""
    has = set.intersection(*(set(run.members) for run in runs)) if runs else set()
    return [
        name
        for name, (_, group, _) in METHODS.items()
        if group in has and (name != 'stun' or STUN_VARIANCE in has)
    ]


def _rule(method: str, queries: EmbeddedRun) -> tuple[Method, str]:
    rank, group, _ = METHODS[method]
    if rank is None:
        return rank_aleatoric(queries.of(STUN_VARIANCE)), group
    return rank, group
