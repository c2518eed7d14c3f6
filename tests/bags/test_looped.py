"""A looped drive is the same drive again and again, its stamps shifted."""

import numpy as np
import pytest

from bags.looped import LoopedDrive
from bags.records import ImuSample, LidarScan, TruthPose
from bags.street import LidarConfig, Route, StreetConfig, StreetDrive

SECOND = 1_000_000_000


@pytest.fixture(scope='module')
def drive() -> StreetDrive:
    route = Route().through([(0, 0), (12, 0)])
    return StreetDrive(route, StreetConfig(imu_rate=20.0), LidarConfig(columns=16))


def test_rounds_repeat_with_increasing_stamps(drive: StreetDrive) -> None:
    once, looped = list(drive.records()), LoopedDrive(drive, 3)
    records = list(looped.records())
    stamps = [r.stamp_ns for r in records]
    assert len(records) == 3 * len(once) and stamps == sorted(stamps)
    for turn in range(3):
        part = records[turn * len(once) : (turn + 1) * len(once)]
        assert {b.stamp_ns - a.stamp_ns for a, b in zip(once, part, strict=True)} == {
            turn * looped.period_ns
        }
    scans = [r for r in records if isinstance(r, LidarScan)]
    np.testing.assert_array_equal(scans[0].cloud.xyz, scans[len(scans) // 3].cloud.xyz)


def test_streams_and_truth_cover_all_rounds(drive: StreetDrive) -> None:
    looped = LoopedDrive(drive, 2)
    records = list(looped.records())
    for stream in looped.streams():
        kind = {'/imu': ImuSample, '/ground_truth/pose': TruthPose}.get(stream.topic)
        if kind is not None:
            stamps = [r.stamp_ns for r in records if isinstance(r, kind)]
            assert (stream.count, stream.last_ns) == (len(stamps), stamps[-1])
    truth = looped.truth()
    assert truth is not None
    poses = [r for r in records if isinstance(r, TruthPose)]
    assert truth.stamps_ns.tolist() == [p.stamp_ns for p in poses]
    np.testing.assert_allclose(truth.T_world_body, [p.T_world_base for p in poses], atol=1e-9)


def test_a_span_across_the_seam(drive: StreetDrive) -> None:
    looped = LoopedDrive(drive, 3)
    everything = [r.stamp_ns for r in looped.records()]
    begin, end = everything[len(everything) // 2], everything[-5]
    expected = [s for s in everything if begin <= s <= end]
    assert [r.stamp_ns for r in looped.records(begin, end)] == expected
