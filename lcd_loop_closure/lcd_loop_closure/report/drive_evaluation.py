"""Put together the figures of one drive."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.report.evaluation import TrajectoryErrors, trajectory_errors
from lcd_loop_closure.report.loop_evaluation import JudgedLoop, LoopEvaluation, Verdict, judge_loops
from lcd_loop_closure.report.result import DriveResult

# Causes that a reader of the report must see: input that did not count, work that was not done.
_TROUBLE = ('drop', 'reject', 'skip', 'fail', 'error', 'lost', 'late', 'jump', 'missing', 'invalid')


@dataclass(frozen=True)
class DriveEvaluation:
    """Figures of one drive; None where there is no reference.

    Attributes:
        corrected: T_map_base of every scan.
        before, after: errors of odometry and of the corrected trajectory.
        loops: how well loops were found.
        judged: every candidate with its verdict, by the reference where there is one.
        truth_in_map: the reference laid on the corrected trajectory, for drawing.
        warnings: one sentence for each thing that did not go as it should.
    """

    corrected: Trajectory
    before: TrajectoryErrors | None
    after: TrajectoryErrors | None
    loops: LoopEvaluation | None
    judged: tuple[JudgedLoop, ...]
    truth_in_map: Trajectory | None
    warnings: tuple[str, ...]

    @property
    def missed_stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the keyframes that should have a loop and have none."""
        return np.empty(0, np.int64) if self.loops is None else self.loops.missed_stamps_ns


def evaluate_drive(result: DriveResult) -> DriveEvaluation:
    """Compute every figure that the drive and its reference allow."""
    corrected = result.corrected()
    before = after = loops = truth_in_map = None
    if result.truth is not None:
        before = trajectory_errors(result.odometry, result.truth)
        after = trajectory_errors(corrected, result.truth)
        loops = judge_loops(
            result.loops, result.keyframes.stamps_ns, result.scan_stamps_ns, result.truth
        )
        if after is not None:
            driven = _between(result.truth, corrected.stamps_ns[0], corrected.stamps_ns[-1])
            truth_in_map = driven.in_frame(se3.inverse(after.T_truth_estimate), np.eye(4))
    judged = (
        loops.judged
        if loops is not None
        else tuple(
            JudgedLoop(loop, Verdict.UNKNOWN if loop.accepted else Verdict.REJECTED)
            for loop in result.loops
        )
    )
    warnings = tuple(_warnings(result, after))
    return DriveEvaluation(corrected, before, after, loops, judged, truth_in_map, warnings)


def metrics(result: DriveResult, evaluation: DriveEvaluation) -> dict[str, object]:
    """Return every figure as plain nested values, numbers in the unit of the key's suffix."""
    rejected = Counter(loop.status.name.lower() for loop in result.loops if not loop.accepted)
    loops: dict[str, object] = {
        'candidates': len(result.loops),
        'accepted': len(result.accepted),
        'rejected': {
            status.name.lower(): rejected[status.name.lower()]
            for status in LoopStatus
            if rejected[status.name.lower()]
        },
    }
    if evaluation.loops is not None:
        loops |= {
            'true': evaluation.loops.count(Verdict.TRUE),
            'false': evaluation.loops.count(Verdict.FALSE),
            'without_reference': evaluation.loops.count(Verdict.UNKNOWN),
            'keyframes_with_partner': len(evaluation.loops.revisiting_stamps_ns),
            'missed': len(evaluation.loops.missed_stamps_ns),
            'precision': evaluation.loops.precision,
            'recall': evaluation.loops.recall,
        }
    return {
        'drive': {
            'name': result.name,
            'source': result.source,
            'scans': len(result.scan_stamps_ns),
            'registered': len(result.odometry),
            'keyframes': len(result.keyframes),
            'path_m': evaluation.corrected.length_m,
            'recorded_s': result.recorded_s,
            'wall_s': result.wall_s,
            'realtime_factor': result.realtime_factor,
            'interrupted': result.interrupted,
        },
        'start_to_end_m': {
            'before': start_to_end_m(result.odometry),
            'after': start_to_end_m(evaluation.corrected),
            'reference': (
                None if evaluation.truth_in_map is None else start_to_end_m(evaluation.truth_in_map)
            ),
        },
        'before': None if evaluation.before is None else evaluation.before.plain(),
        'after': None if evaluation.after is None else evaluation.after.plain(),
        'loops': loops,
        'stages_ms': {
            node: {stage: stage_summary(times) for stage, times in stages.items() if times}
            for node, stages in result.stage_times_ms.items()
        },
        'counts': {node: dict(counts) for node, counts in result.counts.items()},
        'skipped': dict(result.skipped),
        'warnings': list(evaluation.warnings),
    }


def stage_summary(times_ms: list[float]) -> dict[str, float]:
    """Return median, 99th percentile, maximum and number of runs of a stage."""
    p50, p99 = np.percentile(times_ms, [50, 99])
    return {
        'p50': float(p50),
        'p99': float(p99),
        'max': float(max(times_ms)),
        'runs': len(times_ms),
    }


def start_to_end_m(trajectory: Trajectory) -> float:
    """Return how far the last position is from the first."""
    return float(np.linalg.norm(trajectory.positions[-1] - trajectory.positions[0]))


def _between(trajectory: Trajectory, first_ns: int, last_ns: int) -> Trajectory:
    inside = (trajectory.stamps_ns >= first_ns) & (trajectory.stamps_ns <= last_ns)
    return Trajectory(trajectory.stamps_ns[inside], trajectory.T_world_body[inside])


def _warnings(result: DriveResult, after: TrajectoryErrors | None) -> list[str]:
    texts = []
    if result.interrupted:
        texts.append(
            f'Interrupted: only the first {len(result.odometry)} scans were driven; '
            'everything below is about them.'
        )
    scans = len(result.scan_stamps_ns)
    lost = scans - len(result.odometry)
    if lost > 0:
        texts.append(f'Scans without odometry: {lost} of {scans}.')
    texts += [f'Not read: {cause} ({count}).' for cause, count in result.skipped.items() if count]
    texts += [
        f'{node.strip("/")}: {cause} ({count}).'
        for node, counts in result.counts.items()
        for cause, count in counts.items()
        if count
        and any(word in cause.lower() for word in _TROUBLE)
        and not cause.startswith('loops ')
    ]
    if result.truth is not None and after is None:
        texts.append('The reference has no pose at the time of the scans: nothing is compared.')
    elif after is not None and after.poses < len(result.odometry):
        texts.append(
            f'The reference covers {after.poses} of {len(result.odometry)} scans; '
            'errors are about those.'
        )
    if after is not None and after.ate_rmse_m is None:
        texts.append(
            'The drive is a straight line, which does not fix a rigid alignment: '
            'errors are given with only the first poses laid on one another.'
        )
    return texts
