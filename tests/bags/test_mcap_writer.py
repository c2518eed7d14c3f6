"""What is written satisfies independent readers: the mcap library with mcap_ros2, and rosbags."""

import json
import os
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability

from bags.bag_messages import camera_info, encode, static_transforms
from bags.mcap_writer import BagWriter
from bags.records import (
    CameraImage,
    CameraModel,
    GnssFix,
    ImuSample,
    LidarScan,
    Mounting,
    Record,
    TruthPose,
    TwistSample,
)
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError

RNG = np.random.default_rng(0)
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
CAMERA = CameraModel(
    'camera', 12, 8, np.array([[7.0, 0, 6], [0, 7.5, 4], [0, 0, 1]]), (0.1, 0.2, 0.3, 0.4, 0.5)
)
MOUNTINGS = (
    Mounting('base_link', 'lidar', se3.exp([0, 0, 1.73, 0, 0, 0])),
    Mounting('lidar', 'camera', se3.exp(RNG.normal(size=6))),
)
TOPICS = {
    '/tf_static': 'tf2_msgs/msg/TFMessage',
    '/points': 'sensor_msgs/msg/PointCloud2',
    '/camera/image': 'sensor_msgs/msg/Image',
    '/camera/camera_info': 'sensor_msgs/msg/CameraInfo',
    '/imu': 'sensor_msgs/msg/Imu',
    '/gps/fix': 'sensor_msgs/msg/NavSatFix',
    '/twist': 'geometry_msgs/msg/TwistStamped',
    '/ground_truth/pose': 'geometry_msgs/msg/PoseStamped',
}


def records() -> list[Record]:
    """Two of everything, with all that is optional once there and once not."""
    out: list[Record] = []
    for i in range(2):
        stamp = START + i * SECOND + 123_456_789
        n = 1000 + i
        cloud = PointCloud(
            RNG.normal(size=(n, 3)).astype(np.float32),
            RNG.random(n).astype(np.float32) if i == 0 else None,
            (0.1 * RNG.random(n)).astype(np.float32) if i == 0 else None,
        )
        shape = (8, 12) if i == 0 else (8, 12, 3)
        out += [
            ImuSample(stamp, RNG.normal(size=3), RNG.normal(size=3)),
            TwistSample(stamp, RNG.normal(size=3), RNG.normal(size=3)),
            GnssFix(stamp, 49.0, 8.4, 110.0, np.diag([1.0, 2.0, 3.0]) if i == 0 else None),
            TruthPose(stamp, se3.exp(RNG.normal(size=6))),
            CameraImage(stamp, RNG.integers(0, 256, shape, dtype=np.uint8)),
            LidarScan(stamp, cloud),
        ]
    return out


@pytest.fixture(scope='module')
def written() -> list[Record]:
    return records()


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory, written: list[Record]) -> Path:
    path = tmp_path_factory.mktemp('bags') / 'drive'
    with BagWriter(path) as bag:
        bag.write(static_transforms(MOUNTINGS, written[0].stamp_ns))
        for record in written:
            for message in encode(record, CAMERA):
                bag.write(message)
    return path


def test_the_folder_is_laid_out_as_rosbag2_does(bag: Path) -> None:
    assert sorted(p.name for p in bag.iterdir()) == ['drive_0.mcap', 'metadata.yaml']
    assert sorted(p.name for p in bag.parent.iterdir()) == ['drive']


