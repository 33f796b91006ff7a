"""Map packets: an octree as bytes and back, bit for bit. docs/packet-format.md describes every byte."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import zstandard

from octoreplay.errors import PacketError
from octoreplay.mapping.octree import SemanticOctree, TreeStreams, mask_bytes, octree_from_streams
from octoreplay.records import Int64Array

MAGIC = b"OCTM"
VERSION = 2
FULL, DELTA = 0, 1
CONTENT_FLOAT32 = 0
NO_COMPRESSION, ZSTD = 0, 1
ZSTD_LEVEL = 1
MAX_ZSTD_RATIO = 1 << 15
"""A zstd block of at least 4 bytes holds at most 2^17."""
MAX_CLASSES = 254

_HEADER = struct.Struct("<4sBBBBHHdIIIIII")
"""magic, version, kind, content, compression, classes, 0, resolution, words, leaves, masks, own values, payload
bytes, CRC."""

HEADER_BYTES = _HEADER.size


@dataclass(frozen=True)
class PacketHeader:
    """What a packet says of itself."""

    kind: int
    compression: int
    num_classes: int
    resolution: float
    num_words: int
    num_leaves: int
    num_vectors: int
    num_own_values: int
    payload_bytes: int

    @property
    def raw_bytes(self) -> int:
        """Size of the uncompressed octree."""
        num_values = self.num_leaves + self.num_own_values
        return 2 * self.num_words + 4 * num_values + self.num_vectors * mask_bytes(self.num_classes)


def encode_packet(
    octree: SemanticOctree, *, compress: bool = True, tolerance: float = 0.0, prune: bool = True
) -> bytes:
    """A whole map as a packet (a key frame).

    Sibling leaves that differ by at most ``tolerance`` are merged (0: lossless); without ``prune`` none are.
    """
    return pack(octree, octree.streams(prune=prune, tolerance=tolerance), FULL, compress=compress)


def encode_delta(octree: SemanticOctree, indices: Int64Array, *, compress: bool = True) -> bytes:
    """A packet with the bricks ``indices`` (n,) int64 of a map, whole and lossless."""
    return pack(octree, octree.streams(indices), DELTA, compress=compress)


def pack(octree: SemanticOctree, streams: TreeStreams, kind: int, *, compress: bool) -> bytes:
    """The packet of the streams of an octree."""
    little_endian = (np.ascontiguousarray(array, array.dtype.newbyteorder("<")) for array in streams)
    parts: list[bytes | memoryview] = [array.data for array in little_endian]
    if compress:
        parts = [zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(b"".join(parts))]
    fields = (
        MAGIC, VERSION, kind, CONTENT_FLOAT32, ZSTD if compress else NO_COMPRESSION, octree.num_classes, 0,
        octree.resolution, streams.words.size, streams.num_leaves, len(streams.masks), streams.own_values.size,
        len(parts[0]) if compress else streams.num_bytes,
    )  # fmt: skip
    checksum = zlib.crc32(_HEADER.pack(*fields, 0))
    for part in parts:
        checksum = zlib.crc32(part, checksum)
    return b"".join((_HEADER.pack(*fields, checksum), *parts))


def read_header(data: bytes) -> PacketHeader:
    """The header of a packet whose checksum holds. Raises PacketError for anything else."""
    if len(data) < HEADER_BYTES or data[:4] != MAGIC:
        raise PacketError("not a map packet")
    _, version, kind, content, compression, num_classes, zero, resolution, *sizes, checksum = _HEADER.unpack_from(data)
    if version != VERSION:
        raise PacketError(f"map packet of format version {version}, this octoreplay reads version {VERSION}")
    payload = memoryview(data)[HEADER_BYTES:]
    if len(payload) != sizes[-1]:
        raise PacketError(f"map packet cut: {len(payload)} bytes of payload, its header says {sizes[-1]}")
    if zlib.crc32(payload, zlib.crc32(data[: HEADER_BYTES - 4] + bytes(4))) != checksum:
        raise PacketError("map packet damaged: its checksum does not match")
    known = kind in (FULL, DELTA) and content == CONTENT_FLOAT32 and compression in (NO_COMPRESSION, ZSTD)
    if not known or zero or not 0 < num_classes <= MAX_CLASSES or not 0 < resolution < np.inf:
        raise PacketError("map packet of a kind, content or compression that this octoreplay does not know")
    return PacketHeader(kind, compression, num_classes, resolution, *sizes)


def decode_packet(data: bytes) -> SemanticOctree:
    """The map of a key-frame packet. Raises PacketError for a delta and for anything that is not a whole packet."""
    header = read_header(data)
    if header.kind != FULL:
        raise PacketError("map packet is a delta; it needs the map that it changes")
    return _decode(data, header)


def apply_delta(octree: SemanticOctree, data: bytes, revision: int = 0) -> None:
    """Replace the bricks that a delta packet holds, in place. Raises PacketError and then leaves the map as it was."""
    header = read_header(data)
    if header.kind != DELTA:
        raise PacketError("map packet is a key frame, not a delta")
    if header.resolution != octree.resolution or header.num_classes != octree.num_classes:
        raise PacketError("map packet of another resolution or number of classes than the map that it changes")
    changed = _decode(data, header)
    octree.overwrite(changed, np.arange(changed.num_bricks), revision)


def _decode(data: bytes, header: PacketHeader) -> SemanticOctree:
    """The octree of a packet with a good header."""
    payload = memoryview(data)[HEADER_BYTES:]
    if header.compression == ZSTD:
        payload = memoryview(_unpack(payload, header.raw_bytes))
    if len(payload) != header.raw_bytes:
        raise PacketError("map packet damaged: its size does not match its counts")
    words_end = 2 * header.num_words
    values_end = words_end + 4 * header.num_leaves
    masks_end = values_end + header.num_vectors * mask_bytes(header.num_classes)
    streams = TreeStreams(
        _array(payload[:words_end], np.uint16),
        _array(payload[words_end:values_end], np.float32),
        _array(payload[values_end:masks_end], np.uint8).reshape(-1, mask_bytes(header.num_classes)),
        _array(payload[masks_end:], np.float32),
    )
    try:
        return octree_from_streams(streams, header.resolution, header.num_classes)
    except ValueError as error:
        raise PacketError(f"map packet damaged: {error}") from error


def _array(content: memoryview, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """The little-endian numbers of a part of a payload; copied where it is not aligned."""
    return np.require(np.frombuffer(content, np.dtype(dtype).newbyteorder("<")), dtype, "A")


def _unpack(payload: memoryview, size: int) -> bytes:
    """The content of one zstd frame, which must say itself that it holds ``size`` bytes."""
    try:
        parameters = zstandard.get_frame_parameters(payload)
        # Memory is allocated for what the frame says, so that has to be possible for a frame of this length.
        if parameters.content_size != size or size > MAX_ZSTD_RATIO * len(payload):
            raise PacketError("map packet damaged: its size does not match its counts")
        return zstandard.ZstdDecompressor().decompress(payload, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise PacketError(f"map packet cannot be decompressed: {error}") from error


def grid_bytes(num_cells: int, num_classes: int) -> int:
    """Size of the uniform-grid packet that octree packets are compared with: an 8-byte key and K float32 per cell."""
    return num_cells * (8 + 4 * (num_classes + 1))
