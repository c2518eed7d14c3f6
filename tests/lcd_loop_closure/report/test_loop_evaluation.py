"""Loops judged by a reference, and revisits found by brute force."""

from dataclasses import replace

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.report.loop_evaluation import (
    LoopJudgementConfig,
    Verdict,
    judge_loop,
    judge_loops,
    revisiting_keyframes,
)
from lcd_loop_closure.report.result import DriveResult


def test_counts_true_false_and_missed(result: DriveResult, truth: Trajectory) -> None:
    evaluation = judge_loops(result.loops, result.keyframes.stamps_ns, result.scan_stamps_ns, truth)
    assert evaluation.count(Verdict.TRUE) == 20
    assert evaluation.count(Verdict.FALSE) == 2
    assert evaluation.count(Verdict.REJECTED) == 3
    assert evaluation.precision == pytest.approx(20 / 22)
    assert evaluation.recall is not None
    found = len(evaluation.revisiting_stamps_ns) - len(evaluation.missed_stamps_ns)
    assert found == 20
    assert evaluation.recall == pytest.approx(found / len(evaluation.revisiting_stamps_ns))
    false = {j.loop.query_stamp_ns for j in evaluation.judged if j.verdict is Verdict.FALSE}
    assert false <= set(evaluation.missed_stamps_ns.tolist())  # a wrong loop is no found one


def test_revisits_are_those_of_a_double_loop(truth: Trajectory, result: DriveResult) -> None:
    scans = truth.stamps_ns
    keyframes = result.keyframes.stamps_ns
    index = {int(stamp): k for k, stamp in enumerate(scans)}
    expected = []
    for stamp in keyframes:
        i = index[int(stamp)]
        partners = [
            j
            for j in (index[int(other)] for other in keyframes)
            if j <= i - 50 and np.linalg.norm(truth.positions[i] - truth.positions[j]) <= 4.0
        ]
        if i >= 100 and partners:
            expected.append(int(stamp))
    assert revisiting_keyframes(keyframes, scans, truth).tolist() == expected
    assert expected


@pytest.mark.parametrize(
    ('metres', 'degrees', 'verdict'),
    [
        (0.0, 0.0, Verdict.TRUE),
        (0.99, 0.0, Verdict.TRUE),
        (1.01, 0.0, Verdict.FALSE),
        (0.0, 2.9, Verdict.TRUE),
        (0.0, 3.1, Verdict.FALSE),
        (0.0, 180.0, Verdict.FALSE),
    ],
)
def test_limits_are_one_metre_and_three_degrees(
    result: DriveResult, truth: Trajectory, metres: float, degrees: float, verdict: Verdict
) -> None:
    loop = result.loops[0]
    assert loop.T_match_query is not None
    error = se3.from_rotation_translation(se3.so3_exp([0, 0, np.radians(degrees)]), [0, metres, 0])
    moved = replace(loop, T_match_query=loop.T_match_query @ error)
    judged = judge_loop(moved, truth, LoopJudgementConfig())
    assert judged.verdict is verdict
    assert judged.translation_error_m == pytest.approx(metres, abs=1e-9)
    assert judged.rotation_error_deg == pytest.approx(degrees, abs=1e-5)


def test_what_the_reference_does_not_cover_stays_unknown(
    result: DriveResult, truth: Trajectory
) -> None:
    first_half = Trajectory(truth.stamps_ns[:300], truth.T_world_body[:300])
    assert judge_loop(result.loops[0], first_half, LoopJudgementConfig()).verdict is Verdict.UNKNOWN
    rejected = replace(result.loops[0], status=LoopStatus.REJECTED_OVERLAP)
    assert judge_loop(rejected, first_half, LoopJudgementConfig()).verdict is Verdict.REJECTED


def test_no_loops_and_no_revisits_have_no_rates(truth: Trajectory) -> None:
    nothing = np.empty(0, np.int64)
    evaluation = judge_loops((), nothing, truth.stamps_ns, truth)
    assert evaluation.precision is None and evaluation.recall is None
