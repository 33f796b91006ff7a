"""Reader of a result's MCAP file that checks whatever an answer depends on (docs/result-format.md)."""

from __future__ import annotations

import heapq
import io
import os
import struct
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, ChunkIndex, Message, Metadata, MetadataIndex, Schema
from mcap.summary import Summary

from octoreplay.errors import InputError
from octoreplay.io.containers.decompression import ContentBudget, content_limit
from octoreplay.io.containers.mcap_records import (
    FOOTER,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    chunk_head,
    walk,
    whole_records,
)
from octoreplay.io.containers.mcap_summary import are_disjoint

MAX_WHOLE = 1 << 26
"""Largest file whose data section is checked as a whole when it is opened [byte]; parts of larger ones are checked as
they are read."""

_PIECE_BYTES = 1 << 20
_TAIL = RECORD_HEAD.size + FOOTER.size + len(MAGIC)
_DATA_END = RECORD_HEAD.size + 4
_RECORDS: Mapping[int, Any] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}  # fmt: skip
_UNREADABLE = (McapError, struct.error, ValueError, LookupError, OverflowError, MemoryError)


class CheckedReader(SeekingReader):
    """Reader of a finished MCAP file with chunks, as ``RosMcapWriter`` writes it.

    Raises InputError for a file that is cut, or where a checksum, a size or an offset does not match. Checksums of
    metadata are compared by their reader.
    """

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self._file = file
        self._path = path
        self._size = os.fstat(file.fileno()).st_size
        self._start = self._check_ends()
        self._check_data(self._start)
        file.seek(0)
        super().__init__(file)
        self._summary = self._read_summary(self._start)

    def get_summary(self) -> Summary:
        """Return the summary."""
        assert self._summary is not None
        return self._summary

    # Named parameters only, and messages without a schema are given too.
    def iter_messages(  # type: ignore[override]  # see above
        self,
        topics: Collection[str] | None = None,
        *,
        log_time_order: bool = True,
        reverse: bool = False,
        starting_at: int | None = None,
        ending_before: int | None = None,
    ) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """Yield messages with ``starting_at`` <= log time < ``ending_before`` by log time, or in reverse.

        Messages of one time are in the order of the file, as are all without ``log_time_order``. Raises InputError for
        a damaged chunk.
        """
        sign = -1 if reverse else 1
        summary = self.get_summary()
        wanted = {i: channel for i, channel in summary.channels.items() if topics is None or channel.topic in topics}
        chunks = [
            chunk
            for chunk in summary.chunk_indexes
            if (starting_at is None or chunk.message_end_time >= starting_at)
            and (ending_before is None or chunk.message_start_time < ending_before)
            and not wanted.keys().isdisjoint(chunk.message_index_offsets)
        ]
        first = [sign * (chunk.message_end_time if reverse else chunk.message_start_time) for chunk in chunks]
        if not log_time_order:
            first = [0] * len(chunks)
        order = sorted(range(len(chunks)), key=lambda place: (first[place], sign * chunks[place].chunk_start_offset))
        budget = ContentBudget(self._path, self._size)
        pending: list[tuple[int, int, Message]] = []
        for place in (*order, None):
            # Chunks may overlap in time.
            while pending and (place is None or not log_time_order or pending[0][0] < first[place]):
                message = heapq.heappop(pending)[2]
                channel = wanted[message.channel_id]
                yield summary.schemas.get(channel.schema_id), channel, message
            if place is None:
                return
            for offset, message in self._records(chunks[place], wanted, budget):
                time = message.log_time
                if (starting_at is None or time >= starting_at) and (ending_before is None or time < ending_before):
                    heapq.heappush(pending, (sign * time if log_time_order else 0, sign * offset, message))

    def iter_metadata(self) -> Iterator[Metadata]:
        """Yield the metadata records."""
        for index in self.get_summary().metadata_indexes:
            self._file.seek(min(index.offset, self._start))
            data = self._file.read(min(index.length, self._start))
            if data[: RECORD_HEAD.size] != RECORD_HEAD.pack(Opcode.METADATA, max(0, index.length - RECORD_HEAD.size)):
                raise self._damaged(f"its metadata '{index.name}' is not where the index says")
            yield self._parsed(Metadata, data[RECORD_HEAD.size :])

    def _records(
        self, chunk: ChunkIndex, wanted: Collection[int], budget: ContentBudget
    ) -> Iterator[tuple[int, Message]]:
        """Yield place in the file's records and content of each wanted message of a chunk."""
        self._file.seek(chunk.chunk_start_offset)
        data = self._file.read(chunk.chunk_length)
        body = memoryview(data)[RECORD_HEAD.size :]
        head = chunk_head(body)
        if (
            data[: RECORD_HEAD.size] != RECORD_HEAD.pack(Opcode.CHUNK, chunk.chunk_length - RECORD_HEAD.size)
            or head is None
            or (head.start_ns, head.end_ns, head.size, head.length, head.compression)
            != (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size, chunk.compressed_size,
                chunk.compression)
        ):  # fmt: skip
            raise self._damaged(f"the chunk at byte {chunk.chunk_start_offset} does not match the index")
        records = whole_records(body, budget)
        if records is None:
            raise self._damaged(f"the checksum of the chunk at byte {chunk.chunk_start_offset} does not match")
        for opcode, start, end in budget.counted(walk(records)):
            if opcode != Opcode.MESSAGE or end - start < MESSAGE_HEAD.size:
                continue
            number, sequence, time, publish_time = MESSAGE_HEAD.unpack_from(records, start)
            if number in wanted:
                data = bytes(records[start + MESSAGE_HEAD.size : end])
                yield chunk.chunk_start_offset + start, Message(number, time, data, publish_time, sequence)

    def _check_ends(self) -> int:
        """Return the start of the summary. Raises InputError for a file that is cut or no MCAP file."""
        self._file.seek(0)
        magic = self._file.read(len(MAGIC))
        self._file.seek(max(0, self._size - _TAIL))
        tail = self._file.read()
        if magic != MAGIC or len(tail) != _TAIL or not tail.endswith(MAGIC):
            raise InputError(
                f"{self._path}: not a finished MCAP file, or damaged; give the OUT.mcap of 'octoreplay run'"
            )
        start, _, crc = FOOTER.unpack_from(tail, RECORD_HEAD.size)
        end = self._size - _TAIL
        if RECORD_HEAD.unpack_from(tail) != (Opcode.FOOTER, FOOTER.size) or not len(MAGIC) + _DATA_END <= start <= end:
            raise self._damaged("its footer is wrong")
        if crc and self._crc(start, self._size - len(MAGIC) - 4) != crc:
            raise self._damaged("the checksum of its summary does not match")
        return int(start)

    def _check_data(self, summary_start: int) -> None:
        """Check the end of the data section, and the whole section where the file is not large."""
        self._file.seek(summary_start - _DATA_END)
        end = self._file.read(_DATA_END)
        if end[: RECORD_HEAD.size] != RECORD_HEAD.pack(Opcode.DATA_END, 4):
            raise self._damaged("its data section has no end")
        crc = int.from_bytes(end[-4:], "little")
        # Results of format 2 have no such checksum.
        if crc and self._size <= MAX_WHOLE and self._crc(0, summary_start - _DATA_END) != crc:
            raise self._damaged("the checksum of its data does not match")

    def _crc(self, start: int, end: int) -> int:
        """Return the CRC-32 of the bytes from ``start`` to ``end``."""
        self._file.seek(start)
        crc = 0
        for place in range(start, end, _PIECE_BYTES):
            crc = isal_zlib.crc32(self._file.read(min(_PIECE_BYTES, end - place)), crc)
        return crc

    def _read_summary(self, start: int) -> Summary:
        """Return schemas, channels and the indexes of chunks and metadata."""
        self._file.seek(start)
        content = self._file.read(self._size - _TAIL - start)
        summary = Summary()
        for opcode, begin, end in walk(content):
            if opcode not in _RECORDS:
                continue
            record = self._parsed(_RECORDS[opcode], content[begin:end])
            if isinstance(record, Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, Channel):
                summary.channels[record.id] = record
            elif isinstance(record, ChunkIndex):
                summary.chunk_indexes.append(record)
            else:
                summary.metadata_indexes.append(record)
        size = sum(chunk.uncompressed_size for chunk in summary.chunk_indexes)
        # No byte may be read twice, or a small file could hold any number of messages.
        if not are_disjoint(summary.chunk_indexes, start) or sum(i.length for i in summary.metadata_indexes) > start:
            raise self._damaged("its index names parts that overlap")
        if size > content_limit(self._size):
            raise self._damaged(f"its {self._size} bytes cannot hold messages of {size} bytes")
        return summary

    def _parsed(self, kind: Any, body: bytes) -> Any:
        """Parse one record, which must fill its bytes."""
        stream = ReadDataStream(io.BytesIO(body))
        try:
            record = kind.read(stream)
        except _UNREADABLE as error:
            raise self._damaged(f"a record of kind {kind.__name__} cannot be read") from error
        return record

    def _damaged(self, problem: str) -> InputError:
        """Return the error for a damaged file."""
        return InputError(f"{self._path}: damaged: {problem}; replay the logs again")
