"""Argoverse 2: the real log, and damaged copies of it."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather
from scipy.spatial import cKDTree

from bags.argoverse2 import open_argoverse2
from bags.records import CameraImage, LidarScan
from lcd_common.errors import DataError

STAMPS = (315966265259836000, 315966265360032000)


@pytest.fixture
def log(real_data: Path) -> Path:
    return real_data / 'argoverse2' / '7fab2350'


@pytest.fixture
def copy(log: Path, tmp_path: Path) -> Path:
    for path in log.rglob('*.feather'):
        target = tmp_path / 'log' / path.relative_to(log)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    return tmp_path / 'log'


def scans_of(drive):
    return [r for r in drive.records() if isinstance(r, LidarScan)]


def raw_sweep(log: Path, stamp: int) -> dict[str, np.ndarray]:
    table = feather.read_table(log / 'sensors' / 'lidar' / f'{stamp}.feather')
    return {name: table[name].to_numpy() for name in table.column_names}


def mounting_of(drive, child):
    return next(m.T_parent_child for m in drive.mountings if m.child == child)


def test_real_sweeps_and_poses_are_read(log):
    drive = open_argoverse2(log)
    scans = scans_of(drive)
    assert [s.stamp_ns for s in scans] == list(STAMPS)
    assert [len(s.cloud) for s in scans] == [99229, 99466]
    assert len(drive.truth()) == 2706
    raw = raw_sweep(log, STAMPS[0])
    back = scans[0].cloud.transformed(mounting_of(drive, 'lidar'))
    expected = np.stack([raw[axis] for axis in 'xyz'], axis=1).astype(np.float32)
    assert back.xyz == pytest.approx(expected, abs=1e-4)
    assert np.array_equal(back.intensity, raw['intensity'].astype(np.float32))
    assert not drive.skipped


def test_sweeps_are_in_the_frame_of_the_upper_lidar(log):
    """Seen from where it sits, each of its lasers keeps one elevation."""
    scan = scans_of(open_argoverse2(log))[0]
    laser = raw_sweep(log, STAMPS[0])['laser_number']
    xyz = scan.cloud.xyz.astype(float)
    distance = np.linalg.norm(xyz[:, :2], axis=1)
    elevation = np.degrees(np.arctan2(xyz[:, 2], distance))
    lasers = [(laser == n) & (distance > 8) for n in range(32)]
    spread = [np.std(elevation[chosen]) for chosen in lasers if chosen.sum() > 100]
    assert len(spread) > 20
    assert np.median(spread) < 0.1


def structure(points, center):
    keep = (np.linalg.norm(points - center, axis=1) < 30) & (points[:, 2] > center[2] + 0.5)
    return points[keep]


def test_consecutive_sweeps_meet_in_the_city_frame(log):
    drive = open_argoverse2(log)
    truth = drive.truth()
    clouds, centers = [], []
    for scan in scans_of(drive):
        T = truth.at(scan.stamp_ns)
        centers.append(T[:3, 3])
        xyz = scan.cloud.transformed(mounting_of(drive, 'lidar')).xyz.astype(float)
        clouds.append(structure(xyz @ T[:3, :3].T + T[:3, 3], T[:3, 3]))
    gap = cKDTree(clouds[0]).query(clouds[1])[0]
    assert np.median(gap) < 0.04
    T_unmoved = clouds[1] - (centers[1] - centers[0]) * 10  # the test can tell half a metre
    assert np.median(cKDTree(clouds[0]).query(T_unmoved)[0]) > 2 * np.median(gap)


def test_sweeps_are_compensated_already_so_they_carry_no_time(log):
    """Taking the motion out again by offset_ns moves the two lidars' returns apart."""
    drive = open_argoverse2(log)
    truth = drive.truth()
    for scan in scans_of(drive):
        assert scan.cloud.time_s is None
        raw = raw_sweep(log, scan.stamp_ns)
        xyz = np.stack([raw[axis] for axis in 'xyz'], axis=1).astype(float)
        T_stamp = truth.at(scan.stamp_ns)
        again = np.empty_like(xyz)
        for slot in range(55):
            chosen = raw['offset_ns'] // 2_000_000 == slot
            T = np.linalg.inv(T_stamp) @ truth.at(scan.stamp_ns + slot * 2_000_000 + 1_000_000)
            again[chosen] = xyz[chosen] @ T[:3, :3].T + T[:3, 3]
        near = (np.linalg.norm(xyz, axis=1) < 30) & (xyz[:, 2] > 0.5)
        upper = raw['laser_number'] < 32
        gaps = [
            np.median(cKDTree(p[near & ~upper]).query(p[near & upper])[0]) for p in (xyz, again)
        ]
        assert gaps[0] < 0.9 * gaps[1]


