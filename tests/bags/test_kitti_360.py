"""KITTI-360: the real frames in the flat layout, and the published layout made of them."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bags.kitti_360 import open_kitti_360
from bags.records import CameraImage, LidarScan
from lcd_common.errors import DataError

EPOCH_NS = 1_000_000_000 * 10**9
CAM_TO_VELO = (
    '0.04307104361 -0.08829286498 0.995162929 0.8043914418 -0.999004371 0.007784614041 '
    '0.04392796942 0.2993489574 -0.01162548558 -0.9960641394 -0.08786966659 -0.1770225824'
)
CAM_TO_POSE = (
    'image_00: 0.0371783278 -0.0986182135 0.9944306009 1.5752681039 0.9992675562 -0.0053553387 '
    '-0.0378902567 0.0043914093 0.0090621821 0.9951109327 0.0983468786 -0.6500000000'
)
PERSPECTIVE = (
    'R_rect_00: 0.999974 -0.007141 -0.000089 0.007141 0.999969 -0.003247 '
    '0.000112 0.003247 0.999995\n'
    'P_rect_00: 552.554261 0.000000 682.049453 0.000000 0.000000 552.554261 238.769549 0.000000 '
    '0.000000 0.000000 1.000000 0.000000\n'
)
SEQUENCE = '2013_05_28_drive_0003_sync'


def matrix(text: str) -> np.ndarray:
    T = np.eye(4)
    T[:3] = np.array(text.split(), float).reshape(3, 4)
    return T


def mounting_of(drive, child):
    return next(m.T_parent_child for m in drive.mountings if m.child == child)


@pytest.fixture
def root(tmp_path, points_of, write_image) -> Path:
    """Write the published layout with frames 5 to 8 of one sequence; poses for 5, 7 and 8."""
    calibration = tmp_path / 'calibration'
    calibration.mkdir()
    (calibration / 'calib_cam_to_velo.txt').write_text(CAM_TO_VELO)
    (calibration / 'calib_cam_to_pose.txt').write_text(CAM_TO_POSE)
    (calibration / 'perspective.txt').write_text(PERSPECTIVE)
    velodyne = tmp_path / 'data_3d_raw' / SEQUENCE / 'velodyne_points'
    image = tmp_path / 'data_2d_raw' / SEQUENCE / 'image_00'
    poses = tmp_path / 'data_poses' / SEQUENCE
    (velodyne / 'data').mkdir(parents=True)
    image.mkdir(parents=True)
    poses.mkdir(parents=True)
    lines = [f'2013-05-28 08:46:{2 + 0.1 * n:012.9f}' for n in range(9)]
    (velodyne / 'timestamps.txt').write_text('\n'.join(lines))
    (image / 'timestamps.txt').write_text('\n'.join(lines))
    for n in range(5, 9):
        points_of(n).tofile(velodyne / 'data' / f'{n:010d}.bin')
        write_image(image / 'data_rect' / f'{n:010d}.png')
    rows = []
    for n in (5, 7, 8):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler('ZYX', [0.1 * n, 0.02, np.pi]).as_matrix()
        T[:3, 3] = [1000.0 + n, 2000.0, 115.0]
        rows.append([n, *T[:3].ravel()])
    np.savetxt(poses / 'poses.txt', rows, fmt=['%d'] + ['%.12f'] * 12)
    return tmp_path


def test_published_layout_gives_scans_images_and_poses(root, points_of):
    drive = open_kitti_360(root)
    scans = [r for r in drive.records() if isinstance(r, LidarScan)]
    images = [r for r in drive.records() if isinstance(r, CameraImage)]
    first = 1_369_730_762 * 10**9 + 500_000_000  # 2013-05-28 08:46:02.5
    assert [s.stamp_ns - first for s in scans] == [0, 10**8, 2 * 10**8, 3 * 10**8]
    assert np.array_equal(scans[3].cloud.xyz, points_of(8)[:, :3])
    assert len(images) == 4
    assert drive.truth().stamps_ns.tolist() == [scans[n].stamp_ns for n in (0, 2, 3)]
    assert not drive.skipped and not drive.notes


def test_camera_calibration_is_inverted(root):
    drive = open_kitti_360(root)
    R_rect = np.eye(4)
    values = PERSPECTIVE.splitlines()[0].split(':')[1].split()
    R_rect[:3, :3] = np.array(values, float).reshape(3, 3)
    expected = R_rect @ np.linalg.inv(matrix(CAM_TO_VELO))
    T_camera_lidar = np.linalg.inv(mounting_of(drive, 'camera')) @ mounting_of(drive, 'lidar')
    assert T_camera_lidar == pytest.approx(expected, abs=1e-5)
    ahead = T_camera_lidar @ [20.0, 0.0, 0.0, 1.0]
    assert ahead[2] == pytest.approx(19.2, abs=0.2)  # in front of the camera


def test_both_pose_files_give_the_same_truth(root):
    poses = root / 'data_poses' / SEQUENCE
    expected = open_kitti_360(root).truth()
    R_rect = np.eye(4)
    values = PERSPECTIVE.splitlines()[0].split(':')[1].split()
    R_rect[:3, :3] = np.array(values, float).reshape(3, 3)
    rows = []
    for row in np.loadtxt(poses / 'poses.txt'):
        T_world_imu = np.vstack([row[1:].reshape(3, 4), [0, 0, 0, 1]])
        T = T_world_imu @ matrix(CAM_TO_POSE.split(':')[1]) @ np.linalg.inv(R_rect)
        rows.append([row[0], *T.ravel()])
    np.savetxt(poses / 'cam0_to_world.txt', rows, fmt=['%d'] + ['%.12f'] * 16)
    (poses / 'poses.txt').unlink()
    truth = open_kitti_360(root).truth()
    assert np.array_equal(truth.stamps_ns, expected.stamps_ns)
    assert truth.T_world_body == pytest.approx(expected.T_world_body, abs=1e-4)


def test_base_link_of_the_truth_points_up(root):
    """The GPS/IMU looks forward, right, down; base_link must come out forward, left, up."""
    up = open_kitti_360(root).truth().T_world_body[:, 2, 2]
    assert np.all(up > 0.99)


def test_broken_pose_rows_are_counted(root):
    path = root / 'data_poses' / SEQUENCE / 'poses.txt'
    path.write_text(path.read_text() + '9 1 2 3\n8 nan' + ' 1' * 11 + '\n\n')
    drive = open_kitti_360(root)
    assert len(drive.truth()) == 3
    assert drive.skipped == {'broken row of poses.txt': 2}


def test_missing_stamps_follow_from_frame_numbers_and_say_so(root, caplog):
    (root / 'data_3d_raw' / SEQUENCE / 'velodyne_points' / 'timestamps.txt').unlink()
    (root / 'data_2d_raw' / SEQUENCE / 'image_00' / 'timestamps.txt').unlink()
    drive = open_kitti_360(root)
    assert drive.streams()[0].first_ns == EPOCH_NS + 5 * 10**8
    assert any('nominal 10 Hz' in note for note in drive.notes)
    assert 'nominal 10 Hz' in caplog.text


def test_missing_calibration_costs_camera_and_truth(root):
    (root / 'calibration' / 'calib_cam_to_velo.txt').unlink()
    drive = open_kitti_360(root)
    assert drive.camera is None and drive.truth() is None
    assert len(list(drive.records())) == 4
    assert set(drive.skipped) == {'calib_cam_to_velo.txt missing: no camera and no ground truth'}


def test_calibration_of_another_size_is_an_error(root):
    (root / 'calibration' / 'calib_cam_to_velo.txt').write_text('1 2 3')
    with pytest.raises(DataError, match=r'calib_cam_to_velo\.txt: expected 12 numbers'):
        open_kitti_360(root)


def test_sequence_is_chosen_by_name_or_part(root):
    assert open_kitti_360(root / 'data_3d_raw' / SEQUENCE).name == f'kitti_360_{SEQUENCE}'
    (root / 'data_3d_raw' / '2013_05_28_drive_0009_sync').mkdir()
    assert open_kitti_360(root, '0003').name == f'kitti_360_{SEQUENCE}'
    with pytest.raises(DataError, match=r'choose a sequence; it has .*0003.*0009'):
        open_kitti_360(root)
    with pytest.raises(DataError, match=r'no scans NNNNNNNNNN\.bin'):
        open_kitti_360(root, '0009')


def test_real_frames_are_read(real_data: Path):
    drive = open_kitti_360(real_data / 'kitti_360')
    records = list(drive.records())
    scans = [r for r in records if isinstance(r, LidarScan)]
    images = [r for r in records if isinstance(r, CameraImage)]
    assert len(scans) == len(images) == 24
    assert [s.stamp_ns for s in scans] == [EPOCH_NS + n * 10**8 for n in range(3000, 3024)]
    assert images[0].pixels.shape == (376, 1408, 3)
    assert drive.truth() is None


def test_real_road_lies_at_the_height_of_base_link(real_data: Path):
    drive = open_kitti_360(real_data / 'kitti_360')
    scan = next(r for r in drive.records() if isinstance(r, LidarScan))
    p = scan.cloud.transformed(mounting_of(drive, 'lidar')).xyz
    near = p[(np.abs(p[:, 1]) < 1.5) & (p[:, 0] > 4) & (p[:, 0] < 8)]
    assert abs(float(np.median(near[:, 2]))) < 0.06


def test_real_sweep_and_image_agree_best_where_the_calibration_puts_them(real_data: Path):
    """The mutual information of reflectance and grey value peaks at the calibration."""
    drive = open_kitti_360(real_data / 'kitti_360')
    T = np.linalg.inv(mounting_of(drive, 'camera')) @ mounting_of(drive, 'lidar')
    counts = {s: np.zeros((32, 32)) for s in [(0, 0), (-20, 0), (20, 0), (0, -10), (0, 10)]}
    grey = np.empty(0)
    for record in drive.records(end_ns=EPOCH_NS + 3011 * 10**8):
        if isinstance(record, CameraImage):
            grey = record.pixels.mean(axis=2)
            continue
        p = record.cloud.xyz.astype(float) @ T[:3, :3].T + T[:3, 3]
        near = (p[:, 2] > 3) & (p[:, 2] < 40)
        uv = (p[near] @ drive.camera.K.T)[:, :2] / p[near, 2:]
        u, v = np.rint(uv).astype(int).T
        inside = (u > 25) & (u < 1408 - 25) & (v > 15) & (v < 376 - 15)
        u, v, reflectance = u[inside], v[inside], record.cloud.intensity[near][inside]
        for (du, dv), count in counts.items():
            seen = grey[v + dv, u + du]
            count += np.histogram2d(reflectance, seen, 32, [[0, 1], [0, 256]])[0]

    def information(count):
        joint = count / count.sum()
        product = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
        some = joint > 0
        return float((joint[some] * np.log(joint[some] / product[some])).sum())

    score = {shift: information(count) for shift, count in counts.items()}
    assert score.pop((0, 0)) > max(score.values())
