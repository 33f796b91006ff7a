"""Merged faces, compared with the faces of each finest cell."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from octoreplay.mapping import merged_faces as module
from octoreplay.mapping.merged_faces import merged_faces
from octoreplay.records import LeafTable

RESOLUTION = 0.25
COLORS = np.array([[250, 1, 2], [3, 200, 5]], np.uint8)


def random_leaves(seed: int) -> tuple[LeafTable, np.ndarray]:
    """Leaves of one and two cells that do not overlap, and their colours."""
    random = np.random.default_rng(seed)
    fine = np.unique(random.integers(-3, 3, (60, 3)), axis=0)
    coarse = 2 * np.unique(random.integers(2, 8, (5, 3)), axis=0)
    keys, edges = np.concatenate([fine, coarse]), np.repeat([1, 2], [len(fine), len(coarse)])
    centers = (keys + edges[:, None] / 2) * RESOLUTION
    table = LeafTable(centers, edges * RESOLUTION, np.zeros((len(keys), 1), np.float32))
    return table, COLORS[random.integers(0, 2, len(keys))]


def exposed_squares(leaves: LeafTable, colors: np.ndarray) -> dict[tuple[int, ...], tuple[int, ...]]:
    """Colour of each exposed square by twice its centre in cells, and its outward normal."""
    cells = {}
    for center, size, color in zip(leaves.centers, leaves.sizes, colors, strict=True):
        edge = round(size / RESOLUTION)
        low = np.rint(center / RESOLUTION - edge / 2).astype(int)
        for step in itertools.product(range(edge), repeat=3):
            cells[tuple((low + step).tolist())] = tuple(color.tolist())
    squares = {}
    for cell, color in cells.items():
        for axis, sign in itertools.product(range(3), (1, -1)):
            normal = [0, 0, 0]
            normal[axis] = sign
            if tuple(np.add(cell, normal).tolist()) not in cells:
                squares[*(2 * np.array(cell) + 1 + normal).tolist(), *normal] = color
    return squares


@pytest.mark.parametrize("seed", range(4))
def test_rectangles_cover_each_exposed_square_once(seed: int) -> None:
    leaves, colors = random_leaves(seed)
    faces = merged_faces(leaves, colors, RESOLUTION)
    found = {}
    for corners, color in zip(faces.corners / RESOLUTION, faces.colors, strict=True):
        across, along = corners[1] - corners[0], corners[3] - corners[0]
        assert np.array_equal(corners[2], corners[0] + across + along)
        lengths = int(np.abs(across).sum()), int(np.abs(along).sum())
        normal = np.cross(across / lengths[0], along / lengths[1])
        for i, j in np.ndindex(lengths):
            center = 2 * corners[0] + (2 * i + 1) * across / lengths[0] + (2 * j + 1) * along / lengths[1]
            square = (*np.rint(center).astype(int).tolist(), *np.rint(normal).astype(int).tolist())
            assert square not in found
            found[square] = tuple(color.tolist())
    assert found == exposed_squares(leaves, colors)
    assert len(faces.corners) < len(found)


def test_a_box_of_one_colour_has_six_rectangles() -> None:
    keys = np.array(list(np.ndindex(4, 3, 2)))
    leaves = LeafTable((keys + 0.5) * RESOLUTION, np.full(24, RESOLUTION), np.zeros((24, 1), np.float32))
    assert len(merged_faces(leaves, np.zeros((24, 3), np.uint8), RESOLUTION).corners) == 6


def test_too_many_cells_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    leaves, colors = random_leaves(0)
    monkeypatch.setattr(module, "MAX_CELLS", 10)
    with pytest.raises(ValueError, match="the leaves hold more than 10 cells"):
        merged_faces(leaves, colors, RESOLUTION)
