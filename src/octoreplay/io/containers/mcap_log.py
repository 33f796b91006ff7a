"""MCAP files, whole or cut: an index of blocks of records, and lazy reading in log-time order.

The index comes from the file's summary where that is complete, else from one pass over the file. Format:
https://mcap.dev/spec
"""

from __future__ import annotations

import io
import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import IO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex
from mcap.records import Schema as SchemaRecord
from mcap.summary import Summary

from octoreplay.errors import InputError
from octoreplay.io.containers.block_log import Block, BlockLog, Entry, Index
from octoreplay.io.containers.log_reader import Bytes, Channel, normalise_type_name

MAGIC = b"\x89MCAP0\r\n"

# The forms of a block: a chunk's record without its head, or whole records outside chunks.
_CHUNK, _LOOSE = "chunk", "loose"
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
# Records outside chunks are read in blocks of about this size, so that no log is held as a whole.
_LOOSE_BLOCK_BYTES = 1 << 20
_UNREADABLE = (McapError, struct.error, ValueError, KeyError, OverflowError, MemoryError, OSError)
_UNDECOMPRESSABLE = (zstandard.ZstdError, RuntimeError, EOFError, ValueError, OverflowError, MemoryError)


@dataclass
class _McapIndex(Index):
    """The index of an MCAP file, with its schemas and channels."""

    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)


class McapLog(BlockLog):
    """An MCAP file. A cut file gives everything whole before the cut, and ``damage`` says so.

    Raises InputError where the file is no MCAP or cannot be opened.
    """

    def _read_index(self) -> tuple[Index, Mapping[int, Channel]]:
        """The index and the channels: from the summary, else from one pass over the file."""
        if self._file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{self.path}: not an MCAP file")
        index = _index_from_summary(self._file) or _index_from_pass(self._file)
        channels = {i: _channel(record, index.schemas.get(record.schema_id)) for i, record in index.channels.items()}
        return index, channels

    def _read_block(self, block: Block, data: bytes, wanted: Collection[int]) -> Iterator[Entry]:
        """The messages of the wanted channels in a chunk or in a run of records."""
        records: Bytes = data
        if block.form == _CHUNK:
            records, intact = _chunk_records(memoryview(data))
            if not intact and self._index.damage is None:
                what = "is damaged or compressed in an unknown way"
                self._note_damage(f"the chunk at byte {block.offset} {what}; its messages are left out")
                return
        for opcode, start, end in _walk(records):
            if opcode == Opcode.MESSAGE and end - start >= _MESSAGE_HEAD.size:
                channel_id, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(records, start)
                if channel_id in wanted:
                    yield log_time_ns, block.offset, start + _MESSAGE_HEAD.size, end, channel_id, records


def _channel(record: ChannelRecord, schema: SchemaRecord | None) -> Channel:
    """A channel with its type's definition as the file gives it."""
    if schema is None:
        return Channel(record.topic, "", record.message_encoding, "", "")
    is_text = schema.encoding in ("ros1msg", "ros2msg", "ros2idl")
    definition = schema.data.decode("utf-8", "replace") if is_text else ""
    name = normalise_type_name(schema.name) if is_text else schema.name
    return Channel(record.topic, name, record.message_encoding, schema.encoding, definition)


def _index_from_summary(file: IO[bytes]) -> _McapIndex | None:
    """The index that the file's summary holds; None where it has none, or one that leaves something out."""
    try:
        file.seek(0)
        summary = SeekingReader(file).get_summary()
    except _UNREADABLE:
        return None
    if summary is None or summary.statistics is None:
        return None
    statistics = summary.statistics
    counts = dict(statistics.channel_message_counts)
    if not _is_complete(summary, counts):
        return None
    size = file.seek(0, io.SEEK_END)
    if any(chunk.chunk_start_offset + chunk.chunk_length > size for chunk in summary.chunk_indexes):
        return None
    blocks = [_indexed_block(chunk) for chunk in summary.chunk_indexes]
    used = statistics.message_count > 0
    return _McapIndex(
        schemas=dict(summary.schemas),
        channels=dict(summary.channels),
        counts=counts,
        blocks=blocks,
        start_ns=statistics.message_start_time if used else None,
        end_ns=statistics.message_end_time if used else None,
    )


def _is_complete(summary: Summary, counts: dict[int, int]) -> bool:
    """True where the summary names every chunk, channel and schema, and counts every message."""
    statistics = summary.statistics
    if statistics is None:
        return False
    indexed = {channel_id for chunk in summary.chunk_indexes for channel_id in chunk.message_index_offsets}
    return bool(
        len(summary.chunk_indexes) == statistics.chunk_count
        and len(summary.channels) == statistics.channel_count
        and (statistics.chunk_count > 0 or statistics.message_count == 0)
        and sum(counts.values()) == statistics.message_count
        and summary.channels.keys() >= indexed | counts.keys()
        and all(c.schema_id == 0 or c.schema_id in summary.schemas for c in summary.channels.values())
    )


def _indexed_block(chunk: ChunkIndex) -> Block:
    """A chunk as its index record describes it; without message offsets it may hold any channel."""
    channel_ids = frozenset(chunk.message_index_offsets) or None
    head = _RECORD_HEAD.size
    return Block(
        chunk.chunk_start_offset + head, chunk.chunk_length - head, _CHUNK, chunk.message_start_time, channel_ids
    )


