"""Cells of a map as grids of states: occupied cells, sets of classes nearby, ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from octoreplay.records import BoolArray, Float64Array, Int64Array, UInt8Array, UInt64Array

UNKNOWN, UNDECIDED, FREE = 0, 254, 255
"""States of a cell without an occupied class."""

COLUMN_CELLS = 2
"""Edge of a column, and least height of an obstacle above ground [cell]."""

GROUND_WINDOW = 5
"""Edge of the square of columns in which the lowest occupied cell is ground."""

NUM_BITS = 63
"""Number of bits in a set of classes; classes beyond share bits."""


@dataclass(frozen=True, eq=False)
class OccupiedCells:
    """Occupied cells: ``points`` (n, 3) float64, their centres [m], and ``class_ids`` (n,) uint8."""

    points: Float64Array
    class_ids: UInt8Array

    def __len__(self) -> int:
        return len(self.class_ids)

    def subset(self, chosen: BoolArray) -> OccupiedCells:
        """Return the cells where ``chosen`` (n,) is True."""
        return OccupiedCells(self.points[chosen], self.class_ids[chosen])

    def thinned(self, step: int) -> OccupiedCells:
        """Return every ``step``-th cell."""
        return OccupiedCells(self.points[::step], self.class_ids[::step])


def class_bits(class_ids: UInt8Array) -> UInt64Array:
    """Return the bit of each class_id."""
    return np.uint64(1) << ((class_ids.astype(np.uint64) - np.uint64(1)) % np.uint64(NUM_BITS))


def occupied_cells(states: UInt8Array) -> BoolArray:
    """Return True for each cell with an occupied class."""
    result: BoolArray = (states != UNKNOWN) & (states < UNDECIDED)
    return result


def lowest_occupied(is_occupied: BoolArray) -> Int64Array:
    """Return the index (nx, ny) of the lowest occupied cell of each vertical line of cells; nz where there is none."""
    result: Int64Array = np.where(is_occupied.any(axis=2), is_occupied.argmax(axis=2), is_occupied.shape[2])
    return result


def dilated(bits: UInt64Array) -> UInt64Array:
    """Return the union of the bits within one cell, in each cell of a grid with an empty border."""
    for axis in range(3):
        lines = np.moveaxis(bits, axis, 0)
        union = lines.copy()
        union[1:] |= lines[:-1]
        union[:-1] |= lines[1:]
        bits = np.moveaxis(union, 0, axis)
    return np.ascontiguousarray(bits)


def halved(keys: Int64Array, states: UInt8Array) -> tuple[Int64Array, UInt8Array]:
    """Return cells of twice the edge: of the most frequent occupied class of their parts, else free if a part is."""
    coarse = keys >> 1
    # Occupied before free before undecided; among the occupied the most frequent class.
    order = np.lexsort((states, *coarse.T))
    coarse, states = coarse[order], states[order]
    is_new_run = np.ones(len(coarse), np.bool_)
    is_new_run[1:] = (coarse[1:] != coarse[:-1]).any(axis=1) | (states[1:] != states[:-1])
    starts = np.flatnonzero(is_new_run)
    lengths = np.diff(np.append(starts, len(coarse)))
    coarse, states = coarse[starts], states[starts]
    rank = np.where(states == UNDECIDED, 0, np.where(states == FREE, 1, 1 + lengths))
    order = np.lexsort((-rank, *coarse.T))
    coarse, states = coarse[order], states[order]
    is_first = np.ones(len(coarse), np.bool_)
    is_first[1:] = (coarse[1:] != coarse[:-1]).any(axis=1)
    return coarse[is_first], states[is_first]
