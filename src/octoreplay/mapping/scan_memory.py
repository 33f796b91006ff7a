"""Scratch memory of one ray caster: the ends of a scan's rays, and the bricks that they touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import ends, storage
from octoreplay.records import Float64Array, Int32Array, Int64Array, UInt8Array, UInt32Array


class BrickMemory:
    """Memory for the bricks that a scan touches."""

    def __init__(self, capacity: int, *, has_strengths: bool) -> None:
        self.codes = np.empty(capacity, np.int64)
        self.marks = np.empty((capacity, storage.OCTETS), np.uint64)
        self.strengths = np.empty((capacity if has_strengths else 0, storage.OCTETS), np.uint64)


class Runs:
    """Memory for the ends of a scan's rays: first as runs of neighbouring points, then as distinct end cells."""

    def __init__(self, capacity: int, num_classes: int, rays: str) -> None:
        self.capacity = capacity
        self.counters = np.zeros(2, np.int64)
        # One more than the points: kernels write points without information too, and overwrite them with the next.
        places = capacity + 1
        self.keys = np.empty((3, places), np.int32)
        self.kinds = np.empty(places, np.uint8)
        self.lengths = np.empty(places, np.int32)
        self.end_keys = np.empty((capacity, 3), np.int32)
        self.end_places = np.empty(capacity, np.uint32)
        self._num_classes = num_classes
        self._places = np.empty(capacity, np.uint32)
        self._sums = np.empty(places, np.int32)
        self._every = rays == "all"
        self._points = np.empty((places if self._every else 0, 3))
        self._point_keys = np.empty((places if self._every else 0, 3), np.int32)

    @property
    def num_runs(self) -> int:
        """Number of runs."""
        return int(self.counters[ends.NUM_RUNS])

    @property
    def outputs(self) -> tuple[npt.NDArray[Any], ...]:
        """Output arrays of the kernels that find runs."""
        return self.keys, self.kinds, self.lengths, self._sums, self._points, self._point_keys, self.counters

    def reduce(
        self, corner: Int64Array, tables: UInt32Array, marks: UInt8Array, strengths: UInt8Array
    ) -> tuple[int, UInt8Array]:
        """Mark the distinct end cells in the scratch grid; return their number n and their marks (n,).

        With ``strengths``, labels are weighted by the points' confidences, and the cells get their strengths.
        """
        is_weighted = strengths.size > 0
        runs, num_classes = (self.kinds, self.num_runs), self._num_classes
        num_ends, num_open = ends.mark_ends(
            self.keys, *runs, corner, tables, num_classes, is_weighted, marks, self._places, self.end_places,
            self.end_keys,
        )  # fmt: skip
        end_marks = np.empty(num_ends, np.uint8)
        ends.settle_ends(
            self._places, self.kinds, self.lengths, self._sums if is_weighted else self.lengths,
            self.num_runs if num_open else 0, num_classes, np.full(2 << (2 * num_open).bit_length(), -1, np.int32),
            np.empty(num_open, np.uint32), np.zeros((num_open, num_classes), np.int32),
            np.zeros((num_open, num_classes), np.int64), marks, strengths, self.end_places[:num_ends], end_marks,
        )  # fmt: skip
        return num_ends, end_marks

    def rays(self, num_ends: int) -> tuple[Float64Array, Int32Array]:
        """Return end points (n, 3) [m] and end cells (n, 3) of the rays; no end points if rays go to cell centres."""
        if not self._every:
            return self._points, self.end_keys[:num_ends]
        num_points = int(self.counters[ends.NUM_POINTS])
        return self._points[:num_points], self._point_keys[:num_points]
