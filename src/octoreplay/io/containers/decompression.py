"""Decompressing what a log holds, within bounds that follow from how many bytes are really there."""

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
"""A chunk, or a compressed message, of more bytes than this is damage; recorders make chunks of a few MB."""
MAX_FILE_RATIO = 1000
_PIECE_BYTES = 1 << 20
_BLOCK_BYTES = 1 << 17
# No frame gives more bytes for one: a zstd block of 4 bytes holds at most 128 KiB (RFC 8878, 3.1.1.2), and each length
# byte of lz4 stands for at most 255. bz2 is decompressed into memory that grows with what comes out.
_MAX_RATIO = {"zstd": 1 << 15, "lz4": 255}
_FAILURES = (zstandard.ZstdError, OSError, RuntimeError, EOFError, ValueError, OverflowError, MemoryError)


def is_plausible_size(compression: str, num_bytes: int, size: int) -> bool:
    """True where so many compressed bytes can become ``size`` bytes, of a compression that is known here."""
    if compression in ("", "none"):
        return size == num_bytes <= MAX_CHUNK_BYTES
    if compression not in ("zstd", "lz4", "bz2"):
        return False
    return size <= _most_bytes(compression, num_bytes)


def decompress(compression: str, data: memoryview, size: int) -> Bytes:
    """At most ``size`` bytes of compressed data: those of cut data as far as they go, none of damaged data.

    ``compression`` is ``zstd``, ``lz4``, ``bz2``, or ``none`` or empty; anything else gives nothing.
    """
    if compression in ("", "none"):
        return data[:size]
    # What cut data can still become is less than what its whole would have.
    size = min(size, _most_bytes(compression, len(data)))
    try:
        if compression == "zstd":
            return _zstd(data, size)
        if compression == "lz4":
            return _lz4(data, size)
        return bz2.BZ2Decompressor().decompress(data, max_length=size) if compression == "bz2" else b""
    except _FAILURES:
        return b""


def decompress_message(data: Bytes) -> bytes | None:
    """The bytes of one message that rosbag2 compressed with zstd; None where it is damaged."""
    try:
        if 0 <= zstandard.frame_content_size(data) <= _most_bytes("zstd", len(data)):
            return bytes(zstandard.ZstdDecompressor().decompress(data))
    except _FAILURES:
        return None
    return None


def decompress_file(source: Path, target: Path) -> None:
    """Write what a zstd file holds to another, as far as it is whole; at most 1000 times its size and 1 GiB.

    Raises InputError where it cannot be read, or where there is no room for it.
    """
    try:
        room = MAX_FILE_RATIO * source.stat().st_size + MAX_CHUNK_BYTES
        with source.open("rb") as file, target.open("wb") as copy:
            reader = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
            with suppress(zstandard.ZstdError):
                # As much as one block holds, so that no good one is lost with a damaged one.
                while room > 0 and (piece := reader.read(min(_BLOCK_BYTES, room))):
                    room -= copy.write(piece)
            if not copy.tell():
                raise InputError(f"{source}: holds nothing that can be decompressed")
    except FileNotFoundError:
        raise InputError(f"{source}: no such file") from None
    except OSError as error:
        raise InputError(f"{source}: cannot be decompressed into {target.parent}: {error.strerror}") from error


def _most_bytes(compression: str, num_bytes: int) -> int:
    """How many bytes so many compressed bytes can become."""
    if compression not in _MAX_RATIO:
        return MAX_CHUNK_BYTES
    return min(MAX_CHUNK_BYTES, _MAX_RATIO[compression] * num_bytes + _PIECE_BYTES)


def _zstd(data: memoryview, size: int) -> Bytes:
    """At most ``size`` bytes of zstd frames."""
    # One call is quickest, but makes room for what the frame says, so it must say the same as the chunk.
    if zstandard.frame_content_size(data) == size:
        try:
            return bytes(zstandard.ZstdDecompressor().decompress(data))
        except zstandard.ZstdError:
            pass
    return _pieces(data, size)


def _lz4(data: memoryview, size: int) -> bytes:
    """At most ``size`` bytes of an lz4 frame."""
    # One call is quickest, but makes room for what the frame says; the piecewise interface does not believe it.
    if lz4.frame.get_frame_info(data)["content_size"] == size:
        try:
            return bytes(lz4.frame.decompress(data))
        except RuntimeError:
            pass
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))


def _pieces(data: Any, size: int) -> bytearray:
    """At most ``size`` bytes of zstd frames, decompressed as far as they are whole."""
    result = bytearray()
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as reader:
        try:
            while len(result) < size and (piece := reader.read(min(_PIECE_BYTES, size - len(result)))):
                result += piece
        except zstandard.ZstdError:
            return result
    return result
