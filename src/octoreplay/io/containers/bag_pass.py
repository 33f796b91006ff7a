"""Index of a ROS 1 bag whose own index is missing or damaged, built in one pass that resumes after damage."""

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
from octoreplay.io.containers.block_log import CUT_CHUNK, BlockBuilder, Index
from octoreplay.io.containers.damage import Damage
from octoreplay.io.containers.decompression import MAX_CHUNK_BYTES, ContentBudget
from octoreplay.io.messages.decoders import Bytes

_OPERATIONS = range(MESSAGE, CONNECTION + 1)
_WINDOW_BYTES = 1 << 20
_MAX_DEFINITION_BYTES = 1 << 26
# The header of a chunk holds this field and two others in any order: size (13 bytes), compression (19 or 20 bytes).
_CHUNK_FIELD = b"\x04\0\0\0op=\x05"
_FIELDS_BEFORE = (0, 13, 19, 20, 32, 33)
_CHUNK_FIELDS = {"op", "compression", "size"}


class BagPass:
    """Builds the index of a bag in one pass over its records. After damage it resumes at the next intact chunk."""

    def __init__(self, file: IO[bytes], size: int, damage: Damage, content: ContentBudget) -> None:
        self._file = file
        self._size = size
        self._damage = damage
        self._index = Index()
        self._content = content
        # Where a search after damage begins. The length of an intact chunk is certain, that of other records is not:
        # it may itself be damaged.
        self._floor = len(MAGIC)
        self._broken_chunk: tuple[int, int] | None = None
        # Bytes that searches may read. It bounds the time taken by files made to look like many damaged chunks.
        self._budget = 8 * size + MAX_CHUNK_BYTES

    def index(self) -> Index:
        """Return the index; bytes that were skipped are recorded as damage."""
        self._damage.note("the bag has no index, as after a cut")
        position = len(MAGIC)
        while position < self._size:
            end = self._read_record(position)
            if end is None:
                found = self._search(self._floor)
                if found is None:
                    self._add_cut_chunk(position)
                    break
                self._damage.skip_part("part", position, None)
                end = found
            position = end
        self._damage.skip_messages(0, self._index.tally.drop_unknown(self._index.channels))
        return self._index

    def _read_record(self, position: int) -> int | None:
        """Read the record at a byte and return its end; None where there is no complete record."""
        head = read_head(self._file, position, self._size)
        if head is None or head.operation not in _OPERATIONS or head.end > self._size:
            return None
        self._floor = position + 1
        if head.operation == CHUNK:
            return self._read_chunk(position, head)
        if head.operation == CONNECTION:
            self._add_connection(head.fields, self._file.read(min(head.length, _MAX_DEFINITION_BYTES)))
        elif head.operation == INDEX_DATA and self._broken_chunk is not None:
            offset, count = self._broken_chunk
            self._broken_chunk = offset, count + max(0, head.number("count"))
            self._damage.skip_part("chunk", *self._broken_chunk)
        return head.end

    def _read_chunk(self, position: int, head: RecordHead) -> int | None:
        """Add a chunk and return its end; None where it is damaged and no record follows at its end."""
        self._broken_chunk = None
        records = whole_records(head, self._file.read(head.length), self._content)
        if records is not None:
            self._add_chunk(records, position, head.end - position, "")
            self._floor = head.end
            return head.end
        following = read_head(self._file, head.end, self._size)
        if head.end < self._size and (following is None or following.operation not in _OPERATIONS):
            return None
        self._damage.skip_part("chunk", position, None)
        self._broken_chunk = position, 0
        return head.end

    def _add_chunk(self, records: Bytes, offset: int, length: int, form: str) -> None:
        """Add the block of a chunk, its connections and the numbers of its messages."""
        builder = BlockBuilder(self._index.tally)
        end = 0
        for head_start, start, end in self._content.counted(walk(records)):
            message = message_head(records, head_start, start - 4)
            if message is not None:
                builder.add(*message)
                continue
            fields = fields_of(records[head_start : start - 4])
            if fields is not None and RecordHead(fields, start, end - start).operation == CONNECTION:
                self._add_connection(fields, records[start:end])
        self._index.blocks += builder.build(offset, length, form)
        if end < len(records) and not form:
            self._damage.skip_part("part", offset, None)

    def _add_connection(self, fields: Mapping[str, bytes], data: Bytes) -> None:
        """Add the channel of a connection record."""
        channel = channel_of(fields, data)
        if channel is not None:
            self._index.channels[int.from_bytes(fields["conn"], "little")] = channel

    def _add_cut_chunk(self, position: int) -> None:
        """Add the complete messages of a cut last chunk."""
        head = read_head(self._file, position, self._size)
        if head is not None and head.operation == CHUNK and head.end > self._size:
            length = min(self._size - position, MAX_CHUNK_BYTES)
            self._add_chunk(cut_records(head, self._file.read(length), self._content), position, length, CUT_CHUNK)

    def _search(self, start: int) -> int | None:
        """Return the offset of the first intact chunk from a byte on; None where there is none."""
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
        """Return True if a chunk with matching sizes is at a byte."""
        head = read_head(self._file, position, self._size)
        if head is None or head.fields.keys() != _CHUNK_FIELDS or head.end > self._size:
            return False
        self._budget -= head.length + head.number("size")
        return whole_records(head, self._file.read(head.length), self._content) is not None
