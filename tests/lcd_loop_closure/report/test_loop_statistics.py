"""The thesis's Table 3.1 from poses files."""

import json
from pathlib import Path

import pytest

from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.loop_statistics import main


def test_kitti_08_has_the_published_counts(
    real_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = real_data / 'kitti_odometry' / 'poses_lidar_08.txt'
    assert main([str(path), '--json']) == 0
    row = json.loads(capsys.readouterr().out)['files'][0]
    assert (row['scans'], row['loops'], row['pairs']) == (4071, 334, 2960)
    assert row['reverse_share'] > 0.99


def test_camera_poses_counted_for_the_lidar(
    real_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """KITTI 00 has the thesis's 790 loops only when its camera poses are moved to the LiDAR."""
    kitti = real_data / 'kitti_odometry'
    calib = kitti / 'sequences' / '00' / 'calib.txt'
    assert main([str(kitti / 'poses' / '00.txt'), '--calib', str(calib)]) == 0
    assert capsys.readouterr().out.splitlines()[1].split()[1:3] == ['4541', '790']


def test_options_change_the_rule(
    truth: Trajectory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'a.txt'
    truth.write_kitti(path)

    def loops(*options: str) -> int:
        assert main([str(path), '--json', *options]) == 0
        return int(json.loads(capsys.readouterr().out)['files'][0]['loops'])

    assert loops('--excluded', '500') < loops() < loops('--distance', '15')
    assert loops('--first', '799') == 1


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (b'', 'found none'),
        (b'1 2 3\n', 'expected 12'),
        (b'\xff\xfe\x00', 'binary'),
        (b'nan 0 0 0 0 1 0 0 0 0 1 0\n', 'not finite'),
        (b'not a number at all 1 2 3\n', 'eight|expected'),
    ],
)
def test_broken_files_are_one_line(
    tmp_path: Path, content: bytes, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import re

    (tmp_path / 'poses.txt').write_bytes(content)
    assert main([str(tmp_path / 'poses.txt')]) == 1
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count('\n') == 1 and 'poses.txt' in error


def test_missing_file_and_calibration_are_one_line(
    truth: Trajectory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / 'none.txt')]) == 1
    truth.write_kitti(tmp_path / 'a.txt')
    (tmp_path / 'calib.txt').write_text('P0: 1 2 3\n')
    assert main([str(tmp_path / 'a.txt'), '--calib', str(tmp_path / 'calib.txt')]) == 1
    assert 'Tr:' in capsys.readouterr().err
