"""Common part of the log readers that use an index of blocks: MCAP files, ROS 1 bags and damaged databases."""

from __future__ import annotations

import heapq
import io
import math
from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TypeAlias

from octoreplay.errors import InputError
from octoreplay.io.containers.decompression import ContentBudget
from octoreplay.io.containers.log_reader import Channel, LogReader, RawMessage, TopicInfo
from octoreplay.io.messages.decoders import Bytes

Entry: TypeAlias = tuple[int, int, int, int, int, Bytes]
"""One message: log time [ns], offset of its block, start, end, channel id, buffer; its bytes are buffer[start:end]."""

CUT_CHUNK = "cut chunk"
"""Form of a block that is the beginning of a chunk; the file ends within the chunk."""


@dataclass(frozen=True, slots=True)
class Block:
    """A part of a log that is read at once, such as a chunk.

    ``offset`` and ``length`` are in bytes of the file (in rows for databases). ``start_ns`` and ``end_ns`` are the
    least and greatest log times of its messages; ``end_ns`` is None where the index does not give it.
    ``channel_ids`` is None where the block may hold any channel. ``form`` distinguishes kinds of blocks of one
    container. ``num_messages`` is None where the index does not give it.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int | None
    channel_ids: frozenset[int] | None
    form: str = ""
    num_messages: int | None = None

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Least and greatest log time of its messages; None where the index does not give the greatest."""
        return None if self.end_ns is None else (self.start_ns, self.end_ns)

    def can_hold(self, channel_ids: Set[int], start_ns: float, stop_ns: float) -> bool:
        """Return True if the block may hold messages of some channels with ``start_ns <= log time < stop_ns``."""
        return (
            self.start_ns < stop_ns
            and (self.end_ns is None or self.end_ns >= start_ns)
            and (self.channel_ids is None or not channel_ids.isdisjoint(self.channel_ids))
        )


class Tally:
    """Number of messages and time span of each channel."""

    def __init__(self) -> None:
        self._spans: dict[int, tuple[int, int, int]] = {}

    def add(self, channel_id: int, log_time_ns: int, count: int = 1, last_ns: int | None = None) -> None:
        """Count one message, or ``count`` messages with log times from ``log_time_ns`` to ``last_ns``."""
        last_ns = log_time_ns if last_ns is None else last_ns
        number, start, end = self._spans.get(channel_id, (0, log_time_ns, last_ns))
        self._spans[channel_id] = number + count, min(start, log_time_ns), max(end, last_ns)

    def count(self, channel_id: int) -> int:
        """Return the number of messages of a channel."""
        return self._spans.get(channel_id, (0, 0, 0))[0]

    def drop_unknown(self, channels: Mapping[int, object]) -> int:
        """Remove the channels that are not in ``channels`` and return the number of their messages."""
        unknown = [self._spans.pop(i)[0] for i in tuple(self._spans) if i not in channels]
        return sum(unknown)

    @property
    def total(self) -> int:
        """Number of messages of all channels."""
        return sum(number for number, _, _ in self._spans.values())

    @property
    def start_ns(self) -> int | None:
        """Least log time; None without messages."""
        return min((start for number, start, _ in self._spans.values() if number), default=None)

    @property
    def end_ns(self) -> int | None:
        """Greatest log time; None without messages."""
        return max((end for number, _, end in self._spans.values() if number), default=None)


