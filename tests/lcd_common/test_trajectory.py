"""Trajectories interpolate on SE(3) and survive their files; evo is the second reader."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory, read_poses, read_tum


def drive(n: int = 30) -> Trajectory:
    step = se3.exp([1.0, 0.0, 0.02, 0.0, 0.01, 0.05])
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ step)
    stamps = 1_700_000_000_000_000_000 + 100_000_001 * np.arange(n, dtype=np.int64)
    return Trajectory(stamps, np.array(poses))


def test_tum_keeps_nanoseconds_and_evo_reads_it(tmp_path: Path) -> None:
    path = tmp_path / 'drive.tum'
    drive().write_tum(path)
    back = read_tum(path)
    np.testing.assert_array_equal(back.stamps_ns, drive().stamps_ns)
    np.testing.assert_allclose(back.T_world_body, drive().T_world_body, atol=1e-8)
    peer = file_interface.read_tum_trajectory_file(str(path))
    np.testing.assert_allclose(np.array(peer.poses_se3), drive().T_world_body, atol=1e-8)


def test_kitti_rows_are_what_evo_reads(tmp_path: Path) -> None:
    path = tmp_path / 'poses.txt'
    drive().write_kitti(path)
    np.testing.assert_allclose(read_poses(path), drive().T_world_body, atol=1e-8)
    peer = file_interface.read_kitti_poses_file(str(path))
    np.testing.assert_allclose(np.array(peer.poses_se3), drive().T_world_body, atol=1e-8)


def test_at_interpolates_and_never_extrapolates() -> None:
    trajectory = drive()
    stamp = int(trajectory.stamps_ns[4]) + 50_000_000
    T = trajectory.at(stamp)
    assert T is not None
    expected = se3.interpolate(
        trajectory.T_world_body[4], trajectory.T_world_body[5], 50_000_000 / 100_000_001
    )
    np.testing.assert_allclose(T, expected, atol=1e-12)
    np.testing.assert_array_equal(
        trajectory.at(int(trajectory.stamps_ns[0])), trajectory.T_world_body[0]
    )
    assert trajectory.at(int(trajectory.stamps_ns[0]) - 1) is None
    assert trajectory.at(int(trajectory.stamps_ns[-1]) + 1) is None
    assert trajectory.at(stamp, max_gap_ns=1000) is None


def test_in_frame_and_length() -> None:
    T_new_world, T_body_sensor = se3.exp([5, 4, 3, 0.3, 0.2, 0.1]), se3.exp([0, 0, 1, 0, 0, 0.5])
    moved = drive().in_frame(T_new_world, T_body_sensor)
    np.testing.assert_allclose(
        moved.T_world_body[7], T_new_world @ drive().T_world_body[7] @ T_body_sensor, atol=1e-12
    )
    assert drive().length_m == pytest.approx(
        sum(np.linalg.norm(a - b) for a, b in itertools.pairwise(drive().positions))
    )


def test_broken_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / 'x.tum'
    path.write_text('1.0 0 0 0 0 0 0 1\n2.0 1 2\n')
    with pytest.raises(DataError, match=r'x.tum:2: expected "stamp x y z qx qy qz qw"'):
        read_tum(path)
    path.write_text('1 2 3\n')
    with pytest.raises(DataError, match='expected 12'):
        read_poses(path)
    with pytest.raises(DataError, match='found none'):
        read_poses(tmp_path / 'missing.txt')
    with pytest.raises(DataError, match='increase strictly'):
        Trajectory(np.array([2, 1]), np.tile(np.eye(4), (2, 1, 1)))
