"""Reader of ROS 1 bags, also cut and damaged ones.

The index of chunks is read from the records at the bag's end, else built in one pass over the file. Format:
http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import IO

from octoreplay.errors import InputError
from octoreplay.io.containers.bag_pass import BagPass
from octoreplay.io.containers.bag_records import (
    CHUNK_INFO,
    CONNECTION,
    MAGIC,
    RecordHead,
    channel_of,
    cut_records,
    read_head,
    walk_messages,
    whole_records,
)  # fmt: skip
from octoreplay.io.containers.block_log import CUT_CHUNK, Block, BlockLog, Entry, Index
from octoreplay.io.messages.decoders import Bytes

_TIME = struct.Struct("<II")
_COUNT = struct.Struct("<II")


class BagLog(BlockLog):
    """A ROS 1 bag. Of a damaged bag all intact messages are read, and ``damage`` describes what was skipped.

    Raises InputError where the file cannot be opened, is encrypted, or holds neither an index nor a complete message.
    """

    def _read_index(self) -> Index:
        """Return the index from the records at the end, else from one pass over the file."""
        header = read_head(self._file, len(MAGIC), self._size)
        if header is not None and header.fields.get("encryptor"):
            raise InputError(f"{self.path}: cannot be read: the bag is encrypted")
        index = _index_from_end(self._file, self._size)
        if index is not None:
            return index
        index = BagPass(self._file, self._size, self._damage, self._budget).index()
        if not index.blocks:
            raise InputError(f"{self.path}: cannot be read: the bag has no index and holds no complete message")
        return index

    def _read_block(self, block: Block, wanted: Collection[int]) -> Iterator[Entry]:
        """Yield the messages of the wanted connections in a chunk."""
        records = self._records(block)
        if records is None:
            self._damage.skip_part("chunk", block.offset, block.num_messages, block.span_ns)
            return
        count = 0
        for channel_id, log_time_ns, start, end in walk_messages(records, self._budget):
            count += 1
            if channel_id in wanted:
                yield log_time_ns, block.offset, start, end, channel_id, records
        if block.num_messages is not None and count < block.num_messages:
            self._damage.skip_part("part", block.offset, block.num_messages - count)

    def _records(self, block: Block) -> Bytes | None:
        """Return the records in a chunk; None where they cannot be read."""
        try:
            head = read_head(self._file, block.offset, block.offset + block.length)
        except OSError:
            return None
        if head is None:
            return None
        if block.form == CUT_CHUNK:
            return cut_records(head, self._bytes_at(head.start, block.offset + block.length - head.start), self._budget)
        if head.end > block.offset + block.length:
            return None
        return whole_records(head, self._bytes_at(head.start, head.length), self._budget)


def _index_from_end(file: IO[bytes], size: int) -> Index | None:
    """Return the index given by the records at the end; None where they are missing or damaged."""
    header = read_head(file, len(MAGIC), size)
    if header is None or not len(MAGIC) < header.number("index_pos") <= size:
        return None
    index, infos = Index(), []
    position = end = header.number("index_pos")
    while position < size:
        head = read_head(file, position, size)
        if head is None or head.end > size or head.operation not in (CONNECTION, CHUNK_INFO):
            return None
        data = file.read(head.length)
        if head.operation == CHUNK_INFO:
            infos.append((head, data))
        elif (channel := channel_of(head.fields, data)) is not None:
            index.channels[head.number("conn")] = channel
        position = head.end
    if (len(index.channels), len(infos)) != (header.number("conn_count"), header.number("chunk_count")):
        return None
    # A chunk ends where the next one begins, so that no byte is read twice.
    infos.sort(key=lambda info: info[0].number("chunk_pos"))
    ends = [head.number("chunk_pos") for head, _ in infos[1:]] + [end]
    is_good = all(_add_chunk_info(index, head, data, end) for (head, data), end in zip(infos, ends, strict=False))
    return index if is_good else None


def _add_chunk_info(index: Index, head: RecordHead, data: bytes, end: int) -> bool:
    """Add the chunk of a chunk info record, which ends before the byte ``end``; False where the record is damaged."""
    position, times = head.number("chunk_pos"), [head.fields.get(name, b"") for name in ("start_time", "end_time")]
    if len(data) != _COUNT.size * head.number("count") or not len(MAGIC) <= position < end:
        return False
    if any(len(time) != _TIME.size for time in times):
        return not data
    start_ns, end_ns = (sec * 1_000_000_000 + nanosec for sec, nanosec in map(_TIME.unpack, times))
    counts = dict(_COUNT.iter_unpack(data))
    if not index.channels.keys() >= counts.keys():
        return False
    for channel_id, count in counts.items():
        index.tally.add(channel_id, start_ns, count, end_ns)
    if counts:
        num_messages = sum(counts.values())
        last_ns = end_ns if end_ns >= start_ns else None
        index.blocks.append(
            Block(position, end - position, start_ns, last_ns, frozenset(counts), num_messages=num_messages)
        )
    return True
