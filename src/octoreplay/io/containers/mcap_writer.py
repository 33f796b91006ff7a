"""Writer of MCAP files with ROS 2 messages (CDR) and embedded schemas, as rosbag2 writes them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.writer import CompressionType, Writer

from octoreplay._version import __version__
from octoreplay.errors import OutputError
from octoreplay.io.messages.ros_types import typestore


class RosMcapWriter:
    """Writes one MCAP file with profile ``ros2``; a context manager that finishes the file.

    Equal calls give equal bytes: no wall-clock time and nothing machine-dependent is written. ``chunk_size`` [bytes] is
    the size from which a chunk is ended. Raises OutputError where the file cannot be created or written.
    """

    def __init__(self, path: Path, *, chunk_size: int = 1 << 20) -> None:
        self.path = path
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = Writer(self._file, chunk_size=chunk_size, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=f"octoreplay {__version__}")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        self._finished = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.finish()

    def write(self, topic: str, type_name: str, value: Any, stamp_ns: int) -> None:
        """Append one message of a registered type; ``stamp_ns`` is its log and publish time."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._register(topic, type_name)
        sequence = self._sequences.get(channel, 0)
        self._sequences[channel] = sequence + 1
        data = bytes(typestore().serialize_cdr(value, type_name))
        self._guard(
            lambda: self._writer.add_message(
                channel_id=channel, log_time=stamp_ns, publish_time=stamp_ns, sequence=sequence, data=data
            )
        )

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append one metadata record."""
        self._guard(lambda: self._writer.add_metadata(name, dict(values)))

    def finish(self) -> None:
        """Write summary and footer and close the file; a second call does nothing."""
        if self._finished:
            return
        self._finished = True
        try:
            self._guard(self._writer.finish)
        finally:
            self._guard(self._file.close)

    def _register(self, topic: str, type_name: str) -> int:
        """Register a topic and return its channel id."""
        if type_name not in self._schemas:
            definition, _ = typestore().generate_msgdef(type_name, ros_version=2)
            self._schemas[type_name] = self._writer.register_schema(
                name=type_name, encoding="ros2msg", data=definition.encode()
            )
        self._channels[topic] = self._writer.register_channel(
            topic=topic, message_encoding="cdr", schema_id=self._schemas[type_name],
            metadata={"offered_qos_profiles": ""},
        )  # fmt: skip
        return self._channels[topic]

    def _guard(self, action: Any) -> None:
        """Run one writing step; raise OutputError for an OSError such as a full disk."""
        try:
            action()
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from error
