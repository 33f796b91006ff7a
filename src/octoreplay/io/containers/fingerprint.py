"""Fingerprints of input files: quick ones that do not read the whole file, and the full SHA-256."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from octoreplay.errors import InputError

MCAP_MAGIC = b"\x89MCAP0\r\n"
FOOTER_TAIL = 1 + 8 + 8 + 8 + 4 + len(MCAP_MAGIC)
"""Bytes of an MCAP file from its footer record on: opcode, length, two offsets, CRC, magic."""
EDGE = 1 << 20
"""Bytes that are read from either end of a file that is no finished MCAP."""


@dataclass(frozen=True)
class Fingerprint:
    """What identifies one input file: path, size in bytes, what was hashed, and the hash in hexadecimal.

    ``method`` is ``sha256`` (the whole file), ``mcap-summary`` (an MCAP's summary and footer) or ``edges``
    (the first and the last MiB).
    """

    path: Path
    size: int
    method: str
    value: str


def fingerprint(path: Path, *, whole: bool = False) -> Fingerprint:
    """The fingerprint of one file; ``whole`` hashes all of it.

    Raises InputError where the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, 2)
            if whole:
                stream.seek(0)
                return Fingerprint(path, size, "sha256", hashlib.file_digest(stream, "sha256").hexdigest())
            start = _summary_start(stream, size)
            if start is not None:
                stream.seek(start)
                return Fingerprint(path, size, "mcap-summary", hashlib.sha256(stream.read()).hexdigest())
            return Fingerprint(path, size, "edges", _edges(stream, size))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def log_files(log: Path) -> tuple[Path, ...]:
    """The files of one log: itself, or all files of a folder (rosbag2), sorted."""
    return tuple(sorted(path for path in log.iterdir() if path.is_file())) if log.is_dir() else (log,)


def _summary_start(stream: BinaryIO, size: int) -> int | None:
    """Where a finished MCAP's summary starts; None for a cut one, one without a summary, or another format."""
    if size < len(MCAP_MAGIC) + FOOTER_TAIL or not _has_magic(stream, 0):
        return None
    if not _has_magic(stream, size - len(MCAP_MAGIC)):
        return None
    stream.seek(size - FOOTER_TAIL + 1 + 8)
    start = int.from_bytes(stream.read(8), "little")
    return start if len(MCAP_MAGIC) <= start < size - FOOTER_TAIL else None


def _has_magic(stream: BinaryIO, offset: int) -> bool:
    stream.seek(offset)
    return stream.read(len(MCAP_MAGIC)) == MCAP_MAGIC


def _edges(stream: BinaryIO, size: int) -> str:
    """Hash of the first and the last MiB; of a shorter file, of every byte once."""
    digest = hashlib.sha256()
    stream.seek(0)
    digest.update(stream.read(EDGE))
    stream.seek(min(size, max(EDGE, size - EDGE)))
    digest.update(stream.read(EDGE))
    return digest.hexdigest()
