"""Write rosbag2 recordings in mcap storage as ROS 2 Jazzy does, without ROS."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml
from mcap.writer import CompressionType, Writer

from bags.bag_messages import TYPES, BagBytes
from bags.topics import TF_STATIC_TOPIC
from lcd_common.errors import DataError

_CHUNK_BYTES = 4 * 1024 * 1024
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}


class BagWriter:
    """Write messages to a new bag: `with BagWriter(path) as bag: bag.write(message)`.

    A path that ends in .mcap becomes a single file, any other a rosbag2 folder (NAME/NAME_0.mcap
    and NAME/metadata.yaml). It appears under its name only when it is complete; after an error or
    Ctrl-C nothing is left.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        """Prepare to write.

        Args:
            path: of the bag; its folder must exist.
            overwrite: replace a bag of that name.

        Raises:
            DataError: something else is there, or a bag and `overwrite` is false.
        """
        self.path = Path(path)
        self._single = self.path.suffix == '.mcap'
        _must_be_free(self.path, overwrite)
        self._partial = self.path.with_name(f'.{self.path.name}.partial-{os.getpid()}')
        self._counts: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0

    def __enter__(self) -> Self:
        """Create the unfinished bag beside where it will be."""
        with self._one_line():
            if self._single:
                file = self._partial
            else:
                self._partial.mkdir()
                file = self._partial / self._file_name
            self._stream = file.open('wb')
            self._writer = Writer(
                self._stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD
            )
            self._writer.start(profile='ros2', library='bags')
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish and name the bag, or remove it when the block failed."""
        try:
            if kind is None:
                with self._one_line():
                    self._finish()
        finally:
            self._stream.close()
            _remove(self._partial)

    def write(self, message: BagBytes) -> None:
        """Append a message at its stamp; its topic is created when it comes first.

        Raises:
            DataError: the disk is full or gone.
        """
        with self._one_line():
            if message.topic not in self._channels:
                self._add_topic(message.topic, message.type_name)
            self._writer.add_message(
                self._channels[message.topic],
                log_time=message.stamp_ns,
                publish_time=message.stamp_ns,
                data=message.data,
                sequence=self._counts[message.topic],
            )
        self._counts[message.topic] += 1
        first = message.stamp_ns if self._first_ns is None else self._first_ns
        self._first_ns = min(first, message.stamp_ns)
        self._last_ns = max(self._last_ns, message.stamp_ns)

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return dict(self._counts)

    @property
    def _file_name(self) -> str:
        return self.path.name if self._single else f'{self.path.name}_0.mcap'

    def _add_topic(self, topic: str, type_name: str) -> None:
        if type_name not in self._schemas:
            text, _ = TYPES.generate_msgdef(type_name, ros_version=2)
            self._schemas[type_name] = self._writer.register_schema(
                type_name, 'ros2msg', text.encode()
            )
        self._channels[topic] = self._writer.register_channel(
            topic,
            'cdr',
            self._schemas[type_name],
            {
                'offered_qos_profiles': _dump([_qos(topic)]),
                'topic_type_hash': TYPES.hash_rihs01(type_name),
            },
        )
        self._counts[topic], self._types[topic] = 0, type_name

    def _finish(self) -> None:
        metadata = self._metadata()
        # rosbag2 keeps a copy inside, so that a lone .mcap tells as much as a folder does.
        self._writer.add_metadata('rosbag2', {'serialized_metadata': _dump(metadata)})
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        if not self._single:
            text = _dump({'rosbag2_bagfile_information': metadata})
            (self._partial / 'metadata.yaml').write_text(text)
        if self.path.exists():
            old = self.path.with_name(f'.{self.path.name}.old-{os.getpid()}')
            self.path.rename(old)
            self._partial.rename(self.path)
            _remove(old)
        else:
            self._partial.rename(self.path)

    def _metadata(self) -> dict[str, Any]:
        first = 0 if self._first_ns is None else self._first_ns
        span = {
            'duration': {'nanoseconds': self._last_ns - first},
            'starting_time': {'nanoseconds_since_epoch': first},
            'message_count': sum(self._counts.values()),
        }
        return {
            'version': 9,
            'storage_identifier': 'mcap',
            **span,
            'topics_with_message_count': [
                {
                    'topic_metadata': {
                        'name': topic,
                        'type': self._types[topic],
                        'serialization_format': 'cdr',
                        'offered_qos_profiles': [_qos(topic)],
                        'type_description_hash': TYPES.hash_rihs01(self._types[topic]),
                    },
                    'message_count': count,
                }
                for topic, count in self._counts.items()
            ],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [self._file_name],
            'files': [{'path': self._file_name, **span}],
            'custom_data': None,
            'ros_distro': 'jazzy',
        }

    @contextmanager
    def _one_line(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            remedy = 'check the folder'
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                remedy = 'free space or write elsewhere; the unfinished bag is removed'
            raise DataError(f'{self.path}: cannot write: {error.strerror}; {remedy}') from None


def _qos(topic: str) -> dict[str, Any]:
    """Return the profile that a player should offer: latched for /tf_static."""
    latched = topic == TF_STATIC_TOPIC
    return {
        'history': 'keep_last',
        'depth': 1 if latched else 10,
        'reliability': 'reliable',
        'durability': 'transient_local' if latched else 'volatile',
        'deadline': _FOREVER,
        'lifespan': _FOREVER,
        'liveliness': 'automatic',
        'liveliness_lease_duration': _FOREVER,
        'avoid_ros_namespace_conventions': False,
    }


class _Plain(yaml.SafeDumper):
    """Write repeated values out, without anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _dump(data: Any) -> str:
    return str(yaml.dump(data, Dumper=_Plain, sort_keys=False))


def _must_be_free(path: Path, overwrite: bool) -> None:
    if not path.parent.is_dir():
        raise DataError(f'{path}: the folder {path.parent} does not exist; create it first')
    if not path.exists():
        return
    is_bag = path.suffix == '.mcap' if path.is_file() else (path / 'metadata.yaml').is_file()
    if not is_bag:
        raise DataError(f'{path}: exists and is no bag; choose another name')
    if not overwrite:
        raise DataError(f'{path}: exists; choose another name or give --overwrite')


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
