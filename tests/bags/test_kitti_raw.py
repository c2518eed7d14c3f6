"""KITTI's raw recordings, in the layout of its development kit (no sample is at hand)."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bags.kitti_raw import open_kitti_raw
from bags.records import CameraImage, GnssFix, ImuSample, LidarScan, TruthPose, TwistSample
from lcd_common.errors import DataError

# The calibration published with 2011_09_26.
VELO_TO_CAM = """calib_time: 15-Mar-2012 11:37:16
R: 7.533745e-03 -9.999714e-01 -6.166020e-04 1.480249e-02 7.280733e-04 -9.998902e-01 9.998621e-01 7.523790e-03 1.480755e-02
T: -4.069766e-03 -7.631618e-02 -2.717806e-01
"""  # noqa: E501
IMU_TO_VELO = """calib_time: 25-May-2012 16:47:16
R: 9.999976e-01 7.553071e-04 -2.035826e-03 -7.854027e-04 9.998898e-01 -1.482298e-02 2.024406e-03 1.482454e-02 9.998881e-01
T: -8.086759e-01 3.195559e-01 -7.997231e-01
"""  # noqa: E501
CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
R_rect_00: 9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 -4.278459e-03 7.402527e-03 4.351614e-03 9.999631e-01
K_02: 9.597910e+02 0.000000e+00 6.960217e+02 0.000000e+00 9.569251e+02 2.241806e+02 0.000000e+00 0.000000e+00 1.000000e+00
D_02: -3.691481e-01 1.968681e-01 1.353473e-03 5.677587e-04 -6.770705e-02
R_02: 9.999758e-01 -5.267463e-03 -4.552439e-03 5.251945e-03 9.999804e-01 -3.413835e-03 4.570332e-03 3.389843e-03 9.999838e-01
T_02: 5.956621e-02 2.900141e-04 2.577209e-03
P_rect_02: 7.215377e+02 0.000000e+00 6.095593e+02 4.485728e+01 0.000000e+00 7.215377e+02 1.728540e+02 2.163791e-01 0.000000e+00 0.000000e+00 1.000000e+00 2.745884e-03
"""  # noqa: E501
SECOND = 1_000_000_000
FIRST_NS = 1_317_042_145 * SECOND + 964_389_445  # 2011-09-26 13:02:25.964389445


def stamp_lines(count: int, step_ns: int = 100_000_000) -> list[str]:
    stamps = [np.datetime64(FIRST_NS + n * step_ns, 'ns') for n in range(count)]
    return [str(stamp).replace('T', ' ') for stamp in stamps]


def numbers_of(text: str, name: str) -> np.ndarray:
    line = next(row for row in text.splitlines() if row.startswith(f'{name}:'))
    return np.array(line.split(':')[1].split(), float)


def rigid(text: str, suffix: str = '') -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = numbers_of(text, f'R{suffix}').reshape(3, 3)
    T[:3, 3] = numbers_of(text, f'T{suffix}')
    return T


def packet(n: int) -> np.ndarray:
    """Return an OXTS packet of a car that drives a bend uphill at 10 m/s, 10 packets a second."""
    values = np.zeros(30)
    values[:6] = [49.0 + 1e-5 * n, 8.4 + 2e-5 * n, 116.0 + 0.1 * n, 0.02, -0.1, 0.3 + 0.05 * n]
    values[8:11] = [10.0, 0.1, 1.0]
    values[11:14] = [0.5, 0.25 + n, 9.81]
    values[14:17] = -1.0
    values[17:20] = [0.01, 0.02, 0.5 + n]
    values[20:23] = -2.0
    values[23] = 0.05
    return values


