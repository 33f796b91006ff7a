"""What every log container gives: topics, spans and raw messages that are decoded only when asked."""

from __future__ import annotations

import logging
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from octoreplay.errors import InputError
from octoreplay.io.messages.ros_types import typestore

logger = logging.getLogger(__name__)

Bytes: TypeAlias = bytes | bytearray | memoryview
Decoder: TypeAlias = Callable[[Bytes], Any]

DECODABLE_ENCODINGS = ("cdr", "ros1")
"""Message encodings that ``RawMessage.decode`` understands."""


class DamagedMessageError(InputError):
    """One message whose bytes do not hold what its type says; the messages around it may be good."""


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
    """Where a message comes from: the topic, its type, and how its bytes become a message object."""

    topic: str
    type_name: str
    encoding: str
    definition_format: str
    definition: str

    def decode(self, data: Bytes) -> Any:
        """The message object of serialised bytes; raises whatever the decoder raises."""
        return _decoder(self.type_name, self.encoding, self.definition_format, self.definition)(data)


class RawMessage:
    """One message as recorded: its bytes stay as they are until ``decode`` is called."""

    __slots__ = ("channel", "data", "log", "log_time_ns")

    def __init__(self, log: Path, channel: Channel, log_time_ns: int, data: Bytes) -> None:
        self.log = log
        self.channel = channel
        self.log_time_ns = log_time_ns
        self.data = data

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
        return f"{self.log}: topic '{self.topic}' at {self.log_time_ns / 1e9:.3f} s"

    def header_stamp_ns(self) -> int:
        """The header's stamp in nanoseconds, read without decoding the rest; only for types that begin with a Header.

        Raises DamagedMessageError where the bytes are too short.
        """
        # The stamp stands at byte 4 in CDR (after the encapsulation) and in ROS 1 (after the sequence number).
        try:
            sec, nanosec = struct.unpack_from(">iI" if self._is_big_endian else "<iI", self.data, 4)
        except struct.error:
            raise DamagedMessageError(f"{self.where}: the message is too short to hold a header") from None
        return int(sec) * 1_000_000_000 + int(nanosec)

    def header_frame_id(self) -> str:
        """The header's frame, read without decoding the rest; only for types that begin with a Header.

        Raises DamagedMessageError where the bytes are too short.
        """
        try:
            (length,) = struct.unpack_from(">I" if self._is_big_endian else "<I", self.data, 12)
        except struct.error:
            raise DamagedMessageError(f"{self.where}: the message is too short to hold a header") from None
        # CDR counts the zero at the string's end.
        return bytes(self.data[16 : 16 + length]).rstrip(b"\0").decode("utf-8", "replace")

    @property
    def _is_big_endian(self) -> bool:
        """True for CDR in big-endian order; ROS 1 is little-endian always."""
        return self.channel.encoding == "cdr" and len(self.data) > 1 and self.data[1] == 0

    def decode(self) -> Any:
        """The message as an object whose fields are named as in its definition; arrays are views of ``data``.

        Raises DamagedMessageError where the bytes do not fit the type, InputError for an unknown type or encoding.
        """
        if self.channel.encoding not in DECODABLE_ENCODINGS:
            raise InputError(
                f"{self.where}: message encoding '{self.channel.encoding}' is not supported; "
                f"record as ROS 2 (cdr) or ROS 1"
            )
        try:
            return self.channel.decode(memoryview(self.data))
        except SerdeError as error:
            raise DamagedMessageError(f"{self.where}: damaged {self.type_name}: {error}") from error
        except (AssertionError, IndexError, OverflowError, MemoryError) as error:
            raise DamagedMessageError(f"{self.where}: damaged {self.type_name}") from error
        except (KeyError, TypesysError) as error:
            raise InputError(f"{self.where}: the definition of type '{self.type_name}' is unknown") from error


class LogReader(ABC):
    """One log, open for reading; a context manager. Several message iterators may be in use at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._damage: str | None = None

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
    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of some topics in order of log time, read lazily; ties in the order of the file."""

    @abstractmethod
    def close(self) -> None:
        """Close the file; a second call does nothing."""

    @property
    def damage(self) -> str | None:
        """What is missing from a cut or damaged log, as one sentence; None for a good log (as far as it was read)."""
        return self._damage

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _note_damage(self, sentence: str) -> None:
        """Remember and log the first damage; what comes after it is a consequence."""
        if self._damage is None:
            self._damage = f"{self.path}: {sentence}"
            logger.warning("%s", self._damage)


def normalise_type_name(name: str) -> str:
    """``package/msg/Name`` of a type's name in ROS 1's short or ROS 2's long form."""
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


def first_message(log: LogReader, topic: str) -> RawMessage | None:
    """The first message of a topic in log time, or None; reads no further than it."""
    return next(log.messages((topic,)), None)


@cache
def _decoder(type_name: str, encoding: str, definition_format: str, definition: str) -> Decoder:
    """The decoder of a type as the log defines it, or as this package knows it where the log says nothing."""
    store = _store(type_name, encoding, definition_format, definition)
    deserialise = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    # rosbags annotates only bytes and memoryview, and takes any buffer.
    return lambda data: deserialise(data, type_name)  # type: ignore[arg-type]


def _store(type_name: str, encoding: str, definition_format: str, definition: str) -> Typestore:
    """A type store that decodes one type the way the log's own definition says."""
    known = typestore()
    if not definition:
        return get_typestore(Stores.ROS1_NOETIC) if encoding == "ros1" else known
    if encoding == "cdr" and definition_format == "ros2idl" and type_name in known.fielddefs:
        return known
    types = (
        get_types_from_idl(definition) if definition_format == "ros2idl" else get_types_from_msg(definition, type_name)
    )
    if encoding == "cdr" and all(
        name in known.fielddefs and known.fielddefs[name][1] == fields for name, (_, fields) in types.items()
    ):
        return known
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store
