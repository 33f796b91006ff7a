"""Evidence of one scan added to an octree: one update for each cell that the scan touches.

A *mark* is one byte for each cell of a brick: 0 untouched, 1 free, c + 2 a hit of class c (from 0).
Eight marks, those of an octet, are one uint64 word. In shapes, n is the number of bricks, C of classes, and
W = ceil(C / 8) of mask words.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import add_marked_octet, count_ones, lowest_one, prefetch_line
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
def wanted_rows(bricks, indices, marks, num_classes, miss, clamp_min, clamp_max, wanted, known, changes):
    """Find the class rows that the hits of a scan need.

    A map of one class has no class rows; all hits go to the shared rows.

    - ``bricks``: Bricks of the octree.
    - ``indices`` (n,) int64: brick indices.
    - ``marks`` (n, 8) uint64: marks of the bricks.
    - ``num_classes``: C.
    - ``miss``, ``clamp_min``, ``clamp_max``: float32, log-odds increment of a free cell and limits.
    - ``wanted`` (n, W) uint64: output from 0, class rows of the octets and classes that are hit.
    - ``known`` (n,) uint64: output, marked cells.
    - ``changes`` (n,) bool: output, False where a brick does not change because it is free and at the limit.
    """
    for t in range(indices.size):
        any_hit, cells = np.uint64(0), np.uint64(0)
        for e in range(OCTETS):
            octet = marks[t, e]
            cells |= _marked_cells(octet) << np.uint64(8 * e)
            # A mark above 1 is a hit.
            hits = octet & ~EVERY_BYTE
            any_hit |= hits
            if num_classes == 1:
                continue
            while hits:
                shift = np.uint64(lowest_one(hits)) & np.uint64(0x38)
                c = ((octet >> shift) & np.uint64(0xFF)) - np.uint64(2)
                wanted[t, c >> np.uint64(3)] |= np.uint64(1) << (np.uint64(8 * e) + (c & np.uint64(7)))
                hits &= ~(np.uint64(0xFF) << shift)
        known[t] = cells
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


@kernel
def apply_marks(
    bricks, indices, changes, marks, strengths, num_classes, hits, others, miss, clamp_min, clamp_max, revision, steps,
):  # fmt: skip
    """Add one scan's log-odds to bricks that were expanded by the rows of ``wanted_rows``.

    A free cell gets ``miss`` in all classes. A hit cell gets the increments of its strength: one in its class,
    another in the other classes; in a map of one class, every hit is one of this class. The sums are clamped.

    - ``bricks``: Bricks, in place.
    - ``indices`` (n,) int64: brick indices.
    - ``changes`` (n,) bool: as left by wanted_rows; the other bricks are skipped.
    - ``marks`` (n, 8) uint64, ``num_classes``: as for wanted_rows.
    - ``strengths`` (n, 64) uint8: strength of each hit; size 0 for the strength 255 everywhere.
    - ``hits``, ``others`` (256,) float32: log-odds increments of the hit class and of the others for each strength.
    - ``miss``: float32 log-odds increment.
    - ``clamp_min``, ``clamp_max``: float32 limits of the log-odds.
    - ``revision``: revision of the bricks.
    - ``steps`` (2, 64) float32: scratch, increments of each cell's hit in its class and in the others.
    """
    for k in range(BRICK_CELLS):
        steps[0, k], steps[1, k] = hits[255], others[255]
    # Marks of the hits that the shared rows get with the strength; a mark of 0 changes nothing.
    shared_from, shared_to = np.uint8(0), np.uint8(0)
    if num_classes == 1:
        shared_from, shared_to = np.uint8(2), np.uint8(255)
    own_at, rows_at = np.int64(steps.ctypes.data), np.int64(bricks.rows.ctypes.data)
    other_at = own_at + OCTETS * ROW_BYTES
    for t in range(indices.size):
        index = indices[t]
        _prefetch_block(bricks, rows_at, indices[min(t + PREFETCH_AHEAD, indices.size - 1)])
        if not changes[t]:
            continue
        if strengths.size > 0:
            for k in range(BRICK_CELLS):
                steps[0, k], steps[1, k] = hits[strengths[t, k]], others[strengths[t, k]]
        block = np.int64(bricks.blocks[index])
        place = rows_at + block * ROW_BYTES
        octets = octets_of(bricks.known[index])
        while octets:
            e = lowest_one(octets) >> 3
            add_marked_octet(
                place, marks[t, e], shared_from, shared_to, own_at + e * ROW_BYTES, other_at + e * ROW_BYTES, miss,
                clamp_min, clamp_max,
            )  # fmt: skip
            place += ROW_BYTES
            octets &= octets - np.uint64(1)
        num_own = 0
        for w in range(bricks.masks.shape[1]):
            bits = bricks.masks[index, w]
            num_own += count_ones(bits)
            while bits:
                bit = lowest_one(bits)
                e, own = bit >> 3, np.uint8(8 * w + (bit & 7) + 2)
                add_marked_octet(
                    place, marks[t, e], own, own, own_at + e * ROW_BYTES, other_at + e * ROW_BYTES, miss, clamp_min,
                    clamp_max,
                )  # fmt: skip
                place += ROW_BYTES
                bits &= bits - np.uint64(1)
        bricks.revisions[index] = revision
        if num_own > 0:
            share_first_class(bricks.rows, block, bricks.known[index], bricks.masks, index, num_classes)
        elif bricks.known[index] == ALL_CELLS:
            prune_brick(bricks, index)
