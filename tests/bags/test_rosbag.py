"""Bags of every kind: what is read from whole ones."""

import io

import numpy as np
import pytest
from filled_bag import fill, of
from PIL import Image

from bags.records import CameraImage, GnssFix, ImuSample, LidarScan, TruthPose
from bags.rosbag import open_rosbag
from lcd_common.errors import DataError

START_NS = 1_700_000_000 * 10**9
SECOND = 10**9


def check(drive, points_of, count=6):
    records = list(drive.records())
    kinds = [ImuSample, GnssFix, TruthPose, CameraImage, LidarScan]
    assert [type(r) for r in records] == kinds * count
    assert [r.stamp_ns for r in records[::5]] == [START_NS + n * 10**8 for n in range(count)]
    for n, scan in enumerate(records[4::5]):
        assert np.array_equal(scan.cloud.xyz, points_of(n)[:, :3])
        assert np.array_equal(scan.cloud.intensity, points_of(n)[:, 3])
        assert scan.frame_id == 'velodyne'
    assert records[3].pixels[0, 0].tolist() == [0, 20, 30]
    assert records[5].angular_velocity.tolist() == [1.0, 0.0, 0.0]
    assert records[6].latitude_deg == 49.001
    assert np.array_equal(records[6].covariance_enu, np.diag([1.0, 2.0, 3.0]))
    assert drive.truth().positions[:, 0].tolist() == list(range(count))
    assert [(m.parent, m.child, m.T_parent_child[2, 3]) for m in drive.mountings] == [
        ('base_link', 'velodyne', 1.7)
    ]


@pytest.mark.parametrize(('storage', 'compress'), [('mcap', True), ('mcap', False), ('db3', False)])
def test_rosbag2_is_read_in_full(bag, points_of, storage, compress):
    fill(bag, points_of)
    path = bag.write(storage, compress=compress)
    drive = open_rosbag(path)
    check(drive, points_of)
    assert not drive.skipped
    streams = {s.topic: s for s in drive.streams()}
    assert streams['/points'].count == 6
    assert streams['/points'].first_ns == START_NS
    assert streams['/imu'].last_ns == START_NS + 5 * 10**8


@pytest.mark.parametrize('storage', ['mcap', 'db3'])
def test_storage_file_alone_and_folder_without_metadata_open_too(bag, points_of, storage):
    fill(bag, points_of)
    folder = bag.write(storage)
    check(open_rosbag(folder / f'bag.{storage}'), points_of)
    (folder / 'metadata.yaml').unlink()
    check(open_rosbag(folder), points_of)


def test_split_bag_without_metadata_is_read_as_one(bag, points_of, tmp_path):
    fill(bag, points_of)
    whole = list(bag.messages)
    folder = tmp_path / 'split'
    folder.mkdir()
    for name, part in (('a', whole[:16]), ('b', whole[16:])):
        bag.messages = part
        (bag.write(name=name) / f'{name}.mcap').rename(folder / f'split_{name}.mcap')
    check(open_rosbag(folder), points_of)


def test_rosbag1_is_read_in_full(bag1, points_of):
    fill(bag1, points_of)
    drive = open_rosbag(bag1.write())
    check(drive, points_of)
    assert not drive.skipped


def test_point_time_comes_under_the_drivers_name(bag):
    rows = np.array([[1, 2, 3, 0.0], [4, 5, 6, 0.05], [7, 8, 9, 0.1]], np.float32)
    bag.cloud(START_NS, rows, names='xyzt')
    cloud = of(LidarScan, open_rosbag(bag.write()))[0].cloud
    assert cloud.time_s == pytest.approx([0.0, 0.05, 0.1])
    assert cloud.intensity is None


def test_records_come_by_stamp_though_recorded_late(bag, points_of):
    """A camera that needs 300 ms to deliver comes after sweeps that are newer."""
    for n in range(10):
        bag.cloud(START_NS + n * 10**8, points_of(n))
    for n in range(10):
        stamp = START_NS + n * 10**8 + 1
        bag.image(stamp, np.zeros((2, 2), np.uint8), 'mono8', log_ns=stamp + 3 * 10**8)
    bag.messages.sort(key=lambda m: m[1])
    drive = open_rosbag(bag.write())
    stamps = [r.stamp_ns for r in drive.records()]
    assert len(stamps) == 20 and stamps == sorted(stamps)
    assert not drive.skipped