def test_camera_is_read_with_its_pinhole_and_no_distortion(copy, write_image):
    folder = copy / 'sensors' / 'cameras' / 'ring_front_center'
    write_image(folder / f'{STAMPS[0] + 5}.jpg', (50, 60, 70), (1550, 2048))
    drive = open_argoverse2(copy)
    image = next(r for r in drive.records() if isinstance(r, CameraImage))
    assert image.stamp_ns == STAMPS[0] + 5
    assert image.pixels.shape == (2048, 1550, 3)
    assert drive.camera.K[0] == pytest.approx([1776.041484, 0, 777.990573])
    assert drive.camera.distortion == (0.0,) * 5
    ahead = np.linalg.inv(mounting_of(drive, 'camera')) @ [20.0, 0.0, 1.4, 1.0]
    assert ahead[2] > 18 and np.abs(ahead[:2]).max() < 0.5


def test_cut_sweep_is_counted(copy):
    path = copy / 'sensors' / 'lidar' / f'{STAMPS[0]}.feather'
    path.write_bytes(path.read_bytes()[:5000])
    drive = open_argoverse2(copy)
    assert [s.stamp_ns for s in scans_of(drive)] == [STAMPS[1]]
    assert drive.skipped == {'unreadable scan file': 1}


def test_sweep_without_a_column_is_counted_by_name(copy, caplog):
    path = copy / 'sensors' / 'lidar' / f'{STAMPS[0]}.feather'
    feather.write_feather(pa.table({'x': [1.0], 'y': [2.0], 'intensity': [3]}), path)
    drive = open_argoverse2(copy)
    assert len(scans_of(drive)) == 1
    assert 'the column z is missing; it has x, y, intensity' in caplog.text


def test_missing_calibration_leaves_sweeps_in_base_link(copy):
    (copy / 'calibration' / 'egovehicle_SE3_sensor.feather').unlink()
    drive = open_argoverse2(copy)
    scan = scans_of(drive)[0]
    assert scan.frame_id == 'base_link'
    raw = raw_sweep(copy, STAMPS[0])
    assert np.array_equal(scan.cloud.xyz[:, 0], raw['x'].astype(np.float32))
    assert set(drive.skipped) == {'calibration missing: sweeps stay in base_link, no camera'}


def test_log_without_poses_has_no_truth(copy):
    (copy / 'city_SE3_egovehicle.feather').unlink()
    assert open_argoverse2(copy).truth() is None


def test_damaged_poses_are_an_error_that_names_the_file(copy):
    (copy / 'city_SE3_egovehicle.feather').write_bytes(b'ARROW1 but no more')
    with pytest.raises(DataError, match=r'city_SE3_egovehicle\.feather: not a readable'):
        open_argoverse2(copy)


def test_no_sweeps_is_an_error(tmp_path):
    (tmp_path / 'sensors' / 'lidar').mkdir(parents=True)
    with pytest.raises(DataError, match=r'no sweeps STAMP\.feather'):
        open_argoverse2(tmp_path)