def test_metadata_is_that_of_jazzy(bag: Path) -> None:
    text = (bag / 'metadata.yaml').read_text()
    assert '&' not in text  # no anchors
    info = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert (info['version'], info['storage_identifier']) == (9, 'mcap')
    assert info['relative_file_paths'] == ['drive_0.mcap']
    assert info['duration']['nanoseconds'] == SECOND
    assert info['starting_time']['nanoseconds_since_epoch'] == START + 123_456_789
    assert info['message_count'] == 15
    assert info['files'][0]['path'] == 'drive_0.mcap' and info['files'][0]['message_count'] == 15
    topics = {t['topic_metadata']['name']: t for t in info['topics_with_message_count']}
    assert {name: t['topic_metadata']['type'] for name, t in topics.items()} == TOPICS
    for name, topic in topics.items():
        assert topic['message_count'] == (1 if name == '/tf_static' else 2)
        (qos,) = topic['topic_metadata']['offered_qos_profiles']
        latched = name == '/tf_static'
        assert qos['durability'] == ('transient_local' if latched else 'volatile')
        assert (qos['reliability'], qos['history']) == ('reliable', 'keep_last')
        assert qos['depth'] == (1 if latched else 10)


def test_the_mcap_library_reads_every_field(bag: Path, written: list[Record]) -> None:
    with (bag / 'drive_0.mcap').open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == 'ros2'
        found: dict[str, list] = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None and schema.encoding == 'ros2msg'
            assert (schema.name, channel.message_encoding) == (TOPICS[channel.topic], 'cdr')
            assert message.log_time == message.publish_time
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert set(found) == set(TOPICS)
    for topic, messages in found.items():
        if topic != '/tf_static':
            for log_ns, decoded in messages:
                assert _stamp(decoded) == log_ns
    for number in range(2):
        _compare({t: m[number][1] for t, m in found.items() if t != '/tf_static'}, written, number)
    transforms = found['/tf_static'][0][1].transforms
    for stamped, mounting in zip(transforms, MOUNTINGS, strict=True):
        assert (stamped.header.frame_id, stamped.child_frame_id) == (
            mounting.parent,
            mounting.child,
        )
        t, q = stamped.transform.translation, stamped.transform.rotation
        T = se3.from_xyz_quaternion([t.x, t.y, t.z], [q.x, q.y, q.z, q.w])
        np.testing.assert_allclose(T, mounting.T_parent_child, atol=1e-12)


def _stamp(message: object) -> int:
    stamp = message.header.stamp  # type: ignore[attr-defined]
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _vector(v: object) -> list[float]:
    return [v.x, v.y, v.z]  # type: ignore[attr-defined]


def _compare(messages: dict, written: list[Record], number: int) -> None:
    imu, twist, fix, truth, image, scan = written[6 * number : 6 * number + 6]
    assert isinstance(imu, ImuSample) and isinstance(twist, TwistSample)
    assert isinstance(fix, GnssFix) and isinstance(truth, TruthPose)
    assert isinstance(image, CameraImage) and isinstance(scan, LidarScan)

    m = messages['/imu']
    assert m.header.frame_id == 'imu' and m.orientation_covariance[0] == -1.0
    np.testing.assert_array_equal(_vector(m.angular_velocity), imu.angular_velocity)
    np.testing.assert_array_equal(_vector(m.linear_acceleration), imu.linear_acceleration)

    m = messages['/twist']
    assert m.header.frame_id == 'base_link'
    np.testing.assert_array_equal(_vector(m.twist.linear), twist.linear)
    np.testing.assert_array_equal(_vector(m.twist.angular), twist.angular)

    m = messages['/gps/fix']
    assert (m.latitude, m.longitude, m.altitude) == (49.0, 8.4, 110.0)
    assert m.header.frame_id == 'gps' and m.status.status == 0
    assert m.position_covariance_type == (3 if number == 0 else 0)
    expected = np.diag([1.0, 2.0, 3.0]) if number == 0 else np.zeros((3, 3))
    np.testing.assert_array_equal(np.reshape(m.position_covariance, (3, 3)), expected)

    m = messages['/ground_truth/pose']
    q = m.pose.orientation
    T = se3.from_xyz_quaternion(_vector(m.pose.position), [q.x, q.y, q.z, q.w])
    np.testing.assert_allclose(T, truth.T_world_base, atol=1e-12)

    m = messages['/camera/image']
    assert (m.height, m.width, m.encoding) == (8, 12, 'mono8' if number == 0 else 'rgb8')
    assert m.step == (12 if number == 0 else 36)
    pixels = np.frombuffer(bytes(m.data), np.uint8).reshape(image.pixels.shape)
    np.testing.assert_array_equal(pixels, image.pixels)

    m = messages['/camera/camera_info']
    assert (m.height, m.width, m.distortion_model) == (8, 12, 'plumb_bob')
    np.testing.assert_array_equal(np.reshape(m.k, (3, 3)), CAMERA.K)
    np.testing.assert_array_equal(np.reshape(m.p, (3, 4))[:, :3], CAMERA.K)
    assert tuple(m.d) == CAMERA.distortion

    m = messages['/points']
    names = [f.name for f in m.fields]
    assert names == ['x', 'y', 'z'] + (['intensity', 'time'] if number == 0 else [])
    assert [f.offset for f in m.fields] == [4 * i for i in range(len(names))]
    assert all(f.datatype == 7 and f.count == 1 for f in m.fields)
    assert (m.height, m.width, m.point_step) == (1, len(scan.cloud), 4 * len(names))
    assert m.row_step == m.width * m.point_step == len(m.data)
    assert m.is_dense and not m.is_bigendian and m.header.frame_id == 'lidar'
    values = np.frombuffer(bytes(m.data), '<f4').reshape(len(scan.cloud), -1)
    np.testing.assert_array_equal(values[:, :3], scan.cloud.xyz)
    if number == 0:
        np.testing.assert_array_equal(values[:, 3], scan.cloud.intensity)
        np.testing.assert_array_equal(values[:, 4], scan.cloud.time_s)


