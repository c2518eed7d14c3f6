"""Replay a drive straight into node callbacks: no DDS, no threads, the same result on every run."""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from tqdm import tqdm

from bags.bag_messages import BagBytes, encode, static_transforms
from bags.inputs import open_input, span_ns
from bags.nodes.ros_messages import decode, encode_repeatably
from bags.records import CameraImage, Drive, LidarScan
from bags.topics import CAMERA_INFO_TOPIC, TOPICS
from lcd_common.errors import ConfigError

_CLOCK_TOPIC = '/clock'


class LockStep:
    """Carry messages between nodes of this process, first in, first out.

    Whatever a node publishes goes to every subscription of the same resolved topic name (remaps and
    namespaces hold, a node's own subscriptions count) and to observers, after the callback that
    published it has returned. Nothing reaches DDS, and nothing arrives from it as nobody spins.
    Messages are handed over as they are, not copied: neither side may change them afterwards.

    The nodes get `use_sim_time`: their clock is the stamp of the record in hand, and their timers
    fire by it. A node with a parameter `threaded` must have it false. A node may have a method
    `flush` that publishes what it holds back; it is called when the replay ends.
    """

    def __init__(self, nodes: Sequence[Node], *, fire_timers: bool = True) -> None:
        """Take over the nodes' publishers.

        Args:
            nodes: constructed nodes; whoever made them destroys them.
            fire_timers: call timers of the nodes' clock when the replayed time reaches them.

        Raises:
            ConfigError: a node works on a thread of its own.
        """
        self.nodes: list[Node] = []
        self.delivered: Counter[str] = Counter()
        self._fire_timers = fire_timers
        self._now_ns: int | None = None
        self._queue: deque[tuple[str, Any, Any]] = deque()
        self._draining = False
        self._observers: dict[str, list[tuple[Callable[[Any], None], bool]]] = defaultdict(list)
        for node in nodes:
            self.add(node)

    def add(self, node: Node) -> None:
        """Take one more node in, before the replay begins; raises ConfigError as the others do."""
        if node.has_parameter('threaded') and node.get_parameter('threaded').value:
            raise ConfigError(
                f'lock-step replay needs threaded:=false, but node '
                f'{node.get_fully_qualified_name()} has it true'
            )
        self.nodes.append(node)
        node.set_parameters([Parameter('use_sim_time', value=True)])
        for publisher in node.publishers:
            self._take_over(publisher)
        create = node.create_publisher
        node.create_publisher = partial(self._created, create)  # those made later

    def listen(self, topic: str, callback: Callable[[Any], None], *, raw: bool = False) -> None:
        """Call back with every message of an absolute topic.

        With `raw` it gets the serialized bytes, the same for equal messages.
        """
        self._observers[topic].append((callback, raw))

    def feed(self, topic: str, message: Any, message_class: Any = None) -> None:
        """Deliver a message, and all that nodes publish in answer, before returning.

        Args:
            topic: absolute name.
            message: a message, or its serialized bytes; then `message_class` must be given.
            message_class: the class of the message, by default that of `message`.
        """
        if message_class is None and isinstance(message, bytes):
            raise TypeError(f'serialized bytes on {topic} need their message_class')
        self._queue.append((topic, message, message_class or type(message)))
        self._drain()

    def set_time(self, stamp_ns: int) -> None:
        """Set the nodes' clock and fire the timers that are due."""
        if stamp_ns == self._now_ns:
            return
        first = self._now_ns is None
        self._now_ns = stamp_ns
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        self.feed(_CLOCK_TOPIC, Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
        if not self._fire_timers:
            return
        for node in self.nodes:
            for timer in list(node.timers):
                if timer.clock.clock_type != ClockType.ROS_TIME:
                    continue
                if first:  # until now it counted wall time
                    timer.reset()
                elif timer.is_ready():
                    with timer.handle:
                        timer.handle.call_timer()
                    timer.callback()
                    self._drain()

    def run(
        self,
        source: Drive | str | Path,
        *,
        start_s: float = 0.0,
        duration_s: float | None = None,
        progress: bool = True,
    ) -> Counter[str]:
        """Feed a drive in stamp order, /tf_static first; return the messages fed by topic.

        Args:
            source: a Drive, a bag, a data set folder or the word street.
            start_s: seconds of the drive to leave out at its beginning.
            duration_s: seconds to replay; None is to the end.
            progress: show a bar on stderr.

        Raises:
            DataError: the drive cannot be read, is empty, or the start lies behind its end.
        """
        drive = open_input(source) if isinstance(source, str | Path) else source
        begin_ns, end_ns = span_ns(drive, start_s, duration_s)
        fed: Counter[str] = Counter()
        scans = next((s.count for s in drive.streams() if s.topic.endswith('points')), None)
        partly = bool(start_s) or duration_s is not None
        with tqdm(
            total=None if partly else scans, unit='scan', disable=not progress, desc=drive.name
        ) as bar:
            for found in self._messages(drive, begin_ns, end_ns):
                self.set_time(found.stamp_ns)
                if self._wanted(found.topic):
                    self.feed(found.topic, decode(found.data, found.type_name))
                    fed[found.topic] += 1
                bar.update(found.topic == '/points')
        self.flush()
        return fed

    def flush(self) -> None:
        """Have the nodes publish what they hold back, and deliver it; `run` ends with this."""
        for node in self.nodes:
            if hasattr(node, 'flush'):
                node.flush()
                self._drain()

    def _messages(self, drive: Drive, begin_ns: int, end_ns: int | None) -> Iterator[BagBytes]:
        if drive.mountings:
            yield static_transforms(drive.mountings, begin_ns)
        camera = drive.camera if self._wanted(CAMERA_INFO_TOPIC) else None
        # Sensors that nobody listens to are not read; sweeps are, as they are what drives time.
        kinds = {kind for kind, (topic, _) in TOPICS.items() if self._wanted(topic)} | {LidarScan}
        if camera:
            kinds.add(CameraImage)
        for record in drive.records(begin_ns, end_ns, kinds):
            yield from encode(record, camera)

    def _take_over(self, publisher: Publisher) -> Publisher:
        publisher.publish = partial(self._published, publisher.topic_name, publisher.msg_type)
        return publisher

    def _created(self, create: Callable[..., Publisher], *args: Any, **kwargs: Any) -> Publisher:
        return self._take_over(create(*args, **kwargs))

    def _published(self, topic: str, message_class: Any, message: Any) -> None:
        if not isinstance(message, message_class | bytes):
            raise TypeError(f'Expected {message_class}, got {type(message)}')  # as rclpy says it
        self._queue.append((topic, message, message_class))

    def _drain(self) -> None:
        if self._draining:
            return
        self._draining = True
        try:
            while self._queue:
                self._deliver(*self._queue.popleft())
        except BaseException:
            self._queue.clear()
            raise
        finally:
            self._draining = False

    def _deliver(self, topic: str, message: Any, message_class: Any) -> None:
        forms: dict[bool, Any] = {isinstance(message, bytes): message}
        receivers = [(s.callback, s.raw) for s in self._subscriptions(topic)]
        for callback, raw in [*receivers, *self._observers[topic]]:
            if raw not in forms:
                forms[raw] = (
                    encode_repeatably(message)
                    if raw
                    else deserialize_message(message, message_class)
                )
            callback(forms[raw])
            self.delivered[topic] += 1

    def _subscriptions(self, topic: str) -> Collection[Subscription]:
        return [s for node in self.nodes for s in node.subscriptions if s.topic_name == topic]

    def _wanted(self, topic: str) -> bool:
        return bool(self._observers.get(topic)) or bool(self._subscriptions(topic))