class BlockBuilder:
    """Collects time span and channels of one block, message by message, and counts the messages in a tally."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._start_ns: int | None = None
        self._end_ns: int | None = None
        self._channel_ids: set[int] = set()
        self.num_messages = 0

    def add(self, channel_id: int, log_time_ns: int) -> None:
        """Add one message."""
        self._tally.add(channel_id, log_time_ns)
        self._start_ns = log_time_ns if self._start_ns is None else min(self._start_ns, log_time_ns)
        self._end_ns = log_time_ns if self._end_ns is None else max(self._end_ns, log_time_ns)
        self._channel_ids.add(channel_id)
        self.num_messages += 1

    def build(self, offset: int, length: int, form: str = "") -> list[Block]:
        """Return the block as a list, which is empty where no message was added."""
        if self._start_ns is None:
            return []
        channel_ids = frozenset(self._channel_ids)
        return [Block(offset, length, self._start_ns, self._end_ns, channel_ids, form, self.num_messages)]


@dataclass
class Index:
    """Index of a log: its channels by id, the numbers of their messages, and the blocks that hold them."""

    channels: dict[int, Channel] = field(default_factory=dict)
    tally: Tally = field(default_factory=Tally)
    blocks: list[Block] = field(default_factory=list)


class BlockLog(LogReader):
    """A log with an index of blocks. Subclasses read the index and the messages of a block.

    Raises InputError where the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self._file: IO[bytes] = path.open("rb")
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            self._size = self._file.seek(0, io.SEEK_END)
            self._file.seek(0)
            self._budget = ContentBudget(path, self._size)
            self._index = self._read_index()
        except OSError as error:
            self._file.close()
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        except BaseException:
            self._file.close()
            raise

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """Topics, sorted by name and type."""
        groups: dict[tuple[str, str, str], list[int]] = {}
        for channel_id, channel in sorted(self._index.channels.items()):
            groups.setdefault((channel.topic, channel.type_name, channel.encoding), []).append(channel_id)
        return tuple(
            TopicInfo(*key, sum(self._index.tally.count(i) for i in channel_ids), tuple(channel_ids))
            for key, channel_ids in sorted(groups.items())
        )

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message; None in a log without messages."""
        return self._index.tally.start_ns

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message; None in a log without messages."""
        return self._index.tally.end_ns

    @property
    def message_count(self) -> int:
        """Number of messages of all topics."""
        return self._index.tally.total

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Messages of some topics in order of log time, read lazily; equal times in the order of the file.

        Only messages with ``start_ns <= log_time_ns < stop_ns`` are given; None leaves that side open. Only blocks that
        can hold such messages are read. A damaged one of these is left out and noted in ``damage``.
        """
        wanted = {i: channel for i, channel in self._index.channels.items() if channel.topic in topics}
        first = -math.inf if start_ns is None else start_ns
        stop = math.inf if stop_ns is None else stop_ns
        blocks = [block for block in self._index.blocks if block.can_hold(wanted.keys(), first, stop)]
        blocks.sort(key=lambda block: (block.start_ns, block.offset))
        self._budget = ContentBudget(self.path, self._size)
        pending: list[Entry] = []
        for block in blocks:
            while pending and pending[0][:2] < (block.start_ns, block.offset):
                yield self._message(heapq.heappop(pending))
            for entry in self._read_block(block, wanted):
                if first <= entry[0] < stop:
                    heapq.heappush(pending, entry)
        while pending:
            yield self._message(heapq.heappop(pending))

    @abstractmethod
    def _read_index(self) -> Index:
        """Return the index of the open file and record what is damaged."""

    @abstractmethod
    def _read_block(self, block: Block, wanted: Collection[int]) -> Iterator[Entry]:
        """Yield the messages of the wanted channels in a block and record what is damaged."""

    def _bytes_at(self, offset: int, length: int) -> bytes:
        """Return bytes of the file, fewer at its end and none after a read error."""
        if offset >= self._size:
            return b""
        try:
            self._file.seek(offset)
            # A file object allocates as many bytes as are requested, so a damaged length must not be passed on.
            return self._file.read(min(length, self._size - offset))
        except OSError:
            return b""

    def _message(self, entry: Entry) -> RawMessage:
        """Return a message with a copy of its bytes, which releases the block and aligns the arrays in the message."""
        log_time_ns, _, start, end, channel_id, data = entry
        return RawMessage(
            self.path, self._index.channels[channel_id], log_time_ns, bytearray(memoryview(data)[start:end])
        )
