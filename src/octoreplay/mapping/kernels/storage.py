"""Storage of an octree's cells: bricks, their hash table, Morton codes.

A *brick* is a cube of 4 x 4 x 4 finest cells in Morton order (bit 0 of the index is x, bit 1 y, bit 2 z). Eight sibling
cells are an *octet*; a brick has eight. Most classes have the same value in a cell, because no scan hit them there.
So a brick stores one shared value for these classes, and in each octet separate values for the other classes.

A brick is stored as one value for all its cells and classes, or as a *block* of rows of 8 float32. The block starts
with one *shared row* for each octet that has a known cell. One *class row* for each octet and class with separate
values follows. ``masks`` lists the class rows: bit 8 e + c % 8 of word c // 8 stands for class c in octet e, and the
rows are in the order of the bits. Where all classes of an octet have class rows, the shared row repeats that of
class 0.

Shapes: W = ceil(C / 8) mask words for C classes. Masks and known cells are uint64, codes and indices int64, values
float32 deviations h - h_0 in log-odds.
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
"""Bits of a cell within its brick: brick code = cell's Morton code >> CELL_BITS."""
BRICK_CELLS = 1 << CELL_BITS
ALL_CELLS = np.uint64(0xFFFFFFFFFFFFFFFF)
"""Mask of a brick in which all cells are known: bit i stands for cell i."""
FIRST_CELLS = np.uint64(0x0101010101010101)
"""Mask of the first cell of each octet."""
OCTETS = 8
"""Number of octets in a brick, and of cells in an octet."""
ROW_BYTES = 4 * OCTETS
BRICK_BYTES = 32
"""Bytes of a brick's code, block, value, known cells and revision."""
GROWTH = 2
"""Block sizes are multiples of this number of rows: whole cache lines."""
KEY_BITS = 19
"""A key's three coordinates lie in [-2^18, 2^18)."""
KEY_OFFSET = 1 << (KEY_BITS - 1)
BRICK_DEPTH = KEY_BITS - BRICK_BITS
"""Depth of a brick's cube in the octree; the root is at depth 0, the finest cells are at depth KEY_BITS."""

NUM_BRICKS, NUM_ROWS, NUM_FREE_ROWS = 0, 1, 2


