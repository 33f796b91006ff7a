"""Map of one robot in its own frame, in the forms that registration uses: cells, columns and surfaces.

A cell is *occupied* by the class of its largest evidence where that is at least half a hit, and *free* where all its
evidence is at most a miss, as for the contradiction of evidence (docs/metrics.md). *Ground* is the lowest occupied
cell nearby; *obstacles* stand at least two cells above it.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import ndimage

from octoreplay.mapping.octree import SemanticOctree, codes_to_keys
from octoreplay.records import BoolArray, Float64Array, Int64Array, UInt8Array, UInt64Array
from octoreplay.registration.cells import (
    COLUMN_CELLS,
    FREE,
    GROUND_WINDOW,
    NUM_BITS,
    UNDECIDED,
    OccupiedCells,
    class_bits,
    dilated,
    halved,
    lowest_occupied,
    occupied_cells,
)
from octoreplay.registration.columns import Columns
from octoreplay.registration.features import DescribedPoints
from octoreplay.registration.icp import Surface
from octoreplay.registration.measured_points import MeasuredPoints
from octoreplay.registration.planes import PlanePoints

MAX_CELLS = 1 << 27
"""Largest number of cells in a map's bounding box; a larger map is halved in resolution until it fits."""

FIRST_GROUND_CODE = 255
"""Code of ground of class 0 in the surface of a map with a vertical axis; obstacles have their class as code."""

# Radius of the neighbourhood that shapes the local surface [cell].
_SURFACE_RADIUS = 3.5
# Total weight of ground and of edges between ground classes, relative to that of the obstacles.
_GROUND_WEIGHT, _EDGE_WEIGHT = 0.5, 1.0
# First code of the edges between two ground classes in a surface.
_FIRST_EDGE_CODE = 1000
# Spacing of described points, and radius of their neighbourhoods [cell].
_FEATURE_SPACING, _FEATURE_RADIUS = 2, 10.0
# Distance up to which free cells orient a normal [cell].
_NORMAL_REACH = 2


