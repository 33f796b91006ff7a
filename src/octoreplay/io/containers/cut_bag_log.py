"""ROS 1 bags whose index is missing, as recordings that were cut off leave them: read by one pass over the file.

Format: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import bz2
import io
import struct
from collections.abc import Collection, Iterator, Mapping

import lz4.frame

from octoreplay.io.containers.block_log import Block, BlockLog, Entry, Index
from octoreplay.io.containers.log_reader import Bytes, Channel, normalise_type_name

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = 0x02, 0x05, 0x07
_UNDECOMPRESSABLE = (OSError, RuntimeError, EOFError, ValueError, KeyError)


class CutBagLog(BlockLog):
    """A ROS 1 bag without a usable index: everything whole before the cut; ``damage`` always says so."""

    def _read_index(self) -> tuple[Index, Mapping[int, Channel]]:
        """The index and the channels, from one pass over the file."""
        index = Index(damage="the bag has no index, as after a cut; everything whole before the cut is used")
        channels: dict[int, Channel] = {}
        size = self._file.seek(0, io.SEEK_END)
        self._file.seek(len(_MAGIC))
        while (head := self._read_head(size)) is not None:
            fields, length = head
            start = self._file.tell()
            data = self._file.read(min(length, size - start)) if _operation(fields) in (_CHUNK, _CONNECTION) else b""
            if _operation(fields) == _CONNECTION and len(data) == length:
                _take_connection(channels, fields, data)
            elif _operation(fields) == _CHUNK:
                _take_chunk(index, channels, start, fields.get("compression", b"").decode("ascii", "replace"), data)
            self._file.seek(min(start + length, size))
        return index, channels

    def _read_head(self, size: int) -> tuple[dict[str, bytes], int] | None:
        """The fields of the next record's head and the length of its data; None where no whole head follows."""
        length_bytes = self._file.read(4)
        head_length = int.from_bytes(length_bytes, "little")
        if len(length_bytes) < 4 or self._file.tell() + head_length + 4 > size:
            return None
        fields = _fields(self._file.read(head_length))
        return None if fields is None else (fields, int.from_bytes(self._file.read(4), "little"))

    def _read_block(self, block: Block, data: bytes, wanted: Collection[int]) -> Iterator[Entry]:
        """The messages of the wanted connections in a chunk."""
        records = _decompress(block.form, data)
        for fields, start, end in _walk(records):
            message = _message_of(fields)
            if message is not None and message[0] in wanted:
                yield message[1], block.offset, start, end, message[0], records


def _take_chunk(index: Index, channels: dict[int, Channel], offset: int, compression: str, data: bytes) -> None:
    """Add one chunk's block and connections, and count its messages."""
    start_ns: int | None = None
    channel_ids = set()
    records = _decompress(compression, data)
    for fields, start, end in _walk(records):
        if _operation(fields) == _CONNECTION:
            _take_connection(channels, fields, records[start:end])
        message = _message_of(fields)
        if message is not None and message[0] in channels:
            index.count(*message)
            channel_ids.add(message[0])
            start_ns = message[1] if start_ns is None else min(start_ns, message[1])
    if start_ns is not None:
        index.blocks.append(Block(offset, len(data), compression, start_ns, frozenset(channel_ids)))


def _take_connection(channels: dict[int, Channel], fields: Mapping[str, bytes], data: bytes) -> None:
    """Add a connection record's channel."""
    details = _fields(data)
    if details is None or "conn" not in fields or len(fields["conn"]) != 4:
        return
    topic = fields.get("topic", details.get("topic", b"")).decode("utf-8", "replace")
    type_name = normalise_type_name(details.get("type", b"").decode("utf-8", "replace"))
    definition = details.get("message_definition", b"").decode("utf-8", "replace")
    channels[int.from_bytes(fields["conn"], "little")] = Channel(topic, type_name, "ros1", "ros1msg", definition)


def _message_of(fields: Mapping[str, bytes]) -> tuple[int, int] | None:
    """(connection, log time in nanoseconds) of a message record's fields; None for any other record."""
    if _operation(fields) != _MESSAGE or len(fields.get("time", b"")) != 8 or len(fields.get("conn", b"")) != 4:
        return None
    sec, nanosec = struct.unpack("<II", fields["time"])
    return int.from_bytes(fields["conn"], "little"), sec * 1_000_000_000 + nanosec


def _operation(fields: Mapping[str, bytes]) -> int:
    """What kind of record it is; -1 where it does not say."""
    return fields["op"][0] if fields.get("op") else -1


def _decompress(compression: str, data: bytes) -> bytes:
    """A chunk's records as far as they can be decompressed."""
    if compression == "none":
        return data
    try:
        if compression == "bz2":
            return bz2.BZ2Decompressor().decompress(data)
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data))
    except _UNDECOMPRESSABLE:
        return b""
    return b""


def _walk(records: Bytes) -> Iterator[tuple[dict[str, bytes], int, int]]:
    """(fields of the head, start, end) of each whole record in a chunk."""
    position, size = 0, len(records)
    while position + 4 <= size:
        (head_length,) = struct.unpack_from("<I", records, position)
        start = position + 4 + head_length + 4
        fields = _fields(bytes(records[position + 4 : start - 4])) if start <= size else None
        if fields is None:
            return
        (length,) = struct.unpack_from("<I", records, start - 4)
        position = start + length
        if position > size:
            return
        yield fields, start, position


def _fields(head: bytes) -> dict[str, bytes] | None:
    """The fields ``name=value`` of a record's head; None where it is damaged."""
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(head):
        if position + 4 > len(head):
            return None
        (length,) = struct.unpack_from("<I", head, position)
        name, separator, value = head[position + 4 : position + 4 + length].partition(b"=")
        position += 4 + length
        if position > len(head) or not separator:
            return None
        fields[name.decode("ascii", "replace")] = value
    return fields
