"""Cut of a run's space into tiles: columns along z, or cubes, that consist of nodes of the octree."""

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
    """One tile: its place in the grid of tiles, and its edge [cell]. Without ``z`` it has all heights of the map."""

    x: int
    y: int
    num_cells: int
    z: int | None = None

    @property
    def name(self) -> str:
        """Name in files and messages."""
        return f"tile_{self.x}_{self.y}" + ("" if self.z is None else f"_{self.z}")

    def bounds(self, map_config: MapConfig) -> tuple[float, ...]:
        """Bounds of the tile's map (6,) [m]: the tile, and the bounds of the run."""
        edge, reach = self.num_cells * map_config.resolution, KEY_OFFSET * map_config.resolution
        bottom, top = (-reach, reach) if self.z is None else (self.z * edge, (self.z + 1) * edge)
        low = np.array([self.x * edge, self.y * edge, bottom])
        high = np.array([(self.x + 1) * edge, (self.y + 1) * edge, top])
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


def tiles_of(blocks: Int64Array, factor: int, num_cells: int) -> tuple[Tile, ...]:
    """Return the tiles with an edge of ``num_cells`` that hold some blocks, in ascending order.

    ``blocks`` are the places (n, 2) of columns along x and y, or (n, 3) of cubes; ``factor`` of them make the edge of a
    tile. Raises ConfigError for more than MAX_TILES.
    """
    places = np.unique(blocks // factor, axis=0)
    if len(places) > MAX_TILES:
        raise ConfigError(f"tiles: the maps have {len(places):,} tiles, more than {MAX_TILES:,}; give a larger edge")
    return tuple(Tile(x, y, num_cells, *z) for x, y, *z in places.tolist())
