"""Maps as runs of finest cells along the Morton curve: what they share, what they cover, and where that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octoreplay.mapping.octree import LeafSpans, codes_to_keys
from octoreplay.records import BoolArray, Int64Array

_CUBES = np.int64(1) << np.arange(0, 63, 3)
"""Numbers of finest cells in cubes of the edges 1, 2, 4, ..."""


class Region:
    """The cells that any of some maps knows, as runs along the Morton curve."""

    def __init__(self, maps: Sequence[LeafSpans]) -> None:
        codes = np.concatenate([np.empty(0, np.int64), *(spans.codes for spans in maps)])
        ends = np.concatenate([np.empty(0, np.int64), *(spans.codes + spans.num_cells for spans in maps)])
        if len(maps) > 1:
            order = np.argsort(codes, kind="stable")
            codes, ends = codes[order], np.maximum.accumulate(ends[order])
        # A run goes on where the next leaf begins at its end or, of another map, inside it.
        breaks = np.flatnonzero(codes[1:] > ends[:-1]) + 1
        self._starts = codes[np.append(0, breaks)[: codes.size]]
        self._ends = ends[np.append(breaks, codes.size)[: codes.size] - 1]
        self._lengths = self._ends - self._starts
        self._before = np.cumsum(self._lengths) - self._lengths

    def is_same(self, other: Region) -> bool:
        """Whether both hold the same cells."""
        return np.array_equal(self._starts, other._starts) and np.array_equal(self._ends, other._ends)

    @property
    def num_cells(self) -> int:
        """Number of finest cells."""
        return int(self._lengths.sum())

    def num_inside(self, spans: LeafSpans) -> Int64Array:
        """How many cells of each leaf (L,) are in the region."""
        return self._num_below(spans.codes + spans.num_cells) - self._num_below(spans.codes)

    def holds(self, codes: Int64Array) -> BoolArray:
        """Which cells (n,) are in the region."""
        is_inside: BoolArray = self._num_below(codes + 1) > self._num_below(codes)
        return is_inside

    def _num_below(self, codes: Int64Array) -> Int64Array:
        """How many cells of the region come before each cell (n,)."""
        run = np.searchsorted(self._starts, codes, side="right") - 1
        counts = np.zeros(codes.size, np.int64)
        is_after = run >= 0
        run = run[is_after]
        counts[is_after] = self._before[run] + np.minimum(codes[is_after] - self._starts[run], self._lengths[run])
        return counts


class CommonRuns(NamedTuple):
    """Runs of finest cells along the Morton curve in which neither of two maps changes, in its order.

    ``codes`` (S,) int64 are the Morton codes of their first cells, ``num_cells`` (S,) int64 their lengths, ``leaves_a``
    and ``leaves_b`` (S,) int64 each map's leaf, -1 where it knows nothing; one of them always knows something.
    """

    codes: Int64Array
    num_cells: Int64Array
    leaves_a: Int64Array
    leaves_b: Int64Array


def common_runs(a: LeafSpans, b: LeafSpans) -> CommonRuns:
    """The common refinement of two maps' leaves: at most twice as many runs as the two have leaves."""
    # Four sorted lists, which a stable sort merges many times faster than any other way sorts them.
    bounds = np.sort(np.concatenate([a.codes, b.codes, a.codes + a.num_cells, b.codes + b.num_cells]), kind="stable")
    num_cells = np.diff(bounds)
    starts, num_cells = bounds[:-1][num_cells > 0], num_cells[num_cells > 0]
    leaves_a, leaves_b = a.leaves_at(starts), b.leaves_at(starts)
    known = (leaves_a >= 0) | (leaves_b >= 0)
    return CommonRuns(starts[known], num_cells[known], leaves_a[known], leaves_b[known])


def bounding_box(codes: Int64Array, num_cells: Int64Array) -> tuple[Int64Array, Int64Array]:
    """The least and the largest key (3,) of any cell in some runs (S,), S >= 1, along the Morton curve."""
    lows, highs = [], []
    while codes.size:
        # The largest cube that starts at the run's first cell and ends in the run.
        aligned = np.where(codes == 0, num_cells, codes & -codes)
        levels = np.searchsorted(_CUBES, np.minimum(aligned, num_cells), side="right") - 1
        keys = codes_to_keys(codes)
        lows.append(keys.min(axis=0))
        highs.append((keys + (np.int64(1) << levels)[:, None] - 1).max(axis=0))
        taken = np.int64(1) << (3 * levels)
        rest = num_cells > taken
        codes, num_cells = (codes + taken)[rest], (num_cells - taken)[rest]
    return np.min(lows, axis=0), np.max(highs, axis=0)
