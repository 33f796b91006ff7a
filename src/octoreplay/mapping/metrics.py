"""Distances and agreement of a team's maps, stored brick by brick; docs/metrics.md defines the metrics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from octoreplay.log_odds import TIE_TOLERANCE
from octoreplay.mapping.block_sums import BlockSums
from octoreplay.mapping.kernels import metrics as metrics_kernels
from octoreplay.mapping.kernels.storage import BRICK_CELLS
from octoreplay.mapping.octree import SemanticOctree, brick_table, cache_aligned, parts_of
from octoreplay.records import Float64Array, Int64Array


@dataclass(frozen=True, eq=False)
class MapComparison:
    """Result of a comparison, cell by cell; arrays are (N,) over the robots. Distances are squared log-odds."""

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
    """Incremental comparison of N maps and the oracle: only changed bricks are compared again.

    ``prior`` is h_0 [log-odds]. The maps' ``revisions`` must increase with every change.
    """

    def __init__(self, num_robots: int, prior: float) -> None:
        self._prior = prior
        # A brick's index in this octree is its row in the arrays below.
        self._bricks = SemanticOctree(1.0, 1)
        self._links: Int64Array | None = None
        self._least_tie = 0.0
        self._result: MapComparison | None = None
        self._distances = BlockSums(2, np.float64, np.float64)
        self._counts = BlockSums(4 + 3 * num_robots, np.int32, np.int64)
        self._entropies = BlockSums(num_robots, np.float64, np.float64)

    def compare(
        self,
        maps: Sequence[SemanticOctree],
        oracle: SemanticOctree,
        links: Sequence[tuple[int, int]],
        since: int,
        threads: Executor | None = None,
        *,
        least_tie: float = 0.0,
    ) -> MapComparison:
        """Return the comparison; bricks with all revisions below ``since`` are not compared again.

        ``links`` are robot indices, each linked pair once. Log-odds tie with the largest of their cell where they are
        within ``least_tie``, or the relative tolerance, of it. The result does not depend on ``threads``.
        """
        link_ends = np.array(links, np.int64).reshape(-1, 2)
        stale_rows = self._stale_rows((*maps, oracle), link_ends, since, is_new=self._least_tie != least_tie)
        self._links, self._least_tie = link_ends, least_tie
        self._refresh((*maps, oracle), stale_rows, threads)
        if self._result is None or stale_rows.size:
            for of_bricks in (self._distances, self._counts, self._entropies):
                of_bricks.update(stale_rows)
            self._result = self._sum()
        return self._result

    def link_distance(
        self,
        maps: Sequence[SemanticOctree],
        links: Sequence[tuple[int, int]],
        since: int,
        threads: Executor | None = None,
    ) -> float:
        """Return ``total_distance`` of maps that change again before the next call of ``compare``.

        The parameters are those of ``compare``, which must follow with a ``since`` that is not later.
        """
        link_ends = np.array(links, np.int64).reshape(-1, 2)
        stale_rows = self._stale_rows(maps, link_ends, since)
        self._refresh((*maps, maps[0]), stale_rows, threads, link_ends)
        self._distances.update(stale_rows)
        return float(self._distances.total()[0])

    def forget(self) -> None:
        """Compare all bricks at the next call. Needed after a map is replaced by another one."""
        self._links = None

    @property
    def brick_distances(self) -> tuple[Int64Array, Float64Array]:
        """Codes (n,) of the bricks, and each brick's part (n,) of ``total_distance`` in the last comparison."""
        return self._bricks.codes, self._distances.rows[: self._bricks.num_bricks, 0]

    def _stale_rows(
        self, octrees: Sequence[SemanticOctree], link_ends: Int64Array, since: int, *, is_new: bool = False
    ) -> Int64Array:
        """Rows (n,) of the bricks that changed ``since`` a revision; all rows where ``is_new`` or for new links."""
        rows = [self._bricks.find_or_add(octree.codes[octree.revisions >= since]) for octree in octrees]
        stale = np.zeros(self._bricks.num_bricks, np.bool_)
        stale[np.concatenate(rows)] = True
        if is_new or self._links is None or not np.array_equal(self._links, link_ends):
            stale[:] = True
        for of_bricks in (self._distances, self._counts, self._entropies):
            of_bricks.reserve(stale.size)
        return np.flatnonzero(stale)

    def _refresh(
        self,
        octrees: Sequence[SemanticOctree],
        rows: Int64Array,
        threads: Executor | None,
        distance_links: Int64Array | None = None,
    ) -> None:
        """Compare the bricks ``rows`` (n,) of the maps and, the last octree, the oracle.

        With ``distance_links`` only the distances are computed, over these links.
        """
        link_ends = self._links if distance_links is None else distance_links
        num_maps, num_classes = len(octrees) - 1, octrees[0].num_classes

        def work(part: Int64Array) -> None:
            metrics_kernels.compare_maps(
                brick_table(octrees, self._bricks.codes[rows[part]]),
                link_ends,
                np.float32(self._prior),
                np.float32(TIE_TOLERANCE),
                np.float32(self._least_tie),
                num_classes,
                distance_links is not None,
                cache_aligned(((num_maps + 1) * num_classes + num_maps + 6, BRICK_CELLS), np.float32),
                cache_aligned((num_maps + 3, BRICK_CELLS), np.int32),
                rows[part],
                self._distances.rows,
                self._counts.rows,
                self._entropies.rows,
            )

        parts = parts_of(rows.size, threads)
        list(map(work, parts) if threads is None else threads.map(work, parts))

    def _sum(self) -> MapComparison:
        """Sum over all bricks."""
        distances, counts = self._distances.total(), self._counts.total()
        per_robot = counts[4:].reshape(-1, 3)
        cells = per_robot[:, 0]
        entropies = self._entropies.total() / math.log(2.0)
        return MapComparison(
            total_distance=float(distances[0]),
            total_distance_all=float(distances[1]),
            num_known_cells=int(counts[0]),
            label_disagreement=float(counts[2] / counts[0]) if counts[0] else 0.0,
            num_link_cells=int(counts[3]),
            num_cells=cells,
            agreement=_share(per_robot[:, 1], counts[0]),
            agreement_occupied=_share(per_robot[:, 2], counts[1]),
            entropy_bits=np.divide(entropies, cells, out=np.zeros(len(cells)), where=cells > 0),
        )


def _share(parts: Int64Array, whole: int) -> Float64Array:
    """Return parts / whole; 1 where the whole is 0."""
    return parts / whole if whole else np.ones(len(parts))
