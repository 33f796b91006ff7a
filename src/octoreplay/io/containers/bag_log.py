"""ROS 1 bags and rosbag2 recordings (sqlite3 files, folders with metadata.yaml), read by rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag1 import ReaderError as Rosbag1ReaderError
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2 import ReaderError as Rosbag2ReaderError

from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import Channel, LogReader, RawMessage, TopicInfo, normalise_type_name

_FORMATS = {
    MessageDefinitionFormat.NONE: "",
    MessageDefinitionFormat.MSG: "ros2msg",
    MessageDefinitionFormat.IDL: "ros2idl",
}


class BagLog(LogReader):
    """A recording that rosbags reads. Raises InputError where it cannot be opened."""

    def __init__(self, path: Path, *, is_ros1: bool) -> None:
        super().__init__(path)
        self._is_ros1 = is_ros1
        self._reader: Any = None
        try:
            self._reader = Rosbag1Reader(path) if is_ros1 else Rosbag2Reader(path)
            self._reader.open()
        except (Rosbag1ReaderError, Rosbag2ReaderError, OSError) as error:
            self._reader = None
            raise InputError(f"{path}: cannot be read: {str(error).rstrip('.')}") from error
        except Exception as error:
            # On a damaged index rosbags lets whatever its parsers raise through, bare AssertionErrors included.
            self._reader = None
            raise InputError(f"{path}: cannot be read: the recording's index is damaged") from error
        self._connections: list[Connection] = list(self._reader.connections)
        self._channels = {(id(c.owner), c.id): self._channel(c) for c in self._connections}

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The topics, sorted by name and type."""
        groups: dict[tuple[str, str, str], list[Connection]] = {}
        for connection in self._connections:
            channel = self._channels[id(connection.owner), connection.id]
            groups.setdefault((channel.topic, channel.type_name, channel.encoding), []).append(connection)
        return tuple(
            TopicInfo(*key, sum(c.msgcount for c in group), tuple(c.id for c in group))
            for key, group in sorted(groups.items())
        )

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message; None in a log without messages."""
        return int(self._reader.start_time) if self.message_count else None

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message; None in a log without messages."""
        # rosbags gives the first nanosecond after the last message.
        return int(self._reader.end_time) - 1 if self.message_count else None

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(connection.msgcount for connection in self._connections)

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of some topics in order of log time, read lazily; ties in the order of the file."""
        connections = [c for c in self._connections if c.topic in topics and c.msgcount]
        if not connections:
            return
        iterator = self._reader.messages(connections=connections)
        while True:
            try:
                connection, log_time_ns, data = next(iterator)
            except StopIteration:
                return
            except Exception:
                # See __init__: a damaged page or chunk can raise anything.
                self._note_damage("damaged or cut; everything whole before the damage is used")
                return
            channel = self._channels[id(connection.owner), connection.id]
            yield RawMessage(self.path, channel, int(log_time_ns), data)

    def _channel(self, connection: Connection) -> Channel:
        """A connection's topic, type and definition."""
        encoding = "ros1" if self._is_ros1 else str(getattr(connection.ext, "serialization_format", "cdr"))
        return Channel(
            connection.topic,
            normalise_type_name(connection.msgtype),
            encoding,
            _FORMATS[connection.msgdef.format],
            connection.msgdef.data,
        )
