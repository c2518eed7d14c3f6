"""Measure how honest the odometry's covariance is, on simulated drives with known motion."""

from pathlib import Path
from typing import Any

import numpy as np

from bags.street import LidarConfig, StreetConfig, StreetDrive
from lcd_common import se3
from lcd_loop_closure.lidar_odometry import LidarOdometry, OdometryConfig

_SWEEPS = 250
_OVER_M = 4.0  # a little more than from one keyframe to the next


def evaluate(work: Path) -> dict[str, Any]:
    """Return the mean NEES of relative poses (expectation 6), per sweep and over 4 m of driving.

    Three towns; a snapshot sensor and one that sweeps while it drives.
    """
    del work
    runs = {}
    for seed, timed in ((10, False), (11, False), (12, True)):
        name = f'town_{seed}_{"sweeping" if timed else "snapshot"}'
        runs[name] = nees(
            StreetDrive('loop', StreetConfig(seed=seed), LidarConfig(point_time=timed))
        )
    steps = [run['nees_per_sweep'] for run in runs.values()]
    spans = [run['nees_over_4_m'] for run in runs.values()]
    return {
        'expected_nees': 6.0,
        'nees_per_sweep': float(np.mean(steps)),
        'nees_over_4_m': float(np.mean(spans)),
        'worst_ratio_to_expectation': max(max(n / 6.0, 6.0 / n) for n in (*steps, *spans)),
        **runs,
    }


def nees(drive: StreetDrive, sweeps: int = _SWEEPS) -> dict[str, float]:
    """Return the mean normalised estimation error squared over a drive."""
    odometry = LidarOdometry(OdometryConfig(threads=1))
    truth = drive.truth()
    T_base_lidar = next(m.T_parent_child for m in drive.mountings if m.child == 'lidar')
    per_sweep, over_span = [], []
    T_true_last = T_from = T_true_from = np.eye(4)
    span_covariance = np.zeros((6, 6))
    for index in range(sweeps):
        scan = drive.scan(index)
        T_world_base = truth.at(scan.stamp_ns)
        assert T_world_base is not None
        T_true = T_world_base @ T_base_lidar
        estimate = odometry.register(scan.cloud, scan.stamp_ns)
        T_estimate = estimate.T_odom_lidar
        if estimate.T_previous_this is None:
            T_from, T_true_from = T_estimate, T_true
        else:
            assert estimate.covariance is not None and estimate.growth is not None
            error = _error(se3.inverse(T_true_last) @ T_true, estimate.T_previous_this)
            per_sweep.append(error @ np.linalg.solve(estimate.covariance, error))
            span_covariance = se3.compose_covariance(
                span_covariance, estimate.T_previous_this, estimate.growth
            )
            motion = se3.inverse(T_from) @ T_estimate
            if np.linalg.norm(motion[:3, 3]) >= _OVER_M:
                error = _error(se3.inverse(T_true_from) @ T_true, motion)
                over_span.append(error @ np.linalg.solve(span_covariance, error))
                T_from, T_true_from = T_estimate, T_true
                span_covariance = np.zeros((6, 6))
        T_true_last = T_true
    return {
        'nees_per_sweep': float(np.mean(per_sweep)),
        'nees_over_4_m': float(np.mean(over_span)),
    }


def _error(T_true: se3.Array, T_estimate: se3.Array) -> se3.Array:
    return se3.log(se3.inverse(T_estimate) @ T_true)
