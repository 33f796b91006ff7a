"""Grid of a world on which robots drive: obstacles, distances to them, shortest paths."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from octoreplay.records import BoolArray, Float64Array, Int64Array
from octoreplay.simulate.world import World, grid_length

CELL = 0.5
"""Edge length of a cell [m]."""


class DrivingGrid:
    """Cells of a world's drivable square.

    ``obstacles`` (n, n) bool are the cells in which a robot cannot drive. ``distance`` (n, n) float64 [m] is the
    distance between the centres of a cell and the nearest obstacle cell; the square's edge is an obstacle.
    """

    def __init__(self, world: World) -> None:
        self.size = world.size
        self.n = grid_length(world.size, CELL)
        self.obstacles = world.obstacle_mask(CELL)
        self.distance = obstacle_distance(self.obstacles)

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the cell that contains a point [m]; points on the map's edge belong to the last cell."""
        i, j = (min(self.n - 1, max(0, math.floor((value + self.size / 2) / CELL))) for value in (x, y))
        return i, j

    def center(self, cells: Int64Array) -> Float64Array:
        """Return the centres (..., 2) of cells (..., 2) [m]."""
        centers: Float64Array = (np.asarray(cells, dtype=np.float64) + 0.5) * CELL - self.size / 2
        return centers


def obstacle_distance(obstacles: BoolArray) -> Float64Array:
    """Return the distance (n, m) [m] from the centre of each cell to that of the nearest obstacle, or past the edge."""
    from scipy.ndimage import distance_transform_edt

    padded = np.pad(~obstacles, 1, constant_values=False)
    distance: Float64Array = distance_transform_edt(padded)[1:-1, 1:-1] * CELL
    return distance


def shortest_paths(passable: BoolArray, start: Int64Array) -> tuple[Int64Array, Float64Array, Int64Array]:
    """Return the shortest paths from a cell (2,) over the passable cells (n, m).

    A cell has eight neighbours; diagonal steps need both adjacent cells (Dijkstra). Returns the cells (P, 2), their
    distances (P,) from the start in cells, infinite if unreachable, and the index (P,) of each cell's predecessor,
    negative at the start.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    cells = np.argwhere(passable)
    index = np.full(passable.shape, -1, dtype=np.int64)
    index[cells[:, 0], cells[:, 1]] = np.arange(len(cells))
    rows, columns, lengths = [], [], []
    padded = np.pad(index, 1, constant_values=-1)
    n, m = passable.shape
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        neighbour = padded[1 + di : 1 + di + n, 1 + dj : 1 + dj + m]
        beside = padded[1 : 1 + n, 1 + dj : 1 + dj + m], padded[1 + di : 1 + di + n, 1 : 1 + m]
        linked = (index >= 0) & (neighbour >= 0) & (beside[0] >= 0) & (beside[1] >= 0)
        rows.append(index[linked])
        columns.append(neighbour[linked])
        lengths.append(np.full(int(linked.sum()), math.hypot(di, dj)))
    graph = csr_array(
        (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), shape=(len(cells), len(cells))
    )
    distance, previous = dijkstra(
        graph, directed=False, indices=int(index[start[0], start[1]]), return_predecessors=True
    )
    return cells, distance, previous


def wrapped(angle: npt.ArrayLike) -> Float64Array:
    """Return angles [rad] wrapped to [-pi, pi)."""
    result: Float64Array = (np.asarray(angle, dtype=np.float64) + math.pi) % (2 * math.pi) - math.pi
    return result
