"""Map packets: lossless conversion of an octree to bytes and back; docs/packet-format.md defines the format."""

from __future__ import annotations

import functools
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
from octoreplay.mapping.key_box import KeyBox
from octoreplay.mapping.octree import SemanticOctree, octree_from_streams
from octoreplay.mapping.quantise import CONTENTS, INT8_MAX, content_numbers, content_values, is_step
from octoreplay.mapping.streams import TreeStreams, mask_bytes
from octoreplay.records import Float32Array, Int64Array

MAGIC = b"OCTM"
VERSION = 3
FULL, DELTA = 0, 1
NO_COMPRESSION, ZSTD = 0, 1
MAX_ZSTD_RATIO = 1 << 15
"""Maximum compression ratio of zstd: a block of at least 4 bytes holds at most 2^17 bytes."""
MAX_CLASSES = 254
VALUE_BYTES = 16
"""Memory for each value while a packet is decoded: code, literal, bits and float32, rounded up [byte]."""
SMALL_MAP = 1 << 28
"""Memory that a map may take however small its packets are [byte]."""
MEMORY_PER_BYTE = 256
"""Memory that a map may take for each byte of its packets, where that is more than ``SMALL_MAP`` [byte]."""

WRONG_SIZE = "map packet damaged: its size does not match its counts"

_DTYPES = {"float32": "<f4", "float16": "<f2", "int8": "<i1"}
_HEADER = struct.Struct("<4sBBBBdqHHIIIfIIIIII")
"""Magic, version, kind, content, compression, resolution, weight, classes, origin, epoch, map version, base, step,
words, leaves, masks, own values, payload bytes, CRC."""

HEADER_BYTES = _HEADER.size


def max_memory(num_bytes: int) -> int:
    """Return the largest memory of maps that are read from ``num_bytes`` of packets [byte].

    A leaf of a few bits may stand for 2^24 bricks, so without this limit packets of 120 bytes would take 10 GB.
    """
    return max(SMALL_MAP, MEMORY_PER_BYTE * num_bytes)


@dataclass(frozen=True)
class PacketFormat:
    """Encoding of packets: number format, step of int8 [log-odds], and zstd level, 1 to 22 (None: no compression)."""

    content: str = "float32"
    step: float = 0.05
    zstd_level: int | None = 1


@dataclass(frozen=True)
class MapVersion:
    """Identity of the map in a packet: state ``version`` of the map of robot ``origin`` in restart epoch ``epoch``.

    A delta holds all bricks that changed after state ``base``. ``weight`` is the weight of running sums.
    """

    origin: int = 0
    epoch: int = 0
    version: int = 0
    base: int = 0
    weight: int = 0


@dataclass(frozen=True)
class PacketHeader:
    """Header of a packet. ``step`` is 0 except for int8."""

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
        """Size of the uncompressed octree [byte]."""
        num_values = self.num_leaves + self.num_own_values
        return 2 * self.num_words + self.number_bytes * num_values + self.num_vectors * mask_bytes(self.num_classes)

    @property
    def number_bytes(self) -> int:
        """Size of one value [byte]."""
        return np.dtype(_DTYPES[self.content]).itemsize


def encode_packet(
    octree: SemanticOctree,
    *,
    packet_format: PacketFormat = PacketFormat(),
    map_version: MapVersion = MapVersion(),
    tolerance: float = 0.0,
    prune: bool = True,
) -> bytes:
    """Return a packet with a whole map (a key frame).

    Sibling leaves that differ by at most ``tolerance`` are merged (0: lossless); without ``prune`` none are. Raises
    ValueError like ``pack``.
    """
    return pack(octree, octree.streams(prune=prune, tolerance=tolerance), FULL, packet_format, map_version)


def encode_delta(
    octree: SemanticOctree,
    indices: Int64Array,
    *,
    packet_format: PacketFormat = PacketFormat(),
    map_version: MapVersion = MapVersion(),
) -> bytes:
    """Return a delta packet with the whole bricks ``indices`` (n,) of a map. Raises ValueError like ``pack``."""
    if not indices.size:
        return _packet(octree, _encoded_nothing(octree.num_classes, packet_format), DELTA, packet_format, map_version)
    return pack(octree, octree.streams(indices), DELTA, packet_format, map_version)


