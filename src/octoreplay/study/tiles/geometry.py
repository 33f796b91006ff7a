"""Cut of a run's space into tiles: columns along z whose sides are nodes of the octree."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.sensor import MapConfig
from octoreplay.errors import ConfigError
from octoreplay.mapping.octree import KEY_OFFSET
from octoreplay.records import Int64Array

LEAST_CELLS = 32
"""Least edge of a tile [cells]: twice that of the nodes whose sizes are counted apart."""
MAX_TILES = 100_000
"""Largest number of tiles of a run."""


class Tile(NamedTuple):
    """One tile: its place in the grid of tiles, and its edge [cells]. It covers all heights of the map."""

    x: int
    y: int
    num_cells: int

    @property
    def name(self) -> str:
        """Name in files and messages."""
        return f"tile_{self.x}_{self.y}"

    def bounds(self, map_config: MapConfig) -> tuple[float, ...]:
        """Bounds of the tile's map (6,) [m]: the tile, and the bounds of the run."""
        edge, reach = self.num_cells * map_config.resolution, KEY_OFFSET * map_config.resolution
        tile = (self.x * edge, self.y * edge, -reach, (self.x + 1) * edge, (self.y + 1) * edge, reach)
        low, high = np.array(tile[:3]), np.array(tile[3:])
        run = np.array(map_config.box)
        return (*np.maximum(low, run[:3]).tolist(), *np.minimum(high, run[3:]).tolist())

    def config(self, config: ResolvedRun) -> ResolvedRun:
        """Configuration of the run of this tile."""
        return dataclasses.replace(config, map=dataclasses.replace(config.map, bounds=self.bounds(config.map)))


def tile_cells(edge: float, resolution: float) -> int:
    """Return the edge of tiles in cells: the power of two nearest to ``edge`` [m] in proportion.

    Raises ConfigError where it is below LEAST_CELLS.
    """
    if not (math.isfinite(edge) and edge > 0.0):
        raise ConfigError(f"tiles: {edge:g} m is no edge of a tile; give metres above 0")
    num_cells = 2 ** round(math.log2(edge / resolution))
    if num_cells < LEAST_CELLS:
        raise ConfigError(
            f"tiles: an edge of {edge:g} m is about {num_cells:g} cells of {resolution:g} m; give at least "
            f"{LEAST_CELLS * resolution:g} m, {LEAST_CELLS} cells"
        )
    return min(int(num_cells), 2 * KEY_OFFSET)


def tiles_of(columns: Int64Array, column_cells: int, num_cells: int) -> tuple[Tile, ...]:
    """Return the tiles with an edge of ``num_cells`` that hold the columns (n, 2), by x and then y.

    ``column_cells`` is the edge of the columns; edges are in cells. Raises ConfigError for more than MAX_TILES.
    """
    places = np.unique(columns // (num_cells // column_cells), axis=0)
    if len(places) > MAX_TILES:
        raise ConfigError(f"tiles: the maps have {len(places):,} tiles, more than {MAX_TILES:,}; give a larger edge")
    return tuple(Tile(x, y, num_cells) for x, y in places.tolist())
