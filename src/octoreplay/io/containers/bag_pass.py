"""The index of a ROS 1 bag whose own is missing or damaged, from one pass that finds its way after damage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import IO

from octoreplay.io.containers.bag_records import (
    CHUNK,
    CONNECTION,
    INDEX_DATA,
    MAGIC,
    MESSAGE,
    RecordHead,
    channel_of,
    cut_records,
    fields_of,
    message_head,
    read_head,
    walk,
    whole_records,
)  # fmt: skip
from octoreplay.io.containers.block_log import BlockBuilder, Index
from octoreplay.io.containers.damage import Damage
from octoreplay.io.containers.decompression import MAX_CHUNK_BYTES
from octoreplay.io.messages.decoders import Bytes

CUT_CHUNK = "cut chunk"
"""The form of a block that is a chunk as far as the file goes."""
_OPERATIONS = range(MESSAGE, CONNECTION + 1)
_WINDOW_BYTES = 1 << 20
_MAX_DEFINITION_BYTES = 1 << 26
# A chunk's head holds this field among two others, of 13 bytes (size) and of 19 or 20 (compression).
_CHUNK_FIELD = b"\x04\0\0\0op=\x05"
_FIELDS_BEFORE = (0, 13, 19, 20, 32, 33)
_CHUNK_FIELDS = {"op", "compression", "size"}


class BagPass:
    """One pass over a bag's records. What is no record is passed over up to the next chunk that is whole."""

    def __init__(self, file: IO[bytes], size: int, damage: Damage) -> None:
        self._file = file
        self._size = size
        self._damage = damage
        self._index = Index()
        # From where on to search after damage: a whole chunk is as long as it says, but of any other record that was
        # taken the length may be what is damaged.
        self._floor = len(MAGIC)
        self._broken_chunk: tuple[int, int] | None = None
        # Searching may read chunks in vain; more than this, and the file was made to be searched for ever.
        self._budget = 8 * size + MAX_CHUNK_BYTES

    def index(self) -> Index:
        """The index; what was passed over is noted as damage."""
        self._damage.note("the bag has no index, as after a cut")
        position = len(MAGIC)
        while position < self._size:
            end = self._take(position)
            if end is None:
                found = self._search(self._floor)
                if found is None:
                    self._take_rest(position)
                    break
                self._damage.skip("part", position, None)
                end = found
            position = end
        self._damage.lose(0, self._index.tally.drop_unknown(self._index.channels))
        return self._index

    def _take(self, position: int) -> int | None:
        """Take the record at a byte; returns where it ends, None where there is no whole record."""
        head = read_head(self._file, position, self._size)
        if head is None or head.operation not in _OPERATIONS or head.end > self._size:
            return None
        self._floor = position + 1
        if head.operation == CHUNK:
            return self._take_chunk(position, head)
        if head.operation == CONNECTION:
            self._take_connection(head.fields, self._file.read(min(head.length, _MAX_DEFINITION_BYTES)))
        elif head.operation == INDEX_DATA and self._broken_chunk is not None:
            offset, count = self._broken_chunk
            self._broken_chunk = offset, count + max(0, head.number("count"))
            self._damage.skip("chunk", *self._broken_chunk)
        return head.end

    def _take_chunk(self, position: int, head: RecordHead) -> int | None:
        """Take a chunk's messages; a damaged one is left out where the next record shows that its length is right."""
        self._broken_chunk = None
        records = whole_records(head, self._file.read(head.length))
        if records is not None:
            self._take_records(records, position, head.end - position, "")
            self._floor = head.end
            return head.end
        following = read_head(self._file, head.end, self._size)
        if head.end < self._size and (following is None or following.operation not in _OPERATIONS):
            return None
        self._damage.skip("chunk", position, None)
        self._broken_chunk = position, 0
        return head.end

    def _take_records(self, records: Bytes, offset: int, length: int, form: str) -> None:
        """Add a chunk's block and connections, and count its messages."""
        builder = BlockBuilder(self._index.tally)
        end = 0
        for head_start, start, end in walk(records):
            message = message_head(records, head_start, start - 4)
            if message is not None:
                builder.add(*message)
                continue
            fields = fields_of(records[head_start : start - 4])
            if fields is not None and RecordHead(fields, start, end - start).operation == CONNECTION:
                self._take_connection(fields, records[start:end])
        self._index.blocks += builder.build(offset, length, form)
        if end < len(records) and not form:
            self._damage.skip("part", offset, None)

    def _take_connection(self, fields: Mapping[str, bytes], data: Bytes) -> None:
        """Add a connection record's channel."""
        channel = channel_of(fields, data)
        if channel is not None:
            self._index.channels[int.from_bytes(fields["conn"], "little")] = channel

    def _take_rest(self, position: int) -> None:
        """Take the whole messages of a last chunk that is cut; note what is none."""
        head = read_head(self._file, position, self._size)
        if head is not None and head.operation == CHUNK and head.end > self._size:
            length = min(self._size - position, MAX_CHUNK_BYTES)
            self._take_records(cut_records(head, self._file.read(length)), position, length, CUT_CHUNK)

    def _search(self, start: int) -> int | None:
        """The first byte from a place on at which a whole chunk stands; None where there is none."""
        overlap = len(_CHUNK_FIELD) - 1
        for window_start in range(start, self._size, _WINDOW_BYTES):
            self._file.seek(window_start)
            window = self._file.read(_WINDOW_BYTES + overlap)
            place = window.find(_CHUNK_FIELD)
            while place >= 0 and self._budget >= 0:
                for before in _FIELDS_BEFORE:
                    position = window_start + place - before - 4
                    if position >= start and self._is_whole_chunk(position):
                        return position
                place = window.find(_CHUNK_FIELD, place + 1)
        return None

    def _is_whole_chunk(self, position: int) -> bool:
        """True where a chunk stands at a byte whose sizes fit."""
        head = read_head(self._file, position, self._size)
        if head is None or head.fields.keys() != _CHUNK_FIELDS or head.end > self._size:
            return False
        self._budget -= head.length + head.number("size")
        return whole_records(head, self._file.read(head.length)) is not None
