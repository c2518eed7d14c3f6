"""Evaluate all methods for which runs have embeddings, and put the figures together."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from uncertain_place_recognition.ambiguity import AmbiguityConfig
from uncertain_place_recognition.embedded_run import EmbeddedRun, ordered_pairs
from uncertain_place_recognition.evaluation.calibration_error import Reliability, reliability
from uncertain_place_recognition.evaluation.interchange import Interchange, interchange
from uncertain_place_recognition.evaluation.pairs import PairConfig, available, judge_pairs
from uncertain_place_recognition.evaluation.recall import Recall, recall
from uncertain_place_recognition.evaluation.scores import (
    SCORES,
    JudgedScore,
    doubt_of,
    judge_score,
)
from uncertain_place_recognition.match_probability import MatchModel
from uncertain_place_recognition.query_table import feature_rows

_NO_SPACE = ('stun_variance',)


@dataclass(frozen=True)
class Study:
    """What was found.

    Attributes:
        recall: of each method.
        scores: of each doubt of `scores.SCORES`.
        interchange: of each ensemble with more than one member.
        reliability: of the model's probabilities; None without a model.
        facts: runs, settings.
    """

    recall: dict[str, Recall]
    scores: dict[str, JudgedScore]
    interchange: dict[str, Interchange]
    reliability: Reliability | None
    facts: dict[str, Any] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """Return the figures as JSON has them; shares are 0 .. 1."""
        return {
            **self.facts,
            'recall': {name: recall_figures(one) for name, one in self.recall.items()},
            'failure': {name: one.figures for name, one in self.scores.items()},
            'interchange': {
                name: interchange_figures(one) for name, one in self.interchange.items()
            },
            'probability': None
            if self.reliability is None
            else {'ece': self.reliability.ece, 'brier': self.reliability.brier},
        }


def study(
    runs: Sequence[EmbeddedRun],
    settings: PairConfig | None = None,
    model: MatchModel | None = None,
    open_set: bool = False,
    no_match_share: float = 0.0,
    seed: int = 0,
    ambiguity: AmbiguityConfig | None = None,
) -> Study:
    """Evaluate every method on all ordered pairs of runs of one world (`ordered_pairs`).

    Args:
        runs: with embeddings by the names that `pairs.METHODS` uses.
        settings: radius and metric.
        model: of match probabilities, for the score `shared_combined`; it must not have been fitted
            to these runs.
        open_set: count queries without their place in the database as failures.
        no_match_share: of queries, drawn, from whose database their place is taken away.
        seed: of the draw.
        ambiguity: as the model was fitted with.

    Raises:
        DataError: no two runs are of one world, or none of them asks in another one.
    """
    s = settings or PairConfig()
    judged = {name: judge_pairs(runs, name, s, no_match_share, seed) for name in available(runs)}
    recalls = {name: recall(pairs) for name, pairs in judged.items()}
    scores = {}
    for name, (method, measure) in SCORES.items():
        if method in judged and (measure != 'combined' or model is not None):
            doubts = [
                doubt_of(pair, measure, s.metric, model, ambiguity) for pair in judged[method]
            ]
            scores[name] = judge_score(judged[method], doubts, open_set)
    groups = set.intersection(*(set(run.members) for run in runs)) - set(_NO_SPACE)
    exchanged = {
        name: interchange(runs, name, s) for name in sorted(groups) if runs[0].of(name).shape[1] > 1
    }
    observed = None
    if model is not None and 'shared' in judged:
        rows = np.concatenate(
            [feature_rows(pair, s.metric, ambiguity) for pair in judged['shared']]
        )
        wrong = np.concatenate([pair.wrong for pair in judged['shared']])
        observed = reliability(model.false_match_probability(rows), wrong)
    facts = {
        'runs': [
            {
                'name': r.name, 'world': r.world, 'submaps': len(r), 'searched': r.searched,
                'queries': len(r.queries()),
            }
            for r in runs
        ],
        'pairs': len(ordered_pairs(runs)),
        'metric': s.metric,
        'radius_m': s.radius,
        'open_set': open_set,
        'no_match_share': no_match_share,
        'ambiguity': asdict(ambiguity or AmbiguityConfig()),
    }  # fmt: skip
    return Study(
        {name: one for name, one in recalls.items() if one is not None},
        {name: one for name, one in scores.items() if one is not None},
        {name: one for name, one in exchanged.items() if one is not None},
        observed,
        facts,
    )


def recall_figures(found: Recall) -> dict[str, Any]:
    """Return r1, r5, r10, their intervals and the recall at 1 %, as shares."""
    figures: dict[str, Any] = {f'r{n}': share for n, share in found.at.items()}
    for n, ends in found.interval.items():
        figures[f'r{n}_low'], figures[f'r{n}_high'] = ends or (None, None)
    return {
        **figures,
        'one_percent': found.one_percent,
        'pairs': found.pairs,
        'queries': found.queries,
    }


def interchange_figures(found: Interchange) -> dict[str, Any]:
    """Return diagonal_r1, off_diagonal_r1, chance_r1 and the matrix, as shares."""
    return {
        'diagonal_r1': found.diagonal,
        'off_diagonal_r1': found.off_diagonal,
        'chance_r1': found.chance,
        'matrix': found.recall.tolist(),
    }
