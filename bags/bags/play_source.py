"""Yield what is to be published: a bag's own bytes, or the messages of any other drive."""

import logging
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability
from rosbags.typesys import Stores, get_typestore

from bags.bag_messages import TYPES, BagBytes, encode, static_transforms
from bags.inputs import span_ns
from bags.records import CameraImage, Drive
from bags.topics import CAMERA_INFO_TOPIC, TF_STATIC_TOPIC, TOPICS
from lcd_common.errors import DataError

_log = logging.getLogger(__name__)
_LITTLE_ENDIAN_CDR = b'\x00\x01'


@dataclass(frozen=True)
class PlayTopic:
    """One topic to publish; a latched one is still there for late subscribers."""

    name: str
    type_name: str
    latched: bool = False


class PlaySource(Protocol):
    """Something that can be played."""

    topics: list[PlayTopic]
    first_ns: int
    last_ns: int
    static: BagBytes | None  # all of /tf_static in one message

    def messages(self, start_ns: int, end_ns: int | None) -> Iterator[BagBytes]:
        """Yield the messages between two stamps, /tf_static left out."""
        ...


class DriveSource:
    """Encode the records of a drive."""

    def __init__(self, drive: Drive, topics: Collection[str] | None = None) -> None:
        """Choose what to play; raises DataError when the drive is empty or has no such topic."""
        streams = drive.streams()
        present = {s.type_name for s in streams if s.count}
        self._kinds = {
            kind
            for kind, (topic, type_name) in TOPICS.items()
            if (type_name in present or any(s.topic == topic for s in streams))
            and (topics is None or topic in topics)
        }
        self.topics: list[PlayTopic] = [
            PlayTopic(*TOPICS[kind]) for kind in TOPICS if kind in self._kinds
        ]
        self._camera = drive.camera if CameraImage in self._kinds else None
        if self._camera is not None and (topics is None or CAMERA_INFO_TOPIC in topics):
            self.topics.append(PlayTopic(CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo'))
        offered = [TOPICS[kind][0] for kind in TOPICS]
        _must_know(drive.path, topics, [*offered, CAMERA_INFO_TOPIC, TF_STATIC_TOPIC])
        self._drive = drive
        self.first_ns, _ = span_ns(drive)
        self.last_ns = max(s.last_ns for s in streams if s.last_ns is not None)
        self.static = static_of(drive, self.first_ns)

    def messages(self, start_ns: int, end_ns: int | None) -> Iterator[BagBytes]:
        """Yield the messages between two stamps, both inclusive."""
        names = {topic.name for topic in self.topics}
        for record in self._drive.records(start_ns, end_ns, self._kinds):
            for message in encode(record, self._camera):
                if message.topic in names:
                    yield message


class BagFileSource:
    """Pass on the bytes of a rosbag2 as they are, all topics of it."""

    def __init__(self, drive: Drive, topics: Collection[str] | None = None) -> None:
        """Open a drive's rosbag2; raises DataError when it is empty or has no such topic."""
        self._drive = drive
        self._path = path = drive.path
        with self._reader() as reader:
            _must_know(path, topics, [c.topic for c in reader.connections])
            self._names = {
                c.topic
                for c in reader.connections
                if c.topic != TF_STATIC_TOPIC and (topics is None or c.topic in topics)
            }
            self.topics = list(
                {
                    c.topic: PlayTopic(c.topic, c.msgtype, _latched(c.ext))
                    for c in reader.connections
                    if c.topic in self._names
                }.values()
            )
            if not reader.message_count:
                raise DataError(f'{path}: the bag is empty, there is nothing to play')
            self.first_ns, self.last_ns = reader.start_time, reader.end_time - 1
        self.static = static_of(drive, self.first_ns)

    def messages(self, start_ns: int, end_ns: int | None) -> Iterator[BagBytes]:
        """Yield the messages recorded between two times, both inclusive.

        Where the file is damaged, the drive's records take over: its reader knows how to go on.
        """
        reached_ns = start_ns - 1
        try:
            for message in self._stored(start_ns, end_ns):
                yield message
                reached_ns = message.stamp_ns
        except Exception as error:  # noqa: BLE001 - struct, zstd, sqlite: each fails in its way
            _log.warning('%s: %s; playing what can still be read', self._path, error)
            for message in DriveSource(self._drive).messages(reached_ns + 1, end_ns):
                if message.topic in self._names:
                    yield message

    def _stored(self, start_ns: int, end_ns: int | None) -> Iterator[BagBytes]:
        stop_ns = None if end_ns is None else end_ns + 1
        with self._reader() as reader:
            chosen = [c for c in reader.connections if c.topic in self._names]
            for connection, log_ns, data in reader.messages(chosen, start_ns, stop_ns):
                yield BagBytes(connection.topic, connection.msgtype, log_ns, bytes(data))

    def _reader(self) -> AnyReader:
        return AnyReader([self._path], default_typestore=get_typestore(Stores.ROS2_JAZZY))


def source_of(drive: Drive, topics: Collection[str] | None = None) -> PlaySource:
    """Return how to play a drive: a sound rosbag2 by its bytes, everything else by its records."""
    path = drive.path
    bag = path.suffix in ('.mcap', '.db3') or (path / 'metadata.yaml').is_file()
    if bag and path.exists():
        try:
            return BagFileSource(drive, topics)
        except DataError:
            raise
        except Exception as error:  # noqa: BLE001 - a broken index fails in many ways
            _log.warning('%s: %s; playing what can still be read', path, error)
    return DriveSource(drive, topics)


def static_of(drive: Drive, stamp_ns: int) -> BagBytes | None:
    """Return the drive's mountings as one message, None when it has none."""
    return static_transforms(drive.mountings, stamp_ns) if drive.mountings else None


def shifted(message: BagBytes, shift_ns: int) -> BagBytes:
    """Move a message and, where its type begins with a header, its header's stamp.

    Transforms on /tf move too; messages without a header stay as they are.
    """
    if not shift_ns:
        return message
    data = message.data
    fields = TYPES.fielddefs.get(message.type_name, ((), ()))[1]
    if message.type_name == 'tf2_msgs/msg/TFMessage':
        data = _shifted_transforms(data, shift_ns)
    elif fields and fields[0][0] == 'header' and data[:2] == _LITTLE_ENDIAN_CDR:
        seconds = int.from_bytes(data[4:8], 'little', signed=True)
        nanoseconds = int.from_bytes(data[8:12], 'little')
        seconds, nanoseconds = divmod(seconds * 10**9 + nanoseconds + shift_ns, 10**9)
        stamp = seconds.to_bytes(4, 'little', signed=True) + nanoseconds.to_bytes(4, 'little')
        data = data[:4] + stamp + data[12:]
    return replace(message, stamp_ns=message.stamp_ns + shift_ns, data=data)


def _shifted_transforms(data: bytes, shift_ns: int) -> bytes:
    message = TYPES.deserialize_cdr(data, 'tf2_msgs/msg/TFMessage')
    for stamped in message.transforms:  # type: ignore[attr-defined]
        stamp = stamped.header.stamp
        stamp.sec, stamp.nanosec = divmod(stamp.sec * 10**9 + stamp.nanosec + shift_ns, 10**9)
    return bytes(TYPES.serialize_cdr(message, 'tf2_msgs/msg/TFMessage'))


def _latched(ext: object) -> bool:
    profiles = ext.offered_qos_profiles if isinstance(ext, ConnectionExtRosbag2) else []
    return any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in profiles)


def _must_know(path: Path, wanted: Collection[str] | None, known: Collection[str]) -> None:
    unknown = sorted(set(wanted or ()) - set(known))
    if unknown:
        raise DataError(f'{path}: no topic {", ".join(unknown)}; it has {", ".join(sorted(known))}')
