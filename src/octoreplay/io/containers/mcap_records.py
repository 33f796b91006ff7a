"""Parsing of MCAP records: record headers, sequences of records and chunks.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex, Statistics
from mcap.records import Schema as SchemaRecord

from octoreplay.io.containers.decompression import ContentBudget, decompress, is_plausible_size
from octoreplay.io.containers.log_reader import Channel, normalise_type_name
from octoreplay.io.messages.decoders import ROS_FORMATS, Bytes

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
FOOTER = struct.Struct("<QQI")
MAX_TIME_NS = (1 << 63) - 1
"""Greatest log time accepted [ns] (year 2262). MCAP stores unsigned times, which may exceed int64."""
CRC_KEY = "crc32"
"""Last key of a metadata record that octoreplay writes: its checksum, see ``metadata_crc``."""
_CHUNK_HEAD = struct.Struct("<QQQII")
_INDEX_HEAD = struct.Struct("<HI")
_READERS: dict[int, Any] = {
    Opcode.SCHEMA: SchemaRecord, Opcode.CHANNEL: ChannelRecord, Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.STATISTICS: Statistics,
}  # fmt: skip
_UNREADABLE = (McapError, struct.error, ValueError, OverflowError, MemoryError)

Record: TypeAlias = SchemaRecord | ChannelRecord | ChunkIndex | Statistics


class Definitions:
    """Schemas and channels of a file, collected record by record."""

    def __init__(self) -> None:
        self.schemas: dict[int, SchemaRecord] = {}
        self.channels: dict[int, ChannelRecord] = {}

    def add(self, opcode: int, body: Bytes, *, is_certain: bool = True) -> None:
        """Add a schema or a channel; other records and damaged ones are ignored.

        A record that is not certain, because it was found in a damaged part, holds until a certain one with its id is
        added.
        """
        record = read_record(opcode, body)
        if isinstance(record, SchemaRecord) and (is_certain or record.id not in self.schemas):
            self.schemas[record.id] = record
        elif isinstance(record, ChannelRecord) and (is_certain or record.id not in self.channels):
            self.channels[record.id] = record

    def resolved(self) -> dict[int, Channel]:
        """Return the channels by id, with the definitions of their types."""
        return {i: _channel(record, self.schemas.get(record.schema_id)) for i, record in self.channels.items()}


class ChunkHead(NamedTuple):
    """Header of a chunk.

    ``size`` and ``crc`` are length [bytes] and CRC-32 of the uncompressed records (0: no checksum). ``start`` and
    ``length`` [bytes] locate the compressed records within the chunk's body.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    start: int
    length: int


def metadata_crc(name: str, values: Mapping[str, str]) -> str:
    """Return the checksum of a metadata record as 8 hexadecimal digits.

    It is the CRC-32 of the name and of all keys and values but ``CRC_KEY`` in their order, each in UTF-8 and followed
    by a zero byte. MCAP has no checksum of a metadata record alone.
    """
    pairs = (part for key, value in values.items() if key != CRC_KEY for part in (key, value))
    return f"{isal_zlib.crc32(b''.join(part.encode() + bytes(1) for part in (name, *pairs))):08x}"


def read_record(opcode: int, body: Bytes) -> Record | None:
    """Parse a schema, channel, chunk index or statistics record; None for other records and damaged ones."""
    if opcode not in _READERS:
        return None
    try:
        record: Record = _READERS[opcode].read(ReadDataStream(io.BytesIO(body)))
    except _UNREADABLE:
        return None
    return record


def walk(records: Bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of each complete record; start and end delimit its body."""
    position, size = 0, len(records)
    while position + RECORD_HEAD.size <= size:
        opcode, length = RECORD_HEAD.unpack_from(records, position)
        start = position + RECORD_HEAD.size
        position = start + length
        if position > size:
            return
        yield opcode, start, position


def chunk_head(body: Bytes) -> ChunkHead | None:
    """Parse the header of a chunk; None where its sizes contradict each other or the compression is unknown."""
    if len(body) < _CHUNK_HEAD.size:
        return None
    start_ns, end_ns, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
    start = _CHUNK_HEAD.size + name_length + 8
    if name_length > 4 or len(body) < start:
        return None
    compression = bytes(body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name_length]).decode("ascii", "replace")
    length = int.from_bytes(body[start - 8 : start], "little")
    if not is_plausible_size(compression, length, size):
        return None
    return ChunkHead(start_ns, end_ns, size, crc, compression, start, length)


def whole_records(body: Bytes, budget: ContentBudget | None = None) -> Bytes | None:
    """Return the records of a chunk, which are taken from ``budget``.

    The result is None where the chunk's sizes or its checksum, if it has one, do not match.
    """
    head = chunk_head(body)
    if head is None or head.start + head.length != len(body):
        return None
    if budget is not None:
        budget.take(head.size)
    records = decompress(head.compression, memoryview(body)[head.start :], head.size)
    is_whole = len(records) == head.size and (head.crc == 0 or isal_zlib.crc32(records) == head.crc)
    return records if is_whole else None


def cut_records(body: Bytes, budget: ContentBudget) -> Bytes:
    """Return the records of a chunk that is cut, up to where they can be decompressed; they are taken from a budget."""
    head = chunk_head(body)
    if head is None:
        return b""
    records = decompress(head.compression, memoryview(body)[head.start :], head.size)
    budget.take(len(records))
    return records


def num_indexed(head: Bytes, length: int) -> int:
    """Return the number of messages in a message index record, from its first 6 bytes and its length [bytes]."""
    if len(head) < _INDEX_HEAD.size:
        return 0
    _, num_bytes = _INDEX_HEAD.unpack_from(head)
    return int(num_bytes) // 16 if int(num_bytes) == length - _INDEX_HEAD.size else 0


def _channel(record: ChannelRecord, schema: SchemaRecord | None) -> Channel:
    """Return a channel with the definition of its type."""
    if schema is None:
        return Channel(record.topic, "", record.message_encoding, "", b"")
    name = normalise_type_name(schema.name) if schema.encoding in ROS_FORMATS else schema.name
    return Channel(record.topic, name, record.message_encoding, schema.encoding, schema.data)
