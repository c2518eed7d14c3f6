"""Interchange of members, recall, failure detection and promised rates (thesis 4.3)."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.place_sets import (
    ARCHITECTURES,
    CALIBRATION,
    SETS,
    TestSet,
    embedded,
    shortened,
    trained_for,
)
from uncertain_place_recognition.calibration import Calibrated, calibrate
from uncertain_place_recognition.drift_alarm import DriftAlarm
from uncertain_place_recognition.embedded_run import EmbeddedRun
from uncertain_place_recognition.evaluation.figures import write_pictures
from uncertain_place_recognition.evaluation.guarantee import observe
from uncertain_place_recognition.evaluation.interchange import interchange
from uncertain_place_recognition.evaluation.pairs import PairConfig, available, judge_pairs
from uncertain_place_recognition.evaluation.recall import recall
from uncertain_place_recognition.evaluation.study import (
    interchange_figures,
    recall_figures,
    study,
)
from uncertain_place_recognition.query_table import QueryTable, query_table
from uncertain_place_recognition.run_inputs import ROLES

TARGETS = (0.01, 0.05)
# Tables and curves of all methods are of this one; both are in the interchange.
MAIN = 'minkloc3d'
# Of the calibration's 6000 queries: promises are to rest on 3000 and more without their place.
_NO_MATCH_SHARE = 0.55


def exchanged(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return recall between members trained from scratch and by distillation (Tables 4.1, 4.2)."""
    figures: dict[str, Any] = {}
    others: dict[str, Any] = {}
    for architecture in ARCHITECTURES:
        roles = ROLES if architecture == MAIN else ('students', 'naive')  # the others are not asked
        runs = embedded('town', _set('town', quick), architecture, work, roles)
        for name, role in (('triplet', 'naive'), ('distilled', 'students')):
            found = interchange(runs, role)
            assert found is not None
            figures.setdefault(name, {})[architecture] = interchange_figures(found)
        if architecture != MAIN:
            others[architecture] = {'town': _recall_of(runs, 'cosine')}
    return {'interchange': figures, 'recall_of_others': others}


