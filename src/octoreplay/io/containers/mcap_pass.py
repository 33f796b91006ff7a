"""Index of an MCAP file without a usable summary, built in one pass that resumes after damage."""

from __future__ import annotations

import io
import re
from typing import IO

from mcap.opcode import Opcode

from octoreplay.io.containers.block_log import CUT_CHUNK, BlockBuilder, Index
from octoreplay.io.containers.damage import Damage
from octoreplay.io.containers.decompression import MAX_CHUNK_BYTES, ContentBudget
from octoreplay.io.containers.mcap_records import (
    FOOTER,
    MAGIC,
    MAX_TIME_NS,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChunkHead,
    Definitions,
    chunk_head,
    cut_records,
    num_indexed,
    read_record,
    walk,
    whole_records,
)  # fmt: skip
from octoreplay.io.containers.mcap_summary import CHUNK
from octoreplay.io.messages.decoders import Bytes

LOOSE = "loose"
"""Form of a block that is a sequence of complete records outside chunks."""
# Size of blocks of records outside chunks. It bounds the memory that reading them takes.
_LOOSE_BLOCK_BYTES = 1 << 20
_CHUNK_PREFIX_BYTES = 64
_MAX_DEFINITION_BYTES = 1 << 26
_NUM_PLAUSIBLE_RECORDS = 3
_WINDOW_BYTES = 1 << 20
_OVERLAP_BYTES = 64
_OPCODES = frozenset(range(Opcode.HEADER, Opcode.DATA_END + 1))
_FIRST_PRIVATE_OPCODE = 0x80
# Opcode, length, times, size, checksum and compression of a chunk; sizes are below 4 GiB.
_CHUNK_PATTERN = re.compile(
    rb"\x06.{4}\0{4}.{16}.{4}\0{4}.{4}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0).{4}\0{4}", re.DOTALL
)
_RECORD_PATTERN = re.compile(rb"[\x03-\x06].{4}\0{4}", re.DOTALL)


