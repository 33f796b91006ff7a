"""Where the cells of an octree are stored: bricks, their hash table, Morton codes.

A *brick* is a cube of 4 x 4 x 4 finest cells in Morton order (bit 0 of the index is x, bit 1 y, bit 2 z). Eight sibling
cells are an *octet*; a brick has eight. Most classes have the same value in a cell, because none of them was ever hit
there, so a brick holds what its classes share and, octet by octet, the classes with values of their own.

A brick is one value for all its cells and classes, or a *block* of rows of 8 values: one row for each octet that has a
known cell, with the shared values, then one for each octet and class with values of its own. ``masks`` says which those
are: bit 8 e + c % 8 of word c // 8 stands for class c in octet e, and the rows are in the order of the bits. Where
every class of an octet has a row of its own, the shared one repeats that of class 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import (
    copy_octet,
    count_ones,
    float_array,
    highest_one,
    lowest_one,
    same_bits,
)
from octoreplay.records import BoolArray, Float32Array, Int32Array, Int64Array, UInt64Array

BRICK_BITS = 2
BRICK_EDGE = 1 << BRICK_BITS
CELL_BITS = 3 * BRICK_BITS
"""A cell's Morton code without its last CELL_BITS bits is its brick's code."""
BRICK_CELLS = 1 << CELL_BITS
ALL_CELLS = np.uint64(0xFFFFFFFFFFFFFFFF)
"""The mask of a brick with all its cells known: bit i stands for cell i."""
FIRST_CELLS = np.uint64(0x0101010101010101)
"""The first cell of each octet."""
OCTETS = 8
"""Octets of a brick, and cells of an octet."""
ROW_BYTES = 4 * OCTETS
BRICK_BYTES = 32
"""Bytes of a brick's code, block, value, known cells and revision."""
GROWTH = 2
"""Blocks have room for a multiple of so many rows: whole cache lines."""
KEY_BITS = 19
"""A key's three coordinates lie in [-2^18, 2^18)."""
KEY_OFFSET = 1 << (KEY_BITS - 1)
BRICK_DEPTH = KEY_BITS - BRICK_BITS
"""Depth of a brick's cube in the octree; the root is depth 0, the finest cells are at depth KEY_BITS."""

NUM_BRICKS, NUM_ROWS, NUM_FREE_ROWS = 0, 1, 2


class Bricks(NamedTuple):
    """The arrays of one octree. ``counters`` holds NUM_BRICKS, NUM_ROWS and NUM_FREE_ROWS.

    ``blocks`` is the first row of each brick's block, -1 where the brick is the one value in ``values``. ``free`` is
    the first of the unused blocks of each size, -1 for none; each holds the next one's number in its first value.
    """

    codes: Int64Array
    blocks: Int32Array
    values: Float32Array
    masks: UInt64Array
    known: UInt64Array
    revisions: Int64Array
    table: Int32Array
    counters: Int64Array
    free: Int32Array
    rows: Float32Array


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
    """A new brick, all of it unknown: the one value 0 without a known cell."""
    index = bricks.counters[NUM_BRICKS]
    bricks.counters[NUM_BRICKS] = index + 1
    bricks.codes[index] = code
    bricks.blocks[index] = -1
    bricks.values[index] = 0.0
    bricks.revisions[index] = 0
    bricks.known[index] = 0
    for w in range(bricks.masks.shape[1]):
        bricks.masks[index, w] = 0
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


@inline_kernel
def octets_of(known):
    """The octets with a cell in the mask ``known``, one bit each at 8 e."""
    x = known | known >> np.uint64(4)
    x |= x >> np.uint64(2)
    return (x | x >> np.uint64(1)) & FIRST_CELLS


@inline_kernel
def ones_below(mask, bit):
    """Number of ones of a mask below a bit."""
    return count_ones(mask & ((np.uint64(1) << np.uint64(bit)) - np.uint64(1)))


@kernel
def num_rows(known, masks, n):
    """Rows of a block with these known cells and values of single classes by the mask ``masks[n]``."""
    total = count_ones(octets_of(known))
    for w in range(masks.shape[1]):
        total += count_ones(masks[n, w])
    return total


@inline_kernel
def block_rows(rows):
    """Rows of the block that holds so many."""
    return (rows + GROWTH - 1) // GROWTH * GROWTH


