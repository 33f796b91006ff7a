"""Encoding of maps as packets, once for all receivers."""

from __future__ import annotations

import numpy as np

from octoreplay.config.packets import PacketConfig
from octoreplay.mapping import codec
from octoreplay.mapping.codec import MapVersion, PacketFormat
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import Int64Array
from octoreplay.replay.exchange.messages import HeldMap, Source


class PacketEncoder:
    """The team's packets: each is made once, however many robots send it to however many others."""

    def __init__(self, config: PacketConfig) -> None:
        self._format = PacketFormat(
            content=config.content,
            step=config.int8_step,
            zstd_level=config.zstd_level if config.packet_compression == "zstd" else None,
        )
        # By the octree's identity, version and base; the octree is kept so that no other takes its place.
        self._packets: dict[tuple[int, int, int | None], tuple[SemanticOctree, bytes]] = {}
        self._older: dict[tuple[int, int, int | None], tuple[SemanticOctree, bytes]] = {}

    def packet(self, source: Source, held: HeldMap, base: int | None) -> bytes:
        """A whole map, or what changed in it after version ``base``."""
        key = (id(held.octree), held.version, base)
        entry = self._packets.get(key) or self._older.get(key) or (held.octree, self.encode(source, held, base))
        self._packets[key] = entry
        return entry[1]

    def encode(self, source: Source, held: HeldMap, base: int | None, indices: Int64Array | None = None) -> bytes:
        """A packet made anew; with ``indices`` (n,) it holds those bricks in place of all that changed."""
        version = MapVersion(source.origin, source.epoch, held.version, base or 0, held.weight)
        if base is None:
            return codec.pack(held.octree, held.streams or held.octree.streams(), codec.FULL, self._format, version)
        if indices is None:
            indices = np.flatnonzero(held.octree.revisions >= base)
        return codec.encode_delta(held.octree, indices, packet_format=self._format, map_version=version)

    def end_tick(self) -> None:
        """Forget the packets that nobody sent in this tick."""
        self._older, self._packets = self._packets, {}
