"""Decompression of chunks, messages and files, with output limited in proportion to the compressed size."""

from __future__ import annotations

import bz2
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import lz4.frame
import zstandard

from octoreplay.config.file_url import InputFile
from octoreplay.errors import InputError
from octoreplay.io.messages.decoders import Bytes

MAX_CHUNK_BYTES = 1 << 30
"""Greatest size of a chunk or message; a greater one is damage. Recorders write chunks of a few MB."""
SMALL_CONTENT = 1 << 27
"""Size up to which a chunk, a message or a file may decompress however small it is [byte]."""
SMALL_COUNT = 1 << 17
"""Number of records that a file may hold however small it is; above, a record takes four bytes or more."""
MAX_RATIO = 256
"""Greatest ratio of decompressed to compressed size above SMALL_CONTENT. Recorded chunks have ratios below 20."""
_PIECE_BYTES = 1 << 20
_BLOCK_BYTES = 1 << 17
# Greatest ratio of decompressed to compressed size: a zstd block of 4 bytes holds at most 128 KiB (RFC 8878, 3.1.1.2),
# and a length byte of lz4 counts at most 255 bytes. bz2 needs no limit: its output buffer grows with the output.
_FORMAT_RATIO = {"zstd": 1 << 15, "lz4": 255}
_FAILURES = (zstandard.ZstdError, OSError, RuntimeError, EOFError, ValueError, OverflowError, MemoryError)


_T = TypeVar("_T")


class ContentBudget:
    """Bytes and records that one pass over a file of ``num_bytes`` may read; they bound its memory and time.

    Methods raise InputError where the file holds more, which only files made for it do.
    """

    def __init__(self, path: InputFile, num_bytes: int) -> None:
        self._path = path
        self._num_bytes = num_bytes
        self._bytes_left = content_limit(num_bytes)
        self._records_left = SMALL_COUNT + num_bytes // 4

    def take(self, num_bytes: int) -> None:
        """Take some decompressed bytes."""
        self._bytes_left -= num_bytes
        if self._bytes_left < 0:
            self._refuse(f"{content_limit(self._num_bytes):,} bytes")

    def counted(self, records: Iterable[_T]) -> Iterator[_T]:
        """Yield records and take each of them."""
        for record in records:
            self._records_left -= 1
            if self._records_left < 0:
                self._refuse(f"{SMALL_COUNT + self._num_bytes // 4:,} messages")
            yield record

    def _refuse(self, most: str) -> None:
        raise InputError(f"{self._path}: damaged: its {self._num_bytes:,} bytes hold more than {most}; record it again")


def is_plausible_size(compression: str, num_bytes: int, size: int) -> bool:
    """Return True if ``num_bytes`` bytes in a known compression can decompress to ``size`` bytes."""
    if compression in ("", "none"):
        return size == num_bytes <= MAX_CHUNK_BYTES
    if compression not in ("zstd", "lz4", "bz2"):
        return False
    return size <= _max_bytes(compression, num_bytes)


def decompress(compression: str, data: memoryview, size: int) -> Bytes:
    """Decompress at most ``size`` bytes. Cut data give the bytes before the cut, damaged data give no bytes.

    ``compression`` is ``zstd``, ``lz4``, ``bz2``, ``none`` or empty; any other gives no bytes.
    """
    if compression in ("", "none"):
        return data[:size]
    # Cut data decompress to less than the size given for the whole.
    size = min(size, _max_bytes(compression, len(data)))
    try:
        if compression == "zstd":
            return _zstd(data, size)
        if compression == "lz4":
            return _lz4(data, size)
        return bz2.BZ2Decompressor().decompress(data, max_length=size) if compression == "bz2" else b""
    except _FAILURES:
        return b""


def decompress_message(data: Bytes) -> bytes | None:
    """Decompress one message that rosbag2 compressed with zstd; None where it is damaged."""
    try:
        if 0 <= zstandard.frame_content_size(data) <= _max_bytes("zstd", len(data)):
            return bytes(zstandard.ZstdDecompressor().decompress(data))
    except _FAILURES:
        return None
    return None


def decompress_file(source: Path, target: Path) -> None:
    """Decompress a zstd file into another one, up to the first damage.

    The output is limited to ``SMALL_CONTENT``, or ``MAX_RATIO`` times the size of ``source`` if that is more. Raises
    InputError where ``source`` cannot be read or holds nothing that can be decompressed, and where ``target`` cannot be
    written.
    """
    try:
        room = content_limit(source.stat().st_size)
        with source.open("rb") as file, target.open("wb") as copy:
            reader = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
            with suppress(zstandard.ZstdError):
                # Reads of one block each, so that no intact block is lost with a damaged one.
                while room > 0 and (piece := reader.read(min(_BLOCK_BYTES, room))):
                    room -= copy.write(piece)
            if not copy.tell():
                raise InputError(f"{source}: holds nothing that can be decompressed")
    except FileNotFoundError:
        raise InputError(f"{source}: no such file") from None
    except OSError as error:
        raise InputError(f"{source}: cannot be decompressed into {target.parent}: {error.strerror}") from error


def content_limit(num_bytes: int) -> int:
    """Return the greatest size to which ``num_bytes`` compressed bytes may decompress [byte]."""
    return max(SMALL_CONTENT, MAX_RATIO * num_bytes)


def _max_bytes(compression: str, num_bytes: int) -> int:
    """Return the greatest size to which ``num_bytes`` bytes of a chunk or message can decompress."""
    limit = min(MAX_CHUNK_BYTES, content_limit(num_bytes))
    return min(limit, _FORMAT_RATIO[compression] * num_bytes + _PIECE_BYTES) if compression in _FORMAT_RATIO else limit


def _zstd(data: memoryview, size: int) -> Bytes:
    """Decompress at most ``size`` bytes of zstd frames."""
    # One call is fastest but allocates the size that the frame gives, so that must equal the chunk's.
    if zstandard.frame_content_size(data) == size:
        try:
            return bytes(zstandard.ZstdDecompressor().decompress(data))
        except zstandard.ZstdError:
            pass
    return _zstd_pieces(data, size)


def _lz4(data: memoryview, size: int) -> bytes:
    """Decompress at most ``size`` bytes of an lz4 frame."""
    # One call is fastest but allocates the size that the frame gives; the piecewise interface does not.
    if lz4.frame.get_frame_info(data)["content_size"] == size:
        try:
            return bytes(lz4.frame.decompress(data))
        except RuntimeError:
            pass
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))


def _zstd_pieces(data: Any, size: int) -> bytearray:
    """Decompress at most ``size`` bytes of zstd frames piece by piece, up to the first damage."""
    result = bytearray()
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as reader:
        try:
            while len(result) < size and (piece := reader.read(min(_PIECE_BYTES, size - len(result)))):
                result += piece
        except zstandard.ZstdError:
            return result
    return result
