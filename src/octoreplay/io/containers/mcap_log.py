"""Reader of MCAP files, also cut and damaged ones.

The index of chunks is read from the file's summary if that is complete, else built in one pass over the file. Format:
https://mcap.dev/spec
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from mcap.opcode import Opcode

from octoreplay.errors import InputError
from octoreplay.io.containers.block_log import CUT_CHUNK, Block, BlockLog, Entry, Index
from octoreplay.io.containers.decompression import MAX_CHUNK_BYTES
from octoreplay.io.containers.mcap_pass import McapPass
from octoreplay.io.containers.mcap_records import (
    MAGIC,
    MAX_TIME_NS,
    MESSAGE_HEAD,
    RECORD_HEAD,
    cut_records,
    num_indexed,
    walk,
    whole_records,
)  # fmt: skip
from octoreplay.io.containers.mcap_summary import CHUNK, index_from_summary
from octoreplay.io.messages.decoders import Bytes


class McapLog(BlockLog):
    """An MCAP file. Of a damaged file all intact messages are read, and ``damage`` describes what was skipped.

    A chunk whose checksum or sizes do not match is skipped completely. Raises InputError for a file that is not MCAP or
    cannot be opened.
    """

    def _read_index(self) -> Index:
        """Return the index from the summary, else from one pass over the file."""
        if self._file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{self.path}: not an MCAP file")
        return index_from_summary(self._file) or McapPass(self._file, self._damage, self._budget).index()

    def _read_block(self, block: Block, wanted: Collection[int]) -> Iterator[Entry]:
        """Yield the messages of the wanted channels in a chunk or in a sequence of records outside chunks."""
        records = self._records(block)
        if records is None:
            self._damage.skip_part("chunk", block.offset, self._num_messages_of(block), block.span_ns)
            return
        end = num_late = 0
        for opcode, start, end in self._budget.counted(walk(records)):
            if opcode == Opcode.MESSAGE and end - start >= MESSAGE_HEAD.size:
                channel_id, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(records, start)
                if channel_id not in wanted:
                    continue
                if log_time_ns > MAX_TIME_NS:
                    num_late += 1
                    continue
                yield log_time_ns, block.offset, start + MESSAGE_HEAD.size, end, channel_id, records
        if num_late:
            self._damage.skip_messages(block.offset, num_late)
        if end < len(records) and block.form == CHUNK and block.num_messages is None:
            # The chunk has no checksum, and its last record is incomplete: messages behind the damage are lost.
            expected = self._num_messages_of(block)
            found = sum(opcode == Opcode.MESSAGE for opcode, _, _ in walk(records))
            self._damage.skip_part("part", block.offset, None if expected is None else max(0, expected - found))

    def _records(self, block: Block) -> Bytes | None:
        """Return the records in a block; None where they cannot be read."""
        if block.length > 2 * MAX_CHUNK_BYTES:
            return None
        data = self._bytes_at(block.offset, block.length)
        if len(data) < block.length:
            return None
        if block.form == CHUNK:
            return whole_records(data, self._budget)
        return cut_records(data, self._budget) if block.form == CUT_CHUNK else data

    def _num_messages_of(self, block: Block) -> int | None:
        """Return the number of messages of a damaged chunk, from the message indexes behind it; None without them."""
        if block.num_messages is not None:
            return block.num_messages
        total, place = None, block.offset + block.length
        while len(head := self._bytes_at(place, RECORD_HEAD.size)) == RECORD_HEAD.size:
            opcode, length = RECORD_HEAD.unpack(head)
            if opcode != Opcode.MESSAGE_INDEX:
                break
            total = (total or 0) + num_indexed(self._bytes_at(place + RECORD_HEAD.size, 6), length)
            place += RECORD_HEAD.size + length
        return total