@pytest.fixture
def drive_folder(tmp_path, points_of, write_image):
    def make(kind: str = 'sync', count: int = 4, oxts_step_ns: int = 100_000_000) -> Path:
        date = tmp_path / '2011_09_26'
        folder = date / f'2011_09_26_drive_0001_{kind}'
        for name in ('velodyne_points', 'image_02', 'oxts'):
            (folder / name / 'data').mkdir(parents=True)
            step = oxts_step_ns if name == 'oxts' else 100_000_000
            lines = stamp_lines(count, step)
            (folder / name / 'timestamps.txt').write_text('\n'.join(lines) + '\n')
        for n in range(count):
            if kind == 'sync':
                points_of(n).tofile(folder / 'velodyne_points' / 'data' / f'{n:010d}.bin')
            else:
                file = folder / 'velodyne_points' / 'data' / f'{n:010d}.txt'
                np.savetxt(file, points_of(n), fmt='%.6f')
            write_image(folder / 'image_02' / 'data' / f'{n:010d}.png', (n, 2, 3))
            text = ' '.join(f'{v:.12f}' for v in packet(n))
            (folder / 'oxts' / 'data' / f'{n:010d}.txt').write_text(text + '\n')
        (date / 'calib_velo_to_cam.txt').write_text(VELO_TO_CAM)
        (date / 'calib_imu_to_velo.txt').write_text(IMU_TO_VELO)
        (date / 'calib_cam_to_cam.txt').write_text(CAM_TO_CAM)
        return folder

    return make


def of(kind, drive):
    return [r for r in drive.records() if isinstance(r, kind)]


def mounting_of(drive, child):
    return next(m.T_parent_child for m in drive.mountings if m.child == child)


def test_sync_gives_every_sensor_at_the_published_stamps(drive_folder, points_of):
    drive = open_kitti_raw(drive_folder())
    records = list(drive.records())
    assert [type(r) for r in records[:6]] == [
        ImuSample, TwistSample, GnssFix, TruthPose, CameraImage, LidarScan,
    ]  # fmt: skip
    assert len(records) == 24
    assert records[0].stamp_ns == FIRST_NS
    assert records[-1].stamp_ns == FIRST_NS + 3 * 10**8
    assert np.array_equal(records[-1].cloud.xyz, points_of(3)[:, :3])
    assert not drive.skipped


def test_imu_takes_the_body_axes_not_the_levelled_ones(drive_folder):
    sample = of(ImuSample, open_kitti_raw(drive_folder()))[2]
    assert sample.linear_acceleration.tolist() == [0.5, 2.25, 9.81]
    assert sample.angular_velocity.tolist() == [0.01, 0.02, 2.5]


def test_fix_carries_the_stated_accuracy(drive_folder):
    fix = of(GnssFix, open_kitti_raw(drive_folder()))[1]
    assert (fix.latitude_deg, fix.longitude_deg, fix.altitude_m) == (49.00001, 8.40002, 116.1)
    assert np.diag(fix.covariance_enu) == pytest.approx([0.0025, 0.0025, 0.01])


def test_twist_is_the_velocity_in_the_units_own_axes(drive_folder):
    twist = of(TwistSample, open_kitti_raw(drive_folder()))[0]
    body = Rotation.from_euler('ZYX', [0.0, -0.1, 0.02])  # levelled frame from the unit's
    assert twist.linear == pytest.approx(body.inv().apply([10.0, 0.1, 1.0]), abs=1e-12)
    assert twist.angular.tolist() == [0.01, 0.02, 0.5]
    assert twist.frame_id == 'imu'


def test_truth_is_the_pose_of_base_link_east_north_up(drive_folder):
    drive = open_kitti_raw(drive_folder())
    truth = drive.truth()
    T_imu_base = np.linalg.inv(mounting_of(drive, 'imu'))
    expected = []
    for n in range(4):
        values = packet(n)
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler('ZYX', values[[5, 4, 3]]).as_matrix()
        # Metres a degree at 49 degrees on the sphere that the development kit uses.
        per_degree = 6378137.0 * np.pi / 180
        T[:3, 3] = [
            (values[1] - 8.4) * per_degree * np.cos(np.radians(49.0)),
            (values[0] - 49.0) * per_degree,
            values[2] - 116.0,
        ]
        expected.append(T @ T_imu_base)
    expected = np.array(expected)
    expected[:, :3, 3] -= expected[0, :3, 3].copy()
    assert truth.T_world_body == pytest.approx(expected, abs=1e-4)