def recalls(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return the recall of all methods on all sets, by cosine and by Euclidean distance."""
    figures: dict[str, Any] = {'recall': {}, 'recall_euclidean': {}}
    for name in SETS:
        runs = embedded(name, _set(name, quick), MAIN, work)
        for key, metric in (('recall', 'cosine'), ('recall_euclidean', 'euclidean')):
            figures[key][name] = _recall_of(runs, metric)
    return figures


def failures(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return how well doubts find wrong matches, with and without places the map does not have."""
    table, calibrated = _calibration(work, quick)
    figures: dict[str, Any] = {'failure': {}, 'failure_open_set': {}, 'probability': {}}
    for name in SETS:
        runs = embedded(name, _set(name, quick), MAIN, work)
        known = study(runs, PairConfig(), calibrated.model)
        unknown = study(runs, PairConfig(), calibrated.model, open_set=True, no_match_share=0.3)
        figures['failure'][name] = known.plain()['failure']
        figures['failure_open_set'][name] = unknown.plain()['failure']
        figures['probability'][name] = known.plain()['probability']
        figures['probability'][f'{name}_open_set'] = unknown.plain()['probability']
        write_pictures(known, work / 'pictures' / name)
        write_pictures(unknown, work / 'pictures' / f'{name}_open_set')
    figures['probability']['calibration_runs'] = {
        'ece': calibrated.reliability.ece,
        'brier': calibrated.reliability.brier,
    }
    figures['failure_fitted_to'] = {'runs': len(table.runs), 'queries': len(table)}
    return figures


def epochs(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return what students recall, and their doubt is worth, by how long they were trained.

    The thesis halved the epochs (4.2.4): longer training recalls more, and doubts less truly.
    """
    figures: dict[str, Any] = {}
    for batches, architecture in trained_for(MAIN):
        found = study(embedded('town', _set('town', quick), architecture, work, ('students',)))
        judged = found.plain()['failure']
        figures[str(batches)] = {
            'r1': found.recall['shared'].at[1],
            'student_r1': found.interchange['students'].diagonal,
            'off_diagonal_r1': found.interchange['students'].off_diagonal,
            'u_auroc': judged['shared_u']['auroc'],
            'u_aurc': judged['shared_u']['aurc'],
            'distance_auroc': judged['distance']['auroc'],
        }
    return {'epochs': {MAIN: figures}}


def guarantee(work: Path, quick: bool = False) -> dict[str, Any]:
    """Return promised rates on resplits of runs, and what a foreign town does to them.

    All towns of the calibration share one map, so that the promises cover one of that size.
    """
    table, calibrated = _calibration(work, quick, together=True)
    found = observe(table, TARGETS, resplits=20 if quick else 100)
    figures: dict[str, Any] = {
        'queries': len(table),
        'no_match': int((~table.known).sum()),
        'runs': len(table.runs),
        'database_size': table.database_size,
        'drift_false_alarms': calibrated.false_alarms,
    }
    for one in found:
        key = f'target_{round(100 * one.target):02d}'
        plain = one.plain()
        if one.kind == 'false_match_rate':
            figures[key] = {**plain, **figures.get(key, {})}
        figures.setdefault(key, {})[one.kind] = plain
    figures['elsewhere'] = {
        name: _elsewhere(calibrated, embedded(name, _set(name, quick), MAIN, work)) for name in SETS
    }
    return {'guarantee': figures}


def _elsewhere(calibrated: Calibrated, runs: list[EmbeddedRun]) -> dict[str, Any]:
    """Return what the alarm does on runs, and the rates with and without minding it.

    The alarm is the drift's; a map larger than the promise covers would count, too, but none is.
    """
    table = query_table(runs)
    belief = calibrated.model.belief(table.features)
    minded = np.zeros(len(table), bool)
    first: list[int | None] = []
    for number in table.runs:
        alarm, rows = DriftAlarm(calibrated.drift), np.flatnonzero(table.run == number)
        rung = np.array([alarm.update(u).alarm for u in table.features[rows, 1]])
        minded[rows] = rung
        first.append(int(np.argmax(rung)) if rung.any() else None)
    rung_after = [one for one in first if one is not None]
    figures: dict[str, Any] = {
        'runs': len(first),
        'runs_with_alarm': len(rung_after),
        'queries_until_alarm': float(np.median(rung_after)) if rung_after else None,
        'share_under_alarm': float(minded.mean()),
        'database_size': table.database_size,
        'covered': calibrated.acceptance('false_match_rate', TARGETS[0]).covers(
            table.database_size
        ),
        'wrong': int(table.wrong.sum()),
    }
    for target in TARGETS:
        accepted = calibrated.acceptance('false_match_rate', target).accepts(belief)
        figures[f'target_{round(100 * target):02d}'] = {
            'ignoring_the_alarm': _rate(accepted, table),
            'minding_the_alarm': _rate(accepted & ~minded, table),
            'accepted_right': float(accepted[~table.wrong].mean()),
        }
    return figures


def _rate(accepted: np.ndarray, table: QueryTable) -> float:
    return float((accepted & table.wrong).sum() / max(int(table.wrong.sum()), 1))


def _recall_of(runs: list[EmbeddedRun], metric: str) -> dict[str, dict[str, Any]]:
    found = {
        name: recall(judge_pairs(runs, name, PairConfig(metric=metric))) for name in available(runs)
    }
    figures = {name: recall_figures(one) for name, one in found.items() if one is not None}
    base = figures.get('teacher')
    if base is not None:
        for one in figures.values():
            one |= {f'{key}_above_teacher': one[key] - base[key] for key in ('r1', 'r5', 'r10')}
    return figures


def _set(name: str, quick: bool) -> TestSet:
    return shortened(SETS[name]) if quick else SETS[name]


@cache
def _calibration(work: Path, quick: bool, together: bool = False) -> tuple[QueryTable, Calibrated]:
    chosen = CALIBRATION
    if quick:
        chosen = TestSet(CALIBRATION.seeds[:4], 3, 500.0)
    runs = embedded('calibration', chosen, MAIN, work, ('students',))
    table = query_table(runs, no_match_share=_NO_MATCH_SHARE, together=together)
    return table, calibrate(table, TARGETS)
