"""Logs that are read block by block by means of an index: what MCAP files and cut ROS 1 bags have in common."""

from __future__ import annotations

import heapq
from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TypeAlias

from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import Bytes, Channel, LogReader, RawMessage, TopicInfo

Entry: TypeAlias = tuple[int, int, int, int, int, Bytes]
"""(log time, block's offset, start, end, channel id, bytes that start and end count in) of one message."""


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a file that is read at once: where it is, when it starts, whose messages it holds (None: any).

    ``form`` says how its bytes are to be read, in the words of the log that made it.
    """

    offset: int
    length: int
    form: str
    start_ns: int
    channel_ids: frozenset[int] | None


@dataclass
class Index:
    """How many messages of which channels a file holds, from when to when, and in which blocks."""

    counts: dict[int, int] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    start_ns: int | None = None
    end_ns: int | None = None
    damage: str | None = None

    def count(self, channel_id: int, log_time_ns: int) -> None:
        """Take one message into the counts and the span."""
        self.counts[channel_id] = self.counts.get(channel_id, 0) + 1
        self.start_ns = log_time_ns if self.start_ns is None else min(self.start_ns, log_time_ns)
        self.end_ns = log_time_ns if self.end_ns is None else max(self.end_ns, log_time_ns)


class BlockLog(LogReader):
    """A log with an index of blocks; what a block's bytes hold is the subclass's business."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self._file: IO[bytes] = path.open("rb")
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            self._index, self._channels = self._read_index()
        except BaseException:
            self._file.close()
            raise
        if self._index.damage is not None:
            self._note_damage(self._index.damage)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics, sorted by name and type."""
        groups: dict[tuple[str, str, str], list[int]] = {}
        for channel_id, channel in sorted(self._channels.items()):
            groups.setdefault((channel.topic, channel.type_name, channel.encoding), []).append(channel_id)
        return tuple(
            TopicInfo(*key, sum(self._index.counts.get(i, 0) for i in channel_ids), tuple(channel_ids))
            for key, channel_ids in sorted(groups.items())
        )

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message; None in a log without messages."""
        return self._index.start_ns

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message; None in a log without messages."""
        return self._index.end_ns

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(self._index.counts.values())

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of some topics in order of log time, read lazily; ties in the order of the file.

        Only blocks that hold such messages are read. A damaged block is left out and noted in ``damage``.
        """
        wanted = {i: channel for i, channel in self._channels.items() if channel.topic in topics}
        blocks = [b for b in self._index.blocks if b.channel_ids is None or not wanted.keys().isdisjoint(b.channel_ids)]
        blocks.sort(key=lambda block: (block.start_ns, block.offset))
        pending: list[Entry] = []
        for block in blocks:
            while pending and pending[0][:2] < (block.start_ns, block.offset):
                yield self._message(heapq.heappop(pending))
            self._file.seek(block.offset)
            for entry in self._read_block(block, self._file.read(block.length), wanted):
                heapq.heappush(pending, entry)
        while pending:
            yield self._message(heapq.heappop(pending))

    @abstractmethod
    def _read_index(self) -> tuple[Index, Mapping[int, Channel]]:
        """The index and the channels of the open file."""

    @abstractmethod
    def _read_block(self, block: Block, data: bytes, wanted: Collection[int]) -> Iterator[Entry]:
        """The messages of the wanted channels in a block's bytes."""

    def _message(self, entry: Entry) -> RawMessage:
        """A message with its own copy of the bytes, which lets go of the block and aligns the arrays in it."""
        log_time_ns, _, start, end, channel_id, data = entry
        return RawMessage(self.path, self._channels[channel_id], log_time_ns, bytearray(memoryview(data)[start:end]))
