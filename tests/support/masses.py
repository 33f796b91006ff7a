"""Octrees of integers for ratio consensus."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels import storage
from octoreplay.mapping.kernels.running_sums import MODULUS
from octoreplay.mapping.running_sums import (
    MAX_MASS,
)
from support.octree_factory import cells_of, cube, octree_of

NUM_CLASSES = 3


def log_odds_octree(cells):
    return octree_of(cells, num_classes=NUM_CLASSES)


def mass_of(cells):
    """Octree of integers (C,) of any size, stored modulo MODULUS as bits."""
    return log_odds_octree(
        {key: np.asarray(units % MODULUS, np.int32).view(np.float32) for key, units in cells.items()}
    )


def units_of(octree):
    """{key: integers (C,)} of a mass, in [-MODULUS / 2, MODULUS / 2)."""
    bits = {key: np.frombuffer(value, np.int32).astype(np.int64) for key, value in cells_of(octree).items()}
    assert all(((value >= 0) & (value < MODULUS)).all() for value in bits.values())
    return {key: signed(value) for key, value in bits.items()}


def signed(units):
    return (units + MODULUS // 2) % MODULUS - MODULUS // 2


def random_cells(rng, *, of_log_odds=False):
    """Whole bricks, smaller cubes and single cells, with one value or one for each class; some overlap."""
    cells = {}
    most = rng.choice([1.0, 5.0, 900.0]) if of_log_odds else rng.choice([3, 1 << 17, MAX_MASS])
    for _ in range(rng.integers(0, 5)):
        edge = int(rng.choice([1, 3, 4]))
        corner = (rng.integers(-2, 2, 3) * (4 if edge == 4 else 3)).tolist()
        values = rng.uniform(-most, most, NUM_CLASSES).astype(np.float32)
        values = values if of_log_odds else np.rint(values.astype(np.float64)).astype(np.int64)
        cells.update(cube(corner, edge, values if rng.random() < 0.5 else np.full(NUM_CLASSES, values[0])))
    return cells


def value_at(cells, key):
    return cells.get(key, np.zeros(NUM_CLASSES, np.int64))


def sum_of(*terms):
    """{key: signed sum of factor x cells} of the cells known in any of the terms (factor, cells)."""
    keys = set().union(*(cells for _, cells in terms))
    return {key: signed(sum(factor * value_at(cells, key) for factor, cells in terms)) for key in keys}


def assert_equal(found, expected):
    assert found.keys() == expected.keys()
    assert all((found[key] == expected[key]).all() for key in expected)


def changed_bricks(before, after):
    """Codes of the bricks with a cell that has another value or became known."""
    changed = {key for key in after if key not in before or (before[key] != after[key]).any()}
    return {int(storage.key_to_code(*key)) >> storage.CELL_BITS for key in changed}


def revised_bricks(octree, revision):
    return set(octree.codes[octree.revisions == revision].tolist())
