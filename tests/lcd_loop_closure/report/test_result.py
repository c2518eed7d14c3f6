"""Corrections of keyframes carried over to every scan."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.result import DriveResult, corrected_trajectory


def test_passes_through_every_keyframe(result: DriveResult) -> None:
    corrected = result.corrected()
    assert corrected.stamps_ns.tolist() == result.odometry.stamps_ns.tolist()
    for stamp, T_map_base in zip(
        result.keyframes.stamps_ns, result.keyframes.T_world_body, strict=True
    ):
        T = corrected.at(int(stamp))
        assert T is not None
        np.testing.assert_allclose(T, T_map_base, atol=1e-9)


def test_without_correction_it_is_odometry(odometry: Trajectory) -> None:
    keyframes = Trajectory(odometry.stamps_ns[::7], odometry.T_world_body[::7])
    same = corrected_trajectory(odometry, keyframes)
    np.testing.assert_allclose(same.T_world_body, odometry.T_world_body, atol=1e-9)


def test_a_rigid_correction_moves_everything_rigidly(odometry: Trajectory) -> None:
    T_map_odom = se3.from_rotation_translation(se3.so3_exp([0, 0.01, 0.5]), [3, 2, 1])
    inner = odometry.T_world_body[50:700:9]  # the ends lie outside the keyframes
    keyframes = Trajectory(odometry.stamps_ns[50:700:9], T_map_odom @ inner)
    moved = corrected_trajectory(odometry, keyframes)
    np.testing.assert_allclose(moved.T_world_body, T_map_odom @ odometry.T_world_body, atol=1e-9)


def test_between_keyframes_the_correction_grows_evenly() -> None:
    stamps = 100 * np.arange(11)
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = np.arange(11)
    ends = poses[[0, 10]].copy()
    ends[1, 1, 3] = 2.0  # the second keyframe is 2 m to the left
    corrected = corrected_trajectory(Trajectory(stamps, poses), Trajectory(stamps[[0, 10]], ends))
    np.testing.assert_allclose(corrected.positions[:, 1], 0.2 * np.arange(11), atol=1e-9)


def test_keyframes_outside_odometry_are_left_out(odometry: Trajectory) -> None:
    late = Trajectory(odometry.stamps_ns[-2:] + 10**12, odometry.T_world_body[-2:])
    assert corrected_trajectory(odometry, late) is odometry


def test_realtime_factor(result: DriveResult) -> None:
    assert result.realtime_factor == pytest.approx(79.9 / 40)
    assert DriveResult('a', 'b', result.odometry, result.keyframes).realtime_factor is None
