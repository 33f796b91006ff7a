"""Maps of running sums for tests."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.running_sums import MODULUS
from support.octree_factory import cells_of, octree_of

NUM_CLASSES = 3


def octree_with(cells):
    return octree_of(cells, num_classes=NUM_CLASSES)


def mass_of(cells):
    """Octree of integers (C,) of any size, stored modulo MODULUS as bits."""
    return octree_with({key: np.asarray(units % MODULUS, np.int32).view(np.float32) for key, units in cells.items()})


def units_of(octree):
    """{key: integers (C,)} of a mass, in [-MODULUS / 2, MODULUS / 2)."""
    bits = {key: np.frombuffer(value, np.int32).astype(np.int64) for key, value in cells_of(octree).items()}
    assert all(((value >= 0) & (value < MODULUS)).all() for value in bits.values())
    return {key: signed_of(value) for key, value in bits.items()}


def signed_of(units):
    return (units + MODULUS // 2) % MODULUS - MODULUS // 2


def value_of(cells, key):
    return cells.get(key, np.zeros(NUM_CLASSES, np.int64))
