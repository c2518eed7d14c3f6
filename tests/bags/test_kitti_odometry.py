"""KITTI odometry: what is read, and what becomes of files that are damaged or missing."""

import logging
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bags.kitti_odometry import open_kitti_odometry
from bags.records import CameraImage, LidarScan, TruthPose
from lcd_common.errors import DataError

EPOCH_NS = 1_000_000_000 * 10**9


def scans_of(drive, **span):
    return [r for r in drive.records(**span) if isinstance(r, LidarScan)]


def mounting_of(drive, child):
    return next(m.T_parent_child for m in drive.mountings if m.child == child)


def test_reads_scans_and_poses_in_stamp_order(kitti, points_of):
    drive = open_kitti_odometry(kitti())
    records = list(drive.records())
    assert [type(r) for r in records] == [TruthPose, LidarScan] * 5
    assert [r.stamp_ns for r in records[::2]] == [EPOCH_NS + n * 10**8 for n in range(5)]
    scan = records[7]
    assert np.array_equal(scan.cloud.xyz, points_of(3)[:, :3])
    assert np.array_equal(scan.cloud.intensity, points_of(3)[:, 3])
    assert scan.cloud.time_s is None
    assert not drive.skipped


def test_streams_tell_counts_and_spans_without_reading(kitti):
    folder = kitti([0, 3])
    drive = open_kitti_odometry(folder)
    for path in (folder / 'velodyne').iterdir():
        path.unlink()
    points, truth = drive.streams()
    assert (points.topic, points.type_name) == ('/points', 'sensor_msgs/msg/PointCloud2')
    assert (points.count, points.last_ns) == (2, EPOCH_NS + 3 * 10**8)
    assert (truth.topic, truth.count) == ('/ground_truth/pose', 4)


def test_scan_number_chooses_the_row_of_times_and_poses(kitti, points_of):
    drive = open_kitti_odometry(kitti([1, 4], times=[0.0, 0.1, 0.25, 0.3, 0.55]))
    scans = scans_of(drive)
    assert [s.stamp_ns - EPOCH_NS for s in scans] == [100_000_000, 550_000_000]
    assert np.array_equal(scans[1].cloud.xyz, points_of(4)[:, :3])
    assert len(drive.truth()) == 5


def test_span_is_inclusive_at_both_ends(kitti):
    drive = open_kitti_odometry(kitti())
    scans = scans_of(drive, start_ns=EPOCH_NS + 10**8, end_ns=EPOCH_NS + 3 * 10**8)
    assert [s.stamp_ns - EPOCH_NS for s in scans] == [10**8, 2 * 10**8, 3 * 10**8]


def test_camera_projects_as_the_published_matrices_do(kitti):
    drive = open_kitti_odometry(kitti(images=range(5)))
    image = next(r for r in drive.records() if isinstance(r, CameraImage))
    assert image.pixels.shape == (8, 12, 3)
    assert image.pixels[0, 0].tolist() == [10, 20, 30]
    assert (drive.camera.width, drive.camera.height) == (12, 8)
    lines = dict(line.split(': ') for line in (drive.path / 'calib.txt').read_text().splitlines())
    P2 = np.array(lines['P2'].split(), float).reshape(3, 4)
    Tr = np.vstack([np.array(lines['Tr'].split(), float).reshape(3, 4), [0, 0, 0, 1]])
    point = np.array([12.0, -3.0, 1.0, 1.0])
    expected = P2 @ Tr @ point
    T_camera_lidar = np.linalg.inv(mounting_of(drive, 'camera')) @ mounting_of(drive, 'lidar')
    seen = drive.camera.K @ (T_camera_lidar @ point)[:3]
    assert seen[:2] / seen[2] == pytest.approx(expected[:2] / expected[2], abs=1e-4)


def test_base_link_is_on_the_ground_below_the_velodyne(kitti):
    drive = open_kitti_odometry(kitti())
    expected = np.eye(4)
    expected[2, 3] = 1.73
    assert np.array_equal(mounting_of(drive, 'lidar'), expected)
    assert drive.truth().T_world_body[0] == pytest.approx(np.eye(4), abs=1e-12)


def test_semantic_kitti_poses_are_used_where_the_official_ones_are_missing(kitti):
    folder = kitti()
    expected = open_kitti_odometry(folder).truth().T_world_body
    (folder.parent.parent / 'poses' / '00.txt').rename(folder / 'poses.txt')
    assert np.array_equal(open_kitti_odometry(folder).truth().T_world_body, expected)


def test_root_needs_a_sequence_when_it_holds_several(kitti, tmp_path):
    kitti(sequence='00')
    assert open_kitti_odometry(tmp_path).path.name == '00'
    kitti(sequence='07')
    assert open_kitti_odometry(tmp_path, '07').path.name == '07'
    with pytest.raises(DataError, match=r'choose a sequence.*: 00, 07'):
        open_kitti_odometry(tmp_path)
    with pytest.raises(DataError, match=r'no sequence 11.*: 00, 07'):
        open_kitti_odometry(tmp_path, '11')


