"""Where the cells of an octree are stored: bricks, their hash table, Morton codes.

A *brick* is a cube of 4 x 4 x 4 finest cells, stored in Morton order (bit 0 of the index is x, bit 1 y, bit 2 z).
Its tier says how much is stored: UNIFORM one value for all its cells and classes, SCALAR one value per cell (equal over
the classes: no cell was ever hit), VECTOR one value per class and cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.mapping.kernels.compiler import kernel
from octoreplay.records import Float32Array, Int32Array, Int64Array, UInt8Array, UInt64Array

UNIFORM, SCALAR, VECTOR = 0, 1, 2
ABSENT = 255

BRICK_BITS = 2
BRICK_EDGE = 1 << BRICK_BITS
CELL_BITS = 3 * BRICK_BITS
"""A cell's Morton code without its last CELL_BITS bits is its brick's code."""
BRICK_CELLS = 1 << CELL_BITS
ALL_CELLS = np.uint64(0xFFFFFFFFFFFFFFFF)
"""The mask of a brick with all its cells known: bit i stands for cell i."""
KEY_BITS = 19
"""A key's three coordinates lie in [-2^18, 2^18)."""
KEY_OFFSET = 1 << (KEY_BITS - 1)
BRICK_DEPTH = KEY_BITS - BRICK_BITS
"""Depth of a brick's cube in the octree; the root is depth 0, the finest cells are at depth KEY_BITS."""

NUM_BRICKS, NUM_SCALAR, NUM_VECTOR, NUM_FREE_SCALAR = 0, 1, 2, 3


class Bricks(NamedTuple):
    """The arrays of one octree. ``counters`` holds NUM_BRICKS, NUM_SCALAR, NUM_VECTOR and NUM_FREE_SCALAR."""

    codes: Int64Array
    tiers: UInt8Array
    rows: Int32Array
    values: Float32Array
    known: UInt64Array
    revisions: Int64Array
    table: Int32Array
    counters: Int64Array
    free_scalar: Int32Array
    scalar: Float32Array
    vector: Float32Array


@kernel
def spread_bits(value):
    """Bits 0..20 of ``value`` moved to every third bit."""
    x = np.int64(value) & 0x1FFFFF
    x = (x | x << 32) & 0x1F00000000FFFF
    x = (x | x << 16) & 0x1F0000FF0000FF
    x = (x | x << 8) & 0x100F00F00F00F00F
    x = (x | x << 4) & 0x10C30C30C30C30C3
    return (x | x << 2) & 0x1249249249249249


@kernel
def gather_bits(code):
    """Every third bit of ``code``, starting at bit 0: the inverse of spread_bits."""
    x = np.int64(code) & 0x1249249249249249
    x = (x | x >> 2) & 0x10C30C30C30C30C3
    x = (x | x >> 4) & 0x100F00F00F00F00F
    x = (x | x >> 8) & 0x1F0000FF0000FF
    x = (x | x >> 16) & 0x1F00000000FFFF
    return (x | x >> 32) & 0x1FFFFF


@kernel
def key_to_code(x, y, z):
    """Morton code of a finest cell's key; the key space's lowest corner has code 0."""
    return spread_bits(x + KEY_OFFSET) | spread_bits(y + KEY_OFFSET) << 1 | spread_bits(z + KEY_OFFSET) << 2


@kernel
def keys_to_codes(keys, codes):
    """Morton codes (n,) of the cells with these keys (n, 3)."""
    for i in range(codes.size):
        codes[i] = key_to_code(keys[i, 0], keys[i, 1], keys[i, 2])


@kernel
def codes_to_keys(codes, keys):
    """Keys (n, 3) of the cells with these Morton codes (n,)."""
    for i in range(codes.size):
        keys[i, 0] = gather_bits(codes[i]) - KEY_OFFSET
        keys[i, 1] = gather_bits(codes[i] >> 1) - KEY_OFFSET
        keys[i, 2] = gather_bits(codes[i] >> 2) - KEY_OFFSET


