"""place_recognition that follows keyframes: their numbers, their graph, other maps."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticStatus
from place_feed import Fed, fed_by

from lcd_common import se3
from lcd_loop_closure.nodes.positions_message import positions_message

pytestmark = pytest.mark.ros


@pytest.fixture
def fed(make: Callable[..., Any], small_weights: Path) -> Callable[..., Fed]:
    """Make a fed node with small weights."""
    return fed_by(make, small_weights)


def test_keyframes_give_places_their_numbers_and_the_graph_their_poses(
    fed: Callable[..., Fed],
) -> None:
    made = fed(follow='keyframes')
    for step in range(6):
        made.lockstep.feed('/points', drive.scan(step))
        made.lockstep.feed('/odom', drive.odom_message(step))
        if step != 3:  # keyframes alone become places
            made.lockstep.feed('/keyframe', drive.keyframe(step, first_id=10))
    assert [p.id for p in made.node.recognizer.places()] == [10, 11, 12, 14, 15]
    assert len(made.answers) == 5
    moved = np.array([se3.rotation_z(0.3) @ drive.true_pose(s) for s in range(6)])
    moved[:, :3, 3] += [5.0, -2.0, 0.0]
    made.lockstep.feed('/graph/keyframes', positions_message(np.arange(10, 16), moved, 1, 'map'))
    for step in (0, 1, 2, 4, 5):
        np.testing.assert_allclose(
            made.node.recognizer.place(10 + step).T_map_base, moved[step], atol=1e-4
        )
    made.lockstep.feed('/graph/keyframes', drive.scan(0))
    assert made.counted('rejected graph/keyframes: broken') == 1
    # loop_closure starts again
    made.lockstep.feed('/points', drive.scan(7))
    made.lockstep.feed('/keyframe', _numbered(drive.keyframe(7), 0))
    assert [p.id for p in made.node.recognizer.places()] == [0]


def test_keyframes_of_another_map_neither_answer_nor_move_places(
    fed: Callable[..., Fed], tmp_path: Path
) -> None:
    made = fed(follow='keyframes')
    for step in range(4):
        made.lockstep.feed('/points', drive.scan(step))
        made.lockstep.feed('/keyframe', drive.keyframe(step))
    assert made.save(tmp_path / 'map').success
    later = fed(follow='keyframes', map=str(tmp_path / 'map'))
    before = [place.T_map_base for place in later.node.recognizer.places()]
    elsewhere = np.array([se3.rotation_z(2.0) @ drive.true_pose(s) for s in range(4)])
    moved = positions_message(np.arange(4), elsewhere, 1, 'map')
    later.lockstep.feed('/graph/keyframes', moved)
    later.lockstep.feed('/points', drive.scan(10))
    later.lockstep.feed('/keyframe', _numbered(drive.keyframe(10), 0))
    later.lockstep.feed('/graph/keyframes', moved)
    assert later.answers == []
    assert later.counted('rejected keyframe: other session') == 1
    assert 'load the map of the same drive' in later.node.diagnostics.status().message
    for place, T_map_base in zip(later.node.recognizer.places(), before, strict=True):
        np.testing.assert_array_equal(place.T_map_base, T_map_base)
    later.lockstep.feed('/points', drive.scan(12))
    later.lockstep.feed('/keyframe', _numbered(drive.keyframe(12), 4))
    assert len(later.answers) == 1
    assert later.node.diagnostics.status().level == DiagnosticStatus.WARN


def _numbered(message: Any, id: int) -> Any:
    message.id = id
    return message


def test_a_keyframe_whose_cloud_never_came_is_counted(fed: Callable[..., Fed]) -> None:
    made = fed(follow='keyframes')
    for step in range(25):
        made.lockstep.feed('/keyframe', drive.keyframe(step))
    assert made.counted('rejected keyframe: its cloud did not come') == 5
    made.lockstep.feed('/points', drive.scan(24))  # late, but it comes
    assert len(made.answers) == 1
