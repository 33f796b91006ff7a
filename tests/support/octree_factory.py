"""Octrees from plain lists of cells and cubes, for tests."""

from __future__ import annotations

import itertools

import numpy as np

from octoreplay.mapping.kernels import storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.streams import mask_bytes

BRICK_EDGE = storage.BRICK_EDGE


def octree_of(cells, *, num_classes=2, resolution=0.25):
    """An octree from {key: values (C,)} of finest cells; written brick by brick through the public arrays."""
    octree = SemanticOctree(resolution, num_classes)
    by_brick = {}
    for key, values in cells.items():
        by_brick.setdefault(tuple(k >> storage.BRICK_BITS for k in key), {})[key] = np.broadcast_to(
            np.asarray(values, np.float32), num_classes
        )
    indices = octree.find_or_add(np.array([brick_code(brick) for brick in by_brick], np.int64))
    for index, content in zip(indices, by_brick.values(), strict=True):
        values = np.zeros((num_classes, storage.BRICK_CELLS), np.float32)
        for key, cell_values in content.items():
            cell = storage.key_to_code(*key) & (storage.BRICK_CELLS - 1)
            octree.bricks.known[index] |= np.uint64(1 << cell)
            values[:, cell] = cell_values
        _write_brick(octree, int(index), values)
        octree.bricks.revisions[index] = 1
    return octree


def _write_brick(octree, index, values):
    """Write a brick's values (C, 64), in each octet in another of the ways in which they may be stored."""
    octets = values.reshape(octree.num_classes, storage.OCTETS, storage.OCTETS)
    shared = [octets[e % 2 - 1, e] for e in range(storage.OCTETS)]
    # An octet in three gives every class a row, the others only those that differ from the first or the last class.
    has_row = [
        [
            (octets[c, e] != shared[e]).any() or (e % 3 == 0 and np.ptp(octets[:, e], axis=0).any())
            for e in range(storage.OCTETS)
        ]
        for c in range(octree.num_classes)
    ]
    masks = np.zeros((1, mask_bytes(octree.num_classes)), np.uint64)
    for c, e in itertools.product(range(octree.num_classes), range(storage.OCTETS)):
        masks[0, c // 8] |= np.uint64(has_row[c][e] << (8 * e + c % 8))
    known = octree.known[index : index + 1].copy()
    octree.expand_bricks(np.array([index]), masks, known, np.array([True]))
    row = int(octree.bricks.blocks[index])
    for e in range(storage.OCTETS):
        if int(known[0]) >> (8 * e) & 255:
            octree.bricks.rows[row] = shared[e]
            row += 1
    for word, e in itertools.product(range(masks.size), range(storage.OCTETS)):
        for c in range(8 * word, min(8 * word + 8, octree.num_classes)):
            if has_row[c][e]:
                octree.bricks.rows[row] = octets[c, e]
                row += 1
    storage.share_first_class(
        octree.bricks.rows, int(octree.bricks.blocks[index]), known[0], octree.bricks.masks, index, octree.num_classes
    )
    storage.prune_brick(octree.bricks, index)


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
        values = np.full((octree.num_classes, storage.BRICK_CELLS), octree.bricks.values[index])
        if octree.bricks.blocks[index] >= 0:
            rows = class_rows(octree, np.array([index]))[0]
            values = np.where(rows[..., None] >= 0, octree.bricks.rows[rows], 0).reshape(values.shape)
        cells = np.flatnonzero(known)
        keys = np.empty((len(cells), 3), np.int64)
        storage.codes_to_keys((octree.codes[index] << storage.CELL_BITS) + cells, keys)
        for key, cell in zip(keys.tolist(), cells, strict=True):
            content[tuple(key)] = values[:, cell].tobytes()
    return content


def class_rows(octree, indices):
    """Rows (n, C, 8) that hold the values of every class in every octet of the bricks ``indices`` (n,) with blocks.

    -1 where the octet has no known cell.
    """
    blocks, masks = octree.bricks.blocks[indices].astype(np.int64), octree.bricks.masks[indices]
    is_present = octree.known[indices].astype("<u8").view(np.uint8).reshape(-1, storage.OCTETS) != 0
    shared = blocks[:, None] + np.cumsum(is_present, axis=1) - 1
    first_own = blocks + is_present.sum(axis=1)
    rows = np.empty((len(indices), octree.num_classes, storage.OCTETS), np.int64)
    for c, e in itertools.product(range(octree.num_classes), range(storage.OCTETS)):
        word, bit = masks[:, c // 8], np.uint64(1) << np.uint64(8 * e + c % 8)
        before = np.bitwise_count(masks[:, : c // 8]).sum(axis=1, dtype=np.int64)
        before += np.bitwise_count(word & (bit - np.uint64(1)))
        rows[:, c, e] = np.where(word & bit, first_own + before, np.where(is_present[:, e], shared[:, e], -1))
    return rows
