"""Cut of the space into tiles."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from octoreplay.config.sensor import MapConfig
from octoreplay.errors import ConfigError
from octoreplay.study.tiles.geometry import Tile, tile_cells, tiles_of

BOX = np.array([[-5.0, 1.0, 0.0, 7.0, 2.0, 1.0]])


@dataclasses.dataclass
class Config:
    """The part of a run's configuration that tiles need."""

    map: MapConfig


@pytest.mark.parametrize(("edge", "cells"), [(6.4, 32), (8.0, 32), (10.0, 64), (50.0, 256), (1e9, 1 << 19)])
def test_edges_are_powers_of_two(edge, cells):
    assert tile_cells(edge, 0.2) == cells


@pytest.mark.parametrize("edge", [4.0, 1e-9, 0.0, -1.0, math.nan, math.inf])
def test_small_and_wrong_edges_are_refused(edge):
    with pytest.raises(ConfigError, match=r"^tiles: .*give"):
        tile_cells(edge, 0.2)


def test_tiles_cover_the_boxes():
    config = Config(MapConfig(0.1))
    assert tiles_of(BOX, 32, config) == tuple(Tile(x, 0, 32) for x in (-2, -1, 0, 1, 2))
    apart = np.array([[0.1, 0.1, 0.0, 0.2, 0.2, 1.0], [7.0, 7.0, 0.0, 7.1, 7.1, 1.0]])
    assert tiles_of(apart, 32, config) == (Tile(0, 0, 32), Tile(2, 2, 32))


def test_tiles_lie_within_the_bounds():
    config = Config(MapConfig(0.1, bounds=(-1.0, 0.0, 0.0, 4.0, 1.5, 2.0)))
    tiles = tiles_of(BOX, 32, config)
    assert tiles == tuple(Tile(x, 0, 32) for x in (-1, 0, 1))
    assert tiles[0].bounds(config.map) == (-1.0, 0.0, 0.0, 0.0, 1.5, 2.0)
    assert tiles_of(BOX, 32, Config(MapConfig(0.1, bounds=(20.0, 0.0, 0.0, 30.0, 1.0, 1.0)))) == ()
    assert tiles_of(np.zeros((0, 6)), 32, config) == ()


def test_tiles_without_bounds_have_all_heights():
    bounds = Tile(1, -1, 32).bounds(MapConfig(0.1))
    assert bounds[:2] + bounds[3:5] == (3.2, -3.2, 6.4, 0.0)
    assert (bounds[2], bounds[5]) == (-(2**18) * 0.1, 2**18 * 0.1)


def test_too_many_tiles_are_refused():
    with pytest.raises(ConfigError, match="more than 100,000 tiles; give a larger one"):
        tiles_of(np.array([[-1e4, -1e4, 0.0, 1e4, 1e4, 1.0]]), 32, Config(MapConfig(0.1)))
