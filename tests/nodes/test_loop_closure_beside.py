"""Let loop_closure search in a process beside, and read when it publishes what."""

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from std_srvs.srv import Trigger

from bags.nodes.lockstep import LockStep
from lcd_common.errors import ConfigError
from lcd_loop_closure.compact_cloud import compact
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.map_store import SavedMap, save_map
from lcd_loop_closure.nodes.conversions import keyframe_from_message, loop_from_message
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.offline_slam import OfflineSlam, own_context
from lcd_loop_closure.nodes.positions_message import positions_message
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.search_process import SearchProcess, SearchProcessError
from lcd_msgs.srv import LoadMap

pytestmark = pytest.mark.ros
Make = Callable[..., Any]


@pytest.fixture
def make(make: Make) -> Make:
    """Make nodes that search beside; Scan Context, as LCDNet would be loaded for each."""
    return partial(
        make,
        LoopClosureNode,
        threaded=False,
        beside=True,
        keyframes__distance=2.0,
        detector__delay=10.0,
        descriptor__method='scan_context',
    )


class Fed:
    """A node in lock-step, and all that it published, in order, as bytes too."""

    def __init__(self, node: LoopClosureNode) -> None:
        self.node = node
        self.lockstep = LockStep([node])
        self.said: list[tuple[str, int]] = []
        self.keyframes: list[Any] = []
        self.loops: list[Any] = []
        self.bytes: list[bytes] = []
        self.lockstep.listen('/keyframe', self._on_keyframe)
        self.lockstep.listen('/loop_constraint', self._on_loop)
        for topic in ('/keyframe', '/loop_constraint'):
            self.lockstep.listen(topic, self.bytes.append, raw=True)
        self.lockstep.feed('/tf_static', drive.static_transform())

    def _on_keyframe(self, message: Any) -> None:
        self.keyframes.append(keyframe_from_message(message))
        self.said.append(('keyframe', message.id))

    def _on_loop(self, message: Any) -> None:
        self.loops.append(loop_from_message(message))
        self.said.append(('loop', message.query_id))

    def step(self, step: int, place: int | None = None) -> None:
        """Feed a step's scan (what is seen at `place`), then its odometry."""
        seen = drive.scan(step if place is None else place, stamp_ns=drive.stamp(step))
        self.lockstep.feed('/points', seen)
        self.lockstep.feed('/odom', drive.odom_message(step))

    def twice_around(self) -> None:
        """Drive a circle, which is seen again on the second round."""
        around = 126  # steps; not a whole number fits, three centimetres are left
        for step in [*range(0, around, 3), *range(around, around + 24, 3)]:
            self.step(step, step % around)

    def process(self) -> SearchProcess:
        """Return the process beside."""
        assert self.node._beside is not None
        return self.node._beside

    def ids(self) -> list[int]:
        """Return the ids of the keyframes that came out."""
        return [keyframe.id for keyframe in self.keyframes]


def test_what_was_found_comes_with_the_next_keyframe_and_the_last_with_the_end(make: Make) -> None:
    fed = Fed(make())
    for step in range(6):
        fed.step(step)  # keyframes at 0 and 3
        assert fed.ids() == ([0] if step >= 3 else [])
    fed.lockstep.flush()
    assert fed.ids() == [0, 1]
    fed.lockstep.flush()
    assert fed.ids() == [0, 1]
    stamps = [keyframe.stamp_ns for keyframe in fed.keyframes]
    assert stamps == [drive.stamp(0), drive.stamp(3)]


def test_it_finds_what_is_found_inside_and_repeats_to_the_last_byte(make: Make) -> None:
    found = [Fed(make()), Fed(make()), Fed(make(beside=False))]
    for fed in found:
        fed.twice_around()
        fed.lockstep.flush()
    first, second, inside = found
    assert first.bytes == second.bytes
    # Without a pose graph nobody's knowledge depends on the delay: all messages are the same.
    assert first.bytes == inside.bytes and first.said == inside.said
    assert sum(loop.status is LoopStatus.ACCEPTED for loop in first.loops) >= 5
    order = [query for _, query in first.said]
    assert order == sorted(order)  # a keyframe, then its loops
    counts = inside.node.diagnostics.counts()
    assert first.node.diagnostics.counts() == counts
    assert (
        dict(_values(first))['keyframes remembered']
        == dict(_values(inside))['keyframes remembered']
    )


def _values(fed: Fed) -> list[tuple[str, str]]:
    return [(value.key, value.value) for value in fed.node.diagnostics.status().values]


def test_times_of_the_process_are_told_here(make: Make) -> None:
    fed = Fed(make())
    times: dict[str, list[float]] = {}
    fed.node.diagnostics.on_time = lambda stage, seconds: times.setdefault(stage, []).append(
        seconds
    )
    for step in range(0, 12, 3):
        fed.step(step)
    fed.lockstep.flush()
    assert {stage: len(seconds) for stage, seconds in times.items()} == dict.fromkeys(
        ('reduce', 'describe', 'retrieve', 'search', 'wait'), 4
    )


