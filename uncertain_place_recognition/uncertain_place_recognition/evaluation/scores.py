"""Compare doubts as detectors of wrong matches, with intervals over runs and removal curves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_place_recognition.ambiguity import AmbiguityConfig
from uncertain_place_recognition.evaluation.bootstrap import drawn_pairs, interval
from uncertain_place_recognition.evaluation.failure import (
    aurc,
    auroc,
    failure_detection,
    false_positive_rate,
    recall_at_precision,
    removal_curve,
    risk_coverage,
)
from uncertain_place_recognition.evaluation.pairs import JudgedPair
from uncertain_place_recognition.match_probability import MatchModel
from uncertain_place_recognition.query_table import feature_rows

# Doubts that are compared: the method whose matches they judge, and the measure.
SCORES = {
    'shared_combined': ('shared', 'combined'),
    'shared_u': ('shared', 'u_norm'),
    'shared_u_raw': ('shared', 'u'),
    'shared_ambiguity': ('shared', 'ambiguity'),
    'shared_ratio': ('shared', 'ratio'),
    'distance': ('shared', 'top1'),
    'naive': ('naive', 'u_norm'),
    'naive_distance': ('naive', 'top1'),
    'mason_variance': ('mason', 'variance'),
    'mason_similarity': ('mason', 'similarity'),
    'dropout': ('dropout', 'u_norm'),
    'stun': ('stun', 'variance'),
    'teacher_distance': ('teacher', 'top1'),
}
REMOVED = np.linspace(0.0, 0.9, 19)
DRAWS = 200
_WITH_INTERVAL: dict[str, Callable[[NDArray[np.float64], NDArray[np.bool_]], float]] = {
    'auroc': auroc,
    'aurc': aurc,
    'fpr95': false_positive_rate,
    'recall_at_p99': partial(recall_at_precision, precision=0.99),
}


@dataclass(frozen=True)
class JudgedScore:
    """What a doubt is worth on the queries of all pairs.

    Attributes:
        figures: of `FailureDetection`, and `<figure>_low`, `<figure>_high` over runs.
        removal: by N, the recall at N [S] after removing the shares REMOVED; mean over pairs.
        oracle: the same for a doubt that knows which best matches are wrong.
        coverage, risk: of the risk-coverage curve.
    """

    figures: dict[str, Any]
    removal: dict[int, NDArray[np.float64]]
    oracle: dict[int, NDArray[np.float64]]
    coverage: NDArray[np.float64]
    risk: NDArray[np.float64]


def doubt_of(
    pair: JudgedPair,
    measure: str,
    metric: str,
    model: MatchModel | None = None,
    ambiguity: AmbiguityConfig | None = None,
) -> NDArray[np.float64]:
    """Return a doubt [Q]: a measure of the ranking, a feature by name, or the model's belief."""
    if measure == 'top1':
        return pair.ranking.doubt['distance' if metric == 'euclidean' else 'similarity']
    if measure in ('combined', 'ambiguity', 'ratio'):
        rows = feature_rows(pair, metric, ambiguity)
        if measure == 'combined':
            assert model is not None
            return -model.belief(rows)
        # Without any match left there is nothing to compare: that is the most doubt.
        return np.nan_to_num(rows[:, 2 if measure == 'ambiguity' else 3], nan=np.inf)
    return pair.ranking.doubt[measure]


def judge_score(
    judged: Sequence[JudgedPair], doubts: Sequence[NDArray[np.float64]], open_set: bool = False
) -> JudgedScore | None:
    """Judge a doubt on all pairs together; None when no query counts.

    Args:
        judged: pairs.
        doubts: [Q] of each pair.
        open_set: count queries whose place the database does not have: their matches are wrong.
            The benchmark leaves them out.
    """
    parts = []
    for pair, doubt in zip(judged, doubts, strict=True):
        counted = np.ones(len(doubt), bool) if open_set else pair.known
        if counted.any():
            hits = {n: pair.hit(n)[counted] for n in (1, 5, 10)}
            parts.append(((pair.database, pair.queries), doubt[counted], hits))
    if not parts:
        return None
    names = [name for name, _, _ in parts]
    values = [doubt for _, doubt, _ in parts]
    wrong = [~hits[1] for _, _, hits in parts]
    figures = failure_detection(np.concatenate(values), np.concatenate(wrong)).plain()
    drawn = [
        (np.concatenate([values[k] for k in chosen]), np.concatenate([wrong[k] for k in chosen]))
        for chosen in drawn_pairs(names, DRAWS)
    ]
    drawn = [(doubt, failed) for doubt, failed in drawn if failed.any() and not failed.all()]
    for name, figure in _WITH_INTERVAL.items():
        ends = interval([figure(doubt, failed) for doubt, failed in drawn])
        figures[f'{name}_low'], figures[f'{name}_high'] = ends or (None, None)
    coverage, risk = risk_coverage(np.concatenate(values), np.concatenate(wrong))
    return JudgedScore(
        figures,
        {n: _removal([(d, hits[n]) for _, d, hits in parts]) for n in (1, 5, 10)},
        {
            n: _removal([((~hits[n]).astype(float), hits[n]) for _, _, hits in parts])
            for n in (1, 5, 10)
        },
        coverage,
        risk,
    )


def _removal(
    parts: Sequence[tuple[NDArray[np.float64], NDArray[np.bool_]]],
) -> NDArray[np.float64]:
    """Return the mean over runs: each is a drive that removes its own most doubted queries."""
    return np.mean([removal_curve(doubt, hit, REMOVED) for doubt, hit in parts], axis=0)
