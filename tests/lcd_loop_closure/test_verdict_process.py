"""The child process gives the verdict that the solver gives here, and may be killed."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from orphans import ends_with_its_parent
from saved_maps import made_up_map

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.graph_snapshot import GraphSnapshot
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig
from lcd_loop_closure.verdict_process import (
    SolverProcessError,
    VerdictProcess,
    verdict_arrays,
    verdict_from,
)


def _graph() -> GraphSnapshot:
    """Drive a circle twice; loops tie the rounds together, and one is false."""
    graph = PoseGraph()
    poses = [se3.rotation_z(0.3 * k) @ se3.exp([10.0, 0, 0, 0, 0, 0]) for k in range(42)]
    empty = PointCloud(np.empty((0, 3), np.float32))
    for k, T in enumerate(poses):
        motion = se3.inverse(poses[max(k - 1, 0)]) @ T
        graph.add_keyframe(Keyframe(k, k + 1, T, motion, 1e-4 * np.eye(6), empty))
    for match, query, shift in [(0, 21, 0), (3, 24, 0), (5, 26, 0), (8, 35, 25.0)]:
        T_match_query = se3.inverse(poses[match]) @ poses[query] @ se3.exp([shift, 0, 0, 0, 0, 0])
        graph.add_loop(LoopConstraint(match, query, 0, 0, T_match_query, 1e-3 * np.eye(6)))
    return graph.snapshot()


def test_the_verdict_is_that_of_the_solver() -> None:
    process = VerdictProcess(RobustSolverConfig())
    try:
        there = process.solve(_graph())
        here = RobustSolver(RobustSolverConfig()).solve(_graph())
        assert there.accepted == here.accepted == {(0, 21), (3, 24), (5, 26)}
        assert there.rejected == here.rejected
        assert set(there.rejected) == {(8, 35)}
        np.testing.assert_allclose(there.T_map_base, here.T_map_base, atol=1e-9)
        assert (there.arrivals, there.broken_links) == (here.arrivals, here.broken_links)
        assert process.solve(_graph()).accepted == there.accepted  # the same child again
    finally:
        process.close()


def test_a_killed_child_is_said_and_replaced() -> None:
    process = VerdictProcess(RobustSolverConfig())
    try:
        process.solve(_graph())
        child = process._child
        assert child is not None
        os.kill(child.pid, signal.SIGKILL)
        with pytest.raises(SolverProcessError, match='starts again'):
            process.solve(_graph())
        assert len(process.solve(_graph()).accepted) == 3
    finally:
        process.close()
    process.close()  # twice is once


def test_a_snapshot_that_cannot_be_solved_is_an_error_and_the_child_lives_on() -> None:
    process = VerdictProcess(RobustSolverConfig())
    try:
        broken = made_up_map().graph
        with pytest.raises(SolverProcessError, match='not finite'):
            process.solve(replace(broken, motions=np.full((7, 4, 4), np.nan)))
        assert len(process.solve(_graph()).accepted) == 3
    finally:
        process.close()


def test_the_child_ends_when_its_parent_is_killed() -> None:
    code = (
        'import sys, time\n'
        'from lcd_loop_closure.verdict_process import VerdictProcess\n'
        'from lcd_loop_closure.robust_solver import RobustSolverConfig\n'
        'process = VerdictProcess(RobustSolverConfig())\n'
        'print(process._running().pid, flush=True)\n'
        'time.sleep(60)\n'
    )
    assert ends_with_its_parent(code)


def test_verdicts_survive_their_arrays() -> None:
    verdict = RobustSolver(RobustSolverConfig()).solve(_graph())
    back = verdict_from(verdict_arrays(verdict))
    assert (back.accepted, back.rejected) == (verdict.accepted, verdict.rejected)
    assert (back.iterations, back.seconds) == (verdict.iterations, verdict.seconds)