def test_positions_of_the_graph_are_those_known_when_the_scan_was_taken(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed = Fed(make())
    handed: list[Any] = []
    process = fed.process()
    hand_over = process.hand_over

    def note(session: Any, sweep: Any) -> None:
        handed.append(sweep)
        hand_over(session, sweep)

    monkeypatch.setattr(process, 'hand_over', note)
    fed.step(0)
    poses = np.array([drive.true_pose(k) for k in range(4)])
    fed.lockstep.feed('/graph/keyframes', positions_message(np.arange(4), poses, 1, 'map'))
    fed.step(3)
    assert handed[0].graph is None
    np.testing.assert_array_equal(handed[1].graph.ids, np.arange(4))
    np.testing.assert_array_equal(handed[1].sensor_origin, drive.T_BASE_LIDAR[:3, 3])


def test_a_vehicle_that_stands_does_not_hold_its_last_keyframe_back(make: Make) -> None:
    fed = Fed(make())
    fed.step(0)
    for step in range(1, 14):
        standing = drive.odom_message(0)
        standing.header.stamp = drive.odom_message(step).header.stamp
        fed.lockstep.feed('/odom', standing)
        assert fed.ids() == ([0] if step > 10 else [])  # a second after its scan


def test_a_session_that_ends_takes_its_last_keyframe_along(make: Make, tmp_path: Path) -> None:
    fed = Fed(make())
    for step in range(0, 9, 3):
        fed.step(step)
    assert fed.ids() == [0, 1]
    assert fed.node.on_reset(Trigger.Request(), Trigger.Response()).success
    fed.step(30)
    fed.step(33)
    assert fed.ids() == [0, 1, 0]  # not 2, which belongs to what was forgotten
    fed.step(3)  # the clock jumps back: here ends the session with the scan of step 33
    fed.step(6)
    assert fed.ids() == [0, 1, 0, 0]
    assert fed.keyframes[-1].stamp_ns == drive.stamp(3)
    request = LoadMap.Request(path=str(save_map(_map_of_seven(), tmp_path / 'map')))
    assert fed.node.on_load_map(request, LoadMap.Response()).success
    fed.step(9)
    fed.lockstep.flush()
    assert fed.ids() == [0, 1, 0, 0, 7]
    assert fed.node.diagnostics.counted('dropped keyframes: their session ended') == 3
    assert {loop.query_id for loop in fed.loops} <= {7}  # with the loaded map alone


def _map_of_seven() -> SavedMap:
    made = [keyframe_from_message(drive.keyframe(step)) for step in range(7)]
    graph = PoseGraph()
    for keyframe in made:
        graph.add_keyframe(keyframe)
    return SavedMap(graph.snapshot(), tuple(compact(k.cloud) for k in made), (None,) * 7)


def test_bad_scans_are_counted_and_survived(make: Make) -> None:
    fed = Fed(make())
    empty = drive.scan(0)
    empty.width, empty.row_step, empty.data = 0, 0, empty.data[:0]
    fed.lockstep.feed('/points', empty)
    fed.lockstep.feed('/odom', drive.odom_message(0))
    nameless = drive.scan(3)
    nameless.fields[0].name = 'range'
    fed.lockstep.feed('/points', nameless)
    fed.lockstep.feed('/odom', drive.odom_message(3))
    fed.step(6)
    fed.lockstep.flush()
    assert fed.ids() == [0]
    assert fed.node.diagnostics.counted('rejected points: empty') == 1
    assert fed.node.diagnostics.counted('rejected points: broken') == 1


def test_a_killed_process_ends_the_replay_with_a_word(make: Make) -> None:
    fed = Fed(make())
    fed.step(0)
    child = fed.process()._child
    assert child is not None
    os.kill(child.pid, signal.SIGKILL)
    child.wait()

    def drive_on() -> None:
        for step in (3, 6):  # the first takes the answer, if it came before the end
            fed.step(step)

    with pytest.raises(SearchProcessError, match='drive again'):
        drive_on()


def test_the_process_ends_with_the_node(ros: None) -> None:
    from lcd_common.nodes.parameters import overrides

    node = LoopClosureNode(
        parameter_overrides=overrides(
            threaded=False, beside=True, descriptor__method='scan_context'
        )
    )
    child = node._beside._child if node._beside else None
    assert child is not None and child.poll() is None
    node.destroy_node()
    assert child.returncode is not None


@pytest.mark.parametrize('wrong', [{'threaded': True}, {'gate__use': True}])
def test_beside_is_for_lock_step_without_the_gate(make: Make, wrong: dict[str, bool]) -> None:
    with pytest.raises(ConfigError, match=r'needs threaded false and gate\.use false'):
        make(**wrong)


@pytest.mark.parametrize(('threads', 'beside'), [(1, False), (0, True), (2, True)])
def test_an_offline_drive_searches_beside_unless_it_has_one_thread(
    threads: int, beside: bool
) -> None:
    with own_context() as context:
        slam = OfflineSlam(context, [], threads, 'scan_context')
        try:
            assert slam.loop_closure.config.beside is beside
        finally:
            for node in slam.nodes:
                node.destroy_node()
