"""Read a rosbag1 or rosbag2 recording with the standard messages."""

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bags.bag_records import CONVERTERS, KINDS, camera_from, mountings_from, stamp_of
from bags.bag_source import BagMessage, BagSource, BagTopic
from bags.bag_topics import choose_topics
from bags.records import CameraModel, LidarScan, Mounting, Record, Stream, TruthPose
from bags.sensor_stream import without_broken_points
from bags.skips import Skips, UnreadableError
from bags.topics import ORDER, TF_STATIC_TOPIC
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory

# Messages are recorded in order of arrival: a slow camera's come later than its stamps say.
_REORDER_NS = 2_000_000_000
_MARGIN_NS = 10_000_000_000
_TAILS_NS = (1_000_000_000, 10_000_000_000, None)


def is_rosbag(path: Path) -> bool:
    """Tell whether a path is a bag file, or a folder with metadata.yaml or storage files."""
    if path.is_dir():
        if (path / 'metadata.yaml').is_file():
            return True
        return any(p.suffix in ('.mcap', '.db3') for p in path.iterdir())
    return path.suffix in ('.mcap', '.db3', '.bag')


def open_rosbag(path: Path, topics: Mapping[str, str] | None = None) -> 'RosbagDrive':
    """Open a bag; `topics` maps roles (points, image, imu, …) to topics, '' leaves one out.

    Raises:
        DataError: it is no bag, nothing of it can be read, or a topic is wrong.
    """
    return RosbagDrive(path, topics or {})