def pack(
    octree: SemanticOctree,
    streams: TreeStreams,
    kind: int,
    packet_format: PacketFormat = PacketFormat(),
    map_version: MapVersion = MapVersion(),
) -> bytes:
    """Return the packet of an octree's streams; ``kind`` is FULL or DELTA.

    Raises ValueError where the number format cannot represent the values exactly (``quantise.quantised`` makes values
    that it can), where the base is later than the version, and where a whole map has a base.
    """
    return _packet(octree, _encoded(streams, packet_format), kind, packet_format, map_version)


@dataclass(frozen=True)
class _Encoded:
    """Encoded streams: numbers of words, leaves, masks and own values, and the parts of the payload."""

    sizes: tuple[int, int, int, int]
    payload: tuple[bytes, ...]


def _encoded(streams: TreeStreams, packet_format: PacketFormat) -> _Encoded:
    """Return the encoded streams. Raises ValueError where the number format cannot represent the values exactly."""
    numbers = [_numbers(values, packet_format) for values in (streams.values, streams.own_values)]
    level = packet_format.zstd_level
    payload = _payload(streams, numbers, is_coded=level is not None)
    if level is not None:
        payload = [_compressed(payload, level)]
    sizes = streams.words.size, streams.num_leaves, len(streams.masks), streams.own_values.size
    return _Encoded(sizes, tuple(payload))


@functools.lru_cache(16)
def _encoded_nothing(num_classes: int, packet_format: PacketFormat) -> _Encoded:
    """Return the encoded streams of no bricks, which robots without changes send in every tick."""
    return _encoded(SemanticOctree(1.0, num_classes).streams(), packet_format)


def _packet(
    octree: SemanticOctree, encoded: _Encoded, kind: int, packet_format: PacketFormat, map_version: MapVersion
) -> bytes:
    """Return the packet of encoded streams. Raises ValueError for a base that does not match the kind or version."""
    if map_version.base > (map_version.version if kind == DELTA else 0):
        raise ValueError(
            f"a packet of kind {kind} and version {map_version.version} cannot have base {map_version.base}"
        )
    is_compressed, payload = packet_format.zstd_level is not None, encoded.payload
    fields = (
        MAGIC, VERSION, kind, CONTENTS.index(packet_format.content), ZSTD if is_compressed else NO_COMPRESSION,
        octree.resolution, map_version.weight, octree.num_classes, map_version.origin, map_version.epoch,
        map_version.version, map_version.base, packet_format.step if packet_format.content == "int8" else 0.0,
        *encoded.sizes, sum(map(len, payload)),
    )  # fmt: skip
    checksum = zlib.crc32(_HEADER.pack(*fields, 0))
    for part in payload:
        checksum = zlib.crc32(part, checksum)
    return b"".join((_HEADER.pack(*fields, checksum), *payload))


def read_header(data: bytes) -> PacketHeader:
    """Return the header of a packet. Raises PacketError for other bytes and where the checksum does not match."""
    if data[:4] != MAGIC or len(data) == len(MAGIC):
        raise PacketError("not a map packet")
    # The version is checked first: other versions have headers of other lengths.
    if data[4] != VERSION:
        raise PacketError(f"map packet of format version {data[4]}, this octoreplay reads version {VERSION}")
    if len(data) < HEADER_BYTES:
        raise PacketError(f"map packet cut: {len(data)} bytes, less than its header of {HEADER_BYTES}")
    _, _, kind, content, compression, resolution, weight, num_classes, origin, epoch, version, base, step, *sizes = (
        _HEADER.unpack_from(data)
    )
    checksum = sizes.pop()
    payload = memoryview(data)[HEADER_BYTES:]
    if len(payload) != sizes[-1]:
        raise PacketError(f"map packet cut: {len(payload)} bytes of payload instead of {sizes[-1]}")
    if zlib.crc32(payload, zlib.crc32(data[: HEADER_BYTES - 4] + bytes(4))) != checksum:
        raise PacketError("map packet damaged: its checksum does not match")
    known = kind in (FULL, DELTA) and content < len(CONTENTS) and compression in (NO_COMPRESSION, ZSTD)
    if not known or not 0 < num_classes <= MAX_CLASSES or not 0 < resolution < np.inf:
        raise PacketError("map packet of a kind, content or compression unknown to this octoreplay")
    if not (is_step(step) if CONTENTS[content] == "int8" else step == 0) or base > (version if kind == DELTA else 0):
        raise PacketError("map packet with a step or base that does not match its content or kind")
    map_version = MapVersion(origin, epoch, version, base, weight)
    return PacketHeader(kind, CONTENTS[content], compression, resolution, num_classes, map_version, step, *sizes)