def test_stamps_too_far_back_and_repeated_ones_are_counted(bag, points_of):
    offsets = [0, 1, 1, 2, 9, 0.5, 10]
    for n, offset in enumerate(offsets):
        bag.cloud(START_NS + int(offset * SECOND), points_of(n), log_ns=START_NS + n * SECOND)
    drive = open_rosbag(bag.write())
    scans = of(LidarScan, drive)
    assert [(s.stamp_ns - START_NS) / SECOND for s in scans] == [0, 1, 2, 9, 10]
    assert np.array_equal(scans[1].cloud.xyz, points_of(1)[:, :3])  # the first of a stamp is kept
    assert drive.skipped == {'duplicate stamp': 1, 'stamp out of order': 1}


def test_span_counts_in_header_stamps_even_where_the_recorders_clock_differs(bag, points_of):
    year_ns = 365 * 86400 * SECOND
    for n in range(60):
        stamp = START_NS + n * SECOND
        bag.cloud(stamp, points_of(n, 3), log_ns=stamp + year_ns)
    drive = open_rosbag(bag.write())
    records = list(drive.records(START_NS + 20 * SECOND, START_NS + 30 * SECOND))
    assert [(r.stamp_ns - START_NS) // SECOND for r in records] == list(range(20, 31))


def test_a_span_does_not_read_the_whole_bag(bag, points_of):
    for n in range(100):
        bag.cloud(START_NS + n * SECOND, points_of(n, 5))
    bag.cloud(START_NS + 95 * SECOND + 1, points_of(0, 5), names='xyzq')
    bag.cloud(START_NS + 95 * SECOND + 2, np.ones((4, 2)), names='xy')  # would be counted
    drive = open_rosbag(bag.write('db3'))
    assert len(list(drive.records(START_NS, START_NS + 10 * SECOND))) == 11
    assert not drive.skipped


def test_clouds_without_fields_or_stamp_are_counted(bag, points_of):
    bag.cloud(START_NS, points_of(0))
    bag.cloud(START_NS + 1, np.ones((5, 2)), names='xy')
    bag.cloud(0, points_of(1), log_ns=START_NS + 2)
    bag.cloud(START_NS + 3, np.empty((0, 4)))
    drive = open_rosbag(bag.write())
    assert len(of(LidarScan, drive)) == 1
    assert drive.skipped == {
        'point cloud with a wrong layout': 1,
        'message without a stamp': 1,
        'scan without points': 1,
    }


def test_only_broken_clouds_is_an_error(bag):
    bag.cloud(START_NS, np.ones((5, 2)), names='xy')
    bag.imu(START_NS, 1.0)
    with pytest.raises(
        DataError, match=r'no cloud on /points can be read.*x, y and z.*it has x, y'
    ):
        list(open_rosbag(bag.write()).records())


def test_points_that_are_not_finite_are_dropped_and_counted(bag, points_of):
    points = points_of(0)
    points[2, 0], points[5, 1] = np.nan, -np.inf
    bag.cloud(START_NS, points)
    drive = open_rosbag(bag.write())
    assert len(of(LidarScan, drive)[0].cloud) == 48
    assert len(of(LidarScan, drive)[0].cloud) == 48
    assert drive.skipped == {'points that are not finite': 2}


@pytest.mark.parametrize(
    ('pixels', 'encoding', 'expected'),
    [
        (np.full((2, 2), 7, np.uint8), 'mono8', 7),
        (np.full((2, 2, 3), (1, 2, 3), np.uint8), 'bgr8', [3, 2, 1]),
        (np.full((2, 2, 4), (1, 2, 3, 4), np.uint8), 'rgba8', [1, 2, 3]),
        (np.full((2, 2, 4), (1, 2, 3, 4), np.uint8), 'bgra8', [3, 2, 1]),
    ],
)
def test_images_come_as_grey_or_rgb(bag, pixels, encoding, expected):
    bag.image(START_NS, pixels, encoding)
    assert of(CameraImage, open_rosbag(bag.write()))[0].pixels[0, 0].tolist() == expected


def test_padded_rows_of_an_image_are_cut(bag):
    bag.image(START_NS, np.arange(24, dtype=np.uint8).reshape(3, 8), 'mono8')
    message = bag.messages[0][2]
    object.__setattr__(message, 'width', 5)
    expected = np.arange(24).reshape(3, 8)[:, :5]
    assert np.array_equal(of(CameraImage, open_rosbag(bag.write()))[0].pixels, expected)


def test_images_that_cannot_be_read_are_counted(bag):
    bag.image(START_NS, np.zeros((2, 2), np.uint16), 'mono16')
    bag.image(START_NS + 1, np.zeros((2, 2), np.uint8), 'rgb8')
    bag.image(START_NS + 2, np.zeros((2, 2), np.uint8), 'mono8')
    drive = open_rosbag(bag.write())
    assert len(of(CameraImage, drive)) == 1
    assert drive.skipped == {'image encoding mono16': 1, 'unreadable image': 1}


def test_compressed_images_are_unpacked(bag):
    buffer = io.BytesIO()
    Image.new('RGB', (6, 4), (9, 8, 7)).save(buffer, 'png')
    kind = bag.type('sensor_msgs/msg/CompressedImage')
    for n, data in enumerate((buffer.getvalue(), buffer.getvalue()[:40])):
        stamp = START_NS + n
        message = kind(bag.header(stamp, 'camera'), 'png', np.frombuffer(data, np.uint8))
        bag.add('/camera/image/compressed', message, stamp)
    drive = open_rosbag(bag.write())
    assert of(CameraImage, drive)[0].pixels[0, 0].tolist() == [9, 8, 7]
    assert drive.skipped == {'unreadable image': 1}


def camera_info(bag, model='plumb_bob', d=(-0.3, 0.1, 0.001, 0.002, 0.0), f=700.0):
    K = np.array([f, 0, 600, 0, f, 180, 0, 0, 1])
    roi = bag.type('sensor_msgs/msg/RegionOfInterest')(0, 0, 0, 0, False)
    message = bag.type('sensor_msgs/msg/CameraInfo')(
        bag.header(START_NS, 'camera_optical'), 376, 1241, model, np.array(d, float), K,
        np.eye(3).ravel(), np.zeros(12), 0, 0, roi,
    )  # fmt: skip
    bag.add('/camera/camera_info', message, START_NS)


def test_camera_model_is_read(request, points_of):
    for maker in ('bag', 'bag1'):
        bag = request.getfixturevalue(maker)
        bag.cloud(START_NS, points_of(0))
        camera_info(bag)
        camera = open_rosbag(bag.write()).camera
        assert (camera.frame_id, camera.width, camera.height) == ('camera_optical', 1241, 376)
        assert camera.K.tolist() == [[700, 0, 600], [0, 700, 180], [0, 0, 1]]
        assert camera.distortion == (-0.3, 0.1, 0.001, 0.002, 0.0)


@pytest.mark.parametrize(
    ('info', 'cause'),
    [
        ({'model': 'equidistant'}, 'CameraInfo of another distortion model'),
        ({'f': 0.0}, 'CameraInfo without calibration'),
    ],
)
def test_camera_model_of_another_kind_is_counted(bag, points_of, info, cause):
    bag.cloud(START_NS, points_of(0))
    camera_info(bag, **info)
    drive = open_rosbag(bag.write())
    assert drive.camera is None
    assert drive.skipped == {cause: 1}


def test_records_that_say_nothing_are_counted(bag, points_of):
    bag.cloud(START_NS, points_of(0))
    bag.fix(START_NS, 49.0, status=-1)
    bag.fix(START_NS + 1, float('nan'))
    bag.imu(START_NS, float('nan'))
    bag.pose(START_NS, float('nan'))
    drive = open_rosbag(bag.write())
    assert [type(r) for r in drive.records()] == [LidarScan]
    assert drive.skipped == {
        'GNSS without a fix': 1,
        'NavSatFix that is not finite': 1,
        'Imu that is not finite': 1,
        'pose that is not finite': 1,
    }
    assert drive.truth() is None


# --- damaged bags -------------------------------------------------------------------------------


@pytest.mark.parametrize('data', [b'', b'not an mcap', b'\x89MCAP0\r\n'])
def test_file_that_is_no_mcap_is_an_error(tmp_path, data):
    path = tmp_path / 'x.mcap'
    path.write_bytes(data)
    with pytest.raises(DataError, match=r'x\.mcap: no message can be read'):
        open_rosbag(path)


def test_folder_without_storage_is_an_error(tmp_path):
    with pytest.raises(DataError, match=r'no \.mcap or \.db3 file'):
        open_rosbag(tmp_path)


def test_bag_without_sensors_is_an_error_that_lists_its_topics(bag):
    bag.pose(START_NS, 1.0, topic='/goal')
    with pytest.raises(DataError, match=r'no topic with points.*/goal \(geometry_msgs/msg/Pose'):
        open_rosbag(bag.write())