class RosbagDrive:
    """A drive in a bag. Records come in the order of their header stamps.

    Messages whose stamp is more than 2 s older than one read before are out of order beyond
    mending: they are counted and left out, as are repeated stamps of one topic.
    """

    def __init__(self, path: Path, topics: Mapping[str, str]) -> None:
        """Open a bag and read its camera model and mountings."""
        self.name = path.stem
        self.path = path
        self._skips = Skips()
        self.skipped: Counter[str] = self._skips.counts
        self._source = BagSource(path, self._skips)
        chosen = choose_topics(str(path), self._source.topics, topics)
        if not set(chosen) - {'camera_info'}:
            names = ', '.join(f'{t.name} ({t.type_name})' for t in self._source.topics) or 'nothing'
            raise DataError(
                f'{path}: no topic with points, images, imu, gnss or twist; it has {names}'
            )
        self._camera_info = chosen.pop('camera_info', None)
        self._roles = {topic.name: role for role, topic in chosen.items()}
        self._chosen: dict[str, BagTopic] = chosen
        self.camera: CameraModel | None = self._read_camera()
        self.mountings: tuple[Mounting, ...] = self._read_mountings()
        self._ends: dict[str, tuple[BagMessage, BagMessage]] | None = None

    def streams(self) -> list[Stream]:
        """List the topics that are read, with the header stamps of their first and last message."""
        streams = []
        for role, topic in self._chosen.items():
            ends = self._first_and_last().get(role)
            first = _stamp_or_none(ends[0]) if ends else None
            last = _stamp_or_none(ends[1]) if ends else None
            streams.append(Stream(topic.name, topic.type_name, topic.count, first, last))
        return streams

    def records(
        self,
        start_ns: int | None = None,
        end_ns: int | None = None,
        kinds: Collection[type[Record]] | None = None,
    ) -> Iterator[Record]:
        """Yield everything between two stamps (inclusive) in stamp order, one sweep at a time.

        With `kinds` only these are read.

        Raises:
            DataError: the bag has clouds in the span, and not one of them can be read.
        """
        read, failure = 0, ''
        for topic, log_ns, record in self._in_order(start_ns, end_ns, kinds):
            if isinstance(record, LidarScan):
                try:
                    record = without_broken_points(record, topic, self._skips)
                    read += 1
                except UnreadableError as error:
                    self._skips.add(error.cause, (topic, log_ns), str(error))
                    continue
            elif isinstance(record, UnreadableError):
                failure = failure or str(record)
                continue
            yield record
        if failure and not read:
            topic = self._chosen['points'].name
            raise DataError(f'{self.path}: no cloud on {topic} can be read; the first: {failure}')

    def truth(self) -> Trajectory | None:
        """Return the reference trajectory of base_link, or None when there is none."""
        if 'truth' not in self._chosen:
            return None
        poses: dict[int, TruthPose] = {}
        for found in self._source.messages([self._chosen['truth'].name]):
            record = self._convert(found)
            if isinstance(record, TruthPose):
                poses.setdefault(record.stamp_ns, record)
        if not poses:
            return None
        stamps = sorted(poses)
        return Trajectory(
            np.array(stamps, np.int64), np.stack([poses[stamp].T_world_base for stamp in stamps])
        )

    def _in_order(
        self,
        start_ns: int | None,
        end_ns: int | None,
        kinds: Collection[type[Record]] | None,
    ) -> Iterator[tuple[str, int, Record | UnreadableError]]:
        waiting: list[tuple[int, int, int, str, int, Record]] = []
        newest, released = 0, 0
        last: dict[str, int] = {}
        count = 0

        def ready(until: int) -> Iterator[tuple[str, int, Record]]:
            nonlocal released
            while waiting and waiting[0][0] <= until:
                stamp, _, _, topic, log_ns, record = heapq.heappop(waiting)
                released = stamp
                if last.get(topic) == stamp:
                    message = f'{self.path}: {topic} repeats the stamp {stamp}'
                    self._skips.add('duplicate stamp', (topic, log_ns), message)
                    continue
                last[topic] = stamp
                if (start_ns is None or stamp >= start_ns) and (end_ns is None or stamp <= end_ns):
                    yield topic, log_ns, record

        topics = [t for t, role in self._roles.items() if kinds is None or KINDS[role] in kinds]
        for found in self._source.messages(topics, *self._log_span(start_ns, end_ns)):
            record = self._convert(found)
            if isinstance(record, UnreadableError):
                if self._roles[found.topic] == 'points':
                    yield found.topic, found.log_ns, record
                continue
            if record.stamp_ns < released:
                self._skips.add(
                    'stamp out of order',
                    (found.topic, found.log_ns),
                    f'{self.path}: {found.topic} has the stamp {record.stamp_ns} after {newest}',
                )
                continue
            count += 1
            order = ORDER[type(record)]
            item = (record.stamp_ns, order, count, found.topic, found.log_ns, record)
            heapq.heappush(waiting, item)
            newest = max(newest, record.stamp_ns)
            yield from ready(newest - _REORDER_NS)
        yield from ready(newest)

    def _convert(self, found: BagMessage) -> Record | UnreadableError:
        try:
            record: Record = CONVERTERS[self._roles[found.topic]](found.message)
        except UnreadableError as error:
            message = f'{self.path}: {found.topic} at {found.log_ns}: {error}'
            self._skips.add(error.cause, (found.topic, found.log_ns), message)
            return UnreadableError(error.cause, message)
        return record

    def _log_span(self, start_ns: int | None, end_ns: int | None) -> tuple[int | None, int | None]:
        """Turn a span of header stamps into one of log times, by how far the two are apart."""
        if start_ns is None and end_ns is None:
            return None, None
        lags = [
            found.log_ns - stamp
            for pair in self._first_and_last().values()
            for found in pair
            if (stamp := _stamp_or_none(found)) is not None
        ]
        if not lags:
            return None, None
        low = None if start_ns is None else start_ns + min(lags) - _MARGIN_NS
        high = None if end_ns is None else end_ns + max(lags) + _MARGIN_NS
        return low, high

    def _first_and_last(self) -> dict[str, tuple[BagMessage, BagMessage]]:
        if self._ends is None:
            topics = list(self._roles)
            first = {t: next(self._source.messages([t]), None) for t in topics}
            last: dict[str, BagMessage] = {}
            for tail_ns in _TAILS_NS:  # most topics last until the end; look further for others
                left = [t for t in topics if t not in last and first[t] is not None]
                start_ns = None if tail_ns is None else self._source.last_log_ns - tail_ns
                for found in self._source.messages(left, start_ns) if left else ():
                    last[found.topic] = _without_data(found)
            self._ends = {
                self._roles[topic]: (_without_data(found), last[topic])
                for topic, found in first.items()
                if found is not None and topic in last
            }
        return self._ends

    def _read_camera(self) -> CameraModel | None:
        if self._camera_info is None:
            return None
        for found in self._source.messages([self._camera_info.name]):
            try:
                return camera_from(found.message)
            except UnreadableError as error:
                message = f'{self.path}: {found.topic}: {error}'
                self._skips.add(error.cause, found.topic, message)
                return None
        return None

    def _read_mountings(self) -> tuple[Mounting, ...]:
        mountings: dict[tuple[str, str], Mounting] = {}
        for found in self._source.messages([TF_STATIC_TOPIC]):
            try:
                for mounting in mountings_from(found.message):
                    mountings[mounting.parent, mounting.child] = mounting
            except UnreadableError as error:
                message = f'{self.path}: {TF_STATIC_TOPIC}: {error}'
                self._skips.add(error.cause, (found.topic, found.log_ns), message)
        return tuple(mountings.values())


def _stamp_or_none(found: BagMessage) -> int | None:
    try:
        return stamp_of(found.message)
    except UnreadableError:
        return None


class _Header:
    """What is kept of a message that is only needed for its stamp."""

    def __init__(self, message: Any) -> None:
        self.header = message.header


def _without_data(found: BagMessage) -> BagMessage:
    return replace(found, message=_Header(found.message))
