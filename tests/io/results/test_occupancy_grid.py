"""Occupancy grids, compared with cells that are looked up one by one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from octoreplay.io.results.occupancy_grid import FREE, OCCUPIED, UNKNOWN, grid_files, grid_of
from octoreplay.records import LeafTable

RESOLUTION = 0.5


def random_leaves(seed: int) -> LeafTable:
    """Leaves of one, two and four cells; they may lie above each other."""
    random = np.random.default_rng(seed)
    edges = random.choice([1, 2, 4, 32], 40)
    keys = random.integers(-10, 10, (40, 3)) * edges[:, None] // 2
    log_odds = random.choice([-1.0, 1.0], (40, 2)).astype(np.float32)
    return LeafTable((keys + edges[:, None] / 2) * RESOLUTION, edges * RESOLUTION, log_odds)


def write(path: Path, leaves: LeafTable) -> int:
    """Write a grid, and return the number of known cells."""
    grid = grid_of(leaves, RESOLUTION)
    for name, data in grid_files(path, grid).items():
        name.write_bytes(data)
    return grid.num_known


def read_grid(path: Path) -> tuple[dict[str, object], np.ndarray]:
    """The YAML file, and the image with the lowest row first."""
    content = YAML(typ="safe").load(path.read_text())
    kind, size, largest, data = path.with_name(content["image"]).read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    assert (kind, largest) == (b"P5", b"255")
    return content, np.frombuffer(data, np.uint8).reshape(height, width)[::-1]


@pytest.mark.parametrize("seed", range(4))
def test_each_cell_shows_the_leaves_above_it(tmp_path: Path, seed: int) -> None:
    leaves, (low, high) = random_leaves(seed), (-1.0, 2.5)
    known = write(tmp_path / "map.yaml", leaves.taken(leaves.between(low, high)))
    content, image = read_grid(tmp_path / "map.yaml")
    assert content["resolution"] == RESOLUTION
    assert known == np.count_nonzero(image != UNKNOWN)
    half = leaves.sizes / 2
    for row, column in np.ndindex(image.shape):
        x, y = np.array(content["origin"][:2]) + (np.array([column, row]) + 0.5) * RESOLUTION
        here = (np.abs(leaves.centers[:, 0] - x) < half) & (np.abs(leaves.centers[:, 1] - y) < half)
        here &= (leaves.centers[:, 2] + half > low) & (leaves.centers[:, 2] - half < high)
        is_occupied = (leaves.log_odds[here] > 0).any()
        assert image[row, column] == (OCCUPIED if is_occupied else FREE if here.any() else UNKNOWN)


def test_grey_values_mean_what_the_map_server_reads(tmp_path: Path) -> None:
    write(tmp_path / "map.yaml", random_leaves(0))
    content, _ = read_grid(tmp_path / "map.yaml")
    probabilities = {value: 1.0 - value / 255 for value in (OCCUPIED, FREE, UNKNOWN)}
    assert probabilities[OCCUPIED] > content["occupied_thresh"]
    assert probabilities[FREE] < content["free_thresh"]
    assert content["free_thresh"] <= probabilities[UNKNOWN] <= content["occupied_thresh"]
