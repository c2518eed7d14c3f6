"""Read an mcap file front to back, as far as it goes, without trusting its index.

A recorder that was killed leaves a file without summary and footer, often with half a chunk at its
end. Everything before the cut is intact, and most of the half chunk can be unpacked.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.stores import Stores

from bags.skips import Skips
from lcd_common.errors import DataError

_MAGIC = b'\x89MCAP0\r\n'
_READ: dict[int, Callable[[ReadDataStream, int], McapRecord]] = {
    Opcode.SCHEMA: lambda stream, length: Schema.read(stream),
    Opcode.CHANNEL: lambda stream, length: Channel.read(stream),
    Opcode.MESSAGE: Message.read,
    Opcode.CHUNK: lambda stream, length: Chunk.read(stream),
}
_DAMAGE = (McapError, struct.error, ValueError, OverflowError, MemoryError)
# A longer one that runs past the end of the file is not cut off: its length is damaged.
_LARGEST_CHUNK = 2**30
_RECORD_HEADER = struct.Struct('<BQ')


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
        """Yield the records outside of chunks and the chunks; the last chunk may lack its end."""
        size = self.path.stat().st_size
        with self.path.open('rb') as file:
            at = len(_MAGIC) if file.read(len(_MAGIC)) == _MAGIC else size
            while at + _RECORD_HEADER.size <= size:
                opcode, length = _RECORD_HEADER.unpack(file.read(_RECORD_HEADER.size))
                at += _RECORD_HEADER.size + length
                if opcode == Opcode.DATA_END:
                    return
                whole = at <= size
                cut_chunk = opcode == Opcode.CHUNK and length < _LARGEST_CHUNK
                if opcode in _READ and (whole or cut_chunk):
                    payload = file.read(length)
                    try:
                        yield _READ[opcode](ReadDataStream(BytesIO(payload)), len(payload))
                    except _DAMAGE:
                        break
                file.seek(min(at, size))
        self._skips.add(
            'bag cut off: the rest of the file',
            self.path,
            f'{self.path}: cut off or damaged at byte {min(at, size)}; what comes before is read',
        )

    def _unpack(self, chunk: Chunk) -> list[McapRecord]:
        """Return a chunk's records; of one that is cut off or damaged, those before the damage."""
        try:
            data = _decompressed(chunk)
            complete = len(data) == chunk.uncompressed_size  # else cut off, which is counted
            if complete and chunk.uncompressed_crc not in (0, zlib.crc32(data)):
                raise ValueError('its checksum does not fit')
            whole = _whole_records(data)
            if complete and len(whole) < len(data):
                self._count_damage(
                    chunk, f'{len(whole)} of {chunk.uncompressed_size} bytes are read'
                )
            return breakup_chunk(replace(chunk, compression='', data=whole))
        except (zstandard.ZstdError, RuntimeError, *_DAMAGE) as error:
            self._count_damage(chunk, str(error))
            return []

    def _count_damage(self, chunk: Chunk, why: str) -> None:
        self._skips.add(
            'damaged chunk of a bag',
            (self.path, chunk.message_start_time),
            f'{self.path}: the chunk from {chunk.message_start_time} is damaged: {why}',
        )

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


def _decompressed(chunk: Chunk) -> bytes:
    """Return what a chunk holds, or its beginning when its end is missing."""
    if chunk.compression == 'zstd':
        return zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
    if chunk.compression == 'lz4':
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data))
    return chunk.data


def _whole_records(data: bytes) -> bytes:
    """Return the beginning of a chunk up to the last record that is whole."""
    end = 0
    while end + _RECORD_HEADER.size <= len(data):
        _, length = _RECORD_HEADER.unpack_from(data, end)
        if end + _RECORD_HEADER.size + length > len(data):
            break
        end += _RECORD_HEADER.size + length
    return data[:end]
