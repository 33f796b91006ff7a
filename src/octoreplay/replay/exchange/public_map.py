"""Published map of a robot: rounded as its packets are, and within the budget."""

from __future__ import annotations

from typing import Any
from weakref import WeakSet

import numpy as np

from octoreplay.config.packets import PacketConfig
from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import ConfigError
from octoreplay.mapping import codec
from octoreplay.mapping.consensus import Step, Update, team_step
from octoreplay.mapping.metrics import MapComparer
from octoreplay.mapping.octree import BRICK_CELLS, BRICK_DEPTH, SemanticOctree, octree_from_streams
from octoreplay.mapping.quantise import quantised, top_classes
from octoreplay.mapping.snapshot import Snapshot
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
    """Published map of a robot, in versions. Earlier versions keep their content while a receiver holds them.

    Attributes
    ----------
    is_exact : bool
        True where the published map equals the map in every tick.
    octree : SemanticOctree
        The last version.
    version : int or None
        Its tick; None before the first version.
    """

    def __init__(self, config: ResolvedRun, packet_codec: PacketCodec, source: Source) -> None:
        self.is_exact = config.has_exact_packets
        self._packet = config.effective_packet
        self._tolerance = config.map.prune_tolerance
        self._packet_codec = packet_codec
        self._source = source
        self.octree = SemanticOctree(config.map.resolution, config.classes.num_classes)
        self.version: int | None = None
        self._snapshots: WeakSet[Snapshot] = WeakSet()
        self._comparer = MapComparer(2, 0.0)
        self._bytes_per_brick = 100.0

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for ``pickle``."""
        return {**vars(self), "_snapshots": list(self._snapshots)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state from ``pickle``."""
        vars(self).update(state, _snapshots=WeakSet(state["_snapshots"]))

    def advance(self, octree: SemanticOctree, since: int, version: int, *, num_shares: int = 1) -> HeldMap:
        """Next version of the map. Bricks that change get the revision ``version`` - 1.

        Bricks of ``octree`` with revisions below ``since`` are as in the last version; the first version has all
        bricks. ``num_shares`` maps share the budget.
        """
        since = 0 if self.version is None else since
        if self._packet.budget is not None:
            least = least_budget(self._packet, octree.num_classes)
            self._fill(self._rounded(octree), version, max(self._packet.budget // num_shares, least))
        elif (octree.revisions >= since).any():
            self._copy_changes(octree, since, version)
        self.version, snapshot = version, Snapshot(self.octree)
        self._snapshots.add(snapshot)
        return HeldMap(snapshot, version)

    def _copy_changes(self, octree: SemanticOctree, since: int, version: int) -> None:
        """Copy the bricks that changed ``since`` a revision; bricks without a change of values keep their revisions."""
        if self._tolerance > 0:
            # A change may prune bricks beside it differently.
            target, since = self._rounded(octree), 0
        elif self.is_exact:
            target = octree
        else:
            changed = SemanticOctree(octree.resolution, octree.num_classes)
            changed.overwrite(octree, np.flatnonzero(octree.revisions >= since), since)
            target = self._rounded(changed)
        self._save(target.codes[target.revisions >= since])
        team_step([Step(self.octree, (), (), target, 0.0, since=since)], update=Update.COPY, revision=version - 1)

    def _save(self, codes: Int64Array) -> None:
        """Save bricks for the versions that are still in use."""
        for snapshot in list(self._snapshots):
            snapshot.save(codes)

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

    def _fill(self, target: SemanticOctree, version: int, budget: int) -> None:
        """Update as many bricks as fit into a packet, those with the largest change first."""
        public = self.octree
        self._comparer.compare([public, target], target, [(0, 1)], (self.version or 0) - 1)
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
        self._save(target.codes[order[:best]])
        public.overwrite(target, order[:best], version - 1)

    def _guess(self, num_bricks: int, budget: int) -> int:
        """Estimate of the number of bricks that fit into a packet, from the last packet's bytes per brick."""
        return min(int(0.9 * budget / self._bytes_per_brick), num_bricks)
