"""Playing over DDS: everything arrives, late subscribers get /tf_static, options are obeyed."""

import os
import pty
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage

from bags.convert import convert
from bags.drives import open_drive
from bags.nodes.play import Player, PlayReport
from bags.play import PlayOptions
from bags.play_source import PlayTopic, source_of
from bags.street import LidarConfig, Route, StreetConfig, StreetDrive
from lcd_common.errors import DataError
from lcd_common.nodes import messages, qos

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures('ros')]
FAST = PlayOptions(rate=20.0, wait_for=1)
SpinUntil = Callable[..., bool]


@pytest.fixture(scope='module')
def drive() -> StreetDrive:
    route = Route().through([(0, 0), (25, 0)])
    return StreetDrive(route, StreetConfig(imu_rate=20.0), LidarConfig(columns=16))


class Listener(Node):
    """Note the stamps of what arrives."""

    def __init__(self, namespace: str = '') -> None:
        super().__init__('listener', namespace=namespace)
        self.points: list[int] = []
        self.imu: list[int] = []
        self.clock: list[int] = []
        self.frames: list[str] = []
        deep = QoSProfile(depth=1000)
        self.create_subscription(PointCloud2, 'points', self.on_points, deep)
        self.create_subscription(
            Imu, 'imu', lambda m: self.imu.append(messages.stamp_ns(m.header.stamp)), deep
        )
        best_effort = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(
            Clock, '/clock', lambda m: self.clock.append(messages.stamp_ns(m.clock)), best_effort
        )

    def on_points(self, message: PointCloud2) -> None:
        self.points.append(messages.stamp_ns(message.header.stamp))

    def watch_static(self) -> None:
        self.create_subscription(TFMessage, '/tf_static', self.on_static, qos.TF_STATIC)

    def on_static(self, message: TFMessage) -> None:
        self.frames = [t.child_frame_id for t in message.transforms]


@pytest.fixture
def listener() -> Iterator[Listener]:
    node = Listener()
    yield node
    node.destroy_node()


@pytest.fixture
def play(
    listener: Listener, spin_until: SpinUntil
) -> Iterator[Callable[..., tuple[Player, PlayReport]]]:
    """Play a drive on a thread while the listener spins."""
    made: list[Node] = []

    def run(source: object, options: PlayOptions) -> tuple[Player, PlayReport]:
        node = Node('player', start_parameter_services=False)
        made.append(node)
        player = Player(node, source, options)  # type: ignore[arg-type]
        reports: list[PlayReport] = []
        thread = threading.Thread(target=lambda: reports.append(player.play()), daemon=True)
        thread.start()
        assert spin_until([listener], lambda: not thread.is_alive(), timeout_s=60.0)
        published = player.report.published
        expected = published['/points'], published['/imu']
        spin_until(
            [listener], lambda: (len(listener.points), len(listener.imu)) == expected, timeout_s=5.0
        )
        return player, reports[0]

    yield run
    for node in made:
        node.destroy_node()


@pytest.mark.parametrize('from_bag', [False, True])
def test_every_sweep_arrives_in_order(
    drive: StreetDrive, listener: Listener, play: Callable, tmp_path: Path, from_bag: bool
) -> None:
    source = source_of(drive)
    if from_bag:
        convert(drive, tmp_path / 'bag')
        source = source_of(open_drive(tmp_path / 'bag'))
    _, report = play(source, FAST)
    expected = drive.truth().stamps_ns.tolist()
    assert listener.points == expected
    assert report.published['/points'] == len(expected) == len(report.late_ms)
    assert len(listener.imu) == report.published['/imu']
    assert str(report).startswith(f'{sum(report.published.values())} messages')
    assert listener.clock and listener.clock == sorted(listener.clock)
    assert expected[0] <= listener.clock[0] and listener.clock[-1] <= expected[-1] + 10**9


def test_a_late_subscriber_gets_the_mountings(
    drive: StreetDrive, listener: Listener, play: Callable, spin_until: SpinUntil
) -> None:
    play(source_of(drive), FAST)
    listener.watch_static()
    assert spin_until([listener], lambda: listener.frames == ['lidar', 'imu', 'gps'])


