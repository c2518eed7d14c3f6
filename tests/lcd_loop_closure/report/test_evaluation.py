"""Errors against a reference, checked by displacements that are known."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.evaluation import trajectory_errors


def test_a_moved_copy_has_no_error(truth: Trajectory) -> None:
    T_other_world = se3.from_rotation_translation(se3.so3_exp([0.1, -0.2, 2.0]), [30, -4, 7])
    errors = trajectory_errors(truth.in_frame(T_other_world, np.eye(4)), truth)
    assert errors is not None and errors.poses == len(truth)
    assert errors.ate_rmse_m == pytest.approx(0, abs=1e-9)
    assert errors.first_pose_ate_rmse_m == pytest.approx(0, abs=1e-9)
    assert errors.end_error_m == pytest.approx(0, abs=1e-9)
    assert errors.rpe_100m_rmse_m == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(errors.T_truth_estimate, se3.inverse(T_other_world), atol=1e-9)


def test_aligned_error_is_that_of_a_least_squares_fit(
    truth: Trajectory, odometry: Trajectory
) -> None:
    errors = trajectory_errors(odometry, truth)
    assert errors is not None
    # Horn's closed form by numpy alone.
    a, b = odometry.positions, truth.positions
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    residual = (a - a.mean(0)) @ R.T + b.mean(0) - b
    expected = np.linalg.norm(residual, axis=1)
    np.testing.assert_allclose(errors.errors_m, expected, atol=1e-9)
    assert errors.ate_rmse_m == pytest.approx(np.sqrt((expected**2).mean()))
    assert errors.ate_max_m == pytest.approx(expected.max())
    # First poses laid on one another: both start at the identity already.
    apart = np.linalg.norm(a - b, axis=1)
    assert errors.first_pose_ate_rmse_m == pytest.approx(np.sqrt((apart**2).mean()))


def test_drift_of_a_scaled_drive_is_its_scale_error() -> None:
    angle = np.linspace(0, 1.2, 2000)
    positions = 1000 * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])
    poses = np.array(
        [
            se3.from_rotation_translation(se3.so3_exp([0, 0, a]), p)
            for a, p in zip(angle, positions, strict=True)
        ]
    )
    scaled = poses.copy()
    scaled[:, :3, 3] *= 1.02
    stamps = 100_000_000 * np.arange(len(poses))
    errors = trajectory_errors(Trajectory(stamps, scaled), Trajectory(stamps, poses))
    assert errors is not None
    # Chords of the circle are shorter than the path along it: 0.04 % over 100 m, 2.7 % over 800.
    lengths = np.arange(100, 900, 100)
    chords = 2000 * np.sin(lengths / 2000) / lengths
    assert errors.drift_percent == pytest.approx(2.0 * chords.mean(), rel=0.02)
    assert errors.drift_deg_per_100m == pytest.approx(0, abs=1e-6)
    assert errors.rpe_100m_rmse_m == pytest.approx(2.0, rel=0.01)


def test_end_error_sees_a_turned_last_pose(truth: Trajectory) -> None:
    poses = truth.T_world_body.copy()
    poses[-1] = poses[-1] @ se3.from_rotation_translation(
        se3.so3_exp([0, 0, np.radians(2)]), [0.3, 0.4, 0]
    )
    errors = trajectory_errors(Trajectory(truth.stamps_ns, poses), truth)
    assert errors is not None
    assert errors.end_error_m == pytest.approx(0.5)
    assert errors.end_error_deg == pytest.approx(2.0)


def test_a_straight_line_has_no_alignment_but_still_errors() -> None:
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = np.arange(50)
    longer = poses.copy()
    longer[:, 0, 3] *= 1.1
    stamps = 100_000_000 * np.arange(50)
    errors = trajectory_errors(Trajectory(stamps, longer), Trajectory(stamps, poses))
    assert errors is not None
    assert errors.ate_rmse_m is None and errors.ate_rotation_rmse_deg is None
    assert errors.drift_percent is None  # shorter than 100 m
    assert errors.end_error_m == pytest.approx(4.9)
    assert errors.errors_m[-1] == pytest.approx(4.9)


def test_only_common_times_are_compared(truth: Trajectory) -> None:
    part = Trajectory(truth.stamps_ns[100:200], truth.T_world_body[100:200])
    errors = trajectory_errors(truth, part)
    assert errors is not None and errors.poses == 100
    late = Trajectory(truth.stamps_ns + 10**12, truth.T_world_body)
    assert trajectory_errors(late, truth) is None
