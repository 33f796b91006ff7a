"""Decompression of chunks, messages and files, with output limited in proportion to the compressed size."""

from __future__ import annotations

import bz2
from contextlib import suppress
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard

from octoreplay.errors import InputError
from octoreplay.io.messages.decoders import Bytes

MAX_CHUNK_BYTES = 1 << 30
"""Greatest size of a chunk or message; a greater one is damage. Recorders write chunks of a few MB."""
MAX_FILE_RATIO = 1000
"""Greatest ratio of decompressed to compressed size of a file."""
_PIECE_BYTES = 1 << 20
_BLOCK_BYTES = 1 << 17
# Greatest ratio of decompressed to compressed size: a zstd block of 4 bytes holds at most 128 KiB (RFC 8878, 3.1.1.2),
# and a length byte of lz4 counts at most 255 bytes. bz2 needs no limit: its output buffer grows with the output.
_MAX_RATIO = {"zstd": 1 << 15, "lz4": 255}
_FAILURES = (zstandard.ZstdError, OSError, RuntimeError, EOFError, ValueError, OverflowError, MemoryError)


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

    The output is limited to 1000 times the size of ``source`` plus 1 GiB. Raises InputError where ``source`` cannot be
    read or holds nothing that can be decompressed, and where ``target`` cannot be written.
    """
    try:
        room = MAX_FILE_RATIO * source.stat().st_size + MAX_CHUNK_BYTES
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


def _max_bytes(compression: str, num_bytes: int) -> int:
    """Return the greatest size to which ``num_bytes`` bytes can decompress."""
    if compression not in _MAX_RATIO:
        return MAX_CHUNK_BYTES
    return min(MAX_CHUNK_BYTES, _MAX_RATIO[compression] * num_bytes + _PIECE_BYTES)


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
