"""Published map of a robot: rounded as its packets are, and within the budget."""

from __future__ import annotations

import numpy as np

from octoreplay.config.packets import PacketConfig
from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import ConfigError
from octoreplay.mapping import codec
from octoreplay.mapping.consensus import Step, Update, team_step
from octoreplay.mapping.metrics import MapComparer
from octoreplay.mapping.octree import BRICK_CELLS, BRICK_DEPTH, SemanticOctree, octree_from_streams
from octoreplay.mapping.quantise import quantised, top_classes
from octoreplay.mapping.streams import mask_bytes
from octoreplay.records import Int64Array
from octoreplay.replay.exchange.messages import HeldMap, Source
from octoreplay.replay.exchange.packet_codec import PacketCodec

FIT_TRIES = 6
"""Largest number of packets that are encoded to find one that fits the budget."""

ZSTD_FRAME_BYTES = 64
"""Upper bound of what zstd adds to parts that it cannot compress [bytes]."""


def least_budget(packet: PacketConfig, num_classes: int) -> int:
    """Number of bytes that a packet of one brick never exceeds: header, words, masks, and all values with codes."""
    number_bytes = {"float32": 5, "float16": 3, "int8": 1}[packet.content]
    per_cell = number_bytes * (num_classes + 1) + mask_bytes(num_classes)
    return codec.HEADER_BYTES + 2 * (BRICK_DEPTH + 9) + BRICK_CELLS * per_cell + ZSTD_FRAME_BYTES


def check_budget(packet: PacketConfig, num_classes: int) -> None:
    """Raise ConfigError where a brick could need more than the budget."""
    least = least_budget(packet, num_classes)
    if packet.budget is not None and packet.budget < least:
        raise ConfigError(
            f"budget: {packet.budget} bytes may not hold one brick of {num_classes} classes; give at least {least}, or"
            " a smaller content"
        )


class PublicMap:
    """Versions of a robot's published map. Every version is an octree of its own, so that older versions stay valid.

    ``is_exact`` is True where the published map equals the map in every tick.
    """

    def __init__(self, config: ResolvedRun, packet_codec: PacketCodec, source: Source) -> None:
        self.is_exact = config.has_exact_packets
        self._packet = config.effective_packet
        self._tolerance = config.map.prune_tolerance
        self._packet_codec = packet_codec
        self._source = source
        self._last: HeldMap | None = None
        self._comparer = MapComparer(2, 0.0)
        self._filled = 0
        self._bytes_per_brick = 100.0

    def advance(self, octree: SemanticOctree, revisions: Int64Array, version: int, *, num_shares: int = 1) -> HeldMap:
        """Next version of the map.

        ``revisions`` (n,) int64 are the revisions of the octree's bricks, all below ``version``; those of bricks that
        changed since the last version are at least that. ``num_shares`` maps share the budget.
        """
        last = self._last
        if last is not None and self._packet.budget is None and not (revisions >= last.version).any():
            self._last = HeldMap(last.octree, version)
            return self._last
        public = octree.copy()
        public.revisions[:] = revisions
        if not self.is_exact:
            public = self._within_packets(public, last, version, num_shares)
        self._last = HeldMap(public, version)
        return self._last

    def _within_packets(
        self, octree: SemanticOctree, last: HeldMap | None, version: int, num_shares: int
    ) -> SemanticOctree:
        """Next published octree: the last one, with the changes of ``octree`` that packets can hold."""
        target = self._rounded(octree)
        public = SemanticOctree(octree.resolution, octree.num_classes) if last is None else last.octree.copy()
        if self._packet.budget is None:
            # Unchanged bricks keep their revisions and stay out of deltas.
            team_step([Step(public, (), (), target, 0.0)], update=Update.COPY, revision=version - 1)
        else:
            least = least_budget(self._packet, octree.num_classes)
            self._fill(public, target, version, max(self._packet.budget // num_shares, least))
        return public

    def _rounded(self, octree: SemanticOctree) -> SemanticOctree:
        """Map with the values that packets can hold."""
        if self._tolerance > 0:
            pruned = octree_from_streams(
                octree.streams(tolerance=self._tolerance), octree.resolution, octree.num_classes
            )
            pruned.revisions[:] = octree.revisions[octree.find(pruned.codes)]
            octree = pruned
        if self._packet.top_classes is not None:
            octree = top_classes(octree, self._packet.top_classes)
        return quantised(octree, self._packet.content, self._packet.int8_step)

    def _fill(self, public: SemanticOctree, target: SemanticOctree, version: int, budget: int) -> None:
        """Update as many bricks as fit into a packet, those with the largest change first."""
        self._comparer.compare([public, target], target, [(0, 1)], self._filled - 1)
        self._filled = version
        codes, distances = self._comparer.brick_distances
        # Cells can become known without a change of distance, and a brick can be missing in either map.
        here, there = target.find(codes), public.find(codes)
        known = np.zeros((2, codes.size), np.uint64)
        for row, octree, indices in zip(known, (target, public), (here, there), strict=True):
            row[indices >= 0] = octree.known[indices[indices >= 0]]
        is_new = known[0] != known[1]
        waiting = np.flatnonzero((here >= 0) & (is_new | (distances > 0)))
        order = here[waiting[np.argsort(-distances[waiting], kind="stable")]]
        best, wanted = 0, self._guess(order.size, budget)
        for _ in range(FIT_TRIES):
            size = len(self._packet_codec.encode(self._source, HeldMap(target, version), version, order[:wanted]))
            self._bytes_per_brick = size / max(wanted, 1)
            # The margin is for bricks whose values compress less well in a later packet.
            if size <= 0.95 * budget:
                best = max(best, wanted)
            if best == order.size or 0.85 * budget < size <= 0.95 * budget:
                break
            wanted = max(self._guess(order.size, budget), best + 1)
        public.overwrite(target, order[:best], version - 1)

    def _guess(self, num_bricks: int, budget: int) -> int:
        """Estimate of the number of bricks that fit into a packet, from the last packet's bytes per brick."""
        return min(int(0.9 * budget / self._bytes_per_brick), num_bricks)
