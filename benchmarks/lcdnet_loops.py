"""Loops that the nodes accept with LCDNet as their detector, beside Scan Context."""

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from bags.inputs import open_input
from benchmarks.judging import found_share
from benchmarks.recordings import karlsruhe_out_and_back
from lcd_loop_closure.report.drive_evaluation import evaluate_drive
from lcd_loop_closure.report.loop_evaluation import Verdict

DETECTORS = ('lcdnet', 'scan_context')
# The Karlsruhe sweeps reach 80 m and show the car itself below 3 m.
_RANGES = {'out_and_back': (80.0, 3.0), 'demonstration': (100.0, 2.0)}


def evaluate(work: Path) -> dict[str, Any]:
    """Drive the out-and-back recording and the demonstration in lock-step with each detector."""
    figures: dict[str, Any] = {}
    inputs = {'out_and_back': str(karlsruhe_out_and_back(work)), 'demonstration': 'town'}
    for name, source in inputs.items():
        for detector in DETECTORS:
            # A process of its own: the first odometry of a process decides on KISS-ICP's threads.
            with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
                found = pool.submit(_drive, name, source, detector, work).result()
            figures.setdefault(name, {})[detector] = found
    return {'loops_of_the_nodes': figures}


def _drive(name: str, source: str, detector: str, work: Path) -> dict[str, Any]:
    from lcd_loop_closure.nodes.offline_slam import drive_through

    farthest, nearest = _RANGES[name]
    parameters = work / f'lcdnet_{name}.yaml'
    lines = f'    max_range: {farthest}\n    min_range: {nearest}\n'
    weights = os.environ.get('LCDNET_WEIGHTS')
    text = f'/lidar_odometry:\n  ros__parameters:\n{lines}'
    if weights:
        text += f'/loop_closure:\n  ros__parameters:\n    lcdnet.weights: {weights}\n'
    parameters.write_text(text)
    result = drive_through(
        open_input(source),
        threads=1,
        parameter_files=[parameters],
        source=name,
        detector=detector,
    )
    evaluation = evaluate_drive(result)
    loops = evaluation.loops
    assert loops is not None
    return {
        'keyframes': len(result.keyframes),
        'candidates': len(result.loops),
        'true': loops.count(Verdict.TRUE),
        'false': loops.count(Verdict.FALSE),
        'found_share': found_share(loops, 0),
        'ate_m': None if evaluation.after is None else evaluation.after.ate_rmse_m,
        'realtime_factor': result.realtime_factor,
    }