@kernel
def new_block(bricks, rows):
    """First row of a block with room for so many rows. The room must be there."""
    size = block_rows(rows)
    block = np.int64(bricks.free[size // GROWTH])
    if block >= 0:
        bricks.free[size // GROWTH] = same_bits(bricks.rows[block, 0])
        bricks.counters[NUM_FREE_ROWS] -= size
    else:
        block = bricks.counters[NUM_ROWS]
        bricks.counters[NUM_ROWS] = block + size
    return block


@kernel
def _release(bricks, block, rows):
    """Give a block with so many rows back."""
    size = block_rows(rows)
    bricks.rows[block, 0] = same_bits(bricks.free[size // GROWTH])
    bricks.free[size // GROWTH] = block
    bricks.counters[NUM_FREE_ROWS] += size


@inline_kernel
def _copy_row(rows, target, source):
    """Copy one row. A loop, because numba compiles assignments to slices slowly."""
    for i in range(OCTETS):
        rows[target, i] = rows[source, i]


@inline_kernel
def _fill_row(rows, target, value):
    """Set a row to one value."""
    for i in range(OCTETS):
        rows[target, i] = value


@kernel
def share_first_class(rows, block, known, masks, n, num_classes):
    """Repeat the values of class 0 as the shared ones of the octets in which every class has values of its own."""
    full = FIRST_CELLS
    for c in range(num_classes):
        full &= masks[n, c >> 3] >> np.uint64(c & 7)
    octets = octets_of(known)
    while full:
        bit = lowest_one(full)
        own = block + count_ones(octets) + ones_below(masks[n, 0], bit)
        _copy_row(rows, block + ones_below(octets, bit), own)
        full &= full - np.uint64(1)


@kernel
def rows_to_raise(bricks, indices, wanted, known, needs_block):
    """At most how many new rows ``raise_bricks`` takes."""
    total = 0
    for i in range(indices.size):
        index = indices[i]
        if index < 0 or not (needs_block[i] or bricks.blocks[index] >= 0):
            continue
        rows = count_ones(octets_of(bricks.known[index] | known[i]))
        for w in range(wanted.shape[1]):
            rows += count_ones(bricks.masks[index, w] | wanted[i, w])
        old_rows = num_rows(bricks.known[index], bricks.masks, index)
        if bricks.blocks[index] < 0 or block_rows(rows) != block_rows(old_rows):
            total += block_rows(rows)
    return total


@kernel
def raise_bricks(bricks, indices, wanted, known, needs_block, num_classes, gains):
    """Add known cells (n,) to the bricks ``indices`` (n,), and a block where one is needed (n,), with the rows that it
    takes for them and at least those of the masks ``wanted`` (n, W). Index -1 is left out.

    ``gains`` (n,) says which bricks get a known cell more. Room for the rows must be there.
    """
    words = wanted.shape[1]
    for i in range(indices.size):
        index = indices[i]
        gains[i] = False
        if index < 0:
            continue
        old_octets, new_octets = octets_of(bricks.known[index]), octets_of(bricks.known[index] | known[i])
        gains[i] = bricks.known[index] | known[i] != bricks.known[index]
        old_block = np.int64(bricks.blocks[index])
        old_rows = num_rows(bricks.known[index], bricks.masks, index)
        bricks.known[index] |= known[i]
        if not (needs_block[i] or old_block >= 0):
            continue
        rows = count_ones(new_octets)
        for w in range(words):
            rows += count_ones(bricks.masks[index, w] | wanted[i, w])
        if old_block >= 0 and rows == old_rows:
            continue
        block = old_block
        if old_block < 0 or block_rows(rows) != block_rows(old_rows):
            block = new_block(bricks, rows)
        # From the last row to the first: within a block rows only move up.
        place, source = block + rows, old_block + old_rows
        for w in range(words - 1, -2, -1):
            # The last round is that of the shared rows.
            old_mask = bricks.masks[index, w] if w >= 0 else old_octets
            new_mask = old_mask | wanted[i, w] if w >= 0 else new_octets
            bits = new_mask
            while bits:
                bit = highest_one(bits)
                bits ^= np.uint64(1) << np.uint64(bit)
                place -= 1
                if old_block < 0:
                    _fill_row(bricks.rows, place, bricks.values[index])
                elif old_mask >> np.uint64(bit) & np.uint64(1):
                    source -= 1
                    _copy_row(bricks.rows, place, source)
                elif old_octets >> np.uint64(bit & 56) & np.uint64(1):
                    _copy_row(bricks.rows, place, old_block + ones_below(old_octets, bit & 56))
                else:
                    _fill_row(bricks.rows, place, np.float32(0.0))
            if w >= 0:
                bricks.masks[index, w] = new_mask
        if 0 <= old_block != block:
            _release(bricks, old_block, old_rows)
        bricks.blocks[index] = block
        share_first_class(bricks.rows, block, bricks.known[index], bricks.masks, index, num_classes)


@kernel
def collapse(bricks, index):
    """Make a brick one value when all its cells are known and all values equal: the in-memory prune."""
    block = np.int64(bricks.blocks[index])
    if block < 0 or bricks.known[index] != ALL_CELLS or num_rows(ALL_CELLS, bricks.masks, index) > OCTETS:
        return
    first = bricks.rows[block, 0]
    different = 0
    for e in range(OCTETS):
        for k in range(OCTETS):
            different += bricks.rows[block + e, k] != first
    if different == 0:
        _release(bricks, block, OCTETS)
        bricks.blocks[index] = -1
        bricks.values[index] = first


class BrickTable(NamedTuple):
    """Where bricks of several octrees are, and what is known of them: (J, n) of J octrees, the masks (J, n, W).

    ``addresses`` are those of the blocks, 0 where the brick is the one value in ``values`` (0 where it is absent).
    ``is_changed`` says which have a revision from a given one on. Valid until an octree grows.
    """

    addresses: Int64Array
    values: Float32Array
    masks: UInt64Array
    known: UInt64Array
    is_changed: BoolArray


@kernel
def fill_table(bricks, indices, since, table, column):
    """Fill one column of a table with the bricks ``indices`` (n,); index -1 is an absent brick."""
    base = np.int64(bricks.rows.ctypes.data)
    for i in range(indices.size):
        index = indices[i]
        if index < 0:
            table.addresses[column, i] = 0
            table.values[column, i] = np.float32(0.0)
            table.known[column, i] = 0
            table.is_changed[column, i] = False
            for w in range(table.masks.shape[2]):
                table.masks[column, i, w] = 0
            continue
        block = np.int64(bricks.blocks[index])
        table.addresses[column, i] = base + block * ROW_BYTES if block >= 0 else 0
        table.values[column, i] = bricks.values[index]
        table.known[column, i] = bricks.known[index]
        table.is_changed[column, i] = bricks.revisions[index] >= since
        for w in range(table.masks.shape[2]):
            table.masks[column, i, w] = bricks.masks[index, w]


@kernel
def load(target_at, table, n, column, layout, known, m, num_classes):
    """Write the brick ``n`` of a table's column to an address, with the rows for ``known[m]`` and ``layout[m]``.

    They must hold the brick's own. Cells that the brick does not know are 0.
    """
    octets, own_octets = octets_of(known[m]), octets_of(table.known[column, n])
    rows = num_rows(known[m], layout, m)
    target = float_array(target_at, (rows * OCTETS,))
    address = table.addresses[column, n]
    if address == 0:
        value = table.values[column, n]
        for i in range(rows * OCTETS):
            target[i] = value
        return
    for i in range(rows * OCTETS):
        target[i] = np.float32(0.0)
    place, source = target_at, address
    for w in range(-1, layout.shape[1]):
        # The first round is that of the shared rows.
        bits = layout[m, w] if w >= 0 else octets
        mask = table.masks[column, n, w] if w >= 0 else own_octets
        while bits:
            bit = lowest_one(bits)
            if mask >> np.uint64(bit) & np.uint64(1):
                copy_octet(place, source)
                source += ROW_BYTES
            elif own_octets >> np.uint64(bit & 56) & np.uint64(1):
                copy_octet(place, address + ones_below(own_octets, bit & 56) * ROW_BYTES)
            place += ROW_BYTES
            bits &= bits - np.uint64(1)
    # An octet may be full in the layout alone.
    share_first_class(float_array(target_at, (rows, OCTETS)), 0, known[m], layout, m, num_classes)


@kernel
def rows_of_column(table):
    """How many rows the blocks of a table's only column take."""
    total = 0
    for i in range(table.known.shape[1]):
        if table.addresses[0, i] != 0:
            total += block_rows(num_rows(table.known[0, i], table.masks[0], i))
    return total


@kernel
def replace_bricks(bricks, indices, table):
    """Replace the bricks ``indices`` (n,) by those of a table's only column. Room for their rows must be there."""
    base = np.int64(bricks.rows.ctypes.data)
    for i in range(indices.size):
        index = indices[i]
        if bricks.blocks[index] >= 0:
            _release(bricks, np.int64(bricks.blocks[index]), num_rows(bricks.known[index], bricks.masks, index))
        bricks.known[index] = table.known[0, i]
        bricks.values[index] = table.values[0, i]
        bricks.blocks[index] = -1
        for w in range(table.masks.shape[2]):
            bricks.masks[index, w] = table.masks[0, i, w]
        if table.addresses[0, i] != 0:
            rows = num_rows(table.known[0, i], bricks.masks, index)
            block = new_block(bricks, rows)
            bricks.blocks[index] = block
            for r in range(rows):
                copy_octet(base + (block + r) * ROW_BYTES, table.addresses[0, i] + r * ROW_BYTES)
