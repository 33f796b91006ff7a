"""Two-dimensional occupancy grids: cells, and their files as map_server of ROS and nav2 reads them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoreplay.log_odds import best_labels
from octoreplay.records import Int64Array, LeafTable, UInt8Array

FREE, UNKNOWN, OCCUPIED = 254, 205, 0
"""Grey values of the image. map_server takes a cell as occupied where 1 - value / 255 is above one threshold, and as
free where it is below the other."""
MAX_CELLS = 1 << 30
"""Largest number of cells of a grid."""
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196


class Grid(NamedTuple):
    """Occupancy grid.

    Attributes
    ----------
    cells : (height, width) uint8
        FREE, UNKNOWN or OCCUPIED; rows along y, columns along x, the lowest first.
    origin : (float, float)
        Lower corner x, y [m].
    resolution : float
        Edge of a cell [m].
    """

    cells: UInt8Array
    origin: tuple[float, float]
    resolution: float

    @property
    def num_known(self) -> int:
        """Number of cells that are free or occupied."""
        return int(np.count_nonzero(self.cells != UNKNOWN))


def grid_of(leaves: LeafTable, resolution: float) -> Grid:
    """Return the occupancy grid of one leaf or more.

    A cell is occupied where an occupied leaf lies above or below it, free where only free leaves do, and else unknown.
    Cells have the edge ``resolution`` [m]. Raises ValueError for a map that is too large for a grid.
    """
    edges = np.rint(leaves.sizes / resolution).astype(np.int64)
    corners = np.rint(leaves.centers[:, :2] / resolution - edges[:, None] / 2).astype(np.int64)
    first = corners.min(axis=0)
    width, height = (corners + edges[:, None]).max(axis=0) - first
    if width * height > MAX_CELLS:
        raise ValueError(f"a grid of {width:,} x {height:,} cells is too large")
    cells = np.full((height, width), UNKNOWN, np.uint8)
    is_occupied = best_labels(leaves.log_odds) > 0
    # Occupied leaves last, because they count more.
    for value, chosen in ((FREE, ~is_occupied), (OCCUPIED, is_occupied)):
        _fill(cells, corners[chosen] - first, edges[chosen], value)
    x, y = (first * resolution).tolist()
    return Grid(cells, (x, y), resolution)


def grid_files(path: Path, grid: Grid) -> dict[Path, bytes]:
    """Return the contents of the YAML file ``path`` and of the image (PGM) beside it."""
    height, width = grid.cells.shape
    image_path = path.with_suffix(".pgm")
    x, y = grid.origin
    text = (
        f"image: {image_path.name}\nmode: trinary\nresolution: {grid.resolution!r}\norigin: [{x!r}, {y!r}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {_OCCUPIED_THRESHOLD}\nfree_thresh: {_FREE_THRESHOLD}\n"
    )
    # Images begin with the row of the largest y.
    image = f"P5\n{width} {height}\n255\n".encode() + grid.cells[::-1].tobytes()
    return {path: text.encode(errors="backslashreplace"), image_path: image}


def _fill(image: UInt8Array, corners: Int64Array, edges: Int64Array, value: int) -> None:
    """Set the squares with the lower corners (n, 2) and the edges (n,) in cells to a value."""
    for edge in np.unique(edges):
        of_edge = np.unique(corners[edges == edge], axis=0)
        if edge > 16:
            for x, y in of_edge:
                image[y : y + edge, x : x + edge] = value
            continue
        steps = np.arange(edge)
        rows = of_edge[:, 1, None, None] + steps[:, None]
        columns = of_edge[:, 0, None, None] + steps[None, :]
        image[rows, columns] = value
