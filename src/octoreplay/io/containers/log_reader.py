"""Common interface of the log readers: topics, time span and raw messages, which are decoded on request."""

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

from octoreplay.config.file_url import InputFile
from octoreplay.errors import ConfigError, InputError, printable
from octoreplay.io.containers.damage import Damage, damage_sentence
from octoreplay.io.messages import decoders
from octoreplay.io.messages.decoders import Bytes, DamagedMessageError, UndefinedTypeError
from octoreplay.io.messages.ros_types import stamp_to_ns
from octoreplay.io.messages.sensor_messages import Kind, SensorMessage, convert, kind_of

# Messages that first_whole_message tries to decode.
_NUM_TRIED = 100
# Byte offset of the stamp in a serialised message by encoding: without and with a std_msgs/Header.
_STAMP_OFFSETS = {"cdr": (4, 4), "ros1": (0, 4)}


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a log with one message type. A topic with two types has two entries.

    ``type_name`` has the form ``package/msg/Name``. ``encoding`` is ``cdr``, ``ros1``, ``protobuf``, ...
    ``channel_ids`` are the container's ids of the topic's channels (MCAP) or connections (ROS 1 bags).
    """

    name: str
    type_name: str
    encoding: str
    num_messages: int
    channel_ids: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Channel:
    """Topic, message type and encoding of messages, with the type's definition as the log holds it.

    ``definition_format`` names the language of ``definition``: ``ros2msg``, ``ros2idl``, ``ros1msg``, ``protobuf``, ...
    It is empty, as is ``definition``, where the log holds no definition.
    """

    topic: str
    type_name: str
    encoding: str
    definition_format: str
    definition: bytes


class RawMessage:
    """One message as recorded. ``data`` is its serialised content, which only ``decode`` parses.

    ``log_time_ns`` is the time at which the recorder received the message.
    """

    __slots__ = ("_value", "channel", "data", "log", "log_time_ns")

    def __init__(self, log: InputFile, channel: Channel, log_time_ns: int, data: Bytes) -> None:
        self.log = log
        self.channel = channel
        self.log_time_ns = log_time_ns
        self.data = data
        self._value: Any = None

    @property
    def topic(self) -> str:
        """Topic of the message."""
        return self.channel.topic

    @property
    def type_name(self) -> str:
        """Message type as ``package/msg/Name``."""
        return self.channel.type_name

    @property
    def where(self) -> str:
        """File, topic and log time, the first words of error messages."""
        return printable(f"{self.log}: topic '{self.topic}' at {self.log_time_ns / 1e9:.3f} s")

    def header_stamp_ns(self) -> int:
        """Stamp of the header [ns], for types that begin with a Header or with a time and a frame id.

        ROS messages are not decoded for this. Raises the errors of ``decode``, and DamagedMessageError for a message
        without a stamp.
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
        """Frame id of the header, for the same types and with the same errors as ``header_stamp_ns``."""
        if self.channel.encoding not in _STAMP_OFFSETS:
            return str(getattr(self.decode(), "frame_id", ""))
        start = self._header_offset + 8
        (length,) = self._peek("I", start)
        # In CDR the length includes the terminating zero.
        return bytes(self.data[start + 4 : start + 4 + length]).rstrip(b"\0").decode("utf-8", "replace")

    def decode(self) -> Any:
        """Return the message as an object with the fields of its definition; arrays are views of ``data``.

        Raises DamagedMessageError where the bytes do not fit the type, and InputError for an unknown type or encoding.
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
            # The stamp of such a message is read from the decoded message, so it is decoded before it is used.
            self._value = value
        return value

    def sensor_message(self) -> SensorMessage:
        """Return the message in the form common to ROS and Foxglove schemas, for types that ``kind_of`` knows.

        Raises the errors of ``decode``, DamagedMessageError where fields are missing, and InputError or ConfigError
        for packets of a lidar that cannot be decoded.
        """
        value = self.decode()
        try:
            return convert(self.type_name, value)
        except (InputError, ConfigError) as error:
            raise type(error)(f"{self.where}: {error}") from error

    @property
    def _header_offset(self) -> int:
        """Offset of the stamp: after the encapsulation header in CDR, after the Header's sequence number in ROS 1."""
        has_header = not self.channel.type_name.startswith("foxglove_msgs/")
        return _STAMP_OFFSETS[self.channel.encoding][has_header]

    def _peek(self, form: str, offset: int) -> tuple[Any, ...]:
        """Unpack numbers at a byte offset; CDR may be big-endian, ROS 1 is always little-endian."""
        is_big_endian = self.channel.encoding == "cdr" and len(self.data) > 1 and self.data[1] == 0
        try:
            return struct.unpack_from((">" if is_big_endian else "<") + form, self.data, offset)
        except struct.error:
            raise DamagedMessageError(f"{self.where}: the message is too short to hold a header") from None


class LogReader(ABC):
    """One open log; a context manager. Several iterators over its messages may be in use at a time."""

    def __init__(self, path: Path) -> None:
        self.path: InputFile = path
        self._damage = Damage()

    @property
    @abstractmethod
    def topics(self) -> tuple[TopicInfo, ...]:
        """Topics, sorted by name and type."""

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
        """Number of messages of all topics."""

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
        """One sentence on what is missing from a cut or damaged log; None for a good log.

        It covers what has been read so far, so it is complete only after the last message. A reader logs nothing.
        """
        return damage_sentence(self.path, self.damage_clauses, self.start_ns, self.end_ns)

    @property
    def damage_clauses(self) -> tuple[str, ...]:
        """Clauses of ``damage`` without the path; empty for a good log."""
        return self._damage.clauses

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def normalise_type_name(name: str) -> str:
    """Return ``package/msg/Name`` for a type name in the form of ROS 1 (``package/Name``) or ROS 2."""
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


def first_whole_message(log: LogReader, topic: str, kinds: Collection[Kind]) -> RawMessage | None:
    """Return the first message of a topic that has one of some kinds and can be decoded.

    Returns the first message of these kinds where none of the first hundred can be decoded, and None where the topic
    has no message of these kinds.
    """
    found = None
    messages = (message for message in log.messages((topic,)) if kind_of(message.type_name) in kinds)
    for message in islice(messages, _NUM_TRIED):
        found = found or message
        with suppress(InputError, ConfigError):
            message.sensor_message()
            return message
    return found
