"""Index of an MCAP file from the summary at its end."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import IO

from isal import isal_zlib
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics

from octoreplay.io.containers.block_log import Block, Index
from octoreplay.io.containers.mcap_records import FOOTER, MAGIC, MAX_TIME_NS, RECORD_HEAD, Definitions, read_record

CHUNK = "chunk"
"""Form of a block that is the body of a chunk record."""
_PIECE_BYTES = 1 << 20
_IN_SUMMARY = (
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX,
    Opcode.STATISTICS, Opcode.SUMMARY_OFFSET,
)  # fmt: skip
_FIRST_PRIVATE_OPCODE = 0x80


def index_from_summary(file: IO[bytes]) -> Index | None:
    """Return the index that the summary gives; None where the summary is missing, damaged or incomplete."""
    size = file.seek(0, io.SEEK_END)
    footer_start = size - len(MAGIC) - RECORD_HEAD.size - FOOTER.size
    if footer_start < len(MAGIC):
        return None
    file.seek(footer_start)
    tail = file.read()
    if RECORD_HEAD.unpack_from(tail) != (Opcode.FOOTER, FOOTER.size) or not tail.endswith(MAGIC):
        return None
    start, _, crc = FOOTER.unpack_from(tail, RECORD_HEAD.size)
    if not len(MAGIC) <= start < footer_start:
        return None
    definitions, chunks, statistics = Definitions(), [], None
    for opcode, body in _summary_records(file, start, footer_start):
        record = read_record(opcode, body)
        if isinstance(record, ChunkIndex):
            chunks.append(record)
        elif isinstance(record, Statistics):
            statistics = record
        elif record is not None:
            definitions.add(opcode, body)
        elif opcode not in _IN_SUMMARY and opcode < _FIRST_PRIVATE_OPCODE:
            return None
    if statistics is None or not _is_complete(statistics, chunks, definitions) or not are_disjoint(chunks, start):
        return None
    if crc and _checksum(file, start, footer_start + RECORD_HEAD.size + 16) != crc:
        return None
    if _has_loose_messages(file, chunks, start):
        return None
    return _index(statistics, chunks, definitions)


def _summary_records(file: IO[bytes], start: int, end: int) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, body) of each record between two bytes; the body is empty for records foreign to a summary."""
    while start + RECORD_HEAD.size <= end:
        file.seek(start)
        opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
        start += RECORD_HEAD.size + length
        if start > end:
            opcode, length = 0, 0
        yield opcode, file.read(length) if opcode in _IN_SUMMARY else b""


def _checksum(file: IO[bytes], start: int, end: int) -> int:
    """Return the CRC-32 of the bytes from ``start`` to ``end``."""
    file.seek(start)
    crc = 0
    for place in range(start, end, _PIECE_BYTES):
        crc = isal_zlib.crc32(file.read(min(_PIECE_BYTES, end - place)), crc)
    return crc


def _is_complete(statistics: Statistics, chunks: list[ChunkIndex], definitions: Definitions) -> bool:
    """Return True if the summary lists every chunk, channel and schema and counts every message."""
    counts = statistics.channel_message_counts
    indexed = {channel_id for chunk in chunks for channel_id in chunk.message_index_offsets}
    channels = definitions.channels
    return bool(
        len(chunks) == statistics.chunk_count
        and len(channels) == statistics.channel_count
        and (statistics.chunk_count > 0 or statistics.message_count == 0)
        and sum(counts.values()) == statistics.message_count
        and channels.keys() >= indexed | counts.keys()
        and all(c.schema_id == 0 or c.schema_id in definitions.schemas for c in channels.values())
        and (statistics.message_count == 0 or statistics.message_end_time <= MAX_TIME_NS)
    )


def are_disjoint(chunks: list[ChunkIndex], end: int) -> bool:
    """Return True if the chunks lie in the data section without overlap, so that no byte is read twice."""
    place = len(MAGIC)
    for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
        if chunk.chunk_start_offset < place or chunk.chunk_length < RECORD_HEAD.size:
            return False
        place = chunk.chunk_start_offset + chunk.chunk_length
    return place <= end


def _has_loose_messages(file: IO[bytes], chunks: list[ChunkIndex], end: int) -> bool:
    """Return True if there are messages between the chunks, which the summary does not list."""
    place = len(MAGIC)
    for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
        if _has_message(file, place, chunk.chunk_start_offset):
            return True
        place = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
    return _has_message(file, place, end)


def _has_message(file: IO[bytes], start: int, end: int) -> bool:
    """Return True if one of the records between two bytes is a message."""
    while start + RECORD_HEAD.size <= end:
        file.seek(start)
        opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
        if opcode == Opcode.MESSAGE:
            return True
        start += RECORD_HEAD.size + length
    return False


def _index(statistics: Statistics, chunks: list[ChunkIndex], definitions: Definitions) -> Index:
    """Return the index given by a complete summary."""
    index = Index(definitions.resolved())
    for channel_id, count in statistics.channel_message_counts.items():
        index.tally.add(channel_id, statistics.message_start_time, count, statistics.message_end_time)
    head = RECORD_HEAD.size
    for chunk in chunks:
        # Without message offsets a chunk may hold any channel.
        channel_ids = frozenset(chunk.message_index_offsets) or None
        start, start_ns, end_ns = chunk.chunk_start_offset + head, chunk.message_start_time, chunk.message_end_time
        # Some recorders leave the times of chunks at 0.
        is_timed = end_ns >= max(start_ns, statistics.message_start_time)
        index.blocks.append(
            Block(start, chunk.chunk_length - head, start_ns, end_ns if is_timed else None, channel_ids, CHUNK)
        )
    return index
