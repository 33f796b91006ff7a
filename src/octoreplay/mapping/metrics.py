"""How far a team's maps are from each other and from the oracle, kept brick by brick (docs/metrics.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.mapping.consensus import address_table
from octoreplay.mapping.kernels import metrics as metrics_kernels
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import BoolArray, Float64Array, Int64Array


@dataclass(frozen=True, eq=False)
class MapComparison:
    """The team's maps compared cell by cell; arrays are (N,) over the robots."""

    total_distance: float
    total_distance_all: float
    num_known_cells: int
    label_disagreement: float
    num_link_cells: int
    num_cells: Int64Array
    agreement: Float64Array
    agreement_occupied: Float64Array
    entropy_bits: Float64Array


class MapComparer:
    """Compares N maps and the oracle, and again only where one of them has changed since.

    ``prior`` is h_0. The maps' ``revisions`` must grow with every change.
    """

    def __init__(self, num_robots: int, prior: float) -> None:
        self._num_robots = num_robots
        self._prior = prior
        self._codes: Int64Array = np.empty(0, np.int64)
        self._distances: Float64Array = np.empty((0, 2))
        self._counts: Int64Array = np.empty((0, 3 + 3 * num_robots), np.int64)
        self._entropies: Float64Array = np.empty((0, num_robots))
        self._links: Int64Array | None = None
        self._link_cells: Int64Array = np.empty((0, 0), np.int64)

    def compare(
        self,
        maps: Sequence[SemanticOctree],
        oracle: SemanticOctree,
        links: Sequence[tuple[int, int]],
        since: int,
    ) -> MapComparison:
        """The comparison; bricks whose revisions are all below ``since`` keep what was found before."""
        codes = np.unique(np.concatenate([octree.codes for octree in (*maps, oracle)]))
        link_ends = np.array(links, np.int64).reshape(-1, 2)
        stale = self._adopt(codes)
        if self._links is None or not np.array_equal(self._links, link_ends):
            stale[:] = True
            self._links = link_ends
            self._link_cells = np.zeros((codes.size, len(link_ends)), np.int64)
        for octree in (*maps, oracle):
            changed = octree.codes[octree.revisions >= since]
            stale[np.searchsorted(codes, changed)] = True
        self._refresh(maps, oracle, np.flatnonzero(stale), link_ends)
        return self._result()

    def _adopt(self, codes: Int64Array) -> BoolArray:
        """Make room for the bricks ``codes`` (n,), sorted; a flag for those that are new."""
        places = np.searchsorted(codes, self._codes)
        new = np.ones(codes.size, np.bool_)
        new[places] = False
        if codes.size > self._codes.size:
            for name in ("_distances", "_counts", "_entropies", "_link_cells"):
                old = getattr(self, name)
                larger = np.zeros((codes.size, old.shape[1]), old.dtype)
                larger[places] = old
                setattr(self, name, larger)
            self._codes = codes
        return new

    def _refresh(
        self, maps: Sequence[SemanticOctree], oracle: SemanticOctree, rows: Int64Array, link_ends: Int64Array
    ) -> None:
        """Compare the bricks ``rows`` anew."""
        codes = self._codes[rows]
        addresses, tiers = address_table([*maps, oracle], codes)
        known = np.zeros((rows.size, len(maps)), np.uint64)
        for robot, octree in enumerate(maps):
            found = octree.find(codes)
            known[found >= 0, robot] = octree.known[found[found >= 0]]
        distances = np.empty((rows.size, 2))
        counts = np.empty((rows.size, self._counts.shape[1]), np.int64)
        entropies = np.empty((rows.size, len(maps)))
        metrics_kernels.compare_maps(
            addresses,
            tiers,
            known,
            link_ends,
            np.float32(self._prior),
            maps[0].num_classes,
            distances,
            counts,
            entropies,
        )
        self._distances[rows] = distances
        self._counts[rows] = counts
        self._entropies[rows] = entropies
        for column, (a, b) in enumerate(link_ends):
            either = known[:, a] | known[:, b]
            self._link_cells[rows, column] = np.bitwise_count(either)

    def _result(self) -> MapComparison:
        """The sums over all bricks."""
        distances = self._distances.sum(axis=0)
        counts = self._counts.sum(axis=0)
        per_robot = counts[3:].reshape(-1, 3)
        cells = per_robot[:, 0]
        entropies = self._entropies.sum(axis=0) / math.log(2.0)
        return MapComparison(
            total_distance=float(distances[0]),
            total_distance_all=float(distances[1]),
            num_known_cells=int(counts[0]),
            label_disagreement=float(counts[2] / counts[0]) if counts[0] else 0.0,
            num_link_cells=int(self._link_cells.sum()),
            num_cells=cells,
            agreement=_share(per_robot[:, 1], counts[0]),
            agreement_occupied=_share(per_robot[:, 2], counts[1]),
            entropy_bits=np.divide(entropies, cells, out=np.zeros(len(cells)), where=cells > 0),
        )


def _share(parts: Int64Array, whole: int) -> Float64Array:
    """Parts / whole, where a share of nothing is 1."""
    return parts / whole if whole else np.ones(len(parts))
