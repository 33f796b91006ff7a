"""File with the labels that are finished, from which an interrupted labelling continues.

The file begins with a magic number and a record of the settings; a record of each finished frame follows. A record is
its length and CRC-32 as little-endian uint32, and its bytes. A cut record at the end is ignored.
"""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io.output_file import OutputFile, publish, remove_temporary, temporary_path, writing
from octoreplay.io.sensors.images import MAX_PIXELS
from octoreplay.records import UInt8Array

_MAGIC = b"OCTL\x01"
_HEAD = struct.Struct("<II")
_FRAME = struct.Struct("<IIQQ?")
_ZLIB_LEVEL = 1
_MAX_RECORD = 1 << 30


@dataclass(frozen=True, eq=False)
class FrameLabels:
    """Raw labels of one sensor message, uint16 (H, W) or (P,), and confidences uint8 of the same shape or None."""

    raw: npt.NDArray[np.uint16]
    confidences: UInt8Array | None


def unfinished_path(output: Path) -> Path:
    """Return the path of the finished labels of an output: ``x.labels`` for ``x.mcap``."""
    return output.with_suffix(".labels")


class FinishedFrames:
    """Labels of sensor messages by robot and number of the message; a context manager that closes the file.

    ``settings`` is a text that names everything that the labels depend on. With ``continues`` the frames of an earlier
    file with the same settings are taken over. Raises ConfigError where its settings differ, OutputError where the
    file cannot be written.
    """

    def __init__(self, output: Path, settings: str, *, continues: bool) -> None:
        self.path = unfinished_path(output)
        self._places: dict[tuple[int, int], tuple[int, int]] = {}
        old = list(self._earlier(settings)) if continues and self.path.exists() else []
        temporary = temporary_path(self.path)
        with writing(self.path):
            self._file = OutputFile(temporary)
            self._file.write(_MAGIC)
            self._append(settings.encode())
            for record in old:
                self._add(record)
            publish(temporary, self.path)
        remove_temporary(temporary)
        self._reading = self.path.open("rb")
        self.num_taken_over = len(self._places)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            self._file.sync()
        self._file.close()
        self._reading.close()
        if value is None or not self._places:
            self.path.unlink(missing_ok=True)
        elif isinstance(value, Exception | KeyboardInterrupt):
            value.add_note(f"{len(self._places):,} finished images are kept in {self.path}; --resume continues")

    def __contains__(self, key: object) -> bool:
        return key in self._places

    def __len__(self) -> int:
        return len(self._places)

    def put(self, robot: int, number: int, labels: FrameLabels) -> None:
        """Add the labels of a sensor message. Raises OutputError."""
        shape = labels.raw.shape if labels.raw.ndim == 2 else (1, labels.raw.size)
        head = _FRAME.pack(robot, number, *shape, labels.confidences is not None)
        parts = [labels.raw.astype("<u2").tobytes()]
        if labels.confidences is not None:
            parts.append(labels.confidences.tobytes())
        with writing(self.path):
            self._add(head + zlib.compress(b"".join(parts), _ZLIB_LEVEL))

    def get(self, robot: int, number: int) -> FrameLabels:
        """Return the labels of a sensor message; those of a cloud have one row. Raises InputError."""
        offset, length = self._places[robot, number]
        self._reading.seek(offset)
        record = self._reading.read(length)
        try:
            _, _, height, width, has_confidences = _FRAME.unpack_from(record)
            num_bytes = height * width * (3 if has_confidences else 2)
            if height * width > MAX_PIXELS:
                raise ValueError("too many pixels")
            data = zlib.decompressobj().decompress(record[_FRAME.size :], num_bytes + 1)
            if len(data) != num_bytes:
                raise ValueError("another number of bytes")
            raw = np.frombuffer(data, "<u2", height * width).reshape(height, width)
            confidences = None
            if has_confidences:
                confidences = np.frombuffer(data, np.uint8, height * width, 2 * height * width).reshape(height, width)
        except (struct.error, zlib.error, ValueError) as error:
            raise InputError(f"{self.path}: is damaged; begin anew with --restart") from error
        return FrameLabels(raw, confidences)

    def forget(self) -> None:
        """Drop all frames: their labels are of no use."""
        self._places.clear()

    def _add(self, record: bytes) -> None:
        """Append the record of a frame."""
        robot, number = _FRAME.unpack_from(record)[:2]
        self._append(record)
        self._places[robot, number] = self._file.tell() - len(record), len(record)

    def _append(self, record: bytes) -> None:
        """Append one record."""
        self._file.write(_HEAD.pack(len(record), zlib.crc32(record)) + record)

    def _earlier(self, settings: str) -> Iterator[bytes]:
        """Records of the frames in an earlier file."""
        records = _records(self.path)
        if next(records, b"") != settings.encode():
            raise ConfigError(
                f"{self.path}: was made with another log, model, class table or options; give the same ones, or "
                "--restart to begin anew"
            )
        yield from (record for record in records if len(record) > _FRAME.size)


def check_unstarted(output: Path) -> None:
    """Raise OutputError where an earlier command left finished labels."""
    path = unfinished_path(output)
    with writing(path):
        is_present = path.exists()
    if is_present:
        raise OutputError(
            f"{path}: an earlier command left these finished labels; continue it with --resume, or begin anew with"
            " --restart"
        )


def _records(path: Path) -> Iterator[bytes]:
    """Intact records of a file up to the first one that is not."""
    try:
        with path.open("rb") as file:
            num_bytes = path.stat().st_size
            if file.read(len(_MAGIC)) != _MAGIC:
                return
            while len(head := file.read(_HEAD.size)) == _HEAD.size:
                length, checksum = _HEAD.unpack(head)
                record = file.read(length) if length <= min(_MAX_RECORD, num_bytes) else b""
                if len(record) < length or zlib.crc32(record) != checksum:
                    return
                yield record
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