class Bricks(NamedTuple):
    """Arrays of one octree: B allocated bricks, R allocated rows.

    - ``codes`` (B,): Morton codes of the bricks.
    - ``blocks`` (B,): first row of each brick's block, -1 where the brick is stored as one value.
    - ``values`` (B,): the value of bricks without a block.
    - ``masks`` (B, W): class rows of each block.
    - ``known`` (B,): known cells of each brick.
    - ``revisions`` (B,): revision of each brick's last change.
    - ``table`` (2^k,): hash table of brick indices, -1 for an empty slot.
    - ``counters`` (3,): used bricks, used rows and free rows, at NUM_BRICKS, NUM_ROWS and NUM_FREE_ROWS.
    - ``free``: first unused block of each size, -1 for none; the first value of an unused block holds the next one.
    - ``rows`` (R, 8): rows of all blocks.
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
    """Move bits 0..20 of the integer ``value`` to every third bit."""
    x = np.int64(value) & 0x1FFFFF
    x = (x | x << 32) & 0x1F00000000FFFF
    x = (x | x << 16) & 0x1F0000FF0000FF
    x = (x | x << 8) & 0x100F00F00F00F00F
    x = (x | x << 4) & 0x10C30C30C30C30C3
    return (x | x << 2) & 0x1249249249249249


@kernel
def gather_bits(code):
    """Gather every third bit of ``code`` int64, starting at bit 0: the inverse of spread_bits."""
    x = np.int64(code) & 0x1249249249249249
    x = (x | x >> 2) & 0x10C30C30C30C30C3
    x = (x | x >> 4) & 0x100F00F00F00F00F
    x = (x | x >> 8) & 0x1F0000FF0000FF
    x = (x | x >> 16) & 0x1F00000000FFFF
    return (x | x >> 32) & 0x1FFFFF


@kernel
def key_to_code(x, y, z):
    """Morton code of the finest cell with the key (``x``, ``y``, ``z``); the lowest key of the key space has code 0."""
    return spread_bits(x + KEY_OFFSET) | spread_bits(y + KEY_OFFSET) << 1 | spread_bits(z + KEY_OFFSET) << 2


@kernel
def keys_to_codes(keys, codes):
    """Write the Morton codes of the cells with ``keys`` (n, 3) int64 into ``codes`` (n,) int64."""
    for i in range(codes.size):
        codes[i] = key_to_code(keys[i, 0], keys[i, 1], keys[i, 2])


@kernel
def codes_to_keys(codes, keys):
    """Write the keys of the cells with the Morton ``codes`` (n,) int64 into ``keys`` (n, 3) int64."""
    for i in range(codes.size):
        keys[i, 0] = gather_bits(codes[i]) - KEY_OFFSET
        keys[i, 1] = gather_bits(codes[i] >> 1) - KEY_OFFSET
        keys[i, 2] = gather_bits(codes[i] >> 2) - KEY_OFFSET


@kernel
def _slot(table, code):
    """First slot of a brick ``code`` int64 in the hash ``table`` (2^k,) int32 (Fibonacci hashing)."""
    return np.int64((np.uint64(code) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & (table.size - 1)


@kernel
def find_brick(bricks, code):
    """Index of the brick with the ``code`` int64 in ``bricks``, -1 where it is absent."""
    place = _slot(bricks.table, code)
    while True:
        index = bricks.table[place]
        if index < 0 or bricks.codes[index] == code:
            return index
        place = (place + 1) & (bricks.table.size - 1)


@kernel
def _insert(bricks, index):
    """Insert brick ``index`` into the hash table of ``bricks``."""
    place = _slot(bricks.table, bricks.codes[index])
    while bricks.table[place] >= 0:
        place = (place + 1) & (bricks.table.size - 1)
    bricks.table[place] = index


@kernel
def rebuild_table(bricks):
    """Fill the empty hash table of ``bricks`` with all bricks."""
    for index in range(bricks.counters[NUM_BRICKS]):
        _insert(bricks, index)


@kernel
def add_brick(bricks, code):
    """Add a brick with the ``code`` int64 to ``bricks``, without known cells; returns its index. Needs room for it."""
    index = bricks.counters[NUM_BRICKS]
    bricks.counters[NUM_BRICKS] = index + 1
    bricks.codes[index] = code
    bricks.blocks[index] = -1
    bricks.values[index] = 0.0
    bricks.revisions[index] = 0
    bricks.known[index] = 0
    for w in range(bricks.masks.shape[1]):
        bricks.masks[index, w] = 0
    _insert(bricks, index)
    return index


@kernel
def find_or_add(bricks, codes, indices):
    """Write the index of each brick of ``codes`` (n,) into ``indices`` (n,); adds missing bricks. Needs room for n."""
    for i in range(codes.size):
        index = find_brick(bricks, codes[i])
        if index < 0:
            index = add_brick(bricks, codes[i])
        indices[i] = index


@kernel
def find_all(bricks, codes, indices):
    """Write the index of each brick of ``codes`` (n,) into ``indices`` (n,), -1 where it is absent."""
    for i in range(codes.size):
        indices[i] = find_brick(bricks, codes[i])


@inline_kernel
def octets_of(known):
    """Mask with bit 8 e set for each octet e that has a cell in the mask ``known``."""
    x = known | known >> np.uint64(4)
    x |= x >> np.uint64(2)
    return (x | x >> np.uint64(1)) & FIRST_CELLS


@inline_kernel
def ones_below(mask, bit):
    """Number of ones in ``mask`` below the position ``bit``."""
    return count_ones(mask & ((np.uint64(1) << np.uint64(bit)) - np.uint64(1)))


@kernel
def num_rows(known, masks, n):
    """Number of rows of a block with the ``known`` cells and the class rows ``masks[n]``, ``masks`` (m, W)."""
    total = count_ones(octets_of(known))
    for w in range(masks.shape[1]):
        total += count_ones(masks[n, w])
    return total


@inline_kernel
def block_rows(rows):
    """Size of a block that holds ``rows`` rows."""
    return (rows + GROWTH - 1) // GROWTH * GROWTH


@kernel
def new_block(bricks, rows):
    """Allocate a block of ``bricks`` for ``rows`` rows; returns its first row. Needs room for it."""
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
def _free_block(bricks, block, rows):
    """Free the ``block`` (first row) of ``bricks`` that holds ``rows`` rows."""
    size = block_rows(rows)
    bricks.rows[block, 0] = same_bits(bricks.free[size // GROWTH])
    bricks.free[size // GROWTH] = block
    bricks.counters[NUM_FREE_ROWS] += size


@inline_kernel
def _copy_row(rows, target, source):
    """Copy row ``source`` of ``rows`` (r, 8) to row ``target``. A loop: numba compiles slice assignments slowly."""
    for i in range(OCTETS):
        rows[target, i] = rows[source, i]


@inline_kernel
def _fill_row(rows, target, value):
    """Set row ``target`` of ``rows`` (r, 8) to ``value``."""
    for i in range(OCTETS):
        rows[target, i] = value


@kernel
def share_first_class(rows, block, known, masks, n, num_classes):
    """Copy the class row of class 0 to the shared row in each octet in which all classes have class rows.

    - ``rows`` (r, 8) float32: in place.
    - ``block``: first row of the block.
    - ``known`` uint64: known cells of the block.
    - ``masks`` (m, W) uint64, ``n``: class rows are ``masks[n]``.
    - ``num_classes``: C.
    """
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
def rows_to_expand(bricks, indices, wanted, known, needs_block):
    """Upper bound of the new rows that ``expand_bricks`` allocates for the same parameters."""
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
def expand_bricks(bricks, indices, wanted, known, needs_block, num_classes, has_new_cells):
    """Add known cells and class rows to bricks. Values do not change; new cells are 0. Needs room for the rows.

    Loop invariant: rows are written from the last to the first. A block only grows, so each row moves up or stays, and
    no row is overwritten before it is copied.

    - ``bricks``: Bricks, in place.
    - ``indices`` (n,) int64: brick indices; -1 is skipped.
    - ``wanted`` (n, W) uint64: class rows that a block has at least.
    - ``known`` (n,) uint64: cells that become known.
    - ``needs_block`` (n,) bool: True where a brick of one value becomes a block.
    - ``num_classes``: C.
    - ``has_new_cells`` (n,) bool: output, True where a cell became known.
    """
    words = wanted.shape[1]
    for i in range(indices.size):
        index = indices[i]
        has_new_cells[i] = False
        if index < 0:
            continue
        old_octets, new_octets = octets_of(bricks.known[index]), octets_of(bricks.known[index] | known[i])
        has_new_cells[i] = bricks.known[index] | known[i] != bricks.known[index]
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
        place, source = block + rows, old_block + old_rows
        for w in range(words - 1, -2, -1):
            # w = -1 is the round of the shared rows.
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
            _free_block(bricks, old_block, old_rows)
        bricks.blocks[index] = block
        share_first_class(bricks.rows, block, bricks.known[index], bricks.masks, index, num_classes)


@kernel
def prune_brick(bricks, index):
    """Store brick ``index`` of ``bricks`` as one value if all its cells are known and all values are equal."""
    block = np.int64(bricks.blocks[index])
    if block < 0 or bricks.known[index] != ALL_CELLS or num_rows(ALL_CELLS, bricks.masks, index) > OCTETS:
        return
    first = bricks.rows[block, 0]
    for e in range(OCTETS):
        different = 0
        for k in range(OCTETS):
            different += bricks.rows[block + e, k] != first
        if different > 0:
            return
    _free_block(bricks, block, OCTETS)
    bricks.blocks[index] = -1
    bricks.values[index] = first


@kernel
def largest_values(bricks, largest):
    """Write the largest value of each brick of ``bricks`` into ``largest`` (n,) float32."""
    for index in range(largest.size):
        block = np.int64(bricks.blocks[index])
        if block < 0:
            largest[index] = bricks.values[index]
            continue
        most = bricks.rows[block, 0]
        for row in range(block, block + num_rows(bricks.known[index], bricks.masks, index)):
            for k in range(OCTETS):
                most = max(most, bricks.rows[row, k])
        largest[index] = most


class BrickTable(NamedTuple):
    """Locations of the same n bricks in J octrees (columns). Valid until one of the octrees grows.

    - ``addresses`` (J, n): addresses of the blocks, 0 where the brick is one value or absent.
    - ``values`` (J, n): value of bricks without a block, 0 where absent.
    - ``masks`` (J, n, W): class rows.
    - ``known`` (J, n): known cells.
    - ``is_changed`` (J, n): True where the brick's revision is at least a given one.
    """

    addresses: Int64Array
    values: Float32Array
    masks: UInt64Array
    known: UInt64Array
    is_changed: BoolArray


@kernel
def fill_table(bricks, indices, since, table, column):
    """Fill one column of a table.

    - ``bricks``: Bricks of the octree.
    - ``indices`` (n,) int64: brick indices; -1 is an absent brick.
    - ``since``: bricks with at least this revision are changed.
    - ``table``: BrickTable, in place.
    - ``column``: column of the octree.
    """
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
def load_brick(target_at, table, n, column, layout, known, m, num_classes):
    """Write a brick to an address, in the layout of another brick that has all its known cells and class rows.

    Cells that are unknown in the brick get 0.

    - ``target_at``: address of the target rows.
    - ``table``, ``n``, ``column``: the brick is row ``n`` of the table's ``column``.
    - ``layout`` (k, W) uint64, ``known`` (k,) uint64, ``m``: the target has class rows ``layout[m]`` and the known
      cells ``known[m]``.
    - ``num_classes``: C.
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
        # w = -1 is the round of the shared rows.
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
    # All classes of an octet may have class rows in the layout alone.
    share_first_class(float_array(target_at, (rows, OCTETS)), 0, known[m], layout, m, num_classes)


@kernel
def rows_of_column(table):
    """Number of rows that the blocks in the only column of ``table`` take."""
    total = 0
    for i in range(table.known.shape[1]):
        if table.addresses[0, i] != 0:
            total += block_rows(num_rows(table.known[0, i], table.masks[0], i))
    return total


@kernel
def replace_bricks(bricks, indices, table):
    """Replace the bricks ``indices`` (n,) int64 of ``bricks`` by the only column of ``table``. Needs room for rows."""
    base = np.int64(bricks.rows.ctypes.data)
    for i in range(indices.size):
        index = indices[i]
        if bricks.blocks[index] >= 0:
            _free_block(bricks, np.int64(bricks.blocks[index]), num_rows(bricks.known[index], bricks.masks, index))
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