def test_rosbags_reads_folder_and_file_alike(bag: Path) -> None:
    for path in (bag, bag / 'drive_0.mcap'):
        with AnyReader([path]) as reader:
            assert {c.topic: c.msgtype for c in reader.connections} == TOPICS
            assert reader.message_count == 15
            for connection in reader.connections:
                (qos,) = connection.ext.offered_qos_profiles  # type: ignore[union-attr]
                latched = connection.topic == '/tf_static'
                assert qos.reliability == QosReliability.RELIABLE
                assert (qos.durability == QosDurability.TRANSIENT_LOCAL) is latched
            stamps = [t for c, t, data in reader.messages() if reader.deserialize(data, c.msgtype)]
            assert stamps == sorted(stamps)


def test_the_index_is_complete(bag: Path) -> None:
    """Foxglove seeks by chunk and message indexes; every message must be in one."""
    with (bag / 'drive_0.mcap').open('rb') as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 15
        assert len(summary.channels) == len(summary.schemas) == len(TOPICS)
        data = (bag / 'drive_0.mcap').read_bytes()
        indexed = 0
        for chunk in summary.chunk_indexes:
            assert chunk.compression == 'zstd'
            for channel, offset in chunk.message_index_offsets.items():
                opcode, length, named, size = struct.unpack_from('<BQHI', data, offset)
                assert opcode == 0x07 and named == channel and length == 6 + size
                indexed += size // 16
        assert indexed == 15


@pytest.mark.ros
def test_type_hashes_are_those_of_the_installed_messages(bag: Path) -> None:
    prefixes = [*filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(':')), sys.prefix]
    info = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    compared = 0
    for topic in info['topics_with_message_count']:
        name = topic['topic_metadata']['type']
        files = [Path(p) / 'share' / f'{name}.json' for p in prefixes]
        for file in [f for f in files if f.is_file()]:
            hashes = json.loads(file.read_text())['type_hashes']
            known = {h['type_name']: h['hash_string'] for h in hashes}
            assert topic['topic_metadata']['type_description_hash'] == known[name]
            compared += 1
    if not compared:
        pytest.skip('the installed ROS messages carry no type descriptions')


