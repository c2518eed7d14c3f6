"""Yield the messages of a bag: rosbag1, rosbag2 in both storages, and mcap files cut short."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from bags.scanned_mcap import ScannedMcap
from bags.skips import Skips
from lcd_common.errors import DataError

_REMEDIES = {
    '.bag': 'try `rosbag reindex`, or copy it again',
    '.db3': 'try `sqlite3 FILE .recover`, or copy it again',
}
_STORAGE_SUFFIXES = ('.mcap', '.db3')


@dataclass(frozen=True)
class BagTopic:
    """One topic of a bag: its message type (ROS 2 spelling) and count."""

    name: str
    type_name: str
    count: int


@dataclass(frozen=True)
class BagMessage:
    """One decoded message; `log_ns` is when it was recorded."""

    topic: str
    log_ns: int
    message: Any


class BagSource:
    """The messages of one bag in recording order, decoded one by one.

    A bag whose index is missing or wrong (the recorder was killed, the disk was full, the copy
    stopped) is read as far as it goes when it is mcap; what is lost is counted.
    """

    def __init__(self, path: Path, skips: Skips) -> None:
        """Open a bag: a rosbag2 folder, also without metadata.yaml, or a .mcap, .db3 or .bag file.

        Raises:
            DataError: it is no bag, or nothing of it can be read.
        """
        self.path = path
        self._skips = skips
        self._files = storage_files(path)
        self._scanned: list[ScannedMcap] = []
        counts: Counter[tuple[str, str]] = Counter()
        try:
            with self._reader() as reader:
                self.last_log_ns = reader.end_time if reader.message_count else 0
                for connection in reader.connections:
                    counts[connection.topic, connection.msgtype] += connection.msgcount
        except Exception as error:  # noqa: BLE001 - struct, zstd, sqlite: each fails in its way
            self._scan(error)
            self.last_log_ns = max(part.last_log_ns for part in self._scanned)
            for part in self._scanned:
                for topic, type_name, count in part.topics:
                    counts[topic, type_name] += count
        self.topics = [BagTopic(*key, count) for key, count in sorted(counts.items())]

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[BagMessage]:
        """Yield the messages of some topics in a span of log times, both ends inclusive."""
        if self._scanned:
            parts = [part.messages(topics, start_ns, end_ns) for part in self._scanned]
            for topic, log_ns, message in merge(*parts, key=lambda item: item[1]):
                yield BagMessage(topic, log_ns, message)
            return
        reached_ns = start_ns
        try:
            for found in self._indexed_messages(topics, start_ns, end_ns):
                yield found
                reached_ns = found.log_ns + 1
        except Exception as error:  # noqa: BLE001 - as above
            if not self._mcap_files():
                message = f'{self.path}: readable up to here only: {_reason(error)}'
                self._skips.add('damaged bag: the rest of it', self.path, message)
                return
            self._scan(error)
            yield from self.messages(topics, reached_ns, end_ns)

    def _indexed_messages(
        self, topics: Collection[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        with self._reader() as reader:
            chosen = [c for c in reader.connections if c.topic in topics]
            if not chosen:
                return
            stop_ns = None if end_ns is None else end_ns + 1
            for connection, log_ns, data in reader.messages(chosen, start_ns, stop_ns):
                try:
                    message = reader.deserialize(data, connection.msgtype)
                except Exception as error:  # noqa: BLE001 - damaged bytes, any decoder
                    self._skips.add(
                        'message that cannot be decoded',
                        (connection.topic, log_ns),
                        f'{self.path}: {connection.topic} at {log_ns}: {_reason(error)}',
                    )
                    continue
                yield BagMessage(connection.topic, log_ns, message)

    def _reader(self) -> AnyReader:
        return AnyReader(self._files, default_typestore=get_typestore(Stores.ROS2_JAZZY))

    def _scan(self, error: Exception) -> None:
        """Turn to reading front to back; raises DataError when that is not possible either."""
        files = self._mcap_files()
        if not files:
            remedy = _REMEDIES.get(self.path.suffix, _REMEDIES['.db3'])
            message = f'{self.path}: not readable as a bag: {_reason(error)}; {remedy}'
            raise DataError(message) from None
        self._skips.note(f'{self.path}: {_reason(error)}; reading it from front to back instead')
        self._scanned = [ScannedMcap(file, self._skips) for file in files]

    def _mcap_files(self) -> list[Path]:
        """Return the bag's files if all of them are mcap."""
        files = [file for path in self._files for file in storage_files(path, False)]
        return files if all(file.suffix == '.mcap' for file in files) else []


def _reason(error: Exception) -> str:
    """Return what a library has to say about damage, in one short line."""
    lines = str(error).split('\n')
    return lines[0][:200] or type(error).__name__


def storage_files(path: Path, with_metadata: bool = True) -> list[Path]:
    """Return what to give to the reader: the bag folder, its storage files or the file itself.

    Raises:
        DataError: there is no storage file.
    """
    if not path.is_dir():
        return [path]
    if with_metadata and (path / 'metadata.yaml').is_file():
        return [path]
    files = sorted(p for p in path.iterdir() if p.suffix in _STORAGE_SUFFIXES)
    if not files:
        raise DataError(f'{path}: no .mcap or .db3 file in this bag folder')
    return files
