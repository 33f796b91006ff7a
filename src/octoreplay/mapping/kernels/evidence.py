"""What a scan adds to an octree: one update for each cell that it touches."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import lowest_one, prefetch_line
from octoreplay.mapping.kernels.storage import (
    ALL_CELLS,
    BRICK_CELLS,
    OCTETS,
    ROW_BYTES,
    collapse,
    octets_of,
    share_first_class,
)

PREFETCH_AHEAD = 8

EVERY_BYTE = np.uint64(0x0101010101010101)
LOW_BITS = np.uint64(0x7F7F7F7F7F7F7F7F)


@kernel
def _marked(marks):
    """The bytes of eight marks that are not 0, as eight bits."""
    tops = (((marks & LOW_BITS) + LOW_BITS) | marks) & ~LOW_BITS
    # The product gathers the eight top bits in the top byte.
    return ((tops >> np.uint64(7)) * np.uint64(0x0102040810204080)) >> np.uint64(56)


@kernel
def wanted_rows(bricks, indices, touched, words, num_classes, miss, clamp_min, clamp_max, wanted, known, changes):
    """Which classes the marks of a scan hit in each octet of the bricks ``indices`` (n,), as masks ``wanted`` (n, W).

    ``touched`` (n,) are the scratch bricks of the marks, ``words`` the marks, eight to a word: 0 for no mark, 1 for a
    free cell, c + 2 for a hit of class c. ``known`` (n,) gets the marked cells. ``changes`` (n,) says which bricks
    change at all: one that is free and clamped does not. A map of one class has no rows of single classes, and takes
    every hit as its own.
    """
    for t in range(indices.size):
        any_hit = np.uint64(0)
        known[t] = 0
        for e in range(OCTETS):
            marks = words[touched[t] * OCTETS + e]
            known[t] |= _marked(marks) << np.uint64(8 * e)
            # Bits above the lowest of a byte say that a cell was hit.
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
    """Ask for the block of a brick that comes soon, ahead of its use: bricks lie anywhere."""
    ahead = np.int64(bricks.blocks[index])
    for offset in range(0, BRICK_CELLS * 4, 64):
        prefetch_line(rows_at + ahead * ROW_BYTES + offset)


@inline_kernel
def _gather_rows(words, touched, bricks, index, row_words, row_hits):
    """The words of a scratch brick in the order of the rows of a block, and the mark of each row's own class.

    Returns the number of rows that classes share, which come first, and of all.
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
    """Store what a changed brick's values allow: classes that share the first one's, or one value for all."""
    bricks.revisions[index] = revision
    if has_own_rows:
        share_first_class(bricks.rows, block, bricks.known[index], bricks.masks, index, num_classes)
    elif bricks.known[index] == ALL_CELLS:
        collapse(bricks, index)


@kernel
def apply_marks(
    bricks, indices, touched, words, num_classes, hit, miss, hit_other, clamp_min, clamp_max, revision, scratch
):
    """Add one scan's log-odds to the bricks ``indices`` (n,), raised beforehand.

    A free cell gets ``miss`` in all classes, a hit cell ``hit`` in its class and ``hit_other`` in the others; the sums
    are clamped. The marks are those of ``wanted_rows``. ``scratch`` (2, 9 + 8 C) uint64 is set.
    """
    # The marks, and the mark that says a row's own class was hit, of every value of a block.
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
    bricks, indices, touched, words, strengths, num_classes, hit, miss, hit_other, clamp_min, clamp_max, revision,
    scratch,
):  # fmt: skip
    """As apply_marks, where each cell's ``hit`` has a factor: its strength in 255ths.

    ``strengths`` are parallel to the marks and eight to a word, and ``scratch`` is (3, 9 + 8 C).
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
            weighted = hit * (np.float32(all_strengths[i]) / np.float32(255))
            step = miss if mark == 1 else (weighted if is_own else hit_other)
            changed = min(max(flat[first + i] + step, clamp_min), clamp_max)
            flat[first + i] = changed if mark > 0 else flat[first + i]
        _finish_brick(bricks, index, block, rows > num_shared, revision, num_classes)