def test_channels_carry_what_jazzy_looks_for(bag: Path) -> None:
    with (bag / 'drive_0.mcap').open('rb') as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        for channel in summary.channels.values():
            (qos,) = yaml.safe_load(channel.metadata['offered_qos_profiles'])
            assert qos['depth'] in (1, 10)
            assert channel.metadata['topic_type_hash'].startswith('RIHS01_')
        (metadata,) = reader.iter_metadata()
        assert metadata.name == 'rosbag2'
        inside = yaml.safe_load(metadata.metadata['serialized_metadata'])
        outside = yaml.safe_load((bag / 'metadata.yaml').read_text())
        assert inside == outside['rosbag2_bagfile_information']


def test_a_single_file_stands_alone(tmp_path: Path, written: list[Record]) -> None:
    path = tmp_path / 'one.mcap'
    with BagWriter(path) as bag:
        for message in encode(written[0]):
            bag.write(message)
    assert [p.name for p in tmp_path.iterdir()] == ['one.mcap']
    with AnyReader([path]) as reader:
        assert reader.message_count == 1


def interrupt() -> None:
    raise KeyboardInterrupt


def fill(path: Path, record: Record, number: int, meddle: Callable[[BagWriter], None]) -> None:
    with BagWriter(path) as bag:
        meddle(bag)
        for _ in range(number):
            for message in encode(record):
                bag.write(message)
        assert not path.exists()
        meddle(bag)


def test_nothing_is_visible_before_the_end_and_nothing_stays_after_an_error(
    tmp_path: Path, written: list[Record]
) -> None:
    calls = iter([lambda: None, interrupt])
    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path / 'drive', written[0], 5, lambda _: next(calls)())
    assert list(tmp_path.iterdir()) == []


def test_a_bag_is_not_overwritten_unless_asked(tmp_path: Path, written: list[Record]) -> None:
    path = tmp_path / 'drive'
    for overwrite, record in ((False, written[0]), (True, written[1])):
        with BagWriter(path, overwrite=overwrite) as bag:
            for message in encode(record):
                bag.write(message)
    with pytest.raises(DataError, match='exists; choose another name or give --overwrite'):
        BagWriter(path)
    with AnyReader([path]) as reader:
        assert [c.topic for c in reader.connections] == ['/twist']
    assert [p.name for p in tmp_path.iterdir()] == ['drive']


def test_what_is_no_bag_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'file').touch()
    for name in ('folder', 'file'):
        with pytest.raises(DataError, match='no bag'):
            BagWriter(tmp_path / name, overwrite=True)
    with pytest.raises(DataError, match='does not exist'):
        BagWriter(tmp_path / 'absent' / 'drive')


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path, written: list[Record]) -> None:
    with (
        Path('/dev/full').open('wb', buffering=0) as full,
        pytest.raises(DataError, match='No space left on device'),
    ):
        fill(
            tmp_path / 'drive',
            written[5],
            300,
            lambda bag: setattr(bag._writer, '_Writer__stream', full),
        )
    assert list(tmp_path.iterdir()) == []


def test_camera_info_comes_only_before_images_of_its_camera(written: list[Record]) -> None:
    image = written[4]
    assert isinstance(image, CameraImage)
    assert [m.topic for m in encode(image, CAMERA)] == ['/camera/camera_info', '/camera/image']
    other = CameraImage(image.stamp_ns, image.pixels, 'rear')
    assert [m.topic for m in encode(other, CAMERA)] == ['/camera/image']
    assert camera_info(CAMERA, START).stamp_ns == START


def test_data_survive_bit_rot_checks(bag: Path) -> None:
    """Each chunk carries the checksum of its content."""
    with (bag / 'drive_0.mcap').open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    data = (bag / 'drive_0.mcap').read_bytes()
    import zstandard

    for chunk in summary.chunk_indexes:
        at = chunk.chunk_start_offset + 9 + 16
        size, crc, name = struct.unpack_from('<QII', data, at)
        body = at + 16 + name
        (length,) = struct.unpack_from('<Q', data, body)
        raw = zstandard.decompress(data[body + 8 : body + 8 + length], max_output_size=size)
        assert zlib.crc32(raw) == crc