def test_sensors_sit_where_the_calibration_says(drive_folder):
    drive = open_kitti_raw(drive_folder())
    T_lidar_imu = np.linalg.inv(mounting_of(drive, 'lidar')) @ mounting_of(drive, 'imu')
    assert T_lidar_imu == pytest.approx(rigid(IMU_TO_VELO), abs=1e-6)
    assert np.array_equal(mounting_of(drive, 'gps'), mounting_of(drive, 'imu'))
    point = np.array([15.0, 2.0, -1.0, 1.0])
    R_rect = np.eye(4)
    R_rect[:3, :3] = numbers_of(CAM_TO_CAM, 'R_rect_00').reshape(3, 3)
    P = numbers_of(CAM_TO_CAM, 'P_rect_02').reshape(3, 4)
    expected = P @ R_rect @ rigid(VELO_TO_CAM) @ point
    T_camera_lidar = np.linalg.inv(mounting_of(drive, 'camera')) @ mounting_of(drive, 'lidar')
    seen = drive.camera.K @ (T_camera_lidar @ point)[:3]
    assert seen[:2] / seen[2] == pytest.approx(expected[:2] / expected[2], abs=1e-2)


def test_extract_has_text_sweeps_and_an_unrectified_camera(drive_folder, points_of):
    drive = open_kitti_raw(drive_folder('extract'))
    scan = of(LidarScan, drive)[1]
    assert scan.cloud.xyz == pytest.approx(points_of(1)[:, :3], abs=1e-6)
    assert scan.cloud.intensity == pytest.approx(points_of(1)[:, 3], abs=1e-6)
    assert drive.camera.K[0, 0] == 959.7910
    assert drive.camera.distortion == (
        -0.3691481,
        0.1968681,
        0.001353473,
        0.0005677587,
        -0.06770705,
    )
    T_camera_lidar = np.linalg.inv(mounting_of(drive, 'camera')) @ mounting_of(drive, 'lidar')
    expected = rigid(CAM_TO_CAM, '_02') @ rigid(VELO_TO_CAM)
    assert T_camera_lidar == pytest.approx(expected, abs=1e-5)


def test_stray_empty_lines_are_left_out(drive_folder):
    folder = drive_folder()
    lines = stamp_lines(4)
    stray = '\n'.join([lines[0], '', *lines[1:], '', ''])
    (folder / 'velodyne_points' / 'timestamps.txt').write_text(stray)
    drive = open_kitti_raw(folder)
    assert [s.stamp_ns - FIRST_NS for s in of(LidarScan, drive)] == [0, 10**8, 2 * 10**8, 3 * 10**8]
    assert not drive.skipped


def test_empty_line_of_a_missing_file_keeps_its_place(drive_folder, points_of):
    folder = drive_folder()
    (folder / 'velodyne_points' / 'data' / '0000000001.bin').unlink()
    lines = stamp_lines(4)
    lines[1] = ''
    (folder / 'velodyne_points' / 'timestamps.txt').write_text('\n'.join(lines))
    scans = of(LidarScan, open_kitti_raw(folder))
    assert [s.stamp_ns - FIRST_NS for s in scans] == [0, 2 * 10**8, 3 * 10**8]
    assert np.array_equal(scans[1].cloud.xyz, points_of(2)[:, :3])


def test_fewer_stamps_than_scans_are_counted(drive_folder):
    folder = drive_folder()
    (folder / 'velodyne_points' / 'timestamps.txt').write_text('\n'.join(stamp_lines(2)))
    drive = open_kitti_raw(folder)
    assert len(of(LidarScan, drive)) == 2
    assert drive.skipped['velodyne_points file without a stamp'] == 2


