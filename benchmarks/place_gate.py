"""Loop closure through a district of equal houses, with and without place recognition's word."""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from uncertain_place_recognition.datasets.recorded import TEST_SEEDS

_TOWN = TEST_SEEDS[8]


def evaluate(work: Path, length_m: float = 1500.0) -> dict[str, Any]:
    """Drive through the aliased district with the gate on and off; counts, and the final error."""
    figures: dict[str, Any] = {}
    for name in ('off', 'on'):
        # A process of its own: the first odometry of a process decides on KISS-ICP's threads.
        with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
            figures[name] = pool.submit(_drive, name == 'on', length_m, work).result()
    on, off = figures['on'], figures['off']
    figures['registrations_saved'] = off['registered'] - on['registered']
    figures['false_candidates_saved'] = off['false_registered'] - on['false_registered']
    figures['true_loops_lost'] = off['true'] - on['true']
    return {'gate': figures}


def _drive(gated: bool, length_m: float, work: Path) -> dict[str, Any]:
    from lcd_common.nodes.parameters import overrides
    from lcd_loop_closure.loop import LoopStatus
    from lcd_loop_closure.nodes.offline_slam import OfflineSlam, own_context
    from lcd_loop_closure.report.drive_evaluation import evaluate_drive
    from lcd_loop_closure.report.loop_evaluation import Verdict
    from uncertain_place_recognition.datasets.recorded import simulated_drive
    from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode

    parameters = work / f'gate_{"on" if gated else "off"}.yaml'
    parameters.write_text(
        f'/loop_closure:\n  ros__parameters:\n    gate.use: {"true" if gated else "false"}\n'
    )
    drive = simulated_drive(_TOWN, style='aliased', length_m=length_m, same_way=0.3)
    with own_context() as context:
        slam = OfflineSlam(context, [parameters], threads=1)
        nodes: list[Any] = list(slam.nodes)
        if gated:
            nodes.append(
                PlaceRecognitionNode(
                    context=context,
                    use_global_arguments=False,
                    parameter_overrides=overrides(
                        follow='keyframes',
                        threaded=False,
                        weights=os.environ.get('PLACE_ENSEMBLE', ''),
                        calibration=os.environ.get('PLACE_CALIBRATION', ''),
                    ),
                )
            )
            slam.lockstep.add(nodes[-1])
        try:
            wall_s, interrupted = slam.drive(drive, 0.0, None, True)
            result = slam.result(drive, 'aliased', wall_s, interrupted)
        finally:
            for node in nodes:
                node.destroy_node()
    evaluation = evaluate_drive(result)
    assert evaluation.loops is not None and evaluation.after is not None
    untried = (LoopStatus.REJECTED_DESCRIPTOR, LoopStatus.REJECTED_UNCERTAIN)
    tried = [one for one in evaluation.judged if one.loop.status not in untried]
    true = result.truth
    assert true is not None
    return {
        'keyframes': len(result.keyframes),
        'candidates': len(result.loops),
        'registered': len(tried),
        'false_registered': sum(_apart(one.loop, true) > 25.0 for one in tried),
        'uncertain': sum(one.status is LoopStatus.REJECTED_UNCERTAIN for one in result.loops),
        'true': evaluation.loops.count(Verdict.TRUE),
        'false': evaluation.loops.count(Verdict.FALSE),
        'status': dict(Counter(one.status.name.lower() for one in result.loops)),
        'ate_m': evaluation.after.ate_rmse_m,
        'wall_s': wall_s,
    }


def _apart(loop: Any, truth: Any) -> float:
    """Return how far the two places of a candidate really are apart, metres."""
    import numpy as np

    places = [truth.at(stamp) for stamp in (loop.match_stamp_ns, loop.query_stamp_ns)]
    return float(np.linalg.norm(places[0][:3, 3] - places[1][:3, 3]))
