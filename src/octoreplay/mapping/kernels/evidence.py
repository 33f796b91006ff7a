"""What a scan adds to an octree: one update for each cell that it touches."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import kernel
from octoreplay.mapping.kernels.storage import (
    ALL_CELLS,
    BRICK_CELLS,
    SCALAR,
    UNIFORM,
    collapse,
    make_scalar,
    make_vector,
)


@kernel
def _mask(words, brick):
    """The mask of the cells of a brick that have a mark; ``words`` are the marks, eight to a word."""
    mask = np.uint64(0)
    low_bits = np.uint64(0x7F7F7F7F7F7F7F7F)
    for k in range(BRICK_CELLS // 8):
        word = words[brick * (BRICK_CELLS // 8) + k]
        # The top bit of each byte that is not zero; the product gathers the eight bits in the top byte.
        tops = (((word & low_bits) + low_bits) | word) & ~low_bits
        byte = ((tops >> np.uint64(7)) * np.uint64(0x0102040810204080)) >> np.uint64(56)
        mask |= byte << np.uint64(8 * k)
    return mask


@kernel
def apply_marks(bricks, indices, touched, marks, words, hit, miss, hit_other, clamp_min, clamp_max, revision):
    """Add one scan's log-odds to the bricks ``indices`` (n,) whose marks are the scratch bricks ``touched`` (n,).

    A free cell gets ``miss`` in all classes, a hit cell ``hit`` in its class and ``hit_other`` in the others; the sums
    are clamped. ``words`` are the marks, eight to a word. Room for the rows that may be needed must be there.
    """
    num_classes = bricks.vector.shape[1]
    for t in range(indices.size):
        index = indices[t]
        cells = marks[touched[t] * BRICK_CELLS : (touched[t] + 1) * BRICK_CELLS]
        hits = 0
        for i in range(BRICK_CELLS):
            hits += cells[i] > 1
        if bricks.tiers[index] == UNIFORM and hits == 0:
            value = bricks.values[index]
            if min(max(value + miss, clamp_min), clamp_max) == value and bricks.known[index] == ALL_CELLS:
                continue
        bricks.revisions[index] = revision
        bricks.known[index] |= _mask(words, touched[t])
        if hits > 0 and num_classes > 1:
            make_vector(bricks, index)
        else:
            make_scalar(bricks, index)
        if bricks.tiers[index] == SCALAR:
            data = bricks.scalar[bricks.rows[index]]
            for i in range(BRICK_CELLS):
                step = hit if cells[i] > 1 else miss
                changed = min(max(data[i] + step, clamp_min), clamp_max)
                data[i] = changed if cells[i] > 0 else data[i]
            collapse(bricks, index)
            continue
        for c in range(num_classes):
            row = bricks.vector[bricks.rows[index], c]
            for i in range(BRICK_CELLS):
                mark = cells[i]
                step = miss if mark == 1 else (hit if mark == c + 2 else hit_other)
                changed = min(max(row[i] + step, clamp_min), clamp_max)
                row[i] = changed if mark > 0 else row[i]
