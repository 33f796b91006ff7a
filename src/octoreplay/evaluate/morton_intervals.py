"""Maps as intervals of finest cells on the Morton curve: their union, their common refinement and its bounding box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octoreplay.mapping.octree import LeafSpans, codes_to_keys
from octoreplay.records import BoolArray, Int64Array

_CUBE_SIZES = np.int64(1) << np.arange(0, 63, 3)
"""Numbers of finest cells in cubes with edges of 1, 2, 4, ... cells."""


class Region:
    """Union of the cells that some maps know, as disjoint intervals on the Morton curve."""

    def __init__(self, maps: Sequence[LeafSpans]) -> None:
        codes = np.concatenate([np.empty(0, np.int64), *(spans.codes for spans in maps)])
        ends = np.concatenate([np.empty(0, np.int64), *(spans.codes + spans.num_cells for spans in maps)])
        if len(maps) > 1:
            order = np.argsort(codes, kind="stable")
            codes, ends = codes[order], np.maximum.accumulate(ends[order])
        # An interval continues where the next leaf begins at its end or, of another map, inside it.
        breaks = np.flatnonzero(codes[1:] > ends[:-1]) + 1
        self._starts = codes[np.append(0, breaks)[: codes.size]]
        self._ends = ends[np.append(breaks, codes.size)[: codes.size] - 1]
        self._lengths = self._ends - self._starts
        self._before = np.cumsum(self._lengths) - self._lengths

    def is_same(self, other: Region) -> bool:
        """True where both regions hold the same cells."""
        return np.array_equal(self._starts, other._starts) and np.array_equal(self._ends, other._ends)

    @property
    def num_cells(self) -> int:
        """Number of finest cells."""
        return int(self._lengths.sum())

    def num_inside(self, spans: LeafSpans) -> Int64Array:
        """Number of finest cells of each leaf that are in the region, (L,) int64."""
        return self._num_below(spans.codes + spans.num_cells) - self._num_below(spans.codes)

    def holds(self, codes: Int64Array) -> BoolArray:
        """Membership of cells with Morton codes (n,) in the region, (n,) bool."""
        is_inside: BoolArray = self._num_below(codes + 1) > self._num_below(codes)
        return is_inside

    def _num_below(self, codes: Int64Array) -> Int64Array:
        """Number of the region's cells before each cell (n,) on the curve."""
        interval = np.searchsorted(self._starts, codes, side="right") - 1
        counts = np.zeros(codes.size, np.int64)
        is_after = interval >= 0
        interval = interval[is_after]
        inside = np.minimum(codes[is_after] - self._starts[interval], self._lengths[interval])
        counts[is_after] = self._before[interval] + inside
        return counts


class MortonIntervals(NamedTuple):
    """Intervals of finest cells on the Morton curve in which neither of two maps changes, in the curve's order.

    Attributes
    ----------
    codes : (S,) int64
        Morton codes of the first cells.
    num_cells : (S,) int64
        Lengths.
    leaves_a, leaves_b : (S,) int64
        Leaf of each map, -1 where it knows nothing; at least one of the two is a leaf.
    """

    codes: Int64Array
    num_cells: Int64Array
    leaves_a: Int64Array
    leaves_b: Int64Array


def common_intervals(a: LeafSpans, b: LeafSpans) -> MortonIntervals:
    """Return the common refinement of two maps' leaves: at most twice as many intervals as the two have leaves."""
    # Four sorted lists, which a stable sort merges many times faster than another sort.
    bounds = np.sort(np.concatenate([a.codes, b.codes, a.codes + a.num_cells, b.codes + b.num_cells]), kind="stable")
    num_cells = np.diff(bounds)
    starts, num_cells = bounds[:-1][num_cells > 0], num_cells[num_cells > 0]
    leaves_a, leaves_b = a.leaves_at(starts), b.leaves_at(starts)
    known = (leaves_a >= 0) | (leaves_b >= 0)
    return MortonIntervals(starts[known], num_cells[known], leaves_a[known], leaves_b[known])


def bounding_box(codes: Int64Array, num_cells: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Return the smallest and largest key (3,) of the cells in intervals with first cells and lengths (S,), S > 0."""
    lows, highs = [], []
    while codes.size:
        # The largest cube that starts at the interval's first cell and ends in the interval.
        aligned = np.where(codes == 0, num_cells, codes & -codes)
        levels = np.searchsorted(_CUBE_SIZES, np.minimum(aligned, num_cells), side="right") - 1
        keys = codes_to_keys(codes)
        lows.append(keys.min(axis=0))
        highs.append((keys + (np.int64(1) << levels)[:, None] - 1).max(axis=0))
        taken = np.int64(1) << (3 * levels)
        rest = num_cells > taken
        codes, num_cells = (codes + taken)[rest], (num_cells - taken)[rest]
    return np.min(lows, axis=0), np.max(highs, axis=0)
