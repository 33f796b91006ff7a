"""The index of an MCAP file without a usable summary, from one pass over it that finds its way after damage."""

from __future__ import annotations

import io
import re
from typing import IO

from mcap.opcode import Opcode

from octoreplay.io.containers.block_log import BlockBuilder, Index
from octoreplay.io.containers.damage import Damage
from octoreplay.io.containers.decompression import MAX_CHUNK_BYTES
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

CUT_CHUNK = "cut chunk"
"""The form of a block that is a chunk's record without its head, as far as the file goes."""
LOOSE = "loose"
"""The form of a block that is a run of whole records outside chunks."""
# Records outside chunks are read in blocks of about this size, so that no log is held as a whole.
_LOOSE_BLOCK_BYTES = 1 << 20
_CHUNK_PREFIX_BYTES = 64
_MAX_DEFINITION_BYTES = 1 << 26
_NUM_PLAUSIBLE_RECORDS = 3
_WINDOW_BYTES = 1 << 20
_OVERLAP_BYTES = 64
_OPCODES = frozenset(range(Opcode.HEADER, Opcode.DATA_END + 1))
_FIRST_PRIVATE_OPCODE = 0x80
# A chunk's opcode, length, times, size, checksum and compression; sizes are below 4 GiB.
_CHUNK_PATTERN = re.compile(
    rb"\x06.{4}\0{4}.{16}.{4}\0{4}.{4}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0).{4}\0{4}", re.DOTALL
)
_RECORD_PATTERN = re.compile(rb"[\x03-\x06].{4}\0{4}", re.DOTALL)


