"""Fingerprints of input files: fast ones of a part of the file, and the SHA-256 of all of it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import BinaryIO

from octoreplay.config.fields import path_problem
from octoreplay.config.file_url import FileUrl, InputFile
from octoreplay.errors import InputError
from octoreplay.io.remote_files import local_copy

MCAP_MAGIC = b"\x89MCAP0\r\n"
FOOTER_TAIL = 1 + 8 + 8 + 8 + 4 + len(MCAP_MAGIC)
"""Length of an MCAP file's end from its footer record on [bytes]: opcode, length, two offsets, CRC, magic."""
EDGE = 1 << 20
"""Bytes hashed at the beginning and at the end of a file that is not a finished MCAP file."""


@dataclass(frozen=True)
class Fingerprint:
    """Fingerprint of one input file: path or URL, size [bytes], hashed part, and SHA-256 of this part in hexadecimal.

    ``method`` is ``sha256`` (the whole file), ``mcap-summary`` (summary and footer of an MCAP file) or ``edges`` (the
    first and the last MiB).
    """

    path: InputFile
    size: int
    method: str
    value: str


def fingerprint(path: InputFile, *, whole: bool = False) -> Fingerprint:
    """Return the fingerprint of one file; ``whole`` hashes all of it.

    That of a URL is the fingerprint of its copy. Raises InputError where the file cannot be read.
    """
    try:
        with local_copy(path).open("rb") as stream:
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


def log_files(log: InputFile) -> tuple[InputFile, ...]:
    """Return the files of one log: the file itself, or all files of a rosbag2 folder, sorted.

    Raises InputError where the folder cannot be read or holds a file with a name that is not UTF-8.
    """
    if isinstance(log, FileUrl) or not log.is_dir():
        return (log,)
    try:
        files = tuple(sorted(path for path in log.iterdir() if path.is_file()))
    except OSError as error:
        raise InputError(f"{log}: cannot be read: {error.strerror}") from error
    for file in files:
        problem = path_problem(file)
        if problem is not None:
            raise InputError(f"{file}: {problem}")
    return files


def _summary_start(stream: BinaryIO, size: int) -> int | None:
    """Return the offset of an MCAP file's summary; None for a cut file, one without a summary and other formats."""
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
    """Return the hash of the first and the last MiB, or of every byte once where the file is shorter."""
    digest = hashlib.sha256()
    stream.seek(0)
    digest.update(stream.read(EDGE))
    stream.seek(min(size, max(EDGE, size - EDGE)))
    digest.update(stream.read(EDGE))
    return digest.hexdigest()
