"""Cut of the space into tiles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from octoreplay.config.sensor import MapConfig
from octoreplay.errors import ConfigError
from octoreplay.study.tiles.geometry import Tile, tile_cells, tiles_of


@pytest.mark.parametrize(("edge", "cells"), [(6.4, 32), (8.0, 32), (10.0, 64), (50.0, 256), (1e9, 1 << 19)])
def test_edges_are_powers_of_two(edge, cells):
    assert tile_cells(edge, 0.2) == cells


@pytest.mark.parametrize("edge", [4.0, 1e-9, 0.0, -1.0, math.nan, math.inf])
def test_small_and_wrong_edges_are_refused(edge):
    with pytest.raises(ConfigError, match=r"^tiles: .*give"):
        tile_cells(edge, 0.2)


def test_tiles_cover_the_blocks():
    columns = np.array([[3, 0], [-1, 0], [-3, 1], [2, 0], [3, 0]])
    assert tiles_of(columns, 1, 32) == tuple(Tile(x, y, 32) for x, y in ((-3, 1), (-1, 0), (2, 0), (3, 0)))
    assert tiles_of(columns, 4, 128) == (Tile(-1, 0, 128), Tile(0, 0, 128))
    assert tiles_of(np.array([[1, 0, -1], [0, 0, -2]]), 2, 64) == (Tile(0, 0, 64, -1),)
    assert tiles_of(np.zeros((0, 2), np.int64), 1, 32) == ()


def test_bounds_of_a_tile_lie_within_those_of_the_run():
    bounds = (-1.0, 0.0, 0.0, 4.0, 1.5, 2.0)
    assert Tile(-1, 0, 32).bounds(MapConfig(0.1, bounds=bounds)) == (-1.0, 0.0, 0.0, 0.0, 1.5, 2.0)


def test_tiles_without_bounds_have_all_heights():
    bounds = Tile(1, -1, 32).bounds(MapConfig(0.1))
    assert bounds[:2] + bounds[3:5] == (3.2, -3.2, 6.4, 0.0)
    assert (bounds[2], bounds[5]) == (-(2**18) * 0.1, 2**18 * 0.1)


def test_a_cube_has_bounds_along_each_axis():
    tile = Tile(1, -1, 32, -2)
    assert tile.name == "tile_1_-1_-2"
    assert tile.bounds(MapConfig(0.1)) == (3.2, -3.2, -6.4, 6.4, 0.0, -3.2)


def test_too_many_tiles_are_refused():
    columns = np.column_stack([np.arange(100_001), np.zeros(100_001, np.int64)])
    with pytest.raises(ConfigError, match="100,001 tiles, more than 100,000; give a larger edge"):
        tiles_of(columns, 1, 32)
