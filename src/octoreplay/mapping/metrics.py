"""Distances and agreement of a team's maps, stored brick by brick; docs/metrics.md defines the metrics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.log_odds import TIE_TOLERANCE
from octoreplay.mapping.block_sums import BlockSums
from octoreplay.mapping.kernels import metrics as metrics_kernels
from octoreplay.mapping.kernels.storage import BRICK_CELLS
from octoreplay.mapping.octree import SemanticOctree, brick_table, cache_aligned, parts_of
from octoreplay.records import Float64Array, Int64Array


@dataclass(frozen=True, eq=False)
class MapComparison:
    """Counts of a comparison, cell by cell. Comparisons of different cells add up.

    Attributes
    ----------
    total_distance, total_distance_all : float
        Phi over the links, and over all pairs of robots [squared log-odds].
    num_known_cells : int
        Cells known to any robot.
    num_disagreeing_cells : int
        Of these, cells with different labels, unknown included, of any two robots.
    num_link_cells : int
        Cells that both ends of a link know, summed over the links.
    num_cells : (N,) int64 array
        Cells that each robot knows.
    num_compared, num_agreeing : (N,) int64 arrays
        Known cells that each robot is compared in, and of these the ones with the centralised map's label.
    num_compared_occupied, num_agreeing_occupied : (N,) int64 arrays
        The same over the cells that the centralised map calls occupied.
    entropies : (N,) float64 array
        Sum of the entropies of each robot's cells [nat].
    """

    total_distance: float
    total_distance_all: float
    num_known_cells: int
    num_disagreeing_cells: int
    num_link_cells: int
    num_cells: Int64Array
    num_compared: Int64Array
    num_agreeing: Int64Array
    num_compared_occupied: Int64Array
    num_agreeing_occupied: Int64Array
    entropies: Float64Array

    def __add__(self, other: MapComparison) -> MapComparison:
        return MapComparison(
            **{item.name: getattr(self, item.name) + getattr(other, item.name) for item in fields(MapComparison)}
        )

    def spread(self, members: Sequence[int], num_robots: int) -> MapComparison:
        """Return the comparison of a team of ``num_robots`` of which only the ``members`` (N,) were compared."""

        def spread(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
            of_all = np.zeros(num_robots, values.dtype)
            of_all[list(members)] = values
            return of_all

        arrays: dict[str, Any] = {
            name: spread(value) for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)

    @property
    def label_disagreement(self) -> float:
        """Share of the known cells in which robots have different labels; 0 without known cells."""
        return self.num_disagreeing_cells / self.num_known_cells if self.num_known_cells else 0.0

    @property
    def agreement(self) -> Float64Array:
        """Share (N,) of the compared cells in which a robot agrees with the centralised map; 1 without cells."""
        return _shares(self.num_agreeing, self.num_compared)

    @property
    def agreement_occupied(self) -> Float64Array:
        """The same over the cells that the centralised map calls occupied."""
        return _shares(self.num_agreeing_occupied, self.num_compared_occupied)

    @property
    def entropy_bits(self) -> Float64Array:
        """Mean entropy (N,) of a robot's cells [bit]; 0 without cells."""
        cells = self.num_cells
        return np.divide(self.entropies / math.log(2.0), cells, out=np.zeros(len(cells)), where=cells > 0)


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
        self._label_priors = np.full(num_robots, prior, np.float32)
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
        num_averaged: Sequence[int] | None = None,
    ) -> MapComparison:
        """Return the comparison; bricks with all revisions below ``since`` are not compared again.

        ``links`` are robot indices, each linked pair once. Log-odds tie with the largest of their cell where they are
        within ``least_tie``, or the relative tolerance, of it. ``num_averaged`` (N,) are the numbers of robots whose
        mean each map is (default: 1): labels are those of the posterior h_0 + N (h - h_0), as in the oracle. The result
        does not depend on ``threads``.
        """
        link_ends = np.array(links, np.int64).reshape(-1, 2)
        label_priors = np.float32(self._prior) / np.array(num_averaged or [1] * len(maps), np.float32)
        is_new = self._least_tie != least_tie or not np.array_equal(self._label_priors, label_priors)
        stale_rows = self._stale_rows((*maps, oracle), link_ends, since, is_new=is_new)
        self._links, self._least_tie, self._label_priors = link_ends, least_tie, label_priors
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
                self._label_priors,
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
        return MapComparison(
            total_distance=float(distances[0]),
            total_distance_all=float(distances[1]),
            num_known_cells=int(counts[0]),
            num_disagreeing_cells=int(counts[2]),
            num_link_cells=int(counts[3]),
            num_cells=per_robot[:, 0].copy(),
            num_compared=np.full(len(per_robot), counts[0]),
            num_agreeing=per_robot[:, 1].copy(),
            num_compared_occupied=np.full(len(per_robot), counts[1]),
            num_agreeing_occupied=per_robot[:, 2].copy(),
            entropies=self._entropies.total(),
        )


def _shares(parts: Int64Array, wholes: Int64Array) -> Float64Array:
    """Return parts / wholes (N,); 1 where the whole is 0."""
    return np.divide(parts, wholes, out=np.ones(len(parts)), where=wholes > 0)
