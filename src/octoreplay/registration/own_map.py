"""Map of one robot in its own frame, in the forms that registration uses: cells, columns and surfaces.

A cell is *occupied* by the class of its largest evidence where that is at least half a hit, and *free* where all its
evidence is at most a miss, as for the contradiction of evidence (docs/metrics.md). *Ground* is the lowest occupied
cell nearby; *obstacles* stand at least two cells above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from octoreplay.mapping.octree import SemanticOctree, codes_to_keys
from octoreplay.records import BoolArray, Float64Array, Int64Array, UInt8Array, UInt64Array
from octoreplay.registration.icp import Surface

UNKNOWN, UNDECIDED, FREE = 0, 254, 255
"""States of a cell without an occupied class."""

MAX_CELLS = 1 << 27
"""Largest number of cells in a map's bounding box; a larger map is halved in resolution until it fits."""

COLUMN_CELLS = 2
"""Edge of a column, and least height of an obstacle above ground [cell]."""

# Bits of the set of classes near a cell; classes beyond share bits.
_NUM_BITS = 63
# Height up to which free space makes a column open [columns' edges].
_OPEN_HEIGHT = 4
_MIN_OPEN_CELLS = 4
# Edge of the square of columns in which the lowest occupied cell is ground.
_GROUND_WINDOW = 5
# Radius of the neighbourhood that shapes the local surface [cell].
_SURFACE_RADIUS = 3.5
# Total weight of ground and of edges between ground classes, relative to that of the obstacles.
_GROUND_WEIGHT, _EDGE_WEIGHT = 0.5, 1.0
# First code of the edges between two ground classes in a surface.
_FIRST_EDGE_CODE = 1000


@dataclass(frozen=True, eq=False)
class OccupiedCells:
    """Occupied cells: ``points`` (n, 3) float64, their centres [m], and ``class_ids`` (n,) uint8."""

    points: Float64Array
    class_ids: UInt8Array

    def __len__(self) -> int:
        return len(self.class_ids)