@kernel
def _slot(table, code):
    """First place in the hash table where ``code`` may stand (Fibonacci hashing)."""
    return np.int64((np.uint64(code) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & (table.size - 1)


@kernel
def find_brick(bricks, code):
    """Index of the brick with this code, or -1."""
    place = _slot(bricks.table, code)
    while True:
        index = bricks.table[place]
        if index < 0 or bricks.codes[index] == code:
            return index
        place = (place + 1) & (bricks.table.size - 1)


@kernel
def _enter(bricks, index):
    """Put brick ``index`` into the hash table."""
    place = _slot(bricks.table, bricks.codes[index])
    while bricks.table[place] >= 0:
        place = (place + 1) & (bricks.table.size - 1)
    bricks.table[place] = index


@kernel
def rebuild_table(bricks):
    """Fill an empty hash table with all bricks."""
    for index in range(bricks.counters[NUM_BRICKS]):
        _enter(bricks, index)


@kernel
def add_brick(bricks, code):
    """A new brick, all of it unknown: a UNIFORM brick of value 0 without a known cell."""
    index = bricks.counters[NUM_BRICKS]
    bricks.counters[NUM_BRICKS] = index + 1
    bricks.codes[index] = code
    bricks.tiers[index] = UNIFORM
    bricks.rows[index] = -1
    bricks.values[index] = 0.0
    bricks.revisions[index] = 0
    bricks.known[index] = 0
    _enter(bricks, index)
    return index


@kernel
def find_or_add(bricks, codes, indices):
    """Index (n,) of each brick code (n,), added where it is new. Room for n bricks must be there."""
    for i in range(codes.size):
        index = find_brick(bricks, codes[i])
        if index < 0:
            index = add_brick(bricks, codes[i])
        indices[i] = index


@kernel
def find_all(bricks, codes, indices):
    """Index (n,) of each brick code (n,), -1 where it is absent."""
    for i in range(codes.size):
        indices[i] = find_brick(bricks, codes[i])


@kernel
def _fill(row, value):
    """Set a row of values to one value. Loops, because numba compiles assignments to slices slowly."""
    for i in range(BRICK_CELLS):
        row[i] = value


@kernel
def _copy(row, source):
    """Copy a row of values."""
    for i in range(BRICK_CELLS):
        row[i] = source[i]


@kernel
def make_scalar(bricks, index):
    """Raise a UNIFORM brick to SCALAR. Room for one row must be there."""
    if bricks.tiers[index] != UNIFORM:
        return
    free = bricks.counters[NUM_FREE_SCALAR]
    if free > 0:
        row = np.int64(bricks.free_scalar[free - 1])
        bricks.counters[NUM_FREE_SCALAR] = free - 1
    else:
        row = bricks.counters[NUM_SCALAR]
        bricks.counters[NUM_SCALAR] = row + 1
    _fill(bricks.scalar[row], bricks.values[index])
    bricks.tiers[index] = SCALAR
    bricks.rows[index] = row


@kernel
def _release_scalar(bricks, index):
    """Give a SCALAR brick's row back."""
    free = bricks.counters[NUM_FREE_SCALAR]
    bricks.free_scalar[free] = bricks.rows[index]
    bricks.counters[NUM_FREE_SCALAR] = free + 1


@kernel
def make_vector(bricks, index):
    """Raise a brick to VECTOR. Room for one row must be there."""
    if bricks.tiers[index] == VECTOR:
        return
    row = bricks.counters[NUM_VECTOR]
    bricks.counters[NUM_VECTOR] = row + 1
    if bricks.tiers[index] == UNIFORM:
        for c in range(bricks.vector.shape[1]):
            _fill(bricks.vector[row, c], bricks.values[index])
    else:
        source = bricks.scalar[bricks.rows[index]]
        for c in range(bricks.vector.shape[1]):
            _copy(bricks.vector[row, c], source)
        _release_scalar(bricks, index)
    bricks.tiers[index] = VECTOR
    bricks.rows[index] = row


@kernel
def make_tiers(bricks, tiers):
    """Raise each brick (n,) to at least the tier (n,) that is asked for. Room must be there."""
    for index in range(tiers.size):
        # Asked here, because a call copies the whole record of arrays.
        if tiers[index] == VECTOR and bricks.tiers[index] != VECTOR:
            make_vector(bricks, index)
        elif tiers[index] == SCALAR and bricks.tiers[index] == UNIFORM:
            make_scalar(bricks, index)


@kernel
def collapse(bricks, index):
    """Make a SCALAR brick UNIFORM when all its cells are known and equal: the in-memory prune."""
    if bricks.tiers[index] != SCALAR or bricks.known[index] != ALL_CELLS:
        return
    data = bricks.scalar[bricks.rows[index]]
    first = data[0]
    different = 0
    for i in range(BRICK_CELLS):
        different += data[i] != first
    if different == 0:
        _release_scalar(bricks, index)
        bricks.tiers[index] = UNIFORM
        bricks.rows[index] = -1
        bricks.values[index] = first


@kernel
def copy_bricks(source, indices, target, target_indices):
    """Copy the bricks ``indices`` (n,) of one octree over ``target_indices`` (n,) of another, raised beforehand."""
    for i in range(indices.size):
        a, b = indices[i], target_indices[i]
        tier = source.tiers[a]
        target.known[b] = source.known[a]
        if target.tiers[b] == UNIFORM:
            target.values[b] = source.values[a]
        elif target.tiers[b] == SCALAR:
            if tier == UNIFORM:
                _fill(target.scalar[target.rows[b]], source.values[a])
            else:
                _copy(target.scalar[target.rows[b]], source.scalar[source.rows[a]])
            collapse(target, b)
        else:
            for c in range(target.vector.shape[1]):
                row = target.vector[target.rows[b], c]
                if tier == UNIFORM:
                    _fill(row, source.values[a])
                elif tier == SCALAR:
                    _copy(row, source.scalar[source.rows[a]])
                else:
                    _copy(row, source.vector[source.rows[a], c])


@kernel
def brick_addresses(bricks, indices, scalar_base, vector_base, values_base, addresses, tiers):
    """Where the data of the bricks ``indices`` (n,) lies in memory and their tier; 0 and ABSENT for index -1."""
    vector_bytes = bricks.vector.shape[1] * BRICK_CELLS * 4
    for i in range(indices.size):
        index = indices[i]
        if index < 0:
            addresses[i] = 0
            tiers[i] = ABSENT
            continue
        tier = bricks.tiers[index]
        tiers[i] = tier
        if tier == UNIFORM:
            addresses[i] = values_base + index * 4
        elif tier == SCALAR:
            addresses[i] = scalar_base + np.int64(bricks.rows[index]) * BRICK_CELLS * 4
        else:
            addresses[i] = vector_base + np.int64(bricks.rows[index]) * vector_bytes


@kernel
def merge_known(known, indices, other_known):
    """known[indices] |= other_known; returns a flag (n,) where that changed anything."""
    changed = np.zeros(indices.size, dtype=np.bool_)
    for i in range(indices.size):
        old = known[indices[i]]
        new = old | other_known[i]
        known[indices[i]] = new
        changed[i] = new != old
    return changed