class McapPass:
    """Builds the index of a file in one pass over its records.

    After damage the pass resumes at the next certain record: a chunk whose sizes and checksum match or, in a file
    without chunks, the first of three plausible records in a row.
    """

    def __init__(self, file: IO[bytes], damage: Damage, content: ContentBudget) -> None:
        self._file = file
        self._damage = damage
        self._size = file.seek(0, io.SEEK_END)
        self._index = Index()
        self._content = content
        self.definitions = Definitions()
        """Schemas and channels found so far."""
        self._has_chunks = False
        self._data_ended = False
        self._is_finished = False
        # Where a search after damage begins. The length of an intact chunk is certain, that of other records is not:
        # it may itself be damaged.
        self._floor = len(MAGIC)
        self._broken_chunk: tuple[int, int] | None = None
        self._loose = BlockBuilder(self._index.tally)
        self._loose_start = 0
        # Bytes that searches may read. It bounds the time taken by files made to look like many damaged chunks.
        self._budget = 8 * self._size + MAX_CHUNK_BYTES

    def index(self) -> Index:
        """Return the index; bytes that were skipped are recorded as damage."""
        position = len(MAGIC)
        while not self._is_finished and position < self._size:
            end = self._read_record(position)
            if end is not None:
                position = end
                continue
            self._end_loose_block(position)
            self._has_chunks = self._has_chunks or self._chunk_head(position) is not None
            found = self._search(self._floor)
            if found is None:
                self._add_cut_chunk(position)
                break
            self._damage.skip_part("part", position, None)
            position = found
        self._finish(position)
        return self._index

    # --- records ------------------------------------------------------------------------------------------------------

    def _read_record(self, position: int) -> int | None:
        """Read the record at a byte and return its end; None where there is no complete record."""
        head = self._head(position)
        if head is None:
            return None
        opcode, end = head
        start = position + RECORD_HEAD.size
        self._floor = position + 1
        if opcode == Opcode.CHUNK:
            return self._read_chunk(start, end)
        if opcode == Opcode.MESSAGE:
            self._add_loose_message(position, start, end)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            body = self._bytes(start, min(end - start, _MAX_DEFINITION_BYTES))
            # The summary repeats the definitions, and its damage may be the reason for this pass.
            self.definitions.add(opcode, body, is_certain=not self._data_ended)
        elif opcode == Opcode.MESSAGE_INDEX and self._broken_chunk is not None:
            offset, count = self._broken_chunk
            self._broken_chunk = offset, count + num_indexed(self._bytes(start, 6), end - start)
            self._damage.skip_part("chunk", *self._broken_chunk)
        elif opcode == Opcode.DATA_END:
            self._data_ended = True
        elif opcode == Opcode.FOOTER:
            self._is_finished = self._bytes(end, len(MAGIC) + 1) == MAGIC
        return end

    def _head(self, position: int) -> tuple[int, int] | None:
        """Return (opcode, end) of the record at a byte; None where there is no complete record."""
        data = self._bytes(position, RECORD_HEAD.size)
        if len(data) < RECORD_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack(data)
        end = position + RECORD_HEAD.size + length
        is_known = opcode in _OPCODES or opcode >= _FIRST_PRIVATE_OPCODE
        is_sized = length == {Opcode.DATA_END: 4, Opcode.FOOTER: FOOTER.size}.get(opcode, length)
        return (opcode, end) if is_known and is_sized and end <= self._size else None

    def _read_chunk(self, start: int, end: int) -> int | None:
        """Add a chunk and return its end; None where it is damaged and no record follows at its end."""
        self._has_chunks = True
        self._end_loose_block(start)
        self._broken_chunk = None
        body = self._bytes(start, end - start) if end - start <= 2 * MAX_CHUNK_BYTES else b""
        records = whole_records(body, self._content)
        if records is not None:
            self._add_chunk(records, start, end - start, CHUNK)
            self._floor = end
            return end
        if end < self._size and self._head(end) is None:
            return None
        self._damage.skip_part("chunk", start, None, _span_of(chunk_head(body)))
        self._broken_chunk = start, 0
        # Later chunks may use channels that are declared in the damaged one.
        damaged_records = memoryview(cut_records(body, self._content))
        for opcode, record_start, record_end in self._content.counted(walk(damaged_records)):
            self.definitions.add(opcode, damaged_records[record_start:record_end], is_certain=False)
        return end

    def _add_chunk(self, records: Bytes, offset: int, length: int, form: str) -> None:
        """Add the block of a chunk, and its schemas and channels."""
        builder = BlockBuilder(self._index.tally)
        end = 0
        for opcode, start, end in self._content.counted(walk(records)):
            if opcode == Opcode.MESSAGE and end - start >= MESSAGE_HEAD.size:
                channel_id, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(records, start)
                if log_time_ns <= MAX_TIME_NS:
                    builder.add(channel_id, log_time_ns)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.definitions.add(opcode, memoryview(records)[start:end])
        self._index.blocks += builder.build(offset, length, form)
        if end < len(records) and form == CHUNK:
            self._damage.skip_part("part", offset, None)

    def _add_loose_message(self, position: int, start: int, end: int) -> None:
        """Add one message outside chunks."""
        data = self._bytes(start, MESSAGE_HEAD.size)
        if len(data) < MESSAGE_HEAD.size or end - start < MESSAGE_HEAD.size:
            return
        channel_id, _, log_time_ns, _ = MESSAGE_HEAD.unpack(data)
        if log_time_ns > MAX_TIME_NS:
            return
        if not self._loose.num_messages:
            self._loose_start = position
        self._loose.add(channel_id, log_time_ns)
        if end - self._loose_start >= _LOOSE_BLOCK_BYTES:
            self._end_loose_block(end)

    def _end_loose_block(self, end: int) -> None:
        """Add the current block of records outside chunks and begin another."""
        self._index.blocks += self._loose.build(self._loose_start, end - self._loose_start, LOOSE)
        self._loose = BlockBuilder(self._index.tally)

    # --- after damage -------------------------------------------------------------------------------------------------

    def _search(self, start: int) -> int | None:
        """Return the offset of the first certain record from a byte on; None where there is none."""
        pattern = _CHUNK_PATTERN if self._has_chunks else _RECORD_PATTERN
        for window_start in range(start, self._size, _WINDOW_BYTES):
            window = self._bytes(window_start, _WINDOW_BYTES + _OVERLAP_BYTES)
            match = pattern.search(window)
            while match is not None and match.start() < _WINDOW_BYTES and self._budget >= 0:
                if self._is_certain(window_start + match.start()):
                    return window_start + match.start()
                match = pattern.search(window, match.start() + 1)
        return None

    def _is_certain(self, position: int) -> bool:
        """Return True if an intact chunk, or the first of several plausible records, is at a byte."""
        for _ in range(_NUM_PLAUSIBLE_RECORDS):
            head = self._head(position)
            if head is None or not self._is_plausible(*head, position + RECORD_HEAD.size):
                return False
            opcode, position = head
            if opcode == Opcode.CHUNK or position == self._size:
                return True
        return True

    def _is_plausible(self, opcode: int, end: int, start: int) -> bool:
        """Return True if the content of a record fits its opcode."""
        if opcode == Opcode.CHUNK:
            head = self._chunk_head(start - RECORD_HEAD.size)
            if head is None or head.start + head.length != end - start or head.start_ns > head.end_ns:
                return False
            self._budget -= head.length + head.size
            return whole_records(self._bytes(start, end - start)) is not None
        if opcode == Opcode.MESSAGE:
            data = self._bytes(start, MESSAGE_HEAD.size)
            if end - start < MESSAGE_HEAD.size:
                return False
            channel_id, _, log_time_ns, _ = MESSAGE_HEAD.unpack(data)
            return channel_id in self.definitions.channels and log_time_ns <= MAX_TIME_NS
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._budget -= end - start
            return end - start <= _WINDOW_BYTES and read_record(opcode, self._bytes(start, end - start)) is not None
        return opcode in _OPCODES

    def _add_cut_chunk(self, position: int) -> None:
        """Add the complete messages of a cut last chunk; record other bytes before the end as damage."""
        start = position + RECORD_HEAD.size
        if self._chunk_head(position) is not None:
            length = min(self._size - start, MAX_CHUNK_BYTES)
            self._add_chunk(cut_records(self._bytes(start, length), self._content), start, length, CUT_CHUNK)
        if self._ends_with_magic and not self._data_ended:
            self._damage.skip_part("part", position, None)

    def _finish(self, end: int) -> None:
        """Remove messages of unknown channels; record a missing end as damage."""
        self._end_loose_block(end)
        self._index.channels = self.definitions.resolved()
        self._damage.skip_messages(0, self._index.tally.drop_unknown(self._index.channels))
        if self._is_finished or self._ends_with_magic:
            return
        if self._data_ended:
            self._damage.note("cut after its last message (the end of the file is missing)")
        else:
            self._damage.note("cut before its end")

    @property
    def _ends_with_magic(self) -> bool:
        """True if the file ends with the magic bytes."""
        return self._size >= 2 * len(MAGIC) and self._bytes(self._size - len(MAGIC), len(MAGIC)) == MAGIC

    def _chunk_head(self, position: int) -> ChunkHead | None:
        """Return the header of the chunk at a byte, also of a cut or damaged one; None where there is none."""
        data = self._bytes(position, RECORD_HEAD.size + _CHUNK_PREFIX_BYTES)
        return chunk_head(data[RECORD_HEAD.size :]) if data[:1] == bytes([Opcode.CHUNK]) else None

    def _bytes(self, offset: int, length: int) -> bytes:
        """Return bytes of the file, fewer at its end."""
        self._file.seek(offset)
        return self._file.read(max(0, min(length, self._size - offset)))


def _span_of(head: ChunkHead | None) -> tuple[int, int] | None:
    """Log times of the first and the last message of a damaged chunk; None where they cannot be right."""
    is_plausible = head is not None and 0 < head.start_ns <= head.end_ns <= MAX_TIME_NS
    return (head.start_ns, head.end_ns) if head is not None and is_plausible else None
