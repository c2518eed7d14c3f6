"""Judge the suite and its peer by the same code: errors by evo, loops by the reference."""

from collections.abc import Collection
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.peers import KissSlamRun
from lcd_common import se3
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.drive_evaluation import DriveEvaluation
from lcd_loop_closure.report.evaluation import trajectory_errors
from lcd_loop_closure.report.loop_evaluation import LoopEvaluation, LoopJudgementConfig, Verdict
from lcd_loop_closure.report.result import DriveResult


def suite_figures(result: DriveResult, evaluation: DriveEvaluation) -> dict[str, Any]:
    """Return ATE, end error, loops right and wrong, and time per scan of the suite."""
    after, before, loops = evaluation.after, evaluation.before, evaluation.loops
    assert after is not None and before is not None and loops is not None
    return {
        'odometry_ate_m': before.ate_rmse_m,
        'ate_m': after.ate_rmse_m,
        'end_error_m': after.end_error_m,
        'loops_right': loops.count(Verdict.TRUE),
        'loops_wrong': loops.count(Verdict.FALSE),
        'ms_per_scan': 1e3 * result.wall_s / max(len(result.scan_stamps_ns), 1),
    }


def kiss_slam_figures(run: KissSlamRun, truth_lidar: Trajectory) -> dict[str, Any]:
    """Return the same figures of KISS-SLAM; its closures are between local maps.

    Args:
        run: its poses of the LiDAR.
        truth_lidar: T_world_lidar of every scan.
    """
    n = len(run.T_map_lidar)
    truth = Trajectory(truth_lidar.stamps_ns[:n], truth_lidar.T_world_body[:n])
    slam = trajectory_errors(Trajectory(truth.stamps_ns, run.T_map_lidar), truth)
    odometry = trajectory_errors(Trajectory(truth.stamps_ns, run.T_odom_lidar[:n]), truth)
    assert slam is not None and odometry is not None
    limits = LoopJudgementConfig()
    right = 0
    for source, target, T_source_target in run.closures:
        T_true = se3.inverse(truth.T_world_body[source]) @ truth.T_world_body[target]
        metres, radians = se3.distance(T_true, T_source_target)
        right += int(
            metres <= limits.max_translation_error
            and np.degrees(radians) <= limits.max_rotation_error
        )
    return {
        'odometry_ate_m': odometry.ate_rmse_m,
        'ate_m': slam.ate_rmse_m,
        'end_error_m': slam.end_error_m,
        'loops_right': right,
        'loops_wrong': len(run.closures) - right,
        'ms_per_scan': float(1e3 * run.seconds.mean()),
    }


def link_figures(result: DriveResult, given_up: Collection[int]) -> dict[str, int]:
    """Return how many links between keyframes odometry broke, and what the pose graph noticed.

    A link is broken when it is off by more than a loop may be, by the reference. It is noticed when
    the graph gave it up or one next to it: where a keyframe between the two has no loop, nothing
    tells them apart.

    Args:
        result: of a drive with a reference, on a new map.
        given_up: ids of the keyframes whose link to their predecessor the graph gave up.
    """
    limits, truth = LoopJudgementConfig(), result.truth
    assert truth is not None
    broken = set()
    stamps = result.keyframes.stamps_ns.tolist()
    for row, (last_ns, this_ns) in enumerate(pairwise(stamps), start=1):
        T_odometry, T_true = (
            _motion(trajectory, last_ns, this_ns) for trajectory in (result.odometry, truth)
        )
        metres, radians = se3.distance(T_true, T_odometry)
        if metres > limits.max_translation_error or np.degrees(radians) > limits.max_rotation_error:
            broken.add(row)
    suspected = set(given_up)
    return {
        'links_broken': len(broken),
        'links_noticed': sum(not suspected.isdisjoint({k - 1, k, k + 1}) for k in broken),
        'links_noticed_exactly': len(broken & suspected),
        'links_wrongly_given_up': sum(broken.isdisjoint({k - 1, k, k + 1}) for k in suspected),
    }


def _motion(trajectory: Trajectory, first_ns: int, last_ns: int) -> se3.Array:
    T_first, T_last = trajectory.at(first_ns), trajectory.at(last_ns)
    assert T_first is not None and T_last is not None
    return se3.inverse(T_first) @ T_last


def found_share(loops: LoopEvaluation, not_before_ns: int) -> float:
    """Return the share of the revisiting keyframes after a stamp that have a right loop."""
    asked = loops.revisiting_stamps_ns
    asked = asked[asked >= not_before_ns]
    missed = np.isin(asked, loops.missed_stamps_ns)
    return float(1.0 - missed.mean()) if len(asked) else 0.0