class OwnMap:
    """Evidence of one robot in its own frame.

    - ``states`` (nx, ny, nz) uint8: UNKNOWN, UNDECIDED, FREE or the class_id of each cell in the map's bounding box.
    - ``low`` (3,) int64: key of the first cell.
    - ``resolution``: edge of a cell [m].
    - ``num_classes``: number of occupied classes, at most 253.
    """

    def __init__(self, states: UInt8Array, low: Int64Array, resolution: float, num_classes: int) -> None:
        self.states = states
        self.low = low
        self.resolution = resolution
        self.num_classes = num_classes

    @classmethod
    def of_cells(cls, keys: Int64Array, states: UInt8Array, resolution: float, num_classes: int) -> OwnMap:
        """Return the map of known cells with ``keys`` (n, 3) and ``states`` (n,)."""
        # An empty border spares the neighbourhood operations the edges.
        low = keys.min(axis=0) - 2 if len(keys) else np.zeros(3, np.int64)
        shape = keys.max(axis=0) - low + 3 if len(keys) else np.ones(3, np.int64)
        grid = np.zeros(shape, np.uint8)
        grid[tuple((keys - low).T)] = states
        return cls(grid, low, resolution, num_classes)

    @classmethod
    def of_evidence(cls, evidence: SemanticOctree, *, hit: float, miss: float) -> OwnMap:
        """Return the map of a robot's evidence s_i, given the sensor model's increments [log-odds]."""
        spans = evidence.spans()
        keys = codes_to_keys(spans.cells_in(np.ones(spans.codes.size, np.bool_)))
        largest = spans.deviations.max(axis=1)
        states = np.full(largest.size, UNDECIDED, np.uint8)
        states[largest <= miss] = FREE
        is_occupied = largest >= hit / 2
        states[is_occupied] = spans.deviations[is_occupied].argmax(axis=1) + 1
        states = np.repeat(states, spans.num_cells)
        resolution = evidence.resolution
        while len(keys) and float(np.prod(keys.max(axis=0) - keys.min(axis=0) + 5.0)) > MAX_CELLS:
            keys, states = _halved(keys, states)
            resolution *= 2
        return cls.of_cells(keys, states, resolution, evidence.num_classes)

    @cached_property
    def is_occupied(self) -> BoolArray:
        """True for each occupied cell (nx, ny, nz)."""
        return _is_occupied(self.states)

    @cached_property
    def _occupied_by_height(self) -> tuple[OccupiedCells, OccupiedCells]:
        """Obstacles and ground."""
        indices = np.argwhere(self.is_occupied)
        lowest = _lowest(self.is_occupied)
        ground = ndimage.minimum_filter(lowest, size=_GROUND_WINDOW * COLUMN_CELLS, mode="nearest")
        is_obstacle = indices[:, 2] - ground[indices[:, 0], indices[:, 1]] >= COLUMN_CELLS
        points: Float64Array = (indices + self.low + 0.5) * self.resolution
        class_ids = self.states[tuple(indices.T)]
        return (
            OccupiedCells(points[is_obstacle], class_ids[is_obstacle]),
            OccupiedCells(points[~is_obstacle], class_ids[~is_obstacle]),
        )

    @property
    def obstacles(self) -> OccupiedCells:
        """Occupied cells at least ``COLUMN_CELLS`` above the ground."""
        return self._occupied_by_height[0]

    @property
    def ground(self) -> OccupiedCells:
        """Occupied cells below the obstacles."""
        return self._occupied_by_height[1]

    @cached_property
    def classes_nearby(self) -> UInt64Array:
        """Set of the classes within one cell of each cell (nx, ny, nz), as bits."""
        return _dilated(np.where(self.is_occupied, class_bits(self.states), np.uint64(0)))

    @cached_property
    def columns(self) -> Columns:
        """The map seen from above."""
        return Columns.of_map(self)

    @cached_property
    def surface(self) -> Surface:
        """Surface for the refinement: obstacles, ground, and edges between ground classes, each with codes of its own.

        An edge is a ground cell with exactly one other ground class within one cell.
        """
        obstacles, ground = self.obstacles, self.ground
        bits = np.zeros(self.states.shape, np.uint64)
        cells = tuple(self.indices_of(ground.points).T)
        bits[cells] = class_bits(ground.class_ids)
        nearby = _dilated(bits)[cells]
        is_edge = np.bitwise_count(nearby) == 2
        _, edge_codes = np.unique(nearby[is_edge], return_inverse=True)
        first, second = _two_bits(nearby[is_edge])
        edge_codes = _FIRST_EDGE_CODE + first * _NUM_BITS + second
        num = np.array([len(obstacles), len(ground), int(is_edge.sum())])
        weights = np.array([1.0, _GROUND_WEIGHT, _EDGE_WEIGHT]) * max(num[0], 1) / np.maximum(num, 1)
        return Surface.of_points(
            np.concatenate([obstacles.points, ground.points, ground.points[is_edge]]),
            np.concatenate([obstacles.class_ids.astype(np.int64), ground.class_ids + np.int64(UNDECIDED), edge_codes]),
            np.repeat(weights, num),
            spacing=self.resolution,
            radius=_SURFACE_RADIUS * self.resolution,
        )

    def indices_of(self, points: Float64Array) -> Int64Array:
        """Return the indices (n, 3) of the cells that hold points (n, 3) [m]; they may lie outside of ``states``."""
        indices: Int64Array = np.floor(points / self.resolution).astype(np.int64) - self.low
        return indices

    def at(self, points: Float64Array) -> tuple[UInt8Array, UInt64Array]:
        """Return the state (n,) and the classes nearby (n,) of the cells that hold points (n, 3) [m]."""
        indices = self.indices_of(points)
        inside = ((indices >= 0) & (indices < self.states.shape)).all(axis=1)
        flat = np.ravel_multi_index(tuple(np.where(inside[:, None], indices, 0).T), self.states.shape)
        # The first cell belongs to the empty border.
        return self.states.ravel()[flat], self.classes_nearby.ravel()[flat]