def test_unsorted_and_repeated_oxts_stamps_are_mended(drive_folder):
    folder = drive_folder()
    lines = stamp_lines(4)
    (folder / 'oxts' / 'timestamps.txt').write_text(
        '\n'.join([lines[0], lines[2], lines[1], lines[2]])
    )
    drive = open_kitti_raw(folder)
    samples = of(ImuSample, drive)
    assert [s.stamp_ns - FIRST_NS for s in samples] == [0, 10**8, 2 * 10**8]
    assert [s.linear_acceleration[1] for s in samples] == [0.25, 2.25, 1.25]
    assert drive.skipped == {'duplicate stamp': 1}
    assert len(drive.truth()) == 3


def test_broken_packet_is_counted(drive_folder):
    folder = drive_folder()
    (folder / 'oxts' / 'data' / '0000000001.txt').write_text('49.0 8.4')
    (folder / 'oxts' / 'data' / '0000000002.txt').write_text(' '.join(['nan'] * 30))
    drive = open_kitti_raw(folder)
    assert len(of(GnssFix, drive)) == 2
    assert drive.skipped == {'broken OXTS packet': 2}


def test_missing_scan_stamps_are_taken_from_start_and_end(drive_folder):
    folder = drive_folder() / 'velodyne_points'
    lines = stamp_lines(5, 50_000_000)
    (folder / 'timestamps_start.txt').write_text('\n'.join(lines[:4]))
    (folder / 'timestamps_end.txt').write_text('\n'.join(lines[1:]))
    (folder / 'timestamps.txt').unlink()
    scans = of(LidarScan, open_kitti_raw(folder.parent))
    assert [s.stamp_ns - FIRST_NS for s in scans[:2]] == [25_000_000, 75_000_000]
    (folder / 'timestamps_end.txt').unlink()
    with pytest.raises(DataError, match=r'velodyne_points/timestamps\.txt: missing'):
        open_kitti_raw(folder.parent)


def test_missing_calibration_costs_what_needs_it(drive_folder):
    folder = drive_folder()
    (folder.parent / 'calib_imu_to_velo.txt').unlink()
    (folder.parent / 'calib_velo_to_cam.txt').unlink()
    drive = open_kitti_raw(folder)
    assert drive.truth() is None and drive.camera is None
    assert len(of(LidarScan, drive)) == len(of(ImuSample, drive)) == 4
    assert set(drive.skipped) == {
        'calib_velo_to_cam.txt missing: no camera',
        'calib_imu_to_velo.txt missing: no ground truth',
    }


def test_broken_text_sweep_is_counted(drive_folder):
    folder = drive_folder('extract')
    (folder / 'velodyne_points' / 'data' / '0000000000.txt').write_text('1 2 3\n')
    (folder / 'velodyne_points' / 'data' / '0000000001.txt').write_text('1 2 3 4\n1 2\n')
    drive = open_kitti_raw(folder)
    assert len(of(LidarScan, drive)) == 2
    assert drive.skipped == {'unreadable scan file': 2}


def test_date_folder_needs_a_drive_when_it_holds_several(drive_folder):
    date = drive_folder('sync').parent
    assert open_kitti_raw(date).path.name == '2011_09_26_drive_0001_sync'
    drive_folder('extract')
    assert open_kitti_raw(date, 'extract').path.name == '2011_09_26_drive_0001_extract'
    with pytest.raises(DataError, match=r'choose a drive; it has .*_extract, .*_sync'):
        open_kitti_raw(date)
    with pytest.raises(DataError, match=r"0 drives fit '0099'"):
        open_kitti_raw(date, '0099')


def test_no_scans_is_an_error(drive_folder):
    folder = drive_folder()
    for path in (folder / 'velodyne_points' / 'data').iterdir():
        path.unlink()
    with pytest.raises(DataError, match='no scans NNNNNNNNNN'):
        open_kitti_raw(folder)
