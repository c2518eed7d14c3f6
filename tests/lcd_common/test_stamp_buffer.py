"""Pairing against a brute-force search, and the covariance against GTSAM's and the known sum."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.stamp_buffer import StampBuffer, StampedPose, Unpaired


def _screw(stamp_ns: int) -> np.ndarray:
    """Drive on one screw motion, so that interpolation is exact."""
    return se3.exp(np.array([3.0, 0.5, 0.1, 0.01, -0.02, 0.3]) * stamp_ns * 1e-9)


def _pose(stamp_ns: int, covariance: np.ndarray | None = None) -> StampedPose:
    return StampedPose(stamp_ns, _screw(stamp_ns), covariance)


def test_an_exact_stamp_gives_the_pose_itself() -> None:
    buffer: StampBuffer[str] = StampBuffer(10, 10**9)
    assert buffer.add_item(100, 'scan') == []
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])
    (paired,) = buffer.add_pose(_pose(100, covariance))
    assert paired.item == 'scan'
    assert paired.pose.covariance is covariance
    assert len(buffer) == 0


def test_interpolates_between_two_poses() -> None:
    buffer: StampBuffer[str] = StampBuffer(10, 200_000_000)
    buffer.add_pose(_pose(100_000_000))
    assert buffer.add_item(130_000_000, 'scan') == []
    (paired,) = buffer.add_pose(_pose(200_000_000))
    np.testing.assert_allclose(paired.pose.T_odom_base, _screw(130_000_000), atol=1e-12)
    assert paired.pose.stamp_ns == 130_000_000
    assert paired.pose.covariance is None


def test_a_gap_and_an_item_from_before_the_odometry_are_given_up_and_told_apart() -> None:
    buffer: StampBuffer[str] = StampBuffer(10, 200)
    buffer.add_pose(_pose(1000))
    buffer.add_item(500, 'early')
    buffer.add_item(1100, 'in the gap')
    assert buffer.add_pose(_pose(1500)) == []
    assert buffer.unpaired == [('early', Unpaired.TOO_OLD), ('in the gap', Unpaired.GAP)]


def test_without_odometry_memory_is_bounded_and_the_newest_stay() -> None:
    buffer: StampBuffer[int] = StampBuffer(3, 200)
    for stamp in range(100):
        buffer.add_item(stamp, stamp)
        assert len(buffer) <= 3
    assert [item for item, _ in buffer.unpaired] == list(range(97))
    assert {why for _, why in buffer.unpaired} == {Unpaired.BUFFER_FULL}
    paired = [p.item for stamp in (97, 98, 99) for p in buffer.add_pose(_pose(stamp))]
    assert paired == [97, 98, 99]


def test_poses_are_forgotten_beyond_the_history() -> None:
    buffer: StampBuffer[str] = StampBuffer(3, 10**9, history=5)
    for stamp in range(100):
        buffer.add_pose(_pose(stamp))
    assert buffer.add_item(10, 'late') == []
    assert buffer.unpaired == [('late', Unpaired.TOO_OLD)]
    assert buffer.add_item(97, 'in time')[0].pose.stamp_ns == 97


def test_clear_forgets_both_streams() -> None:
    buffer: StampBuffer[str] = StampBuffer(3, 10**9)
    buffer.add_pose(_pose(1000))
    buffer.add_item(2000, 'scan')
    buffer.clear()
    assert buffer.add_pose(_pose(10)) == []
    assert buffer.add_item(10, 'after')[0].item == 'after'
    assert buffer.unpaired == []


@pytest.mark.parametrize('pose_first', [True, False])
def test_whichever_stream_jumps_back_first_nothing_of_the_new_time_is_lost(
    pose_first: bool,
) -> None:
    second = 10**9
    buffer: StampBuffer[str] = StampBuffer(10, second)
    for stamp in range(50, 60):
        buffer.add_pose(_pose(stamp * second))
    buffer.add_item(61 * second, 'before the jump')
    buffer.rewind(0)
    if pose_first:
        assert buffer.add_pose(_pose(0)) == []
        buffer.rewind(0)
        paired = buffer.add_item(0, 'after')
    else:
        assert buffer.add_item(0, 'after') == []
        buffer.rewind(0)
        paired = buffer.add_pose(_pose(0))
    assert [p.item for p in paired] == ['after']
    assert len(buffer) == 0 and buffer.unpaired == []


@pytest.mark.parametrize('seed', range(5))
def test_any_interleaving_pairs_what_a_search_over_all_poses_pairs(seed: int) -> None:
    random = np.random.default_rng(seed)
    pose_stamps = np.unique(random.integers(0, 5000, 60)).tolist()
    item_stamps = np.unique(random.integers(0, 5000, 60)).tolist()
    limit = 120
    expected = []
    for item in item_stamps:
        if item in pose_stamps:
            expected.append(item)
            continue
        before = [p for p in pose_stamps if p < item]
        after = [p for p in pose_stamps if p > item]
        if before and after and after[0] - before[-1] <= limit:
            expected.append(item)
    buffer: StampBuffer[int] = StampBuffer(1000, limit)
    events = ['pose'] * len(pose_stamps) + ['item'] * len(item_stamps)
    random.shuffle(events)
    poses, items, got = iter(pose_stamps), iter(item_stamps), []
    for event in events:
        if event == 'pose':
            got += buffer.add_pose(_pose(next(poses)))
        else:
            stamp = next(items)
            got += buffer.add_item(stamp, stamp)
    assert [p.item for p in got] == expected
    assert all(p.item == p.pose.stamp_ns for p in got)


def test_relative_covariance_undoes_composition_and_refuses_constants() -> None:
    random = np.random.default_rng(3)
    root = random.normal(size=(6, 6))
    before, added = root @ root.T, np.diag(random.uniform(1e-8, 1e-4, 6))
    T = se3.exp(random.normal(size=6))
    after = se3.compose_covariance(before, T, added)
    found = se3.relative_covariance(before, T, after)
    assert found is not None
    np.testing.assert_allclose(found, added, atol=1e-13 * before.max() * 100)
    constant = np.diag([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])
    assert se3.relative_covariance(constant, T, constant) is None
    assert se3.relative_covariance(np.zeros((6, 6)), T, np.zeros((6, 6))) is None


def test_the_covariance_grows_evenly_between_two_poses() -> None:
    step = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])
    first = np.diag([0.1, 0.2, 0.1, 0.01, 0.02, 0.01])
    T_0_1 = se3.inverse(_screw(0)) @ _screw(100)
    last = se3.compose_covariance(first, T_0_1, step)
    buffer: StampBuffer[str] = StampBuffer(3, 10**9)
    buffer.add_pose(_pose(0, first))
    buffer.add_item(25, 'scan')
    (paired,) = buffer.add_pose(_pose(100, last))
    covariance = paired.pose.covariance
    assert covariance is not None
    T_0_s = se3.inverse(_screw(0)) @ _screw(25)
    grown = se3.relative_covariance(first, T_0_s, covariance)
    assert grown is not None
    np.testing.assert_allclose(grown, 0.25 * step, atol=1e-12)
