"""Compare the written bytes with what rclpy writes and reads."""

import numpy as np
import pytest

pytest.importorskip('rclpy')
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message

from lcd_common import se3
from lcd_common.nodes.messages import header, pose_message
from lcd_loop_closure.nodes.path_message import PathWriter, quaternions

pytestmark = pytest.mark.ros


def _poses(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    T = np.array([se3.exp(random.normal(size=6) * [50, 50, 5, 2, 2, 2]) for _ in range(count)])
    stamps = 1_700_000_000_123_456_789 + np.arange(count, dtype=np.int64) * 99_999_999
    return T.reshape(-1, 4, 4), stamps


def _message(T: np.ndarray, stamps: np.ndarray, stamp_ns: int, frame_id: str) -> Path:
    return Path(
        header=header(stamp_ns, frame_id),
        poses=[
            PoseStamped(header=header(int(s), frame_id), pose=pose_message(t))
            for t, s in zip(T, stamps, strict=True)
        ],
    )


def _padding(count: int, name_length: int) -> list[int]:
    """Find the bytes that CDR leaves undefined, by walking through the message field by field."""
    at, gaps = 0, []

    def put(size: int, alignment: int) -> None:
        nonlocal at
        gap = -at % alignment
        gaps.extend(range(at, at + gap))
        at += gap + size

    def put_header() -> None:
        for size in (4, 4, 4):
            put(size, 4)
        put(name_length + 1, 1)

    put_header()
    put(4, 4)
    for _ in range(count):
        put(0, 4)
        put_header()
        for _ in range(7):
            put(8, 8)
    return [4 + gap for gap in gaps]


@pytest.mark.parametrize('count', [0, 1, 2, 7])
@pytest.mark.parametrize('length', range(10))
def test_bytes_are_those_of_rclpy(count: int, length: int) -> None:
    T, stamps = _poses(count)
    frame_id = 'some_frame'[:length]
    ours = bytearray(PathWriter(frame_id).write(T, stamps, 5_000_000_007))
    message = _message(T, stamps, 5_000_000_007, frame_id)
    theirs = bytearray(serialize_message(message))
    assert len(ours) == len(theirs)
    for gap in _padding(count, length):  # rclpy leaves what was in memory there
        ours[gap] = theirs[gap] = 0
    # Quaternions differ in the last bit at most: compare them as numbers, the rest as bytes.
    read = deserialize_message(bytes(ours), Path)
    for mine, rclpys in zip(read.poses, message.poses, strict=True):
        q, p = mine.pose.orientation, rclpys.pose.orientation
        np.testing.assert_allclose([q.x, q.y, q.z, q.w], [p.x, p.y, p.z, p.w], atol=1e-15)
    message = _message(T, stamps, 5_000_000_007, frame_id)
    for pose, mine in zip(message.poses, read.poses, strict=True):
        pose.pose.orientation = mine.pose.orientation
    theirs = bytearray(serialize_message(message))
    for gap in _padding(count, length):
        theirs[gap] = 0
    assert ours == theirs
    assert read == message


def test_a_path_written_again_is_the_one_written_anew() -> None:
    random = np.random.default_rng(3)
    T, stamps = _poses(40)
    T = T.copy()
    writer = PathWriter('map')
    for count in (0, 1, 5, 5, 6, 40, 12, 0, 13):
        moved = random.integers(0, len(T), 3)
        T = T.copy()
        T[moved] = _poses(3, seed=count)[0]
        if count == 12:  # another map, whose poses may be where the last one's were
            stamps = stamps + 7
        expected = PathWriter('map').write(T[:count], stamps[:count], count)
        assert writer.write(T[:count], stamps[:count], count) == expected


def test_ten_thousand_poses_survive() -> None:
    T, stamps = _poses(10_000)
    read = deserialize_message(PathWriter('map').write(T, stamps, 1), Path)
    assert len(read.poses) == 10_000
    last = read.poses[-1]
    assert last.header.stamp.sec * 10**9 + last.header.stamp.nanosec == stamps[-1]
    position = last.pose.position
    np.testing.assert_array_equal([position.x, position.y, position.z], T[-1, :3, 3])


def test_quaternions_match_the_single_one_also_at_half_turns() -> None:
    T, _ = _poses(500, seed=2)
    half_turns = [se3.so3_exp(np.pi * np.eye(3)[axis]) for axis in range(3)]
    R = np.concatenate([T[:, :3, :3], np.array(half_turns), np.eye(3)[None]])
    for ours, rotation in zip(quaternions(R), R, strict=True):
        single = se3.quaternion_from_rotation(rotation)
        assert min(np.abs(ours - single).max(), np.abs(ours + single).max()) < 1e-12
