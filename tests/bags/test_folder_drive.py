"""Merging the streams of a drive, against a brute-force sort."""

import numpy as np
import pytest

from bags.folder_drive import FolderDrive
from bags.records import GnssFix, ImuSample, LidarScan
from bags.sensor_stream import make_stream
from bags.skips import Skips, UnreadableError
from lcd_common.cloud import PointCloud
from lcd_common.trajectory import Trajectory


def imu(entry: int, stamp_ns: int) -> ImuSample:
    return ImuSample(stamp_ns, np.full(3, entry), np.zeros(3))


def fix(entry: int, stamp_ns: int) -> GnssFix:
    return GnssFix(stamp_ns, 49.0, 8.0, float(entry))


def scan(entry: int, stamp_ns: int) -> LidarScan:
    if entry % 7 == 3:
        raise UnreadableError('broken', f'scan {entry} is broken')
    return LidarScan(stamp_ns, PointCloud(np.full((2, 3), entry, np.float32)))


@pytest.mark.parametrize('seed', range(5))
def test_records_are_the_sorted_union_of_the_streams(seed, tmp_path):
    rng = np.random.default_rng(seed)
    skips = Skips()
    readers = {ImuSample: imu, GnssFix: fix, LidarScan: scan}
    stamps = {kind: rng.integers(1, 60, 25) for kind in readers}  # out of order, with repetitions
    streams = [
        make_stream(kind, kind.__name__, stamps[kind], np.arange(25), read, skips)
        for kind, read in readers.items()
    ]
    drive = FolderDrive('random', tmp_path, streams, skips)
    low, high = 10, 50
    expected, broken = [], 0
    for place, kind in enumerate(readers):
        first: dict[int, int] = {}
        for entry, stamp in enumerate(stamps[kind].tolist()):
            first.setdefault(stamp, entry)
        for stamp, entry in first.items():
            if kind is LidarScan and entry % 7 == 3:
                broken += low <= stamp <= high
            elif low <= stamp <= high:
                expected.append((stamp, place))
    got = [(r.stamp_ns, list(readers).index(type(r))) for r in drive.records(low, high)]
    assert got == sorted(expected)
    repeated = sum(25 - len(set(values.tolist())) for values in stamps.values())
    assert drive.skipped['duplicate stamp'] == repeated
    assert drive.skipped['broken'] == broken


def test_reading_twice_gives_the_same_and_counts_once(tmp_path):
    skips = Skips()
    stream = make_stream(LidarScan, 'lidar', range(1, 21), np.arange(20), scan, skips)
    drive = FolderDrive('twice', tmp_path, [stream], skips)
    first = [r.stamp_ns for r in drive.records()]
    assert [r.stamp_ns for r in drive.records()] == first
    assert drive.skipped == {'broken': 3}


def test_nothing_is_read_before_its_turn(tmp_path):
    opened = []

    def read(entry: int, stamp_ns: int) -> ImuSample:
        opened.append(entry)
        return imu(entry, stamp_ns)

    skips = Skips()
    drive = FolderDrive(
        'lazy', tmp_path, [make_stream(ImuSample, 'imu', range(9), range(9), read, skips)], skips
    )
    records = drive.records()
    assert opened == []
    next(records)
    next(records)
    assert opened[-1] <= 2


def test_truth_is_both_a_trajectory_and_a_stream(tmp_path):
    truth = Trajectory(np.array([5, 9], np.int64), np.tile(np.eye(4), (2, 1, 1)))
    drive = FolderDrive('truth', tmp_path, [], Skips(), truth=truth)
    assert drive.truth() is truth
    assert [r.stamp_ns for r in drive.records()] == [5, 9]
    assert drive.streams()[0].topic == '/ground_truth/pose'


def test_empty_truth_is_none(tmp_path):
    empty = Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4)))
    drive = FolderDrive('empty', tmp_path, [], Skips(), truth=empty)
    assert drive.truth() is None and drive.streams() == []


def test_kinds_that_nobody_asks_for_are_not_read(tmp_path):
    skips = Skips()

    def unwanted(entry: int, stamp_ns: int) -> LidarScan:
        raise AssertionError('read')

    streams = [
        make_stream(ImuSample, 'imu', range(5), range(5), imu, skips),
        make_stream(LidarScan, 'lidar', range(5), range(5), unwanted, skips),
    ]
    drive = FolderDrive('kinds', tmp_path, streams, skips)
    assert len(list(drive.records(kinds=[ImuSample]))) == 5
