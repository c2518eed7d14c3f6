"""Calibrate an ensemble on whole runs: fit probabilities to some, choose thresholds by others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError
from uncertain_place_recognition.acceptance import KINDS, Acceptance, make_acceptance
from uncertain_place_recognition.drift_alarm import DriftAlarm, DriftConfig, DriftReference
from uncertain_place_recognition.evaluation.calibration_error import Reliability, reliability
from uncertain_place_recognition.match_probability import MatchModel
from uncertain_place_recognition.query_table import QueryTable

# Probabilities need few queries; thresholds for rare errors need many.
FIT_SHARE = 1.0 / 3.0
TARGETS = (0.01, 0.05)


@dataclass(frozen=True)
class Calibrated:
    """What a calibration gave.

    Attributes:
        model: of probabilities, fitted to the first runs.
        acceptances: of all kinds and targets, from the others.
        drift: from all runs.
        reliability: of the probabilities, on the others.
        fit_runs, threshold_runs: numbers of the runs.
        false_alarms: share of runs that raise the drift alarm of all other runs.
    """

    model: MatchModel
    acceptances: tuple[Acceptance, ...]
    drift: DriftReference
    reliability: Reliability
    fit_runs: NDArray[np.int64]
    threshold_runs: NDArray[np.int64]
    false_alarms: float

    def acceptance(self, kind: str, target: float) -> Acceptance:
        """Return the acceptance of a kind and target; raises DataError when it was not asked."""
        for one in self.acceptances:
            if one.kind == kind and one.target == target:
                return one
        raise DataError(f'nothing was calibrated for {kind} of {target:g}')


def split_runs(
    table: QueryTable, rng: np.random.Generator, share: float = FIT_SHARE
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the runs to fit to and the runs to choose thresholds by, drawn.

    Raises:
        DataError: there are not two runs.
    """
    runs = rng.permutation(table.runs)
    if len(runs) < 2:
        raise DataError(f'a calibration needs at least two runs with queries, got {len(runs)}')
    first = int(np.clip(round(share * len(runs)), 1, len(runs) - 1))
    return np.sort(runs[:first]), np.sort(runs[first:])


def calibrate(
    table: QueryTable,
    targets: Sequence[float] = TARGETS,
    kinds: Sequence[str] = KINDS,
    confidence: float = 0.95,
    seed: int = 0,
) -> Calibrated:
    """Calibrate on the runs of a table.

    Args:
        table: of runs that the networks were not trained on.
        targets: rates of errors.
        kinds: of `acceptance.KINDS`.
        confidence: of the kind `precision`.
        seed: of the split into runs to fit to and runs to choose thresholds by.

    Raises:
        DataError: there are too few runs, or all matches are right or all wrong.
    """
    fit_runs, threshold_runs = split_runs(table, np.random.default_rng(seed))
    fitted, held = table.of_runs(fit_runs), table.of_runs(threshold_runs)
    model = MatchModel.fit(fitted.features, fitted.wrong)
    acceptances = choose_thresholds(model, fitted, held, targets, kinds, confidence)
    uncertainty = table.uncertainty_by_run()
    return Calibrated(
        model,
        acceptances,
        DriftReference.fit(uncertainty),
        reliability(model.false_match_probability(held.features), held.wrong),
        fit_runs,
        threshold_runs,
        false_alarms(uncertainty),
    )


def choose_thresholds(
    model: MatchModel,
    fitted: QueryTable,
    held: QueryTable,
    targets: Sequence[float],
    kinds: Sequence[str],
    confidence: float = 0.95,
) -> tuple[Acceptance, ...]:
    """Return the acceptances of a model, from queries that it was not fitted to."""
    belief = model.belief(held.features)
    pilot = model.belief(fitted.features), fitted.wrong
    return tuple(
        make_acceptance(
            kind, target, belief, held.wrong, held.run, held.database_size, confidence, pilot
        )
        for kind in kinds
        for target in targets
    )


def false_alarms(
    uncertainty: Sequence[NDArray[np.float64]], settings: DriftConfig | None = None
) -> float:
    """Return the share of runs [N each] at which the alarm of all the others rings."""
    rung = []
    for number, run in enumerate(uncertainty):
        others = [other for k, other in enumerate(uncertainty) if k != number]
        alarm = DriftAlarm(DriftReference.fit(others), settings)
        rung.append(any(alarm.update(value).alarm for value in run))
    return float(np.mean(rung))