@dataclass(frozen=True, eq=False)
class Columns:
    """A map seen from above, in square columns.

    - ``codes`` (mx, my) int64: 0 unknown; class_id of an obstacle; num_classes + class_id of the ground where the
      column is open: free above the ground and not beside an obstacle.
    - ``ground`` (mx, my) float64: height of the ground [m], NaN where unknown.
    - ``low`` (2,) int64: index of the first column; column i spans [i, i + 1) x ``edge``.
    - ``edge``: edge of a column [m].
    """

    codes: Int64Array
    ground: Float64Array
    low: Int64Array
    edge: float

    @classmethod
    def of_map(cls, own: OwnMap) -> Columns:
        """Return the columns of a map."""
        # Columns are aligned to multiples of their edge.
        before = own.low[:2] % COLUMN_CELLS
        after = -(before + own.states.shape[:2]) % COLUMN_CELLS
        states = np.pad(own.states, ((before[0], after[0]), (before[1], after[1]), (0, 0)))
        is_occupied = _is_occupied(states)
        num_x, num_y, num_z = states.shape
        shape = num_x // COLUMN_CELLS, num_y // COLUMN_CELLS
        lowest = _lowest(is_occupied).reshape(shape[0], COLUMN_CELLS, shape[1], COLUMN_CELLS).min(axis=(1, 3))
        ground = ndimage.minimum_filter(lowest, size=_GROUND_WINDOW, mode="nearest")

        def heights(cells: BoolArray) -> tuple[Int64Array, Int64Array, npt.NDArray[np.intp]]:
            """Flat column, height above ground [cell] and position of the cells."""
            indices = np.nonzero(cells)
            x, y = indices[0] // COLUMN_CELLS, indices[1] // COLUMN_CELLS
            return x * shape[1] + y, indices[2] - ground[x, y], np.ravel_multi_index(indices, states.shape)

        size = shape[0] * shape[1]
        column, height, cell = heights(is_occupied)
        class_index = states.ravel()[cell].astype(np.int64) - 1
        is_high = height >= COLUMN_CELLS
        obstacle, has_obstacle = _winner(column[is_high], class_index[is_high], size, own.num_classes)
        floor, has_floor = _winner(column[~is_high], class_index[~is_high], size, own.num_classes)
        column, height, _ = heights(states == FREE)
        is_free = (height >= COLUMN_CELLS) & (height <= _OPEN_HEIGHT * COLUMN_CELLS)
        num_free = np.bincount(column[is_free], minlength=size).reshape(shape)
        # A column without ground of its own, such as one below an overhang, has that of a neighbour.
        distance, nearest = ndimage.distance_transform_edt(~has_floor.reshape(shape), return_indices=True)
        floor = floor.reshape(shape)[tuple(nearest)]
        is_beside = ndimage.binary_dilation(has_obstacle.reshape(shape), np.ones((3, 3)))
        is_open = (num_free >= _MIN_OPEN_CELLS) & ~is_beside & (distance < 2) & bool(has_floor.any())
        codes = np.where(is_open, floor + 1 + own.num_classes, 0)
        codes = np.where(has_obstacle.reshape(shape), obstacle.reshape(shape) + 1, codes)
        height_m = np.where(ground < num_z, (ground + own.low[2]) * own.resolution, np.nan)
        return cls(codes, height_m, (own.low[:2] - before) // COLUMN_CELLS, COLUMN_CELLS * own.resolution)

    @cached_property
    def known(self) -> tuple[Float64Array, Int64Array, Float64Array]:
        """Centres (n, 2) [m], codes (n,) and ground heights (n,) [m] of the known columns."""
        indices = np.argwhere(self.codes > 0)
        cells = tuple(indices.T)
        centres: Float64Array = (indices + self.low + 0.5) * self.edge
        return centres, self.codes[cells], self.ground[cells]


def class_bits(class_ids: UInt8Array) -> UInt64Array:
    """Return the bit of each class_id."""
    return np.uint64(1) << ((class_ids.astype(np.uint64) - np.uint64(1)) % np.uint64(_NUM_BITS))


def _two_bits(sets: UInt64Array) -> tuple[Int64Array, Int64Array]:
    """Positions of the lowest and of the highest bit of sets (n,) with two bits."""
    lowest = sets & (~sets + np.uint64(1))
    return np.log2(lowest.astype(np.float64)).astype(np.int64), np.log2((sets ^ lowest).astype(np.float64)).astype(
        np.int64
    )


def _is_occupied(states: UInt8Array) -> BoolArray:
    """True for each occupied cell."""
    is_occupied: BoolArray = (states != UNKNOWN) & (states < UNDECIDED)
    return is_occupied


def _lowest(is_occupied: BoolArray) -> Int64Array:
    """Index (nx, ny) of the lowest occupied cell of each vertical line of cells; nz where there is none."""
    lowest: Int64Array = np.where(is_occupied.any(axis=2), is_occupied.argmax(axis=2), is_occupied.shape[2])
    return lowest


def _dilated(bits: UInt64Array) -> UInt64Array:
    """Union of the bits within one cell, in each cell of a grid with an empty border."""
    for axis in range(3):
        lines = np.moveaxis(bits, axis, 0)
        union = lines.copy()
        union[1:] |= lines[:-1]
        union[:-1] |= lines[1:]
        bits = np.moveaxis(union, 0, axis)
    return np.ascontiguousarray(bits)


def _winner(
    columns: Int64Array, class_indices: Int64Array, num_columns: int, num_classes: int
) -> tuple[Int64Array, BoolArray]:
    """The most frequent class index of each column (num_columns,), ties to the lower one, and where there is one."""
    votes = np.bincount(columns * num_classes + class_indices, minlength=num_columns * num_classes)
    votes = votes.reshape(num_columns, num_classes)
    has_winner: BoolArray = votes.any(axis=1)
    return votes.argmax(axis=1), has_winner


def _halved(keys: Int64Array, states: UInt8Array) -> tuple[Int64Array, UInt8Array]:
    """Cells of twice the edge: occupied by the most frequent class of their parts, else free where a part is free."""
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