def _index_from_pass(file: IO[bytes]) -> _McapIndex:
    """The index of a file without a usable summary, from one pass over its data section."""
    index = _McapIndex()
    size = file.seek(0, io.SEEK_END)
    position = file.seek(len(MAGIC))
    loose = _LooseRun(index)
    while True:
        head = file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            index.damage = "cut before its end; everything whole before the cut is used"
            break
        opcode, length = _RECORD_HEAD.unpack(head)
        body_start = position + _RECORD_HEAD.size
        is_cut = body_start + length > size
        if opcode == 0 or (is_cut and opcode != Opcode.CHUNK):
            index.damage = f"cut or damaged at byte {position}; everything whole before it is used"
            break
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            if index.damage is None and not _ends_well(file):
                index.damage = "cut after its last message (the end of the file is missing)"
            break
        if opcode == Opcode.CHUNK:
            loose.close()
            body = file.read(min(length, size - body_start))
            if not _take_chunk(index, body_start, body) and not is_cut:
                index.damage = (
                    f"the chunk at byte {position} is damaged or compressed in an unknown way; what can be read is used"
                )
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            loose.take(opcode, position, file.read(length))
        position = file.seek(min(body_start + length, size))
    loose.close()
    return index


def _ends_well(file: IO[bytes]) -> bool:
    """True where the file ends with the magic bytes."""
    file.seek(-len(MAGIC), io.SEEK_END)
    return file.read() == MAGIC


class _LooseRun:
    """Gathers records outside chunks into blocks while a file is passed over."""

    def __init__(self, index: _McapIndex) -> None:
        self._index = index
        self._start: int | None = None
        self._end = 0
        self._start_ns: int | None = None
        self._channel_ids: set[int] = set()

    def take(self, opcode: int, position: int, body: bytes) -> None:
        """Take one whole record that starts at a byte of the file."""
        log_time, channel_id = _take_record(self._index, opcode, body)
        if log_time is None or channel_id is None:
            return
        if self._start is None:
            self._start = position
        self._end = position + _RECORD_HEAD.size + len(body)
        self._start_ns = log_time if self._start_ns is None else min(self._start_ns, log_time)
        self._channel_ids.add(channel_id)
        if self._end - self._start >= _LOOSE_BLOCK_BYTES:
            self.close()

    def close(self) -> None:
        """End the block; the next record begins another."""
        if self._start is not None and self._start_ns is not None:
            self._index.blocks.append(
                Block(self._start, self._end - self._start, _LOOSE, self._start_ns, frozenset(self._channel_ids))
            )
        self._start = self._start_ns = None
        self._channel_ids = set()


def _take_chunk(index: _McapIndex, offset: int, body: bytes) -> bool:
    """Add one chunk's block and what it declares; False where it is damaged (what is whole in it is taken)."""
    records, intact = _chunk_records(memoryview(body))
    start_ns: int | None = None
    channel_ids = set()
    for opcode, start, end in _walk(records):
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            continue
        log_time, channel_id = _take_record(index, opcode, memoryview(records)[start:end])
        if log_time is not None and channel_id is not None:
            start_ns = log_time if start_ns is None else min(start_ns, log_time)
            channel_ids.add(channel_id)
    if start_ns is not None:
        index.blocks.append(Block(offset, len(body), _CHUNK, start_ns, frozenset(channel_ids)))
    return intact


def _take_record(index: _McapIndex, opcode: int, body: Bytes) -> tuple[int | None, int | None]:
    """Add a schema, a channel or a message's count; (log time, channel id) of a message of a known channel."""
    if opcode == Opcode.MESSAGE:
        if len(body) < _MESSAGE_HEAD.size:
            return None, None
        channel_id, _, log_time, _ = _MESSAGE_HEAD.unpack_from(body)
        if channel_id not in index.channels:
            return None, None
        index.count(channel_id, log_time)
        return log_time, channel_id
    try:
        if opcode == Opcode.SCHEMA:
            schema = SchemaRecord.read(ReadDataStream(io.BytesIO(body)))
            index.schemas[schema.id] = schema
        else:
            channel = ChannelRecord.read(ReadDataStream(io.BytesIO(body)))
            index.channels[channel.id] = channel
    except _UNREADABLE:
        return None, None
    return None, None


def _chunk_records(body: memoryview) -> tuple[Bytes, bool]:
    """A chunk's records, decompressed as far as they are there, and whether they are all there."""
    try:
        _, _, size, _ = _CHUNK_HEAD.unpack_from(body)
        position = _CHUNK_HEAD.size
        (name_length,) = struct.unpack_from("<I", body, position)
        compression = bytes(body[position + 4 : position + 4 + name_length]).decode()
        (length,) = struct.unpack_from("<Q", body, position + 4 + name_length)
    except (struct.error, UnicodeDecodeError):
        return b"", False
    start = position + 12 + name_length
    data = body[start : start + length]
    try:
        records = _decompress(compression, data, size)
    except _UNDECOMPRESSABLE:
        records = b""
    return records, len(data) == length and len(records) == size


def _decompress(compression: str, data: memoryview, size: int) -> Bytes:
    """The bytes of a chunk; those of a cut chunk as far as they go."""
    if compression == "":
        return data
    if compression == "zstd":
        # One call for a whole frame; the streaming object also gives what a cut frame still holds.
        try:
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        except zstandard.ZstdError:
            return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data))
    raise ValueError(f"unknown compression {compression}")


def _walk(records: Bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, start, end) of each whole record in a run of records."""
    position, size = 0, len(records)
    while position + _RECORD_HEAD.size <= size:
        opcode, length = _RECORD_HEAD.unpack_from(records, position)
        start = position + _RECORD_HEAD.size
        position = start + length
        if position > size:
            return
        yield opcode, start, position
