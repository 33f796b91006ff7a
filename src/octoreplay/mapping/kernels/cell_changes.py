"""Cells that differ between two states of a map, brick by brick.

In shapes, n is the number of bricks, C of classes, and W = ceil(C / 8) of mask words.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import float_array, lowest_one
from octoreplay.mapping.kernels.storage import BRICK_CELLS, OCTETS, ROW_BYTES, load_brick, octets_of, prune_brick

NEW, OLD = 0, 1
"""Columns of a table of two states of a map."""

NUM_SCRATCH_BLOCKS = 2
"""Scratch blocks of the kernel, one for each state."""


@inline_kernel
def _octet_rows(layout, octets, b, w):
    """Bit mask of a brick's rows in one mask word of its layout; w = -1 is the round of the shared rows."""
    return layout[b, w] if w >= 0 else octets


@kernel
def _changed_cells(new_at, old_at, layout, octets, b):
    """Mask of the cells of which any class differs between two states of a brick, both in the same layout.

    - ``new_at``, ``old_at``: addresses of the rows of both states.
    - ``layout`` (n, W) uint64, ``b``: class rows are ``layout[b]``.
    - ``octets`` uint64: octets with a shared row.
    """
    changed = np.uint64(0)
    for w in range(-1, layout.shape[1]):
        bits = _octet_rows(layout, octets, b, w)
        while bits:
            first = lowest_one(bits) & 56
            new, old = float_array(new_at, (OCTETS,)), float_array(old_at, (OCTETS,))
            for k in range(OCTETS):
                changed |= np.uint64(new[k] != old[k]) << np.uint64(first + k)
            new_at += ROW_BYTES
            old_at += ROW_BYTES
            bits &= bits - np.uint64(1)
    return changed


@kernel
def _copy_cells(target_at, source_at, layout, octets, b, cells):
    """Copy all classes of the ``cells`` uint64 from one address to another, in the layout of ``_changed_cells``."""
    for w in range(-1, layout.shape[1]):
        bits = _octet_rows(layout, octets, b, w)
        while bits:
            first = lowest_one(bits) & 56
            target, source = float_array(target_at, (OCTETS,)), float_array(source_at, (OCTETS,))
            for k in range(OCTETS):
                if cells >> np.uint64(first + k) & np.uint64(1):
                    target[k] = source[k]
            target_at += ROW_BYTES
            source_at += ROW_BYTES
            bits &= bits - np.uint64(1)


@kernel
def take_changes(bricks, indices, table, layout, known, num_classes, revision, scratch):
    """Overwrite the cells of bricks that differ between two states of another map with its new state.

    - ``bricks``: Bricks of the target, in place. Each brick in use has a block, with all class rows and known cells of
      both states.
    - ``indices`` (n,) int64: brick indices of the target; -1 is skipped.
    - ``table``: BrickTable of the states NEW and OLD, (2, n).
    - ``layout`` (n, W) uint64, ``known`` (n,) uint64: class rows and known cells of the target's bricks.
    - ``num_classes``: C.
    - ``revision``: revision of the changed bricks.
    - ``scratch`` float32: room for NUM_SCRATCH_BLOCKS blocks with all rows.
    """
    new_at = np.int64(scratch.ctypes.data)
    old_at = new_at + (num_classes + 1) * BRICK_CELLS * 4
    base = np.int64(bricks.rows.ctypes.data)
    for b in range(indices.size):
        index = indices[b]
        if index < 0:
            continue
        load_brick(new_at, table, b, NEW, layout, known, b, num_classes)
        load_brick(old_at, table, b, OLD, layout, known, b, num_classes)
        octets = octets_of(known[b])
        changed = _changed_cells(new_at, old_at, layout, octets, b) | ~table.known[OLD, b]
        changed &= table.known[NEW, b]
        if changed != 0:
            _copy_cells(base + np.int64(bricks.blocks[index]) * ROW_BYTES, new_at, layout, octets, b, changed)
            bricks.revisions[index] = revision
        prune_brick(bricks, index)