class OwnMap:
    """Evidence of one robot in its own frame.

    - ``states`` (nx, ny, nz) uint8: UNKNOWN, UNDECIDED, FREE or the class_id of each cell in the map's bounding box.
    - ``low`` (3,) int64: key of the first cell.
    - ``resolution``: edge of a cell [m].
    - ``num_classes``: number of occupied classes, at most 253.
    - ``measured``: measured points; occupied cells without them stand at their centres.
    """

    def __init__(
        self,
        states: UInt8Array,
        low: Int64Array,
        resolution: float,
        num_classes: int,
        measured: MeasuredPoints | None = None,
    ) -> None:
        self.measured = measured
        self.states = states
        self.low = low
        self.resolution = resolution
        self.num_classes = num_classes

    @classmethod
    def of_cells(
        cls,
        keys: Int64Array,
        states: UInt8Array,
        resolution: float,
        num_classes: int,
        measured: MeasuredPoints | None = None,
    ) -> OwnMap:
        """Return the map of known cells with ``keys`` (n, 3) and ``states`` (n,)."""
        # An empty border spares the neighbourhood operations the edges.
        low = keys.min(axis=0) - 2 if len(keys) else np.zeros(3, np.int64)
        shape = keys.max(axis=0) - low + 3 if len(keys) else np.ones(3, np.int64)
        grid = np.zeros(shape, np.uint8)
        grid[tuple((keys - low).T)] = states
        return cls(grid, low, resolution, num_classes, measured)

    @classmethod
    def of_evidence(
        cls, evidence: SemanticOctree, *, hit: float, miss: float, measured: MeasuredPoints | None = None
    ) -> OwnMap:
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
            keys, states = halved(keys, states)
            resolution, measured = resolution * 2, None
        return cls.of_cells(keys, states, resolution, evidence.num_classes, measured)

    @cached_property
    def is_occupied(self) -> BoolArray:
        """True for each occupied cell (nx, ny, nz)."""
        return occupied_cells(self.states)

    @cached_property
    def _occupied_cells(self) -> tuple[Int64Array, OccupiedCells]:
        """Indices (n, 3) of the occupied cells, and the cells."""
        indices = np.argwhere(self.is_occupied)
        keys = indices + self.low
        points = (MeasuredPoints(self.resolution) if self.measured is None else self.measured).cell_means(keys)
        return indices, OccupiedCells(points, self.states[tuple(indices.T)])

    @property
    def occupied(self) -> OccupiedCells:
        """All occupied cells."""
        return self._occupied_cells[1]

    @cached_property
    def _occupied_by_height(self) -> tuple[OccupiedCells, OccupiedCells]:
        """Obstacles and ground."""
        indices, cells = self._occupied_cells
        lowest = lowest_occupied(self.is_occupied)
        ground = ndimage.minimum_filter(lowest, size=GROUND_WINDOW * COLUMN_CELLS, mode="nearest")
        is_obstacle = indices[:, 2] - ground[indices[:, 0], indices[:, 1]] >= COLUMN_CELLS
        return cells.subset(is_obstacle), cells.subset(~is_obstacle)

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
        return dilated(np.where(self.is_occupied, class_bits(self.states), np.uint64(0)))

    @cached_property
    def columns(self) -> Columns:
        """The map seen from above."""
        return Columns.of_states(self.states, self.low, self.resolution, self.num_classes)

    @cached_property
    def upright_surface(self) -> Surface:
        """Surface of a map with a vertical axis.

        Obstacles, ground, and edges between ground classes have codes of their own. An edge is a ground cell with
        exactly one other ground class within one cell.
        """
        obstacles, ground = self.obstacles, self.ground
        bits = np.zeros(self.states.shape, np.uint64)
        cells = tuple(self.indices_of(ground.points).T)
        bits[cells] = class_bits(ground.class_ids)
        nearby: UInt64Array = dilated(bits)[cells]
        is_edge = np.bitwise_count(nearby) == 2
        first, second = _two_bits(nearby[is_edge])
        edge_codes = _FIRST_EDGE_CODE + first * NUM_BITS + second
        num = np.array([len(obstacles), len(ground), int(is_edge.sum())])
        weights = np.array([1.0, _GROUND_WEIGHT, _EDGE_WEIGHT]) * max(num[0], 1) / np.maximum(num, 1)
        return Surface.of_points(
            np.concatenate([obstacles.points, ground.points, ground.points[is_edge]]),
            np.concatenate(
                [obstacles.class_ids.astype(np.int64), ground.class_ids + np.int64(FIRST_GROUND_CODE), edge_codes]
            ),
            np.repeat(weights, num),
            spacing=self.resolution,
            radius=_SURFACE_RADIUS * self.resolution,
        )

    @cached_property
    def planes(self) -> PlanePoints | None:
        """Planes around the measured points; None without them."""
        return None if self.measured is None else self.measured.planes()

    @cached_property
    def surface(self) -> Surface:
        """Surface of all occupied cells, with the class as code."""
        radius = _SURFACE_RADIUS * self.resolution
        points, codes = self.occupied.points, self.occupied.class_ids.astype(np.int64)
        return Surface.of_points(points, codes, np.ones(len(points)), spacing=self.resolution, radius=radius)

    @cached_property
    def described_points(self) -> DescribedPoints:
        """Thinned points of the surface with descriptors of their local shapes; normals point to free space."""
        if len(self.occupied) == 0:
            return DescribedPoints(np.zeros((0, 3)), np.zeros((0, 33)))
        cells = np.floor(self.surface.points / (_FEATURE_SPACING * self.resolution)).astype(np.int64)
        _, chosen = np.unique(cells, axis=0, return_index=True)
        points = self.surface.points[chosen]
        _, axes = np.linalg.eigh(self.surface.covariances[chosen])
        normals = axes[:, :, 0]
        towards_free = np.zeros_like(points)
        indices = self.indices_of(points)
        for step in np.ndindex(*(2 * _NORMAL_REACH + 1,) * 3):
            offset = np.array(step) - _NORMAL_REACH
            nearby = np.clip(indices + offset, 0, np.array(self.states.shape) - 1)
            towards_free += (self.states[tuple(nearby.T)] == FREE)[:, None] * offset
        is_inward = np.einsum("ni,ni->n", normals, towards_free) < 0
        normals = np.where(is_inward[:, None], -normals, normals)
        return DescribedPoints.of_points(points, normals, _FEATURE_RADIUS * self.resolution)

    def indices_of(self, points: Float64Array) -> Int64Array:
        """Return the indices (n, 3) of the cells that hold points (n, 3) [m]; they may lie outside of ``states``."""
        indices: Int64Array = np.floor(points / self.resolution).astype(np.int64) - self.low
        return indices

    def at(self, points: Float64Array) -> tuple[UInt8Array, UInt64Array]:
        """Return the state (n,) and the classes nearby (n,) of the cells that hold points (n, 3) [m]."""
        indices = self.indices_of(points)
        inside: BoolArray = np.all((indices >= 0) & (indices < self.states.shape), axis=1)
        flat = np.ravel_multi_index(tuple(np.where(inside[:, None], indices, 0).T), self.states.shape)
        # The first cell belongs to the empty border.
        return self.states.ravel()[flat], self.classes_nearby.ravel()[flat]


def _two_bits(sets: UInt64Array) -> tuple[Int64Array, Int64Array]:
    """Positions of the lowest and of the highest bit of sets (n,) with two bits."""
    lowest = sets & (~sets + np.uint64(1))
    return np.log2(lowest.astype(np.float64)).astype(np.int64), np.log2((sets ^ lowest).astype(np.float64)).astype(
        np.int64
    )
