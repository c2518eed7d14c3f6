"""What is played: a bag's bytes, or the messages of any other drive."""

from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from bags.bag_messages import TYPES, BagBytes, encode
from bags.convert import convert
from bags.drives import open_drive
from bags.mcap_writer import BagWriter
from bags.play_source import BagFileSource, DriveSource, shifted, source_of
from bags.street import LidarConfig, Route, StreetConfig, StreetDrive
from lcd_common.errors import DataError

SECOND = 1_000_000_000


@pytest.fixture(scope='module')
def drive() -> StreetDrive:
    route = Route().through([(0, 0), (40, 0)])
    return StreetDrive(route, StreetConfig(imu_rate=20.0), LidarConfig(columns=16))


@pytest.fixture(scope='module')
def bag(drive: StreetDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('bags') / 'street'
    convert(drive, path)
    return path


def key(message: BagBytes) -> tuple[str, int, bytes]:
    return message.topic, message.stamp_ns, message.data


def test_a_bag_gives_its_own_bytes(bag: Path) -> None:
    source = source_of(open_drive(bag))
    assert isinstance(source, BagFileSource)
    with AnyReader([bag]) as reader:
        expected = [
            (c.topic, t, bytes(d)) for c, t, d in reader.messages() if c.topic != '/tf_static'
        ]
        assert (source.first_ns, source.last_ns) == (expected[0][1], expected[-1][1])
    assert [key(m) for m in source.messages(source.first_ns, None)] == expected
    middle = source.first_ns + SECOND
    part = [key(m) for m in source.messages(middle, middle + SECOND)]
    assert part == [e for e in expected if middle <= e[1] <= middle + SECOND]


def test_a_drive_and_its_bag_play_the_same(drive: StreetDrive, bag: Path) -> None:
    direct, stored = source_of(drive), source_of(open_drive(bag))
    assert isinstance(direct, DriveSource)
    assert sorted(t.name for t in direct.topics) == sorted(t.name for t in stored.topics)
    assert direct.static is not None and stored.static is not None
    assert direct.static.data == stored.static.data
    assert sorted(map(key, direct.messages(direct.first_ns, None))) == sorted(
        map(key, stored.messages(stored.first_ns, None))
    )


@pytest.mark.parametrize('from_bag', [True, False])
def test_chosen_topics_alone_are_played(drive: StreetDrive, bag: Path, from_bag: bool) -> None:
    source = source_of(open_drive(bag) if from_bag else drive, ['/imu'])
    assert [t.name for t in source.topics] == ['/imu']
    assert {m.topic for m in source.messages(source.first_ns, None)} == {'/imu'}
    with pytest.raises(DataError, match='no topic /nothing; it has'):
        source_of(open_drive(bag) if from_bag else drive, ['/nothing'])


def test_other_topics_of_a_bag_pass_as_they_are(tmp_path: Path, drive: StreetDrive) -> None:
    from rosbags.typesys.stores.ros2_jazzy import std_msgs__msg__String as String

    extra = BagBytes(
        '/notes',
        'std_msgs/msg/String',
        drive.streams()[0].first_ns or 0,
        bytes(TYPES.serialize_cdr(String(data='hello'), 'std_msgs/msg/String')),
    )
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write(extra)
        for message in encode(drive.scan(0)):
            bag.write(message)
    source = source_of(open_drive(tmp_path / 'bag'))
    assert key(extra) in [key(m) for m in source.messages(source.first_ns, None)]


def test_a_bag_that_is_cut_off_is_played_as_far_as_it_goes(tmp_path: Path, bag: Path) -> None:
    whole = (bag / 'street_0.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[: int(0.7 * len(whole))])
    drive = open_drive(tmp_path / 'cut.mcap')
    source = source_of(drive)
    played = list(source.messages(source.first_ns, None))
    with AnyReader([bag]) as reader:
        assert 10 < len(played) < reader.message_count
    assert drive.skipped


def test_a_damaged_chunk_costs_only_itself(tmp_path: Path, drive: StreetDrive) -> None:
    path = tmp_path / 'drive'
    long = StreetDrive(drive.route, StreetConfig(imu_rate=20.0), LidarConfig(columns=720))
    convert(long, path)
    file = path / 'drive_0.mcap'
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    file.write_bytes(data)
    damaged = open_drive(path)
    source = source_of(damaged)
    stamps = [m.stamp_ns for m in source.messages(source.first_ns, None) if m.topic == '/points']
    whole = [r.stamp_ns for r in long.records() if type(r).__name__ == 'LidarScan']
    assert stamps[0] == whole[0] and stamps == sorted(set(stamps))
    assert len(stamps) >= 3


def test_shifting_moves_header_and_log_time(drive: StreetDrive) -> None:
    from bags.bag_messages import static_transforms

    for message in [*encode(drive.scan(3)), static_transforms(drive.mountings, 5 * SECOND)]:
        moved = shifted(message, 3 * SECOND + 999_999_999)
        before = TYPES.deserialize_cdr(message.data, message.type_name)
        after = TYPES.deserialize_cdr(moved.data, moved.type_name)
        pairs = (
            [(before.header, after.header)]
            if hasattr(before, 'header')
            else [
                (a.header, b.header)
                for a, b in zip(before.transforms, after.transforms, strict=True)
            ]
        )
        for old, new in pairs:
            shift = (new.stamp.sec - old.stamp.sec) * SECOND + new.stamp.nanosec - old.stamp.nanosec
            assert shift == 3 * SECOND + 999_999_999
            assert 0 <= new.stamp.nanosec < SECOND and new.frame_id == old.frame_id
        assert moved.stamp_ns - message.stamp_ns == 3 * SECOND + 999_999_999
        assert moved.data[12:] == message.data[12:] or message.type_name.startswith('tf2')
    assert shifted(message, 0) is message


def test_an_empty_bag_is_an_error(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'empty'):
        pass
    with pytest.raises(DataError):
        source_of(open_drive(tmp_path / 'empty'))
