"""Octrees from plain lists of cells and cubes, for tests."""

from __future__ import annotations

import itertools

import numpy as np

from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree

BRICK_EDGE = storage.BRICK_EDGE


def octree_of(cells, *, num_classes=2, resolution=0.25):
    """An octree from {key: values (C,)} of finest cells; written brick by brick through the public arrays."""
    octree = SemanticOctree(resolution, num_classes)
    by_brick = {}
    for key, values in cells.items():
        by_brick.setdefault(tuple(k >> storage.BRICK_BITS for k in key), {})[key] = np.broadcast_to(
            np.asarray(values, np.float32), num_classes
        )
    codes = np.array([brick_code(brick) for brick in by_brick], np.int64)
    indices = octree.find_or_add(codes)
    is_vector = [any((v != v[0]).any() for v in content.values()) for content in by_brick.values()]
    octree.raise_tiers(np.where(is_vector, storage.VECTOR, storage.SCALAR).astype(np.uint8))
    for index, content, vector in zip(indices, by_brick.values(), is_vector, strict=True):
        row = octree.bricks.rows[index]
        for key, values in content.items():
            cell = storage.key_to_code(*key) & (storage.BRICK_CELLS - 1)
            octree.bricks.known[index] |= np.uint64(1 << cell)
            if vector:
                octree.bricks.vector[row, :, cell] = values
            else:
                octree.bricks.scalar[row, cell] = values[0]
    consensus_kernels.finish_step(
        octree.bricks, np.ones(octree.num_bricks, np.float32), np.ones(octree.num_bricks, np.uint8), 1
    )
    return octree


def brick_code(brick):
    """Code of the brick whose lowest cell has BRICK_EDGE times this key."""
    return int(storage.key_to_code(*(storage.BRICK_EDGE * k for k in brick))) >> storage.CELL_BITS


def cube(corner, edge, values):
    """{key: values} of a cube of finest cells."""
    ranges = (range(c, c + edge) for c in corner)
    return dict.fromkeys(itertools.product(*ranges), values)


def cells_of(octree):
    """{key: bytes of its values (C,) float32} of every known finest cell, read from the bricks' arrays."""
    content = {}
    for index in range(octree.num_bricks):
        known = (octree.known[index] >> np.arange(storage.BRICK_CELLS, dtype=np.uint64)) & np.uint64(1) == 1
        tier, row = octree.bricks.tiers[index], octree.bricks.rows[index]
        values = np.empty((octree.num_classes, storage.BRICK_CELLS), np.float32)
        if tier == storage.UNIFORM:
            values[:] = octree.bricks.values[index]
        elif tier == storage.SCALAR:
            values[:] = octree.bricks.scalar[row]
        else:
            values[:] = octree.bricks.vector[row]
        cells = np.flatnonzero(known)
        keys = np.empty((len(cells), 3), np.int64)
        storage.codes_to_keys((octree.codes[index] << storage.CELL_BITS) + cells, keys)
        for key, cell in zip(keys.tolist(), cells, strict=True):
            content[tuple(key)] = values[:, cell].tobytes()
    return content
