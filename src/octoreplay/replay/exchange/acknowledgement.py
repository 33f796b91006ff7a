"""Bytes of acknowledgements: the versions of maps that a robot holds (format: docs/packet-format.md)."""

from __future__ import annotations

import functools
import struct
import zlib
from typing import NamedTuple

from octoreplay.errors import PacketError

MAGIC = b"OCTA"
VERSION = 1

_HEADER = struct.Struct("<4sBBH")
"""magic, version, 0, number of entries."""
_ENTRY = struct.Struct("<HIBI")
"""origin, epoch, 1 for a map and 0 for none, version."""
_CHECKSUM = struct.Struct("<I")
_NUM_KEPT = 1024
"""Number of acknowledgements that are kept: the neighbours of a robot send the same bytes in most ticks."""


class Possession(NamedTuple):
    """Version that a robot holds of the map of robot ``origin`` in its restart epoch ``epoch``; None: no version."""

    origin: int
    epoch: int
    version: int | None


@functools.lru_cache(_NUM_KEPT)
def encode_acknowledgement(entries: tuple[Possession, ...]) -> bytes:
    """Encode an acknowledgement."""
    data = _HEADER.pack(MAGIC, VERSION, 0, len(entries)) + b"".join(
        _ENTRY.pack(origin, epoch, version is not None, version or 0) for origin, epoch, version in entries
    )
    return data + _CHECKSUM.pack(zlib.crc32(data))


@functools.lru_cache(_NUM_KEPT)
def decode_acknowledgement(data: bytes) -> tuple[Possession, ...]:
    """Decode an acknowledgement. Raises PacketError where it is damaged or of an unknown format."""
    end = len(data) - _CHECKSUM.size
    if end < _HEADER.size or data[:4] != MAGIC:
        raise PacketError("not an acknowledgement")
    if zlib.crc32(data[:end]) != _CHECKSUM.unpack_from(data, end)[0]:
        raise PacketError("acknowledgement damaged: its checksum does not match")
    _, version, zero, count = _HEADER.unpack_from(data)
    if version != VERSION or zero or end != _HEADER.size + count * _ENTRY.size:
        raise PacketError("acknowledgement of an unknown format version")
    found = []
    for origin, epoch, has_map, number in _ENTRY.iter_unpack(data[_HEADER.size : end]):
        if has_map > 1:
            raise PacketError("acknowledgement of an unknown format version")
        found.append(Possession(origin, epoch, number if has_map else None))
    return tuple(found)
