"""Gather what calibration learns from: queries of whole runs, and whether their match was wrong."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcd_common.errors import DataError
from uncertain_place_recognition.ambiguity import AmbiguityConfig, match_spread, second_place_ratio
from uncertain_place_recognition.embedded_run import EmbeddedRun
from uncertain_place_recognition.evaluation.pairs import JudgedPair, PairConfig, judge_pair

_WORLD_M = 1e6  # between worlds that share a map


@dataclass(frozen=True)
class QueryTable:
    """One row a query, in the order of driving within a run.

    Attributes:
        features: [N x F], in the order of `match_probability.FEATURES`.
        wrong: [N] whether the best match is of another place.
        known: [N] whether the place was in the map at all.
        run: [N] number of the run.
        names: of the runs, by their number.
        database_size: entries that were searched, the median.
        metric: by which places are ranked.
    """

    features: NDArray[np.float64]
    wrong: NDArray[np.bool_]
    known: NDArray[np.bool_]
    run: NDArray[np.int64]
    names: tuple[str, ...]
    database_size: int
    metric: str

    def __len__(self) -> int:
        return len(self.wrong)

    @property
    def runs(self) -> NDArray[np.int64]:
        """Numbers of the runs that have queries."""
        return np.unique(self.run)

    def of_runs(self, chosen: ArrayLike) -> 'QueryTable':
        """Return the queries of some runs."""
        rows = np.isin(self.run, np.asarray(chosen))
        return QueryTable(
            self.features[rows], self.wrong[rows], self.known[rows], self.run[rows], self.names,
            self.database_size, self.metric,
        )  # fmt: skip

    def uncertainty_by_run(self) -> list[NDArray[np.float64]]:
        """Return the normalised u_EV of each run, in the order of driving."""
        return [self.features[self.run == number, 1] for number in self.runs]


def query_table(
    runs: Sequence[EmbeddedRun],
    settings: PairConfig | None = None,
    no_match_share: float = 0.5,
    seed: int = 0,
    ambiguity: AmbiguityConfig | None = None,
    together: bool = False,
) -> QueryTable:
    """Search every run in the map that all other runs of its world make.

    A larger map holds more places that look like a query, so a promise covers maps up to about the
    calibration's. With `together` the maps of all worlds are one, and the promise covers that size.

    Places that the map does not have are what an acceptance must refuse above all, and no drive
    through a mapped town offers them: of a share of queries, drawn, the place is taken out of the
    map. The share is what probabilities rest on, as a prior.

    Args:
        runs: with embeddings `students` of the ensemble.
        settings: radius and metric.
        no_match_share: of queries without their place.
        seed: of the draw.
        ambiguity: as in use.
        together: with the runs of all other worlds in the same map, where they are never right.

    Raises:
        DataError: no world has two runs, or the embeddings are missing.
    """
    s = settings or PairConfig()
    columns: list[tuple[NDArray[np.float64], JudgedPair, int]] = []
    for number, queries in enumerate(runs):
        others = [run for run in runs if run.world == queries.world and run is not queries]
        if not others or not len(queries):
            continue
        if together:
            others += _elsewhere(runs, queries.world)
        drawn = np.random.default_rng([seed, number]).random(len(queries))
        judged = judge_pair([one_map(others), queries], (0, 1), 'shared', s, drawn < no_match_share)
        columns.append((feature_rows(judged, s.metric, ambiguity), judged, number))
    if not columns:
        raise DataError(
            'no world has two runs: a run is calibrated in the map that the others make '
            f'({", ".join(f"{run.name} in {run.world}" for run in runs) or "no runs"})'
        )
    rows = np.concatenate([features for features, _, _ in columns])
    # A query for which no entry is left has no match that could be believed.
    sound = np.isfinite(rows).all(axis=1)
    return QueryTable(
        rows[sound],
        np.concatenate([judged.wrong for _, judged, _ in columns])[sound],
        np.concatenate([judged.known for _, judged, _ in columns])[sound],
        np.concatenate([np.full(len(j.known), number) for _, j, number in columns])[sound],
        tuple(run.name for run in runs),
        int(np.median([judged.size for _, judged, _ in columns])),
        s.metric,
    )


def feature_rows(
    judged: JudgedPair, metric: str, ambiguity: AmbiguityConfig | None = None
) -> NDArray[np.float64]:
    """Return the features [Q x F] of shared-space queries: the same as `trust.match_features`."""
    ranking = judged.ranking
    apart = ranking.distance if metric == 'euclidean' else 1.0 - ranking.similarity
    kept = (ambiguity or AmbiguityConfig()).matches
    found = judged.ranking.entry[:, :kept] >= 0
    # What is missing is so far away that it has no weight.
    distance = np.where(found, apart[:, :kept].astype(np.float64), np.inf)
    where = np.where(found[..., None], judged.where[:, :kept], judged.where[:, :1])
    return np.column_stack(
        [
            distance[:, 0],
            ranking.doubt['u_norm'],
            match_spread(distance, where, ambiguity),
            second_place_ratio(distance, where, ambiguity),
        ]
    )


def spacing_m(runs: Sequence[EmbeddedRun]) -> float | None:
    """Return how far apart submaps of a run are, the median; None of runs with one submap."""
    apart = [np.linalg.norm(np.diff(run.positions, axis=0), axis=1) for run in runs]
    every = np.concatenate([*apart, np.empty(0)])
    return float(np.median(every)) if len(every) else None


def _elsewhere(runs: Sequence[EmbeddedRun], world: str) -> list[EmbeddedRun]:
    """Return the runs of all other worlds, each world far from the others."""
    worlds = sorted({run.world for run in runs} - {world})
    return [
        replace(run, positions=run.positions + _WORLD_M * (1 + worlds.index(run.world)))
        for run in runs
        if run.world != world
    ]


def one_map(runs: Sequence[EmbeddedRun]) -> EmbeddedRun:
    """Return runs as one database of the first one's world, with the ensembles that all have."""
    groups = set.intersection(*(set(run.members) for run in runs))
    return EmbeddedRun(
        ' + '.join(run.name for run in runs),
        runs[0].world,
        np.concatenate([run.stamps_ns for run in runs]),
        np.concatenate([run.positions for run in runs]),
        {name: np.concatenate([run.members[name] for run in runs]) for name in sorted(groups)},
    )
