"""Parsing of the records of ROS 1 bags: record headers, sequences of records and chunks.

Format: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from typing import IO, NamedTuple

from octoreplay.io.containers.decompression import ContentBudget, decompress, is_plausible_size
from octoreplay.io.containers.log_reader import Channel, normalise_type_name
from octoreplay.io.messages.decoders import Bytes

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX_DATA, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
_MAX_HEAD_BYTES = 1 << 20
_UINT32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
# The fields of a message's header, in any order. Headers of other records are longer.
_MESSAGE_HEAD = re.compile(
    rb"(?:\x04\0\0\0op=\x02|\x09\0\0\0conn=(?P<conn>.{4})|\x0d\0\0\0time=(?P<time>.{8})){3}", re.DOTALL
)


class RecordHead(NamedTuple):
    """Header of a record: its fields, and start and length of the record's data in the file [bytes]."""

    fields: Mapping[str, bytes]
    start: int
    length: int

    @property
    def operation(self) -> int:
        """Kind of the record, its field ``op``; -1 where it is missing."""
        value = self.fields.get("op", b"")
        return value[0] if len(value) == 1 else -1

    @property
    def end(self) -> int:
        """End of the record's data."""
        return self.start + self.length

    def number(self, name: str) -> int:
        """Return a field as an unsigned number; -1 where it is missing."""
        value = self.fields.get(name)
        return -1 if value is None else int.from_bytes(value, "little")


def read_head(file: IO[bytes], position: int, limit: int) -> RecordHead | None:
    """Read the header of the record at a byte; None where it is damaged or ends after ``limit``. The data may."""
    file.seek(position)
    head_length = int.from_bytes(file.read(4), "little")
    start = position + 4 + head_length + 4
    if head_length > _MAX_HEAD_BYTES or start > limit:
        return None
    fields = fields_of(file.read(head_length))
    length_bytes = file.read(4)
    if fields is None or "op" not in fields or len(length_bytes) < 4:
        return None
    return RecordHead(fields, start, int.from_bytes(length_bytes, "little"))


def fields_of(head: Bytes) -> dict[str, bytes] | None:
    """Return the fields ``name=value`` of a record header; None where it is damaged."""
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(head):
        if position + 4 > len(head):
            return None
        (length,) = _UINT32.unpack_from(head, position)
        name, separator, value = bytes(head[position + 4 : position + 4 + length]).partition(b"=")
        position += 4 + length
        if position > len(head) or not separator:
            return None
        fields[name.decode("ascii", "replace")] = value
    return fields


def walk(records: Bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (start of the header, start of the data, end) of each complete record in a chunk."""
    position, size = 0, len(records)
    while position + 4 <= size:
        (head_length,) = _UINT32.unpack_from(records, position)
        start = position + 4 + head_length + 4
        if start > size:
            return
        end = start + _UINT32.unpack_from(records, start - 4)[0]
        if end > size:
            return
        yield position + 4, start, end
        position = end


def message_head(records: Bytes, start: int, end: int) -> tuple[int, int] | None:
    """Return (connection, log time [ns]) of a message's header between two bytes; None for other headers."""
    match = _MESSAGE_HEAD.fullmatch(records, start, end)
    if match is None or match["conn"] is None or match["time"] is None:
        return None
    sec, nanosec = _TIME.unpack(match["time"])
    return _UINT32.unpack(match["conn"])[0], sec * 1_000_000_000 + nanosec


def walk_messages(records: Bytes, budget: ContentBudget) -> Iterator[tuple[int, int, int, int]]:
    """Yield (connection, log time [ns], start, end) of each complete message in a chunk; records take a budget."""
    for head_start, start, end in budget.counted(walk(records)):
        message = message_head(records, head_start, start - 4)
        if message is not None:
            yield *message, start, end


def whole_records(head: RecordHead, data: bytes, budget: ContentBudget) -> Bytes | None:
    """Return the records of a chunk; None for another record, or where its sizes do not match."""
    if head.operation != CHUNK or len(data) != head.length:
        return None
    compression, size = head.fields.get("compression", b"").decode("ascii", "replace"), head.number("size")
    if not compression or not is_plausible_size(compression, len(data), size):
        return None
    records = decompress(compression, memoryview(data), size)
    budget.take(len(records))
    return records if len(records) == size else None


def cut_records(head: RecordHead, data: bytes, budget: ContentBudget) -> Bytes:
    """Return the records of a chunk that is cut, up to where they can be decompressed."""
    compression = head.fields.get("compression", b"").decode("ascii", "replace")
    records = decompress(compression, memoryview(data), max(0, head.number("size")))
    budget.take(len(records))
    return records


def channel_of(fields: Mapping[str, bytes], data: Bytes) -> Channel | None:
    """Return the channel given by a connection record's fields and data; None where it is damaged."""
    details = fields_of(data)
    if details is None or len(fields.get("conn", b"")) != 4:
        return None
    topic = fields.get("topic", details.get("topic", b"")).decode("utf-8", "replace")
    type_name = normalise_type_name(details.get("type", b"").decode("utf-8", "replace"))
    definition = details.get("message_definition", b"")
    return Channel(_single_slashes(topic), type_name, "ros1", "ros1msg", definition)


def _single_slashes(topic: str) -> str:
    """Return a topic's name without repeated and trailing slashes."""
    return "/" * topic.startswith("/") + "/".join(part for part in topic.split("/") if part)
