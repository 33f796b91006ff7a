"""Distances and agreement of a team's maps, stored brick by brick; docs/metrics.md defines the metrics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from octoreplay.log_odds import TIE_TOLERANCE
from octoreplay.mapping.kernels import metrics as metrics_kernels
from octoreplay.mapping.kernels.storage import BRICK_CELLS
from octoreplay.mapping.octree import SemanticOctree, brick_table, cache_aligned, parts_of
from octoreplay.records import Float64Array, Int32Array, Int64Array


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
        self._distances: Float64Array = np.empty((0, 2))
        self._counts: Int32Array = np.empty((0, 4 + 3 * num_robots), np.int32)
        self._entropies: Float64Array = np.empty((0, num_robots))

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
        rows = [self._bricks.find_or_add(octree.codes[octree.revisions >= since]) for octree in (*maps, oracle)]
        stale = np.zeros(self._bricks.num_bricks, np.bool_)
        stale[np.concatenate(rows)] = True
        is_new = self._links is None or not np.array_equal(self._links, link_ends)
        if is_new or self._least_tie != least_tie:
            stale[:] = True
            self._links, self._least_tie = link_ends, least_tie
        for name in ("_distances", "_counts", "_entropies"):
            old = getattr(self, name)
            if len(old) < len(stale):
                setattr(self, name, np.concatenate([old, np.zeros((len(stale) - len(old), old.shape[1]), old.dtype)]))
        stale_rows = np.flatnonzero(stale)

        def refresh(part: Int64Array) -> None:
            self._refresh(maps, oracle, stale_rows[part], link_ends)

        parts = parts_of(stale_rows.size, threads)
        list(map(refresh, parts) if threads is None else threads.map(refresh, parts))
        if self._result is None or parts:
            self._result = self._sum()
        return self._result

    def forget(self) -> None:
        """Compare all bricks at the next call. Needed after a map is replaced by another one."""
        self._links = None

    @property
    def brick_distances(self) -> tuple[Int64Array, Float64Array]:
        """Codes (n,) of the bricks, and each brick's part (n,) of ``total_distance`` in the last comparison."""
        return self._bricks.codes, self._distances[: self._bricks.num_bricks, 0]

    def _refresh(
        self, maps: Sequence[SemanticOctree], oracle: SemanticOctree, rows: Int64Array, link_ends: Int64Array
    ) -> None:
        """Compare the bricks at the ``rows`` (n,) of the arrays."""
        codes = self._bricks.codes[rows]
        table = brick_table([*maps, oracle], codes)
        metrics_kernels.compare_maps(
            table,
            link_ends,
            np.float32(self._prior),
            np.float32(TIE_TOLERANCE),
            np.float32(self._least_tie),
            maps[0].num_classes,
            cache_aligned(((len(maps) + 1) * maps[0].num_classes + len(maps) + 6, BRICK_CELLS), np.float32),
            cache_aligned((len(maps) + 3, BRICK_CELLS), np.int32),
            rows,
            self._distances,
            self._counts,
            self._entropies,
        )

    def _sum(self) -> MapComparison:
        """Sum over all bricks."""
        distances = self._distances.sum(axis=0)
        counts = self._counts.sum(axis=0, dtype=np.int64)
        per_robot = counts[4:].reshape(-1, 3)
        cells = per_robot[:, 0]
        entropies = self._entropies.sum(axis=0) / math.log(2.0)
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