def decode_packet(data: bytes, most_bytes: int | None = None, box: KeyBox | None = None) -> SemanticOctree:
    """Return the map of a key-frame packet; with ``box``, without leaves and bricks that lie outside of it.

    The whole payload is decompressed, since the words and codes of a packet have no index. The octree, which takes most
    of the memory, has the bricks near the box only; ``regions.cut`` leaves the cells in the box.

    Raises PacketError for a delta, for damaged or other bytes, and for a map of more than ``most_bytes`` (None:
    ``max_memory`` of the packet).
    """
    header = read_header(data)
    if header.kind != FULL:
        raise PacketError("map packet is a delta; it needs the map that it changes")
    return _decode(data, header, max_memory(len(data)) if most_bytes is None else most_bytes, box)


def apply_delta(
    octree: SemanticOctree,
    data: bytes,
    revision: int = 0,
    most_bytes: int | None = None,
    box: KeyBox | None = None,
) -> None:
    """Replace the bricks that a delta packet holds, in place; with ``box``, those that overlap it.

    Raises PacketError for other packets and other bytes, and for new bricks of more than ``most_bytes`` (None:
    ``max_memory`` of the packet); it then leaves the map unchanged.
    """
    header = read_header(data)
    if header.kind != DELTA:
        raise PacketError("map packet is a key frame, not a delta")
    if header.resolution != octree.resolution or header.num_classes != octree.num_classes:
        raise PacketError("map packet with another resolution or number of classes than the map that it changes")
    changed = _decode(data, header, max_memory(len(data)) if most_bytes is None else most_bytes, box)
    octree.overwrite(changed, np.arange(changed.num_bricks), revision)


def grid_bytes(num_cells: int, num_classes: int) -> int:
    """Return the size of the same map as a uniform grid: an 8-byte key and C + 1 float32 for each cell [byte]."""
    return num_cells * (8 + 4 * (num_classes + 1))


def _numbers(values: Float32Array, packet_format: PacketFormat) -> npt.NDArray[Any]:
    """Return the little-endian numbers that represent values exactly."""
    content, step = packet_format.content, packet_format.step
    numbers = content_numbers(values, content, step)
    if content != "float32" and not np.array_equal(content_values(numbers, content, step), values):
        raise ValueError(f"the map has values that {content} cannot represent; quantise it first")
    return np.ascontiguousarray(numbers, _DTYPES[content])


def _payload(streams: TreeStreams, numbers: list[npt.NDArray[Any]], *, is_coded: bool) -> list[bytes]:
    """Return the parts of a payload; ``is_coded``: numbers as codes and literals, which compress better."""
    words, values, masks, own_values = streams.words.astype("<u2"), numbers[0], streams.masks, numbers[1]
    parts: list[npt.NDArray[Any]] = [words, values, masks, own_values]
    if is_coded and values.itemsize > 1:
        parts = [words, *_codes(values), masks, *_codes(own_values)]
    return [part.tobytes() for part in parts]


