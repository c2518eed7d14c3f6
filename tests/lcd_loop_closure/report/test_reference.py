"""References from files: formats, times and frames."""

from pathlib import Path

import numpy as np
import pytest

from bags.records import Mounting
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.reference import mounting_in_base, read_reference

I4 = np.eye(4)


def test_all_formats_hold_the_same_poses(truth: Trajectory, tmp_path: Path) -> None:
    truth.write_tum(tmp_path / 'a.tum')
    truth.write_kitti(tmp_path / 'a.txt')
    rows = truth.T_world_body[:, :3].reshape(len(truth), 12)
    since_zero = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    np.savetxt(tmp_path / 'stamped.txt', np.column_stack([since_zero, rows]))
    for name in ('a.tum', 'a.txt', 'stamped.txt'):
        trajectory = read_reference(tmp_path / name).trajectory(truth.stamps_ns, I4)
        np.testing.assert_allclose(trajectory.T_world_body, truth.T_world_body, atol=1e-8)
        np.testing.assert_allclose(trajectory.stamps_ns, truth.stamps_ns, atol=10)


def test_poses_of_a_camera_become_those_of_the_vehicle(truth: Trajectory, tmp_path: Path) -> None:
    optical = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, 1.6], [0, 0, 0, 1.0]])
    T_base_lidar = se3.from_rotation_translation(se3.so3_exp([0, 0.02, 0]), [0, 0, 1.73])
    mountings = (
        Mounting('base_link', 'lidar', T_base_lidar),
        Mounting('lidar', 'camera', se3.inverse(T_base_lidar) @ optical),
    )
    T_base_camera = mounting_in_base(mountings, 'camera')
    np.testing.assert_allclose(T_base_camera, optical, atol=1e-12)
    truth.in_frame(I4, T_base_camera).write_tum(tmp_path / 'camera.tum')
    back = read_reference(tmp_path / 'camera.tum').trajectory(
        truth.stamps_ns, se3.inverse(T_base_camera)
    )
    np.testing.assert_allclose(back.T_world_body, truth.T_world_body, atol=1e-7)
    np.testing.assert_array_equal(mounting_in_base((), 'base_link'), I4)


def test_a_frame_that_is_not_mounted_is_named() -> None:
    circle = (Mounting('a', 'b', I4), Mounting('b', 'a', I4))
    for mountings in ((), circle):
        with pytest.raises(DataError, match="'b'"):
            mounting_in_base(mountings, 'b')


def test_poses_without_times_must_match_the_scans(truth: Trajectory, tmp_path: Path) -> None:
    truth.write_kitti(tmp_path / 'a.txt')
    with pytest.raises(DataError, match='each of the 799 scans, got 800'):
        read_reference(tmp_path / 'a.txt').trajectory(truth.stamps_ns[1:], I4)


def test_times_that_run_back_are_refused(truth: Trajectory, tmp_path: Path) -> None:
    truth.write_tum(tmp_path / 'a.tum')
    lines = (tmp_path / 'a.tum').read_text().splitlines()
    (tmp_path / 'a.tum').write_text('\n'.join([*lines, lines[3]]))
    with pytest.raises(DataError, match='increase'):
        read_reference(tmp_path / 'a.tum')
