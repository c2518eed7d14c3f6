"""Publish a drive over DDS with its timing."""

import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from tqdm import tqdm

from bags.bag_messages import BagBytes
from bags.nodes.keyboard import Keyboard
from bags.nodes.ros_messages import message_class
from bags.play import PlayOptions
from bags.play_clock import PlayClock
from bags.play_source import PlaySource, PlayTopic, shifted, source_of
from bags.read_ahead import ReadAhead
from bags.records import Drive
from bags.topics import TF_STATIC_TOPIC
from lcd_common.errors import DataError
from lcd_common.nodes.large_messages import carry_large_messages

_READ_AHEAD_BYTES = 48_000_000  # two seconds and more of a dense LiDAR with a camera
_POINTS = 'sensor_msgs/msg/PointCloud2'
_ROUND_GAP_NS = 100_000_000
_CLOCK_QOS = QoSProfile(
    reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=1
)


@dataclass(frozen=True)
class PlayReport:
    """What was played: messages by topic, and how late they were against their due time."""

    published: Counter[str]
    late_ms: list[float]

    def __str__(self) -> str:
        total = sum(self.published.values())
        if not self.late_ms:
            return f'{total} messages'
        p50, p99 = np.percentile(self.late_ms, [50, 99])
        return (
            f'{total} messages, sweeps late by {p50:.1f} ms (median), {p99:.1f} (p99), '
            f'{max(self.late_ms):.1f} (worst)'
        )


