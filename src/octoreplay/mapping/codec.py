"""Map packets: an octree as bytes and back, bit for bit. docs/packet-format.md describes every byte."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import zstandard

from octoreplay.errors import PacketError
from octoreplay.mapping.kernels import packets
from octoreplay.mapping.octree import SemanticOctree, TreeStreams, mask_bytes, octree_from_streams
from octoreplay.mapping.quantise import CONTENTS, INT8_MAX, content_numbers, content_values, is_step
from octoreplay.records import Float32Array, Int64Array

MAGIC = b"OCTM"
VERSION = 3
FULL, DELTA = 0, 1
NO_COMPRESSION, ZSTD = 0, 1
MAX_ZSTD_RATIO = 1 << 15
"""A zstd block of at least 4 bytes holds at most 2^17."""
MAX_CLASSES = 254

WRONG_SIZE = "map packet damaged: its size does not match its counts"

_DTYPES = {"float32": "<f4", "float16": "<f2", "int8": "<i1"}
_HEADER = struct.Struct("<4sBBBBdqHHIIIfIIIIII")
"""magic, version, kind, content, compression, resolution, weight, classes, origin, epoch, map version, base, step,
words, leaves, masks, own values, payload bytes, CRC."""

HEADER_BYTES = _HEADER.size


@dataclass(frozen=True)
class PacketFormat:
    """How packets are written: their numbers (``step`` is int8's), and zstd's level, 1 to 22 (None: no compression)."""

    content: str = "float32"
    step: float = 0.05
    zstd_level: int | None = 1


@dataclass(frozen=True)
class MapVersion:
    """Which map a packet holds: state number ``version`` of the map of robot ``origin`` in its ``epoch``.

    A delta holds every brick that changed after state ``base``. ``weight`` is that of running sums.
    """

    origin: int = 0
    epoch: int = 0
    version: int = 0
    base: int = 0
    weight: int = 0


@dataclass(frozen=True)
class PacketHeader:
    """What a packet says of itself. ``step`` is 0 but for int8."""

    kind: int
    content: str
    compression: int
    resolution: float
    num_classes: int
    map_version: MapVersion
    step: float
    num_words: int
    num_leaves: int
    num_vectors: int
    num_own_values: int
    payload_bytes: int

    @property
    def raw_bytes(self) -> int:
        """Size of the uncompressed octree."""
        num_values = self.num_leaves + self.num_own_values
        return 2 * self.num_words + self.number_bytes * num_values + self.num_vectors * mask_bytes(self.num_classes)

    @property
    def number_bytes(self) -> int:
        """Size of one value."""
        return np.dtype(_DTYPES[self.content]).itemsize


def encode_packet(
    octree: SemanticOctree,
    *,
    packet_format: PacketFormat = PacketFormat(),
    map_version: MapVersion = MapVersion(),
    tolerance: float = 0.0,
    prune: bool = True,
) -> bytes:
    """A whole map as a packet (a key frame).

    Sibling leaves that differ by at most ``tolerance`` are merged (0: lossless); without ``prune`` none are. Raises
    ValueError where ``pack`` does.
    """
    return pack(octree, octree.streams(prune=prune, tolerance=tolerance), FULL, packet_format, map_version)


def encode_delta(
    octree: SemanticOctree,
    indices: Int64Array,
    *,
    packet_format: PacketFormat = PacketFormat(),
    map_version: MapVersion = MapVersion(),
) -> bytes:
    """A packet with the bricks ``indices`` (n,) int64 of a map, whole. Raises ValueError where ``pack`` does."""
    return pack(octree, octree.streams(indices), DELTA, packet_format, map_version)


def pack(
    octree: SemanticOctree,
    streams: TreeStreams,
    kind: int,
    packet_format: PacketFormat = PacketFormat(),
    map_version: MapVersion = MapVersion(),
) -> bytes:
    """The packet of the streams of an octree.

    Raises ValueError where the format cannot hold the values as they are, which it can when ``quantise.quantised`` was
    the last to change them, and for a base that is later than the version, or that of a whole map.
    """
    if map_version.base > (map_version.version if kind == DELTA else 0):
        raise ValueError(f"base {map_version.base} of a packet of kind {kind} and version {map_version.version}")
    numbers = [_numbers(values, packet_format) for values in (streams.values, streams.own_values)]
    level = packet_format.zstd_level
    payload = _payload(streams, numbers, is_coded=level is not None)
    if level is not None:
        payload = [_compressed(payload, level)]
    fields = (
        MAGIC, VERSION, kind, CONTENTS.index(packet_format.content), NO_COMPRESSION if level is None else ZSTD,
        octree.resolution, map_version.weight, octree.num_classes, map_version.origin, map_version.epoch,
        map_version.version, map_version.base, packet_format.step if packet_format.content == "int8" else 0.0,
        streams.words.size, streams.num_leaves, len(streams.masks), streams.own_values.size, sum(map(len, payload)),
    )  # fmt: skip
    checksum = zlib.crc32(_HEADER.pack(*fields, 0))
    for part in payload:
        checksum = zlib.crc32(part, checksum)
    return b"".join((_HEADER.pack(*fields, checksum), *payload))


def read_header(data: bytes) -> PacketHeader:
    """The header of a packet whose checksum holds. Raises PacketError for anything else."""
    if data[:4] != MAGIC or len(data) == len(MAGIC):
        raise PacketError("not a map packet")
    # Other versions have headers of other lengths.
    if data[4] != VERSION:
        raise PacketError(f"map packet of format version {data[4]}, this octoreplay reads version {VERSION}")
    if len(data) < HEADER_BYTES:
        raise PacketError(f"map packet cut: {len(data)} bytes, its header alone has {HEADER_BYTES}")
    _, _, kind, content, compression, resolution, weight, num_classes, origin, epoch, version, base, step, *sizes = (
        _HEADER.unpack_from(data)
    )
    checksum = sizes.pop()
    payload = memoryview(data)[HEADER_BYTES:]
    if len(payload) != sizes[-1]:
        raise PacketError(f"map packet cut: {len(payload)} bytes of payload, its header says {sizes[-1]}")
    if zlib.crc32(payload, zlib.crc32(data[: HEADER_BYTES - 4] + bytes(4))) != checksum:
        raise PacketError("map packet damaged: its checksum does not match")
    known = kind in (FULL, DELTA) and content < len(CONTENTS) and compression in (NO_COMPRESSION, ZSTD)
    if not known or not 0 < num_classes <= MAX_CLASSES or not 0 < resolution < np.inf:
        raise PacketError("map packet of a kind, content or compression that this octoreplay does not know")
    if not (is_step(step) if CONTENTS[content] == "int8" else step == 0) or base > (version if kind == DELTA else 0):
        raise PacketError("map packet whose step or base does not go with its content or kind")
    map_version = MapVersion(origin, epoch, version, base, weight)
    return PacketHeader(kind, CONTENTS[content], compression, resolution, num_classes, map_version, step, *sizes)


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


def grid_bytes(num_cells: int, num_classes: int) -> int:
    """Size of the uniform-grid packet that octree packets are compared with: an 8-byte key and K float32 per cell."""
    return num_cells * (8 + 4 * (num_classes + 1))


def _numbers(values: Float32Array, packet_format: PacketFormat) -> npt.NDArray[Any]:
    """The little-endian numbers that stand for values in a packet, exactly."""
    content, step = packet_format.content, packet_format.step
    numbers = content_numbers(values, content, step)
    if content != "float32" and not np.array_equal(content_values(numbers, content, step), values):
        raise ValueError(f"the map holds values that {content} cannot hold; quantise it first")
    return np.ascontiguousarray(numbers, _DTYPES[content])


def _payload(streams: TreeStreams, numbers: list[npt.NDArray[Any]], *, is_coded: bool) -> list[bytes]:
    """The parts of a payload; compressible ones when it is coded."""
    words, values, masks, own_values = streams.words.astype("<u2"), numbers[0], streams.masks, numbers[1]
    parts: list[npt.NDArray[Any]] = [words, values, masks, own_values]
    if is_coded and values.itemsize > 1:
        parts = [words, *_codes(values), masks, *_codes(own_values)]
    return [part.tobytes() for part in parts]


def _codes(numbers: npt.NDArray[Any]) -> Iterator[npt.NDArray[np.uint8]]:
    """The codes (n,) of numbers (n,), then one array for each byte of their literals, the lowest first."""
    codes = np.empty(numbers.size, np.uint8)
    literals = np.empty((4, numbers.size), np.uint8)
    bits = numbers.view(f"<u{numbers.itemsize}").astype(np.uint32)
    num_literals = packets.write_codes(bits, np.zeros(packets.SLOTS, np.uint32), codes, literals)
    yield codes
    for plane in literals[: numbers.itemsize]:
        yield plane[:num_literals]


def _compressed(parts: list[bytes], level: int) -> bytes:
    """One zstd frame of the parts, each in blocks of its own: what they hold is distributed differently."""
    compressor = zstandard.ZstdCompressor(level=level).compressobj(size=sum(map(len, parts)))
    chunks = []
    for part in parts:
        chunks += [compressor.compress(part), compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*chunks, compressor.flush()])


def _decode(data: bytes, header: PacketHeader) -> SemanticOctree:
    """The octree of a packet with a good header."""
    payload = _Payload(memoryview(data)[HEADER_BYTES:], header)
    width = mask_bytes(header.num_classes)
    words = payload.take(2 * header.num_words).view("<u2")
    values = payload.take_values(header.num_leaves)
    masks = payload.take(header.num_vectors * width).reshape(-1, width)
    own_values = payload.take_values(header.num_own_values)
    payload.check_end()
    try:
        streams = TreeStreams(np.require(words, np.uint16, "A"), values, masks, own_values)
        return octree_from_streams(streams, header.resolution, header.num_classes)
    except ValueError as error:
        raise PacketError(f"map packet damaged: {error}") from error


class _Payload:
    """The parts of a payload, taken from its start to its end. Raises PacketError where they do not fit it."""

    def __init__(self, content: memoryview, header: PacketHeader) -> None:
        self._header = header
        self._dtype = np.dtype(_DTYPES[header.content])
        self._is_coded = header.compression == ZSTD and self._dtype.itemsize > 1
        most = header.raw_bytes
        if self._is_coded:
            # Every value has a code, and at most every one is a literal.
            most += header.num_leaves + header.num_own_values
        self._rest = np.frombuffer(_unpack(content, most) if header.compression == ZSTD else content, np.uint8)

    def take(self, num_bytes: int) -> npt.NDArray[np.uint8]:
        """The next bytes."""
        if num_bytes > self._rest.size:
            raise PacketError(WRONG_SIZE)
        taken, self._rest = self._rest[:num_bytes], self._rest[num_bytes:]
        return taken

    def take_values(self, count: int) -> Float32Array:
        """The next ``count`` values."""
        if self._is_coded:
            numbers = self._take_coded(count).view(self._dtype)
        else:
            numbers = self.take(count * self._dtype.itemsize).view(self._dtype)
        if self._header.content == "int8" and (numbers < -INT8_MAX).any():
            raise PacketError(f"map packet damaged: its int8 goes from {-INT8_MAX} to {INT8_MAX}")
        return np.require(content_values(numbers, self._header.content, self._header.step), np.float32, "A")

    def _take_coded(self, count: int) -> npt.NDArray[Any]:
        """The bits of the next ``count`` numbers, from their codes and literals."""
        codes = self.take(count)
        num_literals = count - int(np.count_nonzero(codes))
        # The kernel reads one literal more than there are, and of numbers with two bytes four.
        literals = np.zeros((4, num_literals + 1), np.uint8)
        for plane in literals[: self._dtype.itemsize]:
            plane[:-1] = self.take(num_literals)
        bits = np.empty(count, np.uint32)
        packets.read_codes(codes, literals, np.zeros(packets.SLOTS, np.uint32), bits)
        return bits.astype(f"<u{self._dtype.itemsize}", copy=False)

    def check_end(self) -> None:
        """See that nothing is left."""
        if self._rest.size:
            raise PacketError(WRONG_SIZE)


def _unpack(payload: memoryview, most: int) -> bytes:
    """The content of one zstd frame, which must say itself how much it holds: ``most`` bytes, or fewer."""
    try:
        parameters = zstandard.get_frame_parameters(payload)
        # Memory is allocated for what the frame says, so that has to be possible for a frame of this length.
        if parameters.content_size > min(most, MAX_ZSTD_RATIO * len(payload)):
            raise PacketError(WRONG_SIZE)
        return zstandard.ZstdDecompressor().decompress(payload, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise PacketError(f"map packet cannot be decompressed: {error}") from error
