"""Evidence of one scan added to an octree: one update for each cell that the scan touches.

A *mark* is one byte for each cell of the scan's scratch grid: 0 untouched, 1 free, c + 2 a hit of class c (from 0).
Eight marks, those of an octet, are one uint64 word. In shapes, n is the number of bricks, C of classes, and
W = ceil(C / 8) of mask words.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import lowest_one, prefetch_line
from octoreplay.mapping.kernels.storage import (
    ALL_CELLS,
    BRICK_CELLS,
    OCTETS,
    ROW_BYTES,
    octets_of,
    prune_brick,
    share_first_class,
)

PREFETCH_AHEAD = 8
"""Number of bricks between the prefetched one and the current one."""

EVERY_BYTE = np.uint64(0x0101010101010101)
LOW_BITS = np.uint64(0x7F7F7F7F7F7F7F7F)


@kernel
def _marked_cells(marks):
    """Return one bit for each of eight ``marks`` uint64 that is not 0."""
    tops = (((marks & LOW_BITS) + LOW_BITS) | marks) & ~LOW_BITS
    # The product gathers the eight top bits in the top byte.
    return ((tops >> np.uint64(7)) * np.uint64(0x0102040810204080)) >> np.uint64(56)


@kernel
def wanted_rows(bricks, indices, touched, words, num_classes, miss, clamp_min, clamp_max, wanted, known, changes):
    """Find the class rows that the hits of a scan need.

    A map of one class has no class rows; all hits go to the shared rows.

    - ``bricks``: Bricks of the octree.
    - ``indices`` (n,) int64: brick indices.
    - ``touched`` (n,) int64: brick of the scratch grid with the marks.
    - ``words`` uint64: marks of the scratch grid.
    - ``num_classes``: C.
    - ``miss``, ``clamp_min``, ``clamp_max``: float32, log-odds increment of a free cell and limits.
    - ``wanted`` (n, W) uint64: output from 0, class rows of the octets and classes that are hit.
    - ``known`` (n,) uint64: output, marked cells.
    - ``changes`` (n,) bool: output, False where a brick does not change because it is free and at the limit.
    """
    for t in range(indices.size):
        any_hit = np.uint64(0)
        known[t] = 0
        for e in range(OCTETS):
            marks = words[touched[t] * OCTETS + e]
            known[t] |= _marked_cells(marks) << np.uint64(8 * e)
            # A mark above 1 is a hit.
            hits = marks & ~EVERY_BYTE
            any_hit |= hits
            if num_classes == 1:
                continue
            while hits:
                shift = np.uint64(lowest_one(hits)) & np.uint64(0x38)
                c = ((marks >> shift) & np.uint64(0xFF)) - np.uint64(2)
                wanted[t, c >> np.uint64(3)] |= np.uint64(1) << (np.uint64(8 * e) + (c & np.uint64(7)))
                hits &= ~(np.uint64(0xFF) << shift)
        index = indices[t]
        changes[t] = True
        if not any_hit and bricks.blocks[index] < 0 and bricks.known[index] == ALL_CELLS:
            value = bricks.values[index]
            changes[t] = min(max(value + miss, clamp_min), clamp_max) != value


@inline_kernel
def _prefetch_block(bricks, rows_at, index):
    """Prefetch the block of brick ``index`` of ``bricks``; ``rows_at`` is the address of the rows."""
    ahead = np.int64(bricks.blocks[index])
    for offset in range(0, BRICK_CELLS * 4, 64):
        prefetch_line(rows_at + ahead * ROW_BYTES + offset)


@inline_kernel
def _gather_rows(words, touched, bricks, index, row_words, row_hits):
    """Copy the words of a scratch brick into the order of a block's rows; returns the numbers of shared and all rows.

    - ``words`` uint64: marks of the scratch grid.
    - ``touched``: brick of the scratch grid.
    - ``bricks``, ``index``: brick of the octree.
    - ``row_words`` (rows,) uint64: output, word of each row's octet.
    - ``row_hits`` (rows,) uint64: output, mark of a hit of the row's class in each byte, 0 for shared rows.
    """
    octets = octets_of(bricks.known[index])
    rows = 0
    for e in range(OCTETS):
        row_words[rows] = words[touched * OCTETS + e]
        row_hits[rows] = 0
        rows += np.int64(octets >> np.uint64(8 * e) & np.uint64(1))
    num_shared = rows
    for w in range(bricks.masks.shape[1]):
        bits = bricks.masks[index, w]
        while bits:
            bit = lowest_one(bits)
            row_words[rows] = words[touched * OCTETS + (bit >> 3)]
            row_hits[rows] = np.uint64(8 * w + (bit & 7) + 2) * EVERY_BYTE
            rows += 1
            bits &= bits - np.uint64(1)
    return num_shared, rows


@inline_kernel
def _finish_brick(bricks, index, block, has_own_rows, revision, num_classes):
    """Set the revision of a changed brick, fill its shared rows or prune it."""
    bricks.revisions[index] = revision
    if has_own_rows:
        share_first_class(bricks.rows, block, bricks.known[index], bricks.masks, index, num_classes)
    elif bricks.known[index] == ALL_CELLS:
        prune_brick(bricks, index)


@kernel
def apply_marks(
    bricks, indices, touched, words, num_classes, hit, miss, hit_other, clamp_min, clamp_max, revision, scratch
):
    """Add one scan's log-odds to bricks that were expanded by the rows of ``wanted_rows``.

    A free cell gets ``miss`` in all classes, a hit cell ``hit`` in its class and ``hit_other`` in the others; the sums
    are clamped.

    - ``bricks``: Bricks, in place.
    - ``indices`` (n,) int64: brick indices.
    - ``touched`` (n,) int64, ``words`` uint64, ``num_classes``: as for wanted_rows.
    - ``hit``, ``miss``, ``hit_other``: float32 log-odds increments.
    - ``clamp_min``, ``clamp_max``: float32 limits of the log-odds.
    - ``revision``: revision of the bricks.
    - ``scratch`` (2, 9 + 8 C) uint64.
    """
    # For every value of a block: the cell's mark, and the mark of a hit of the row's class.
    row_marks, row_hits = scratch[0], scratch[1]
    all_marks, all_hits = row_marks.view(np.uint8), row_hits.view(np.uint8)
    flat = bricks.rows.reshape(bricks.rows.size)
    if num_classes == 1:
        hit_other = hit
    rows_at = np.int64(bricks.rows.ctypes.data)
    for t in range(indices.size):
        index = indices[t]
        _prefetch_block(bricks, rows_at, indices[min(t + PREFETCH_AHEAD, indices.size - 1)])
        num_shared, rows = _gather_rows(words, touched[t], bricks, index, row_marks, row_hits)
        block = np.int64(bricks.blocks[index])
        first = block * OCTETS
        for i in range(rows * OCTETS):
            mark = all_marks[i]
            step = miss if mark == 1 else (hit if mark == all_hits[i] else hit_other)
            changed = min(max(flat[first + i] + step, clamp_min), clamp_max)
            flat[first + i] = changed if mark > 0 else flat[first + i]
        _finish_brick(bricks, index, block, rows > num_shared, revision, num_classes)


@kernel
def apply_weighted_marks(
    bricks, indices, touched, words, strengths, num_classes, hits, miss, hit_other, clamp_min, clamp_max, revision,
    scratch,
):  # fmt: skip
    """Add one scan's log-odds like apply_marks, with a hit for each strength.

    - ``bricks``, ``indices``, ``touched``, ``words``: as for apply_marks.
    - ``strengths`` uint64: one byte for each cell of the scratch grid, parallel to ``words``.
    - ``hits`` (256,) float32: log-odds increment of the hit class for each strength.
    - ``num_classes``, ``miss``, ``hit_other``, ``clamp_min``, ``clamp_max``, ``revision``: as for apply_marks.
    - ``scratch`` (3, 9 + 8 C) uint64.
    """
    row_marks, row_hits, row_strengths = scratch[0], scratch[1], scratch[2]
    all_marks, all_hits = row_marks.view(np.uint8), row_hits.view(np.uint8)
    all_strengths = row_strengths.view(np.uint8)
    flat = bricks.rows.reshape(bricks.rows.size)
    rows_at = np.int64(bricks.rows.ctypes.data)
    for t in range(indices.size):
        index = indices[t]
        _prefetch_block(bricks, rows_at, indices[min(t + PREFETCH_AHEAD, indices.size - 1)])
        _gather_rows(strengths, touched[t], bricks, index, row_strengths, row_hits)
        num_shared, rows = _gather_rows(words, touched[t], bricks, index, row_marks, row_hits)
        block = np.int64(bricks.blocks[index])
        first = block * OCTETS
        for i in range(rows * OCTETS):
            mark = all_marks[i]
            is_own = (mark == all_hits[i]) | (num_classes == 1)
            step = miss if mark == 1 else (hits[all_strengths[i]] if is_own else hit_other)
            changed = min(max(flat[first + i] + step, clamp_min), clamp_max)
            flat[first + i] = changed if mark > 0 else flat[first + i]
        _finish_brick(bricks, index, block, rows > num_shared, revision, num_classes)