class Player:
    """Publish the messages of a source when they are due."""

    def __init__(self, node: Node, source: PlaySource, options: PlayOptions) -> None:
        """Create the publishers; topics whose type is not installed are left out with a warning.

        Raises:
            DataError: there is nothing left to play, or the start lies behind the end.
        """
        self._node, self._source, self._options = node, source, options
        self._publishers: dict[str, Publisher] = {}
        self._points: Publisher | None = None
        for topic in source.topics:
            self._add_publisher(topic)
        if not self._publishers:
            raise DataError('nothing to play: no topic whose message type is installed here')
        self._static: Publisher | None = None
        if source.static is not None:
            topic = PlayTopic(TF_STATIC_TOPIC, source.static.type_name, latched=True)
            self._static = self._publisher(topic)
        self._ticks = node.create_publisher(Clock, '/clock', _CLOCK_QOS)
        self._begin_ns = source.first_ns + round(options.start_s * 1e9)
        self._end_ns = source.last_ns
        if options.duration_s is not None:
            self._end_ns = min(self._end_ns, self._begin_ns + round(options.duration_s * 1e9))
        if self._begin_ns > source.last_ns:
            span = (source.last_ns - source.first_ns) * 1e-9
            raise DataError(f'the start must lie within {span:.1f} s, got {options.start_s:g} s')
        self._clock = PlayClock(options.rate, time.monotonic)
        self._next_tick_s = 0.0
        self._stepping = False
        self.report = PlayReport(Counter(), [])

    def play(self) -> PlayReport:
        """Publish everything; returns when all is published and taken, or the user ends it."""
        ahead = ReadAhead(self._timeline(), _READ_AHEAD_BYTES, lambda m: len(m.data) + 200)
        try:
            with Keyboard(self._options.keyboard) as keyboard:
                if self._options.paused and not keyboard.enabled:
                    raise DataError('--paused needs a terminal, whose space bar goes on')
                if self._static is not None and self._source.static is not None:
                    self._static.publish(self._source.static.data)
                self._wait_for_subscribers()
                ahead.wait_until_full()
                self._publish_all(ahead, keyboard)
        finally:
            ahead.stop()
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=5))
        return self.report

    def _publish_all(self, ahead: ReadAhead[BagBytes], keyboard: Keyboard) -> None:
        options, clock = self._options, self._clock
        newest_ns: int | None = None
        seconds = (self._end_ns - self._begin_ns) * 1e-9 * (options.rounds or 1)
        with tqdm(
            total=None if options.rounds is None else round(seconds, 1),
            unit='s',
            disable=not options.progress,
            bar_format='{l_bar}{bar}| {n:.1f}/{total_fmt} s [{elapsed}]{postfix}',
        ) as bar:
            for message in ahead:
                if newest_ns is None or message.stamp_ns < newest_ns:  # the start, or a jump back
                    clock.start(message.stamp_ns)
                    if newest_ns is None and options.paused:
                        clock.pause()
                elif newest_ns is not None:
                    bar.update((message.stamp_ns - newest_ns) * 1e-9)
                newest_ns = message.stamp_ns
                if not self._wait_until_due(message, keyboard, bar):
                    return
                self._publishers[message.topic].publish(message.data)
                self.report.published[message.topic] += 1
                if message.type_name == _POINTS and not clock.paused:
                    self.report.late_ms.append(-1e3 * clock.wait_s(message.stamp_ns))

    def _wait_until_due(self, message: BagBytes, keyboard: Keyboard, bar: tqdm) -> bool:
        """Wait, tick and obey keys until a message is due; False when the user ends it."""
        clock = self._clock
        while True:
            if self._stepping and clock.paused:
                clock.step_to(message.stamp_ns)
                self._stepping = message.type_name != _POINTS
                self._tick(message.stamp_ns)
                return True
            wait_s = clock.wait_s(message.stamp_ns)
            if wait_s <= 0:
                self._tick_if_due(message.stamp_ns)
                return True
            self._tick_if_due(clock.now_ns())
            until_tick_s = self._next_tick_s - time.monotonic()
            key = keyboard.wait(min(wait_s, max(until_tick_s, 0.0) or wait_s, 0.1))
            if key == 'q':
                return False
            if key == ' ':
                if clock.paused:
                    clock.resume()
                else:
                    clock.pause()
                bar.set_postfix_str('paused' if clock.paused else '')
            self._stepping = self._stepping or (key == 's' and clock.paused)

    def _tick_if_due(self, now_ns: int) -> None:
        if not self._options.clock_hz:
            self._next_tick_s = float('inf')
        elif time.monotonic() >= self._next_tick_s:
            self._tick(now_ns)

    def _tick(self, now_ns: int) -> None:
        if self._options.clock_hz:
            seconds, nanoseconds = divmod(now_ns, 1_000_000_000)
            self._ticks.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
            self._next_tick_s = time.monotonic() + 1.0 / self._options.clock_hz

    def _timeline(self) -> Iterator[BagBytes]:
        """Yield all rounds, one behind the other."""
        played = 0
        period_ns = self._end_ns - self._begin_ns + _ROUND_GAP_NS
        while self._options.rounds is None or played < self._options.rounds:
            shift_ns = played * period_ns if self._options.shift_stamps else 0
            for message in self._source.messages(self._begin_ns, self._end_ns):
                if message.topic in self._publishers:
                    yield shifted(message, shift_ns)
            played += 1

    def _wait_for_subscribers(self) -> None:
        wanted = self._options.wait_for
        if not wanted:
            return
        if self._points is None:
            raise DataError('--wait-for counts subscribers of the points, but there are none here')
        told = False
        while (found := self._points.get_subscription_count()) < wanted:
            if not told:
                self._node.get_logger().info(
                    f'waiting for {wanted} subscribers on {self._points.topic_name}, {found} there'
                )
                told = True
            time.sleep(0.05)
        time.sleep(0.5)  # they know each other here; let them learn of it too

    def _add_publisher(self, topic: PlayTopic) -> None:
        try:
            publisher = self._publisher(topic)
        except DataError as error:
            self._node.get_logger().warning(f'{topic.name} is left out: {error}')
            return
        self._publishers[topic.name] = publisher
        if topic.type_name == _POINTS and self._points is None:
            self._points = publisher

    def _publisher(self, topic: PlayTopic) -> Publisher:
        best_effort = self._options.best_effort and not topic.latched
        qos = QoSProfile(
            reliability=(
                ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
            ),
            durability=(
                DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
            ),
            history=HistoryPolicy.KEEP_LAST,
            depth=1 if topic.latched else 10,
        )
        return self._node.create_publisher(message_class(topic.type_name), topic.name, qos)


def play_on_ros(
    drive: Drive,
    topics: Collection[str] | None,
    options: PlayOptions,
    ros_arguments: Sequence[str] = (),
) -> int:
    """Play a drive as a node of its own and say how it went; returns the exit status."""
    source = source_of(drive, topics)
    carry_large_messages()
    rclpy.init(args=['bags', *ros_arguments], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node('bag_player', enable_rosout=False, start_parameter_services=False)
        report = Player(node, source, options).play()
        sys.stderr.write(f'played {report}\n')
        for cause, count in sorted(drive.skipped.items()):
            sys.stderr.write(f'skipped: {count} x {cause}\n')
    finally:
        rclpy.try_shutdown()
    return 0