def test_start_and_duration_choose_a_part(
    drive: StreetDrive, listener: Listener, play: Callable
) -> None:
    play(source_of(drive), PlayOptions(rate=20.0, start_s=0.5, duration_s=0.6, wait_for=1))
    stamps = drive.truth().stamps_ns
    assert listener.points == stamps[5:12].tolist()


def test_rounds_jump_back_or_go_on(drive: StreetDrive, listener: Listener, play: Callable) -> None:
    options = {'rate': 20.0, 'duration_s': 0.5, 'rounds': 3, 'wait_for': 1}
    play(source_of(drive), PlayOptions(**options))
    first = listener.points[:6]
    assert listener.points == 3 * first
    listener.points.clear()
    listener.imu.clear()
    play(source_of(drive), PlayOptions(shift_stamps=True, **options))
    assert listener.points[:6] == first
    assert [b - a for a, b in zip(first, listener.points[6:12], strict=True)] == [600_000_000] * 6
    assert listener.points == sorted(set(listener.points)) and len(listener.points) == 18


def test_publishers_offer_what_the_options_say(drive: StreetDrive) -> None:
    node = Node('player', start_parameter_services=False)
    Player(node, source_of(drive), PlayOptions(best_effort=True))
    found = {p.topic_name: p.qos_profile for p in node.publishers}
    assert found['/points'].reliability == ReliabilityPolicy.BEST_EFFORT
    assert found['/tf_static'].reliability == ReliabilityPolicy.RELIABLE
    assert found['/tf_static'].durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert found['/tf_static'].depth == 1 and found['/points'].depth == 10
    node.destroy_node()


def test_a_type_that_is_not_installed_is_left_out(drive: StreetDrive) -> None:
    source = source_of(drive)
    source.topics.append(PlayTopic('/odd', 'no_such_msgs/msg/Thing'))
    node = Node('player', start_parameter_services=False)
    player = Player(node, source, PlayOptions())
    assert '/odd' not in player._publishers and '/points' in player._publishers
    node.destroy_node()


def test_mistakes_are_told_before_anything_is_published(drive: StreetDrive) -> None:
    node = Node('player', start_parameter_services=False)
    with pytest.raises(DataError, match='the start must lie within'):
        Player(node, source_of(drive), PlayOptions(start_s=1e3))
    with pytest.raises(DataError, match='needs a terminal'):
        Player(node, source_of(drive), PlayOptions(paused=True)).play()
    imu = source_of(drive, ['/imu'])
    with pytest.raises(DataError, match='counts subscribers of the points'):
        Player(node, imu, PlayOptions(wait_for=1)).play()
    node.destroy_node()


def test_keys_pause_step_and_end(
    drive: StreetDrive,
    listener: Listener,
    spin_until: SpinUntil,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    keys, terminal = pty.openpty()
    node = Node('player', start_parameter_services=False)
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr(sys, 'stdin', stdin)
        options = PlayOptions(rate=20.0, paused=True, keyboard=True, wait_for=1)
        player = Player(node, source_of(drive), options)
        thread = threading.Thread(target=player.play, daemon=True)
        thread.start()
        # What is typed before the terminal gives single keys is thrown away.
        canonical = termios.ICANON
        assert spin_until([listener], lambda: not termios.tcgetattr(stdin)[3] & canonical)
        for steps in (1, 2, 3):
            os.write(keys, b's')
            assert spin_until([listener], lambda n=steps: len(listener.points) == n)
        assert not listener.imu or listener.imu[-1] <= listener.points[-1]
        assert player.report.published['/points'] == 3
        os.write(keys, b' ')
        assert spin_until([listener], lambda: len(listener.points) > 3)
        os.write(keys, b'q')
        assert spin_until([listener], lambda: not thread.is_alive())
        assert player.report.published['/points'] <= len(drive.truth())
    os.close(keys)
    node.destroy_node()
