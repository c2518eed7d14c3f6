"""Read an mcap file front to back, as far as it goes, without trusting its index.

A recorder that was killed leaves a file without summary and footer, often with half a chunk at its
end. Everything before the cut is intact, and most of the half chunk can be unpacked.
"""

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.stores import Stores

from bags.skips import Skips
from lcd_common.errors import DataError

_MESSAGE = 0x05
_RECORD_HEADER = struct.Struct('<BQ')
_MESSAGE_HEADER = struct.Struct('<HIQQ')


class ScannedMcap:
    """The messages of one mcap file, found by scanning it; what is cut or damaged is counted."""

    def __init__(self, path: Path, skips: Skips) -> None:
        """Scan a file once for its topics and counts.

        Raises:
            DataError: no message can be found in it.
        """
        self.path = path
        self._skips = skips
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._registered: set[str] = set(self._types.fielddefs)
        self.last_log_ns = 0
        counts: Counter[int] = Counter()
        for message in self._messages(None, None):
            counts[message.channel_id] += 1
            self.last_log_ns = max(self.last_log_ns, message.log_time)
        self.topics = [
            (channel.topic, self._type_name(channel), counts[channel.id])
            for channel in self._channels.values()
        ]
        if not counts:
            raise DataError(f'{path}: no message can be read from it; record or copy it again')

    def messages(
        self, topics: Collection[str], start_ns: int | None, end_ns: int | None
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, log time, message) of a span of log times, both ends inclusive."""
        for raw in self._messages(start_ns, end_ns):
            channel = self._channels[raw.channel_id]
            if channel.topic not in topics:
                continue
            try:
                message = self._types.deserialize_cdr(raw.data, self._registered_type(channel))
            except Exception as error:  # noqa: BLE001 - damaged bytes, any decoder
                self._skips.add(
                    'message that cannot be decoded',
                    (channel.topic, raw.log_time),
                    f'{self.path}: {channel.topic} at {raw.log_time}: {error}',
                )
                continue
            yield channel.topic, raw.log_time, message

    def _messages(self, start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        low, high = start_ns or 0, 2**63 if end_ns is None else end_ns
        for record in self._records():
            if not isinstance(record, Chunk):
                group: list[McapRecord] = [record]
            # Chunks outside the span are unpacked only while they may hold channels unseen so far.
            elif record.message_end_time < low or record.message_start_time > high:
                if self._channels:
                    continue
                group = self._unpack(record)
            else:
                group = self._unpack(record)
            messages = []
            for item in group:
                if isinstance(item, Schema):
                    self._schemas[item.id] = item
                elif isinstance(item, Channel):
                    self._channels[item.id] = item
                elif (
                    isinstance(item, Message)
                    and low <= item.log_time <= high
                    and item.channel_id in self._channels
                ):
                    messages.append(item)
            yield from sorted(messages, key=lambda m: m.log_time)

    def _records(self) -> Iterator[McapRecord]:
        with self.path.open('rb') as file:
            try:
                yield from StreamReader(file, emit_chunks=True).records
            except (McapError, struct.error, ValueError, UnicodeDecodeError, MemoryError):
                self._skips.add(
                    'bag cut off: the rest of the file',
                    self.path,
                    f'{self.path}: cut off or damaged at byte {file.tell()} of '
                    f'{self.path.stat().st_size}; what comes before is read',
                )

    def _unpack(self, chunk: Chunk) -> list[McapRecord]:
        try:
            return breakup_chunk(chunk, validate_crc=True)
        except CRCValidationError:
            lost = f'{self.path}: the chunk from {chunk.message_start_time} fails its checksum'
            self._skips.add('damaged chunk of a bag', (self.path, chunk.message_start_time), lost)
            return []
        except Exception:  # noqa: BLE001 - zstd, lz4: an exception each
            return _unpack_beginning(chunk)

    def _type_name(self, channel: Channel) -> str:
        schema = self._schemas.get(channel.schema_id)
        return schema.name if schema is not None else ''

    def _registered_type(self, channel: Channel) -> str:
        name = self._type_name(channel)
        if name not in self._registered:
            schema = self._schemas[channel.schema_id]
            text = schema.data.decode()
            parse = get_types_from_msg if schema.encoding == 'ros2msg' else None
            types = parse(text, name) if parse else get_types_from_idl(text)
            self._types.register({k: v for k, v in types.items() if k not in self._registered})
            self._registered.update(types)
        return name


def _unpack_beginning(chunk: Chunk) -> list[McapRecord]:
    """Return the whole messages at the beginning of a chunk that is cut off."""
    data = chunk.data
    try:
        if chunk.compression == 'zstd':
            data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
        elif chunk.compression == 'lz4':
            data = lz4.frame.LZ4FrameDecompressor().decompress(data)
    except (zstandard.ZstdError, RuntimeError):
        return []
    records: list[McapRecord] = []
    position = 0
    while position + _RECORD_HEADER.size <= len(data):
        opcode, length = _RECORD_HEADER.unpack_from(data, position)
        position += _RECORD_HEADER.size
        if position + length > len(data):
            break
        if opcode == _MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE_HEADER.unpack_from(data, position)
            body = data[position + _MESSAGE_HEADER.size : position + length]
            records.append(Message(channel, log_time, body, publish_time, sequence))
        position += length
    return records
