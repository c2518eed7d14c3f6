"""Turn what methods said into the figures of Tables 5.1 to 5.4; nothing here is fitted."""

from dataclasses import asdict
from typing import Any

import numpy as np

from cmrnet_ekf.calibration import AXES, ause, calibration, sharpness
from cmrnet_ekf.evaluation.answers import Answers
from cmrnet_ekf.rejection import accepted, rejection_thresholds, traces
from lcd_common.errors import DataError
from lcd_common.se3 import Array

SHARE = 0.15
SHARES: Array = np.linspace(0.0, 0.6, 25)
MCD_COUNTS = (2, 3, 5, 10, 20, 30, 50, 100)
_LEAST_LEFT = 0.05


def of_uncertainty(answers: Answers) -> dict[str, dict[str, float]]:
    """Return calibration errors, sharpness and AUSE of a method that knows.

    Calibration errors are those of central intervals of the method's own law: Student-t of
    evidence, normal of the others.
    """
    curves = calibration(answers.belief, answers.target)
    metres, radians = answers.errors
    of_translation, of_rotation = traces(answers.belief).T
    return {
        'calibration': {axis: curve.mean_error for axis, curve in curves.items()},
        'calibration_std': {axis: curve.std_error for axis, curve in curves.items()},
        'sharpness': dict(zip(AXES, sharpness(answers.belief).tolist(), strict=True)),
        'ause': {
            'translation': ause(metres, of_translation),
            'rotation': ause(radians, of_rotation),
        },
    }


def after_rejection(answers: Answers, share: float = SHARE) -> dict[str, float]:
    """Return the errors of what is kept, and the share of what is discarded (Table 5.4).

    Discarded is what has either trace, of translation or of rotation, in the top share. The traces
    from which on it is are given by the names of map_registration's parameters.

    Raises:
        DataError: nothing is left.
    """
    found = traces(answers.belief)
    limits = rejection_thresholds(found, share)
    keep = accepted(found, thresholds=limits)
    if not keep.any():
        raise DataError(f'nothing is left of {len(keep)} samples: judge more of them')
    return {
        **asdict(answers.summary(keep)),
        'discarded_share': float(1.0 - keep.mean()),
        'max_trace_translation': float(limits[0]),
        'max_trace_rotation': float(limits[1]),
    }


def by_confidence(answers: Answers) -> dict[str, list[float]]:
    """Return mean errors of what is kept against the top share that is discarded (Fig. 5.5).

    It ends where too few are left to have a mean.
    """
    found = traces(answers.belief)
    least = max(_LEAST_LEFT * len(found), 1)
    shares = [float(share) for share in SHARES if accepted(found, float(share)).sum() >= least]
    rows = [after_rejection(answers, share) for share in shares]
    keys = ('t_mean_m', 'r_mean_deg', 'discarded_share')
    return {'top_share': shares, **{key: [row[key] for row in rows] for key in keys}}


def by_count(answers: Answers) -> dict[str, dict[str, Any]]:
    """Return errors and calibration by the number of draws or members.

    Of an ensemble every run of so many members, round the circle, counts, and means are told.
    """
    assert answers.draws is not None
    total = len(answers.draws)
    found = {}
    if answers.kind == 'mcd':
        for count in [n for n in MCD_COUNTS if n <= total]:
            found[str(count)] = _mean([_with(answers.drawn(slice(count)))])
    else:
        for count in range(2, total + 1):
            starts = range(total if count < total else 1)
            members = [[(k + i) % total for i in range(count)] for k in starts]
            found[str(count)] = _mean([_with(answers.drawn(some)) for some in members])
    return found


def _with(answers: Answers) -> dict[str, float]:
    errors = answers.summary()
    row = {'t_median_m': errors.t_median_m, 't_mean_m': errors.t_mean_m}
    row |= {'r_median_deg': errors.r_median_deg, 'r_mean_deg': errors.r_mean_deg}
    if answers.knows:
        known = of_uncertainty(answers)
        row |= {f'calibration_{axis}': value for axis, value in known['calibration'].items()}
        row |= {'ause_translation': known['ause']['translation']}
    return row


def _mean(rows: list[dict[str, float]]) -> dict[str, float]:
    keys = [key for key in rows[0] if all(key in row for row in rows)]
    return {key: float(np.mean([row[key] for row in rows])) for key in keys}