def test_truncated_scan_is_counted_and_the_others_are_read(kitti, caplog):
    folder = kitti()
    broken = folder / 'velodyne' / '000002.bin'
    broken.write_bytes(broken.read_bytes()[:-5])
    drive = open_kitti_odometry(folder)
    assert len(scans_of(drive)) == 4
    assert len(scans_of(drive)) == 4
    assert drive.skipped == {'scan file of odd size': 1}  # once, though read twice
    assert caplog.text.count('000002.bin') == 1
    assert '795 bytes' in caplog.text


def test_only_broken_scans_is_an_error_that_names_the_first(kitti):
    folder = kitti([0, 1])
    for path in (folder / 'velodyne').iterdir():
        path.write_bytes(b'x' * 17)
    with pytest.raises(DataError, match=r'none of the 2 scans.*000000\.bin'):
        list(open_kitti_odometry(folder).records())


def test_empty_scan_is_counted(kitti):
    folder = kitti()
    (folder / 'velodyne' / '000001.bin').write_bytes(b'')
    drive = open_kitti_odometry(folder)
    assert len(scans_of(drive)) == 4
    assert drive.skipped == {'scan without points': 1}


def test_points_that_are_not_finite_are_dropped_and_counted(kitti, points_of):
    folder = kitti([0])
    points = points_of(0)
    points[3, 1], points[7, 2] = np.nan, np.inf
    points.tofile(folder / 'velodyne' / '000000.bin')
    drive = open_kitti_odometry(folder)
    cloud = scans_of(drive)[0].cloud
    keep = np.isfinite(points).all(axis=1)
    assert np.array_equal(cloud.xyz, points[keep, :3])
    assert np.array_equal(cloud.intensity, points[keep, 3])
    assert drive.skipped == {'points that are not finite': 2}


def test_missing_times_is_an_error_with_a_remedy(kitti):
    folder = kitti()
    (folder / 'times.txt').unlink()
    with pytest.raises(DataError, match=r'times\.txt: missing.*calibration archive'):
        open_kitti_odometry(folder)


@pytest.mark.parametrize('text', ['', 'zero\n', '0.0\nnan\n'])
def test_times_that_are_no_numbers_are_an_error(kitti, text):
    folder = kitti()
    (folder / 'times.txt').write_text(text)
    with pytest.raises(DataError, match=r'times\.txt: expected one time'):
        open_kitti_odometry(folder)


def test_missing_calibration_costs_camera_and_truth_but_no_scan(kitti, caplog):
    folder = kitti(images=range(5))
    (folder / 'calib.txt').unlink()
    drive = open_kitti_odometry(folder)
    assert len(scans_of(drive)) == 5
    assert drive.truth() is None and drive.camera is None
    assert drive.skipped == {'calib.txt missing: no camera and no ground truth': 1}
    assert 'calib.txt: missing' in caplog.text


@pytest.mark.parametrize(
    ('text', 'message'),
    [('P0: 1 2 3\n', 'entry Tr is missing'), ('Tr: 1 2 3\n', 'Tr must be 12 numbers'),
     ('Tr: ' + '9 ' * 12 + '\n', 'a rotation is expected')],
)  # fmt: skip
def test_calibration_that_cannot_be_is_an_error(kitti, text, message):
    folder = kitti()
    (folder / 'calib.txt').write_text(text)
    with pytest.raises(DataError, match=rf'calib\.txt.*{message}'):
        open_kitti_odometry(folder)


def test_scans_beyond_the_times_are_counted(kitti):
    drive = open_kitti_odometry(kitti(range(6), times=[0.0, 0.1, 0.2, 0.3]))
    assert len(scans_of(drive)) == 4
    assert drive.skipped['velodyne file without a row in times.txt'] == 2


def test_no_scan_with_a_time_is_an_error(kitti):
    with pytest.raises(DataError, match='no file number has a row'):
        open_kitti_odometry(kitti([5], times=[0.0]))


@pytest.mark.parametrize('poses', [3, 8])
def test_poses_of_another_count_are_paired_by_row(kitti, poses):
    drive = open_kitti_odometry(kitti(poses=poses))
    assert len(drive.truth()) == min(poses, 5)
    assert drive.skipped == {'pose without a time, or time without a pose': abs(poses - 5)}


def test_backward_and_repeated_times_are_sorted_and_counted(kitti, points_of, caplog):
    drive = open_kitti_odometry(kitti(times=[0.0, 0.2, 0.1, 0.2, 0.3]))
    scans = scans_of(drive)
    assert [s.stamp_ns - EPOCH_NS for s in scans] == [0, 10**8, 2 * 10**8, 3 * 10**8]
    assert np.array_equal(scans[1].cloud.xyz, points_of(2)[:, :3])
    assert np.array_equal(scans[2].cloud.xyz, points_of(1)[:, :3])
    assert drive.skipped['duplicate stamp'] == 1
    assert 'backwards' in caplog.text


