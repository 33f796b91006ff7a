"""What every log container gives: topics, spans and raw messages that are decoded only when asked."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from octoreplay.errors import InputError, printable
from octoreplay.io.containers.damage import Damage, damage_sentence
from octoreplay.io.messages import decoders
from octoreplay.io.messages.decoders import Bytes, DamagedMessageError, UndefinedTypeError
from octoreplay.io.messages.ros_types import stamp_to_ns
from octoreplay.io.messages.sensor_messages import Kind, SensorMessage, convert, kind_of

# So many messages are looked at for one that is whole.
_NUM_TRIED = 100
# Where the stamp of a message stands in its bytes, by encoding: without a Header, and with one.
_STAMP_OFFSETS = {"cdr": (4, 4), "ros1": (0, 4)}


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a log as one type: a topic that carries two types is listed twice.

    ``type_name`` is normalised to ``package/msg/Name``; ``encoding`` is ``cdr``, ``ros1``, ``protobuf``, ...;
    ``channel_ids`` are the container's ids of its channels (connections).
    """

    name: str
    type_name: str
    encoding: str
    num_messages: int
    channel_ids: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Channel:
    """Where a message comes from: the topic, its type, and the definition that its log holds of that type."""

    topic: str
    type_name: str
    encoding: str
    definition_format: str
    definition: bytes


class RawMessage:
    """One message as recorded: its bytes stay as they are until ``decode`` is called."""

    __slots__ = ("_value", "channel", "data", "log", "log_time_ns")

    def __init__(self, log: Path, channel: Channel, log_time_ns: int, data: Bytes) -> None:
        self.log = log
        self.channel = channel
        self.log_time_ns = log_time_ns
        self.data = data
        self._value: Any = None

    @property
    def topic(self) -> str:
        """The topic it was recorded on."""
        return self.channel.topic

    @property
    def type_name(self) -> str:
        """Its type as ``package/msg/Name``."""
        return self.channel.type_name

    @property
    def where(self) -> str:
        """File, topic and time, as errors begin."""
        return printable(f"{self.log}: topic '{self.topic}' at {self.log_time_ns / 1e9:.3f} s")

    def header_stamp_ns(self) -> int:
        """The header's stamp in nanoseconds; only for types that begin with a Header, or with a time and a frame.

        ROS messages are not decoded for it. Raises as ``decode`` does, also where the message has no such stamp.
        """
        if self.channel.encoding in _STAMP_OFFSETS:
            seconds, nanoseconds = self._peek("iI", self._header_offset)
            return int(seconds) * 1_000_000_000 + int(nanoseconds)
        stamp = getattr(self.decode(), "timestamp", None)
        try:
            return stamp_to_ns(stamp)
        except (AttributeError, TypeError, ValueError):
            raise DamagedMessageError(f"{self.where}: the message has no timestamp") from None

    def header_frame_id(self) -> str:
        """The header's frame; as ``header_stamp_ns`` otherwise."""
        if self.channel.encoding not in _STAMP_OFFSETS:
            return str(getattr(self.decode(), "frame_id", ""))
        start = self._header_offset + 8
        (length,) = self._peek("I", start)
        # CDR counts the zero at the string's end.
        return bytes(self.data[start + 4 : start + 4 + length]).rstrip(b"\0").decode("utf-8", "replace")

    def decode(self) -> Any:
        """The message as an object whose fields are named as in its definition; arrays are views of ``data``.

        Raises DamagedMessageError where the bytes do not fit the type, InputError for an unknown type or encoding.
        """
        if self._value is not None:
            return self._value
        channel = self.channel
        try:
            value = decoders.decode(
                self.data, channel.type_name, channel.encoding, channel.definition_format, channel.definition
            )
        except (DamagedMessageError, UndefinedTypeError) as error:
            raise type(error)(f"{self.where}: {error}") from error
        if channel.encoding not in _STAMP_OFFSETS:
            # Its stamp cannot be read from the bytes alone, so it is decoded before it is used.
            self._value = value
        return value

    def sensor_message(self) -> SensorMessage:
        """The message in the form that it has whatever its schema; only for types that ``kind_of`` knows.

        Raises as ``decode`` does, and DamagedMessageError where fields are missing.
        """
        value = self.decode()
        try:
            return convert(self.type_name, value)
        except DamagedMessageError as error:
            raise DamagedMessageError(f"{self.where}: {error}") from error

    @property
    def _header_offset(self) -> int:
        """Where the stamp stands: after the encapsulation in CDR, after a Header's sequence number in ROS 1."""
        has_header = not self.channel.type_name.startswith("foxglove_msgs/")
        return _STAMP_OFFSETS[self.channel.encoding][has_header]

    def _peek(self, form: str, offset: int) -> tuple[Any, ...]:
        """Numbers at an offset of the bytes; CDR may be big-endian, ROS 1 is little-endian always."""
        is_big_endian = self.channel.encoding == "cdr" and len(self.data) > 1 and self.data[1] == 0
        try:
            return struct.unpack_from((">" if is_big_endian else "<") + form, self.data, offset)
        except struct.error:
            raise DamagedMessageError(f"{self.where}: the message is too short to hold a header") from None


class LogReader(ABC):
    """One log, open for reading; a context manager. Several message iterators may be in use at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._damage = Damage()

    @property
    @abstractmethod
    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics, sorted by name and type."""

    @property
    @abstractmethod
    def start_ns(self) -> int | None:
        """Log time of the first message; None in a log without messages."""

    @property
    @abstractmethod
    def end_ns(self) -> int | None:
        """Log time of the last message; None in a log without messages."""

    @property
    @abstractmethod
    def message_count(self) -> int:
        """Messages of all topics."""

    @abstractmethod
    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Messages of some topics in order of log time, read lazily; equal times in the order of the file.

        Only messages with ``start_ns <= log_time_ns < stop_ns`` are given; None leaves that side open. Parts of the log
        that the index places outside this range are not read, and ``damage`` does not cover them.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the file; a second call does nothing."""

    @property
    def damage(self) -> str | None:
        """What is missing from a cut or damaged log, as one sentence; None for a good log.

        It grows while messages are read: ask for it at the end. A reader logs nothing; whoever opened it tells.
        """
        return damage_sentence(self.path, self.damage_clauses)

    @property
    def damage_clauses(self) -> tuple[str, ...]:
        """The parts of that sentence, without the path."""
        return self._damage.clauses

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def normalise_type_name(name: str) -> str:
    """``package/msg/Name`` of a type's name in ROS 1's short or ROS 2's long form."""
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


def first_whole_message(log: LogReader, topic: str, kinds: Collection[Kind]) -> RawMessage | None:
    """The first message of a topic that says something of some kinds and is whole; None without any of those kinds.

    Where none of the first hundred is whole, it is the first.
    """
    found = None
    messages = (message for message in log.messages((topic,)) if kind_of(message.type_name) in kinds)
    for message in islice(messages, _NUM_TRIED):
        found = found or message
        with suppress(InputError):
            message.sensor_message()
            return message
    return found
