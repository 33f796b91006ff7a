"""Reader of rosbag2's sqlite3 files: by rosbags, and by row number after rosbags meets a damaged page."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader

from octoreplay.errors import InputError
from octoreplay.io.containers.damaged_db3_log import DamagedDb3Log, check_schema
from octoreplay.io.containers.log_reader import Channel, LogReader, RawMessage, TopicInfo, normalise_type_name

_FORMATS = {
    MessageDefinitionFormat.NONE: "",
    MessageDefinitionFormat.MSG: "ros2msg",
    MessageDefinitionFormat.IDL: "ros2idl",
}


def open_db3(path: Path) -> LogReader:
    """Open a sqlite3 recording, also a damaged one. Raises InputError where nothing in it can be read."""
    check_schema(path)
    try:
        return Db3Log(path)
    except InputError as error:
        try:
            return DamagedDb3Log(path)
        except InputError:
            raise error from None


class Db3Log(LogReader):
    """A sqlite3 recording read by rosbags. After a damaged page, the remaining rows are read by row number.

    Raises InputError where it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = path
        # SQLite's connections belong to the thread that opens them, so each thread has a reader of its own.
        self._readers: dict[int, Any] = {}
        self._rows: DamagedDb3Log | None = None
        try:
            reader = self._reader_of_this_thread()
            self._connections: list[Connection] = list(reader.connections)
            self._channels = {c.id: _channel(c) for c in self._connections}
            self._is_used = any(c.msgcount for c in self._connections)
            self._span = int(reader.start_time), int(reader.end_time) - 1
        except Exception as error:
            # On a damaged database rosbags raises whatever its parsers raise, also bare AssertionErrors.
            self.close()
            raise InputError(f"{path}: cannot be read: not a rosbag2 recording, or a damaged one") from error

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """Topics, sorted by name and type."""
        groups: dict[tuple[str, str, str], list[Connection]] = {}
        for connection in self._connections:
            channel = self._channels[connection.id]
            groups.setdefault((channel.topic, channel.type_name, channel.encoding), []).append(connection)
        return tuple(
            TopicInfo(*key, sum(c.msgcount for c in group), tuple(c.id for c in group))
            for key, group in sorted(groups.items())
        )

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message; None in a log without messages."""
        return self._span[0] if self._is_used else None

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message; None in a log without messages."""
        return self._span[1] if self._is_used else None

    @property
    def message_count(self) -> int:
        """Number of messages of all topics."""
        return sum(connection.msgcount for connection in self._connections)

    @property
    def damage_clauses(self) -> tuple[str, ...]:
        """Clauses on what is damaged and what was skipped; empty for a good log."""
        return self._damage.clauses if self._rows is None else self._rows.damage_clauses

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        while self._readers:
            _, reader = self._readers.popitem()
            # Where the readers' connections are bound to threads, those of ended threads close with them.
            with suppress(sqlite3.ProgrammingError):
                reader.close()
        if self._rows is not None:
            self._rows.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Messages of some topics in order of log time, read lazily; equal times in the order of the file.

        Only messages with ``start_ns <= log_time_ns < stop_ns`` are given; None leaves that side open. The database
        finds them by its index of times.
        """
        first_ns, end_ns = self._span
        if (start_ns is not None and start_ns > end_ns) or (stop_ns is not None and stop_ns <= first_ns):
            return
        if not any(c.topic in topics and c.msgcount for c in self._connections):
            return
        # A bound outside the log is left out: SQLite takes no integers of more than 64 bits.
        start_ns = None if start_ns is None or start_ns <= first_ns else start_ns
        stop_ns = None if stop_ns is None or stop_ns > end_ns else stop_ns
        # Number of messages given at the last log time by topic, which reading by row number must leave out.
        last_ns, given = start_ns, dict[str, int]()
        reader = self._reader_of_this_thread()
        wanted = [c for c in reader.connections if c.topic in topics and c.msgcount]
        iterator = reader.messages(wanted, start_ns, stop_ns)
        while True:
            try:
                connection, log_time_ns, data = next(iterator)
            except StopIteration:
                return
            except Exception:
                # A damaged page can raise any exception, as at opening.
                break
            if not isinstance(log_time_ns, int) or not isinstance(data, bytes):
                break
            if log_time_ns != last_ns:
                last_ns = log_time_ns
                given.clear()
            given[connection.topic] = given.get(connection.topic, 0) + 1
            yield RawMessage(self.path, self._channels[connection.id], log_time_ns, data)
        yield from self._rest(topics, last_ns, stop_ns, given)

    def _reader_of_this_thread(self) -> Any:
        """The open rosbags reader of this thread."""
        thread = threading.get_ident()
        if thread not in self._readers:
            reader = Reader(self._file)
            reader.open()
            self._readers[thread] = reader
        return self._readers[thread]

    def _rest(
        self, topics: Collection[str], last_ns: int | None, stop_ns: int | None, given: dict[str, int]
    ) -> Iterator[RawMessage]:
        """Yield the messages from ``last_ns`` on by row number, without those at this time that were given already."""
        if self._rows is None:
            try:
                self._rows = DamagedDb3Log(self._file)
            except InputError:
                self._damage.note("cut or damaged beyond repair")
                return
            self._rows.path = self.path
        for message in self._rows.messages(topics, last_ns, stop_ns):
            if message.log_time_ns == last_ns and given.get(message.topic):
                given[message.topic] -= 1
                continue
            yield message


def _channel(connection: Connection) -> Channel:
    """Return the channel of a connection."""
    return Channel(
        connection.topic,
        normalise_type_name(connection.msgtype),
        str(getattr(connection.ext, "serialization_format", "cdr")),
        _FORMATS[connection.msgdef.format],
        connection.msgdef.data.encode(),
    )