def test_empty_velodyne_folder_is_an_error(kitti):
    folder = kitti([0])
    (folder / 'velodyne' / '000000.bin').unlink()
    with pytest.raises(DataError, match=r'velodyne: no scans NNNNNN\.bin'):
        open_kitti_odometry(folder)


def test_unreadable_image_and_odd_names_are_counted(kitti):
    folder = kitti(images=range(5))
    (folder / 'image_2' / '000001.png').write_bytes(b'\x89PNG nonsense')
    (folder / 'velodyne' / 'copy of 1.bin').write_bytes(b'')
    drive = open_kitti_odometry(folder)
    assert sum(isinstance(r, CameraImage) for r in drive.records()) == 4
    assert drive.skipped == {'unreadable image': 1, 'file name is not a number': 1}


def test_scan_deleted_after_opening_is_counted(kitti):
    folder = kitti()
    drive = open_kitti_odometry(folder)
    (folder / 'velodyne' / '000004.bin').unlink()
    assert len(scans_of(drive)) == 4
    assert drive.skipped == {'unreadable scan file': 1}


def test_many_causes_do_not_flood_the_log(kitti, caplog):
    folder = kitti(range(12))
    for number in range(10):
        (folder / 'velodyne' / f'{number:06d}.bin').write_bytes(b'x')
    drive = open_kitti_odometry(folder)
    with caplog.at_level(logging.WARNING):
        list(drive.records())
    assert drive.skipped == {'scan file of odd size': 10}
    assert len(caplog.records) == 4


def test_a_long_drive_never_sits_in_memory(tmp_path):
    folder = tmp_path / 'sequences' / '00'
    (folder / 'velodyne').mkdir(parents=True)
    one_scan = np.ones((20_000, 4), np.float32)
    one_scan.tofile(folder / 'velodyne' / '000000.bin')
    for number in range(1, 300):
        (folder / 'velodyne' / f'{number:06d}.bin').hardlink_to(folder / 'velodyne' / '000000.bin')
    (folder / 'times.txt').write_text('\n'.join(f'{0.1 * n}' for n in range(300)))
    tracemalloc.start()
    count = sum(1 for _ in open_kitti_odometry(folder).records())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 300
    assert peak < 8 * one_scan.nbytes  # of 300 that are read


@pytest.mark.parametrize('later', [1, 5])
def test_truth_aligns_real_sweeps(real_data: Path, later):
    drive = open_kitti_odometry(real_data / 'kitti_odometry', '00')
    scans = scans_of(drive, end_ns=EPOCH_NS + 10**9)
    T_base_lidar = mounting_of(drive, 'lidar')

    def structure(scan, T):
        xyz = scan.cloud.xyz.astype(float)
        xyz = xyz[(np.linalg.norm(xyz, axis=1) < 40) & (xyz[:, 2] > -1.2)]
        return xyz @ T[:3, :3].T + T[:3, 3]

    def gap(T_world_first, T_world_second):
        first = structure(scans[0], T_world_first @ T_base_lidar)
        second = structure(scans[later], T_world_second @ T_base_lidar)
        return float(np.mean(np.minimum(cKDTree(first).query(second[::10])[0], 1.0)))

    truth = drive.truth()
    poses = [truth.at(scans[0].stamp_ns), truth.at(scans[later].stamp_ns)]
    aligned = gap(*poses)
    assert aligned < 0.6 * gap(np.eye(4), np.eye(4))
    assert aligned < 0.6 * gap(*np.linalg.inv(poses))


def test_real_truth_is_the_published_relation(real_data: Path):
    root = real_data / 'kitti_odometry'
    drive = open_kitti_odometry(root / 'sequences' / '00')
    calib = dict(
        line.split(': ') for line in (drive.path / 'calib.txt').read_text().splitlines() if line
    )
    Tr = np.vstack([np.array(calib['Tr'].split(), float).reshape(3, 4), [0, 0, 0, 1]])
    P = np.vstack([np.loadtxt(root / 'poses' / '00.txt')[4501].reshape(3, 4), [0, 0, 0, 1]])
    T_base_lidar = mounting_of(drive, 'lidar')
    lidar = np.linalg.inv(T_base_lidar) @ drive.truth().T_world_body[4501] @ T_base_lidar
    assert lidar == pytest.approx(np.linalg.inv(Tr) @ P @ Tr, abs=1e-4)
    assert len(drive.truth()) == 4541
    assert drive.truth().length_m == pytest.approx(3724.19, rel=2e-3)  # the benchmark's length


def test_labels_come_with_their_scans_and_misfits_are_counted(kitti, points_of):
    folder = kitti()
    (folder / 'labels').mkdir()
    labels = np.arange(len(points_of(1)), dtype=np.uint32) | (5 << 16)
    labels.tofile(folder / 'labels' / '000001.label')
    labels[:-1].tofile(folder / 'labels' / '000002.label')
    drive = open_kitti_odometry(folder)
    found = [scan.cloud.label for scan in scans_of(drive)]
    assert found[0] is None and found[2] is None
    np.testing.assert_array_equal(found[1], labels & 0xFFFF)
    assert drive.skipped == {'labels that do not fit their scan': 1}
