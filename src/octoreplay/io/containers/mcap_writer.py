"""Writer of MCAP files with ROS 2 messages (CDR) and embedded schemas, as rosbag2 writes them."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Self, cast

from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import TypesysError
from zstandard import ZstdError

from octoreplay._version import __version__
from octoreplay.errors import InputError, OutputError
from octoreplay.io.containers.log_reader import Channel as LogChannel
from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.containers.mcap_records import CRC_KEY, metadata_crc
from octoreplay.io.messages.ros_types import typestore
from octoreplay.io.output_file import OutputFile


class WrittenMessage(NamedTuple):
    """One message: its topic, type, log time and serialised value."""

    topic: str
    type_name: str
    stamp_ns: int
    data: bytes


class Written(NamedTuple):
    """Content of an unfinished file.

    ``metadata`` are the names and values of the metadata records, ``number`` is the number of messages, and
    ``unfinished`` are the last messages, which are not in a finished chunk.
    """

    metadata: tuple[tuple[str, dict[str, str]], ...]
    number: int
    unfinished: tuple[WrittenMessage, ...]


class RosMcapWriter:
    """Writes one MCAP file; a context manager that finishes the file.

    ``profile`` is that of the file: 'ros2', or empty for a file with messages of other encodings (``copy_raw``).

    Equal calls give equal bytes: no wall-clock time and nothing machine-dependent is written. ``chunk_size`` [bytes] is
    the size from which a chunk is ended; ``data_crc`` adds the checksum of the data section. Chunks are not buffered: a
    reader sees each of them as soon as it is ended. Raises OutputError where the file exists, or cannot be created or
    written.
    """

    def __init__(self, path: Path, *, chunk_size: int = 1 << 20, data_crc: bool = False, profile: str = "ros2") -> None:
        self.path = path
        try:
            self._file = OutputFile(path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = Writer(
            cast("IO[bytes]", self._file), chunk_size=chunk_size, compression=CompressionType.ZSTD,
            enable_data_crcs=data_crc,
        )  # fmt: skip
        try:
            self._guard(lambda: self._writer.start(profile=profile, library=f"octoreplay {__version__}"))
        except OutputError:
            self._file.close()
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            raise
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._has_new_channels = False
        self._sequences: dict[str, int] = {}
        self._metadata: list[tuple[str, dict[str, str]]] = []
        self._num_messages = 0
        self._unfinished: list[WrittenMessage] = []
        self._end = self._file.tell()
        self._finished = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.finish()

    def write(self, topic: str, type_name: str, value: Any, stamp_ns: int) -> None:
        """Append one message of a registered type; ``stamp_ns`` is its log and publish time."""
        self._append(WrittenMessage(topic, type_name, stamp_ns, bytes(typestore().serialize_cdr(value, type_name))))

    def copy(self, schema: Schema | None, channel: Channel, record: Message) -> None:
        """Append a message of another file as it is."""
        type_name, definition = ("", b"") if schema is None else (schema.name, schema.data)
        if channel.topic not in self._channels:
            self._register(channel.topic, type_name, definition)
        self._sequences[channel.topic] = record.sequence
        self._add(WrittenMessage(channel.topic, type_name, record.log_time, record.data), record.publish_time)

    def copy_raw(self, message: RawMessage) -> None:
        """Append a message of a log in its own encoding, with the definition of its type in the log."""
        channel = message.channel
        key = f"{channel.topic}\0{channel.type_name}\0{channel.encoding}"
        if key not in self._channels:
            self._register_raw(key, channel)
        sequence = self._sequences[key] = self._sequences.get(key, -1) + 1
        data = bytes(message.data)
        self._guard(
            lambda: self._writer.add_message(
                channel_id=self._channels[key], log_time=message.log_time_ns, publish_time=message.log_time_ns,
                sequence=sequence, data=data,
            )
        )  # fmt: skip

    def _register_raw(self, key: str, channel: LogChannel) -> None:
        """Register the channel of another log's messages."""
        name, form, definition = channel.type_name, channel.definition_format, channel.definition
        if not definition and channel.encoding in ("cdr", "ros1"):
            form = "ros2msg" if channel.encoding == "cdr" else "ros1msg"
            with contextlib.suppress(KeyError, TypesysError):
                version = 2 if channel.encoding == "cdr" else 1
                definition = typestore().generate_msgdef(name, ros_version=version)[0].encode()
        # ROS 1 writes package/Name (https://mcap.dev/spec/registry).
        name = name.replace("/msg/", "/") if channel.encoding == "ros1" else name
        schema_key = f"{name}\0{form}\0{definition!r}"
        if schema_key not in self._schemas:
            self._schemas[schema_key] = self._writer.register_schema(name=name, encoding=form, data=definition)
        self._channels[key] = self._writer.register_channel(
            topic=channel.topic, message_encoding=channel.encoding, schema_id=self._schemas[schema_key]
        )

    @property
    def written(self) -> Written:
        """Content of the file so far."""
        return Written(tuple(self._metadata), self._num_messages, tuple(self._unfinished))

    def take_over(self, path: Path, written: Written) -> None:
        """Append the messages that another file of this class held when it was synced.

        They give equal bytes as if they had been written here. Raises InputError where the file is damaged.
        """
        try:
            with path.open("rb") as file:
                self._copy_first(file, written.number - len(written.unfinished))
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        except (McapError, ZstdError, struct.error, LookupError, ValueError) as error:
            raise InputError(f"{path}: damaged: it cannot be continued ({error})") from error
        for message in written.unfinished:
            self._append(message)

    def _copy_first(self, file: IO[bytes], number: int) -> None:
        """Append the first ``number`` messages of a file."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        records = StreamReader(file, validate_crcs=True).records if number else iter(())
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                self.copy(schemas[channel.schema_id], channel, record)
                if self._num_messages == number:
                    return
        if self._num_messages < number:
            raise ValueError(f"it holds {self._num_messages} of {number} messages")

    def _append(self, message: WrittenMessage) -> None:
        """Append one message."""
        if message.topic not in self._channels:
            self._register(message.topic, message.type_name)
        self._sequences[message.topic] = self._sequences.get(message.topic, -1) + 1
        self._add(message, message.stamp_ns)

    def _add(self, message: WrittenMessage, publish_time_ns: int) -> None:
        """Append one message of a registered topic."""
        self._guard(
            lambda: self._writer.add_message(
                channel_id=self._channels[message.topic], log_time=message.stamp_ns, publish_time=publish_time_ns,
                sequence=self._sequences[message.topic], data=message.data,
            )
        )  # fmt: skip
        self._num_messages += 1
        self._unfinished.append(message)
        self._note_chunks()

    def _note_chunks(self) -> None:
        """Forget the messages of chunks that were finished since the last call."""
        if self._file.tell() > self._end:
            self._end = self._file.tell()
            self._unfinished.clear()
            if self._has_new_channels:
                # Later chunks cannot be read without the chunk that has the definition of their channels.
                self._has_new_channels = False
                self.sync()

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append one metadata record, with its checksum."""
        self._guard(lambda: self._writer.add_metadata(name, {**values, CRC_KEY: metadata_crc(name, values)}))
        self._metadata.append((name, dict(values)))
        self._end = self._file.tell()

    def sync(self) -> None:
        """Flush to disk what was written."""
        self._guard(self._file.sync)

    def finish(self) -> None:
        """Write summary and footer and close the file; a second call does nothing.

        After a failed write the file is closed without them: it ends with its last complete record.
        """
        if self._finished:
            return
        self._finished = True
        try:
            if not self._file.is_damaged:
                self._guard(self._writer.finish)
        finally:
            self._guard(self._file.close)

    @property
    def is_open(self) -> bool:
        """True until the file is finished or a write has failed."""
        return not self._finished and not self._file.is_damaged

    def is_at(self, path: Path) -> bool:
        """Return True if a path is this file, and not one that another process has put there."""
        return self._file.is_at(path)

    def _register(self, topic: str, type_name: str, definition: bytes | None = None) -> int:
        """Register a topic and return its channel id; ``definition`` is None for registered types."""
        if type_name not in self._schemas:
            if definition is None:
                definition = typestore().generate_msgdef(type_name, ros_version=2)[0].encode()
            self._schemas[type_name] = self._writer.register_schema(name=type_name, encoding="ros2msg", data=definition)
        self._has_new_channels = True
        self._channels[topic] = self._writer.register_channel(
            topic=topic, message_encoding="cdr", schema_id=self._schemas[type_name],
            metadata={"offered_qos_profiles": ""},
        )  # fmt: skip
        self._note_chunks()
        return self._channels[topic]

    def _guard(self, action: Any) -> None:
        """Run one writing step; raise OutputError for an OSError such as a full disk."""
        try:
            action()
        except BaseException as error:
            # The state of the MCAP writer is unknown, so it must not finish the file.
            self._file.is_damaged = True
            if isinstance(error, OSError):
                raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from error
            raise
