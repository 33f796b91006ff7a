"""Encoding and decoding of packets, once per packet for the whole team."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias
from weakref import ReferenceType, ref

import numpy as np

from octoreplay.config.packets import PacketConfig
from octoreplay.mapping import codec
from octoreplay.mapping.codec import MapVersion, PacketFormat
from octoreplay.mapping.octree import MAX_BYTES, SemanticOctree
from octoreplay.mapping.snapshot import Snapshot
from octoreplay.records import Int64Array
from octoreplay.replay.exchange.messages import HeldMap, Source

_PacketKey: TypeAlias = tuple[int, int, int | None]


class PacketStamp(NamedTuple):
    """Map, version and base version of a packet; ``base`` is None for a full map."""

    source: Source
    version: int
    base: int | None


class PacketCodec:
    """The team's packets.

    A packet is encoded once, however many robots send it, and decoded once per tick, however many robots receive it.
    ``decodes`` is True where receivers decode packets instead of sharing the sender's state.
    """

    always_decodes = False
    """True to decode in every run, whatever ``decode_packets`` says: the tests set it."""

    def __init__(self, config: PacketConfig) -> None:
        self.decodes = config.decode_packets or self.always_decodes
        self._format = PacketFormat(
            content=config.content,
            step=config.int8_step,
            zstd_level=config.zstd_level if config.packet_compression == "zstd" else None,
        )
        # Packets of this tick and the last one, for as long as their content exists. Keys are the content's identity,
        # version and base.
        self._packets: dict[_PacketKey, tuple[ReferenceType[SemanticOctree | Snapshot], bytes]] = {}
        self._older: dict[_PacketKey, tuple[ReferenceType[SemanticOctree | Snapshot], bytes]] = {}
        # Keys are the identities of the packets, which are kept for the same reason.
        self._states: dict[int, tuple[bytes, HeldMap]] = {}

    def packet(self, source: Source, held: HeldMap, base: int | None) -> bytes:
        """Packet of a full map (``base`` None), or of the changes after version ``base``."""
        assert held.content is not None
        key = (id(held.content), held.version, base)
        entry = self._packets.get(key) or self._older.get(key)
        if entry is None or entry[0]() is not held.content:
            entry = ref(held.content, lambda _: self._drop(key)), self.encode(source, held, base)
        self._packets[key] = entry
        return entry[1]

    def encode(self, source: Source, held: HeldMap, base: int | None, indices: Int64Array | None = None) -> bytes:
        """Encode a packet; ``indices`` (n,) int64 selects bricks in place of all changed ones."""
        version = MapVersion(source.origin, source.epoch, held.version, base or 0, held.weight)
        if base is None:
            return codec.encode_packet(held.octree, packet_format=self._format, map_version=version)
        octree = held.octree
        if indices is None:
            indices = np.flatnonzero(octree.revisions >= base)
        return codec.encode_delta(octree, indices, packet_format=self._format, map_version=version)

    @staticmethod
    def stamp(data: bytes) -> PacketStamp:
        """Read a packet's stamp. Raises PacketError for a damaged packet."""
        header = codec.read_header(data)
        version = header.map_version
        base = version.base if header.kind == codec.DELTA else None
        return PacketStamp(Source(version.origin, version.epoch), version.version, base)

    def state(self, data: bytes, mine: HeldMap | None) -> HeldMap:
        """State of the map after a packet; ``mine`` is the receiver's state before it, which stays unchanged.

        A delta gives the same map on every state from its base on, so that all receivers share one result. Raises
        PacketError for a damaged packet.
        """
        entry = self._states.get(id(data))
        if entry is None:
            entry = self._states[id(data)] = data, _decoded(data, mine)
        return entry[1]

    def _drop(self, key: _PacketKey) -> None:
        """Drop a packet whose content no longer exists."""
        for packets in (self._packets, self._older):
            entry = packets.get(key)
            if entry is not None and entry[0]() is None:
                packets.pop(key, None)

    def end_tick(self) -> None:
        """Drop the packets that no robot sent in this tick, and all decoded states."""
        self._older, self._packets = self._packets, {}
        self._states = {}


def _decoded(data: bytes, mine: HeldMap | None) -> HeldMap:
    """State after a packet. No brick's revision is below the sender's, so that forwarded deltas leave nothing out."""
    header = codec.read_header(data)
    stamp = header.map_version
    if header.kind == codec.FULL:
        octree = codec.decode_packet(data, MAX_BYTES)
        octree.revisions[:] = stamp.version - 1
    else:
        octree = mine.octree.copy() if mine else SemanticOctree(header.resolution, header.num_classes)
        # Bricks outside the delta did not change after its base.
        octree.revisions[octree.revisions >= stamp.base] = stamp.base - 1
        codec.apply_delta(octree, data, stamp.version - 1, MAX_BYTES)
    return HeldMap(octree, stamp.version, stamp.weight)
