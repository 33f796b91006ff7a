"""Results that were not finished: what a killed process or a power cut left of them can be read.

Only ``x.partial.mcap`` can be unfinished. A file under any other name without a summary is damaged.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex, MetadataIndex
from mcap.summary import Summary

from octoreplay.io.containers.damage import Damage
from octoreplay.io.containers.decompression import ContentBudget
from octoreplay.io.containers.mcap_pass import McapPass
from octoreplay.io.containers.mcap_records import MAGIC, RECORD_HEAD
from octoreplay.io.containers.mcap_summary import CHUNK, index_from_summary
from octoreplay.io.results.checked_mcap import CheckedReader

PARTIAL_SUFFIX = ".partial.mcap"
"""End of the name of a result that is not complete."""
_LARGE_BYTES = 1 << 24


class UnfinishedReader(SeekingReader):
    """Reader of an MCAP file without summary, which is made from the intact chunks in one pass over the file.

    ``damage`` has clauses on what was skipped: the cut end, and damaged parts before it.
    """

    def __init__(self, file: IO[bytes], path: Path) -> None:
        file.seek(0)
        super().__init__(file, validate_crcs=True)
        damage = Damage()
        self._scanned = _scan(file, path, damage)
        self.damage = damage.clauses

    def get_summary(self) -> Summary:
        """Return the summary of the intact chunks."""
        return self._scanned

    def iter_messages(self, *arguments: Any, **options: Any) -> Iterator[Any]:
        """Iterate over the messages as ``SeekingReader`` does; a file without intact chunks has none."""
        return super().iter_messages(*arguments, **options) if self._scanned.chunk_indexes else iter(())


def container_reader(file: IO[bytes], path: Path, *, is_unfinished: bool = False) -> SeekingReader:
    """Return a reader of a result's container, also of an unfinished one where its name or the caller allows that."""
    if (is_unfinished or path.name.endswith(PARTIAL_SUFFIX)) and index_from_summary(file) is None:
        return UnfinishedReader(file, path)
    return CheckedReader(file, path)


def has_messages(path: Path) -> bool:
    """Return True if a file holds a message, or cannot be read. A large one is not searched: it has chunks."""
    try:
        with path.open("rb") as file:
            if file.seek(0, io.SEEK_END) > _LARGE_BYTES:
                return True
            file.seek(0)
            return file.read(len(MAGIC)) == MAGIC and _pass(file, path, Damage()).index().tally.total > 0
    except OSError:
        return True


def _pass(file: IO[bytes], path: Path, damage: Damage) -> McapPass:
    """Return a pass over a file."""
    return McapPass(file, damage, ContentBudget(path, file.seek(0, io.SEEK_END)))


def _scan(file: IO[bytes], path: Path, damage: Damage) -> Summary:
    """Return the summary of a file's metadata before the first chunk, its intact chunks and their channels."""
    scan = _pass(file, path, damage)
    index, summary = scan.index(), Summary()
    channels, schemas = scan.definitions.channels, scan.definitions.schemas
    summary.schemas = dict(schemas)
    summary.channels = {number: channel for number, channel in channels.items() if channel.schema_id in schemas}
    for block in index.blocks:
        channel_ids = block.channel_ids or frozenset()
        if block.form != CHUNK or not channel_ids <= summary.channels.keys():
            continue
        start, length = block.offset - RECORD_HEAD.size, block.length + RECORD_HEAD.size
        # The reader needs times, place and channels of a chunk only.
        summary.chunk_indexes.append(
            ChunkIndex(
                length,
                start,
                "",
                0,
                block.end_ns or block.start_ns,
                0,
                dict.fromkeys(channel_ids, 0),
                block.start_ns,
                0,
            )
        )
    summary.metadata_indexes = list(_metadata_before_chunks(file))
    return summary


def _metadata_before_chunks(file: IO[bytes]) -> Iterator[MetadataIndex]:
    """Yield the places of the metadata records between the header and the first other record."""
    size, place = file.seek(0, io.SEEK_END), len(MAGIC)
    while place + RECORD_HEAD.size <= size:
        file.seek(place)
        opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
        end = place + RECORD_HEAD.size + length
        if opcode not in (Opcode.HEADER, Opcode.METADATA) or end > size:
            return
        if opcode == Opcode.METADATA:
            yield MetadataIndex(place, end - place, "")
        place = end