def _codes(numbers: npt.NDArray[Any]) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield the codes (n,) of numbers (n,), then one array for each byte of their literals, lowest byte first."""
    codes = np.empty(numbers.size, np.uint8)
    literals = np.empty((4, numbers.size), np.uint8)
    bits = numbers.view(f"<u{numbers.itemsize}").astype(np.uint32)
    num_literals = packets.write_codes(bits, np.zeros(packets.SLOTS, np.uint32), codes, literals)
    yield codes
    for plane in literals[: numbers.itemsize]:
        yield plane[:num_literals]


def _compressed(parts: list[bytes], level: int) -> bytes:
    """Return one zstd frame of the parts, each in separate blocks because their bytes are distributed differently."""
    compressor = zstandard.ZstdCompressor(level=level).compressobj(size=sum(map(len, parts)))
    chunks = []
    for part in parts:
        chunks += [compressor.compress(part), compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*chunks, compressor.flush()])


def _decode(data: bytes, header: PacketHeader, most_bytes: int, box: KeyBox | None) -> SemanticOctree:
    """Return the octree of a packet with a valid header, of at most ``most_bytes``, in a box."""
    num_values = header.num_leaves + header.num_own_values
    most_bytes -= header.raw_bytes + VALUE_BYTES * num_values
    if most_bytes < 0:
        raise PacketError(f"map packet damaged: {len(data)} bytes cannot hold {num_values} values")
    payload = _Payload(memoryview(data)[HEADER_BYTES:], header)
    width = mask_bytes(header.num_classes)
    words = payload.take(2 * header.num_words).view("<u2")
    values = payload.take_values(header.num_leaves)
    masks = payload.take(header.num_vectors * width).reshape(-1, width)
    own_values = payload.take_values(header.num_own_values)
    payload.check_end()
    try:
        streams = TreeStreams(np.require(words, np.uint16, "A"), values, masks, own_values)
        return octree_from_streams(streams, header.resolution, header.num_classes, most_bytes, box)
    except ValueError as error:
        raise PacketError(f"map packet damaged: {error}") from error


class _Payload:
    """Sequential reader of a payload. Methods raise PacketError where the parts do not match the payload's size."""

    def __init__(self, content: memoryview, header: PacketHeader) -> None:
        self._header = header
        self._dtype = np.dtype(_DTYPES[header.content])
        self._is_coded = header.compression == ZSTD and self._dtype.itemsize > 1
        most = header.raw_bytes
        if self._is_coded:
            # Every value has a code of one byte; in the worst case every value is a literal.
            most += header.num_leaves + header.num_own_values
        self._rest = np.frombuffer(_unpack(content, most) if header.compression == ZSTD else content, np.uint8)

    def take(self, num_bytes: int) -> npt.NDArray[np.uint8]:
        """Return the next bytes."""
        if num_bytes > self._rest.size:
            raise PacketError(WRONG_SIZE)
        taken, self._rest = self._rest[:num_bytes], self._rest[num_bytes:]
        return taken

    def take_values(self, count: int) -> Float32Array:
        """Return the next ``count`` values."""
        if self._is_coded:
            numbers = self._take_coded(count).view(self._dtype)
        else:
            numbers = self.take(count * self._dtype.itemsize).view(self._dtype)
        if self._header.content == "int8" and (numbers < -INT8_MAX).any():
            raise PacketError(f"map packet damaged: an int8 is outside {-INT8_MAX} to {INT8_MAX}")
        values = np.require(content_values(numbers, self._header.content, self._header.step), np.float32, "A")
        if not np.isfinite(values).all():
            raise PacketError("map packet damaged: a value is not finite")
        return values

    def _take_coded(self, count: int) -> npt.NDArray[Any]:
        """Return the bits of the next ``count`` numbers, decoded from codes and literals."""
        codes = self.take(count)
        num_literals = count - int(np.count_nonzero(codes))
        # The kernel reads one literal more than there are, and four bytes of each, also for numbers of two bytes.
        literals = np.zeros((4, num_literals + 1), np.uint8)
        for plane in literals[: self._dtype.itemsize]:
            plane[:-1] = self.take(num_literals)
        bits = np.empty(count, np.uint32)
        packets.read_codes(codes, literals, np.zeros(packets.SLOTS, np.uint32), bits)
        return bits.astype(f"<u{self._dtype.itemsize}", copy=False)

    def check_end(self) -> None:
        """Check that the payload is used up."""
        if self._rest.size:
            raise PacketError(WRONG_SIZE)


def _unpack(payload: memoryview, most: int) -> bytes:
    """Decompress one zstd frame of at most ``most`` bytes; the frame must state its content size."""
    try:
        parameters = zstandard.get_frame_parameters(payload)
        # The stated size is allocated, so it must be plausible for a frame of this length.
        if parameters.content_size > min(most, MAX_ZSTD_RATIO * len(payload)):
            raise PacketError(WRONG_SIZE)
        return zstandard.ZstdDecompressor().decompress(payload, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise PacketError(f"map packet cannot be decompressed: {error}") from error