class McapPass:
    """One pass over a file's records. What is no record is passed over up to the next one that is beyond doubt.

    That is a chunk whose sizes and checksum fit or, in a file without chunks, one of three good records in a row.
    """

    def __init__(self, file: IO[bytes], damage: Damage) -> None:
        self._file = file
        self._damage = damage
        self._size = file.seek(0, io.SEEK_END)
        self._index = Index()
        self._definitions = Definitions()
        self._has_chunks = False
        self._data_ended = False
        self._is_finished = False
        # From where on to search after damage: a whole chunk is as long as it says, but of any other record that was
        # taken the length may be what is damaged.
        self._floor = len(MAGIC)
        self._broken_chunk: tuple[int, int] | None = None
        self._loose = BlockBuilder(self._index.tally)
        self._loose_start = 0
        # Searching may read chunks in vain; more than this, and the file was made to be searched for ever.
        self._budget = 8 * self._size + MAX_CHUNK_BYTES

    def index(self) -> Index:
        """The index; what was passed over is noted as damage."""
        position = len(MAGIC)
        while not self._is_finished and position < self._size:
            end = self._take(position)
            if end is not None:
                position = end
                continue
            self._close_loose(position)
            self._has_chunks = self._has_chunks or self._chunk_head(position) is not None
            found = self._search(self._floor)
            if found is None:
                self._take_rest(position)
                break
            self._damage.skip("part", position, None)
            position = found
        self._finish(position)
        return self._index

    # --- records ------------------------------------------------------------------------------------------------------

    def _take(self, position: int) -> int | None:
        """Take the record at a byte; returns where it ends, None where there is no whole record."""
        head = self._head(position)
        if head is None:
            return None
        opcode, end = head
        start = position + RECORD_HEAD.size
        self._floor = position + 1
        if opcode == Opcode.CHUNK:
            return self._take_chunk(start, end)
        if opcode == Opcode.MESSAGE:
            self._take_loose(position, start, end)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            body = self._bytes(start, min(end - start, _MAX_DEFINITION_BYTES))
            # The summary repeats what the data say, and it may be why this pass is made.
            self._definitions.take(opcode, body, is_certain=not self._data_ended)
        elif opcode == Opcode.MESSAGE_INDEX and self._broken_chunk is not None:
            offset, count = self._broken_chunk
            self._broken_chunk = offset, count + num_indexed(self._bytes(start, 6), end - start)
            self._damage.skip("chunk", *self._broken_chunk)
        elif opcode == Opcode.DATA_END:
            self._data_ended = True
        elif opcode == Opcode.FOOTER:
            self._is_finished = self._bytes(end, len(MAGIC) + 1) == MAGIC
        return end

    def _head(self, position: int) -> tuple[int, int] | None:
        """(opcode, end) of the record at a byte; None where no whole record can be there."""
        data = self._bytes(position, RECORD_HEAD.size)
        if len(data) < RECORD_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack(data)
        end = position + RECORD_HEAD.size + length
        is_known = opcode in _OPCODES or opcode >= _FIRST_PRIVATE_OPCODE
        is_sized = length == {Opcode.DATA_END: 4, Opcode.FOOTER: FOOTER.size}.get(opcode, length)
        return (opcode, end) if is_known and is_sized and end <= self._size else None

    def _take_chunk(self, start: int, end: int) -> int | None:
        """Take a chunk's messages; a damaged one is left out where the next record shows that its length is right."""
        self._has_chunks = True
        self._close_loose(start)
        self._broken_chunk = None
        body = self._bytes(start, end - start) if end - start <= 2 * MAX_CHUNK_BYTES else b""
        records = whole_records(body)
        if records is not None:
            self._take_records(records, start, end - start, CHUNK)
            self._floor = end
            return end
        if end < self._size and self._head(end) is None:
            return None
        self._damage.skip("chunk", start, None)
        self._broken_chunk = start, 0
        # The chunks after it may count on the channels that it declares.
        damaged_records = memoryview(cut_records(body))
        for opcode, record_start, record_end in walk(damaged_records):
            self._definitions.take(opcode, damaged_records[record_start:record_end], is_certain=False)
        return end

    def _take_records(self, records: Bytes, offset: int, length: int, form: str) -> None:
        """Add a chunk's block, and what it declares."""
        builder = BlockBuilder(self._index.tally)
        end = 0
        for opcode, start, end in walk(records):
            if opcode == Opcode.MESSAGE and end - start >= MESSAGE_HEAD.size:
                channel_id, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(records, start)
                if log_time_ns <= MAX_TIME_NS:
                    builder.add(channel_id, log_time_ns)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._definitions.take(opcode, memoryview(records)[start:end])
        self._index.blocks += builder.build(offset, length, form)
        if end < len(records) and form == CHUNK:
            self._damage.skip("part", offset, None)

    def _take_loose(self, position: int, start: int, end: int) -> None:
        """Take one message outside chunks."""
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
            self._close_loose(end)

    def _close_loose(self, end: int) -> None:
        """End the block of records outside chunks; the next record begins another."""
        self._index.blocks += self._loose.build(self._loose_start, end - self._loose_start, LOOSE)
        self._loose = BlockBuilder(self._index.tally)

    # --- after damage -------------------------------------------------------------------------------------------------

    def _search(self, start: int) -> int | None:
        """The first byte from a place on at which a record stands beyond doubt; None where there is none."""
        pattern = _CHUNK_PATTERN if self._has_chunks else _RECORD_PATTERN
        for window_start in range(start, self._size, _WINDOW_BYTES):
            window = self._bytes(window_start, _WINDOW_BYTES + _OVERLAP_BYTES)
            match = pattern.search(window)
            while match is not None and match.start() < _WINDOW_BYTES and self._budget >= 0:
                if self._is_beyond_doubt(window_start + match.start()):
                    return window_start + match.start()
                match = pattern.search(window, match.start() + 1)
        return None

    def _is_beyond_doubt(self, position: int) -> bool:
        """True where a whole chunk, or the first of some good records, stands at a byte."""
        for _ in range(_NUM_PLAUSIBLE_RECORDS):
            head = self._head(position)
            if head is None or not self._is_plausible(*head, position + RECORD_HEAD.size):
                return False
            opcode, position = head
            if opcode == Opcode.CHUNK or position == self._size:
                return True
        return True

    def _is_plausible(self, opcode: int, end: int, start: int) -> bool:
        """True where the bytes of a record fit its opcode."""
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
            return channel_id in self._definitions.channels and log_time_ns <= MAX_TIME_NS
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._budget -= end - start
            return end - start <= _WINDOW_BYTES and read_record(opcode, self._bytes(start, end - start)) is not None
        return opcode in _OPCODES

    def _take_rest(self, position: int) -> None:
        """Take the whole messages of a last chunk that is cut; note a part that is none."""
        start = position + RECORD_HEAD.size
        if self._chunk_head(position) is not None:
            length = min(self._size - start, MAX_CHUNK_BYTES)
            self._take_records(cut_records(self._bytes(start, length)), start, length, CUT_CHUNK)
        if self._has_end and not self._data_ended:
            self._damage.skip("part", position, None)

    def _finish(self, end: int) -> None:
        """Leave out what belongs to no channel; note an end that is missing."""
        self._close_loose(end)
        self._index.channels = self._definitions.resolved()
        self._damage.lose(0, self._index.tally.drop_unknown(self._index.channels))
        if self._is_finished or self._has_end:
            return
        if self._data_ended:
            self._damage.note("cut after its last message (the end of the file is missing)")
        else:
            self._damage.note("cut before its end")

    @property
    def _has_end(self) -> bool:
        """True where the file ends as it should, whatever is before that."""
        return self._size >= 2 * len(MAGIC) and self._bytes(self._size - len(MAGIC), len(MAGIC)) == MAGIC

    def _chunk_head(self, position: int) -> ChunkHead | None:
        """What the chunk at a byte says of itself, whether it is whole or not; None where there is none."""
        data = self._bytes(position, RECORD_HEAD.size + _CHUNK_PREFIX_BYTES)
        return chunk_head(data[RECORD_HEAD.size :]) if data[:1] == bytes([Opcode.CHUNK]) else None

    def _bytes(self, offset: int, length: int) -> bytes:
        """Bytes of the file, as many as there are."""
        self._file.seek(offset)
        return self._file.read(max(0, min(length, self._size - offset)))
