"""Errors, calibration and rejection of CMRNet's variants on simulated towns (Tables 5.1 to 5.4)."""

from pathlib import Path
from typing import Any

from benchmarks.cmrnet_sets import ROLES, judged
from cmrnet_ekf.evaluation.plots import write_pictures
from cmrnet_ekf.evaluation.tables import markdown

_MAIN_AXES = ('x', 'y', 'yaw')


def localization(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return errors of a single pass beside those of the guesses; in stages apart."""
    found = judged(work, quick)
    figures = found.plain()
    folder = work / 'pictures' / 'cmrnet'
    pictures = write_pictures(found, folder)
    (folder / 'results.md').write_text(markdown(figures, [path.name for path in pictures]))
    return {
        **figures['localization'],
        'conditions': {key: figures[key] for key in ('drives', 'samples', 'kinds')},
        'refined': figures['refined'],
        'by_count': figures['by_count'],
        'stretch': figures['stretch'],
        'relations': relations(figures),
    }


def calibration(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return calibration errors of each component, with sharpness and AUSE."""
    figures = judged(work, quick).plain()
    return {
        **figures['calibration'],
        'std': figures['calibration_std'],
        'sharpness': figures['sharpness'],
        'ause': figures['ause'],
    }


def rejection(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return errors without the top 15 % of either trace, and by that share."""
    figures = judged(work, quick).plain()
    return {**figures['rejection'], 'by_confidence': figures['by_confidence']}


def relations(figures: dict[str, Any]) -> dict[str, Any]:
    """Tell which relations of the thesis hold, of the networks that are there."""
    errors = {role: one for role, one in figures['localization'].items() if role in ROLES}
    best = min(errors, key=lambda role: errors[role]['t_mean_m'])
    found: dict[str, Any] = {'most_accurate': best, 'missing': sorted(set(ROLES) - set(errors))}
    if 'de' in errors:
        found['de_is_most_accurate'] = best == 'de'
    if 'der' in errors and 'cmrnet' in errors:
        found['der_to_cmrnet_t_mean'] = errors['der']['t_mean_m'] / errors['cmrnet']['t_mean_m']
    found['rejection_lowers_t_mean'] = {
        role: figures['rejection'][role]['t_mean_m'] < errors[role]['t_mean_m']
        for role in ('de', 'der')
        if role in errors
    }
    if 'der' in errors:
        calibrated = figures['calibration']['der']
        found['der_calibrated_within_0_05'] = {
            axis: calibrated[axis] <= 0.05 for axis in _MAIN_AXES
        }
    return found
