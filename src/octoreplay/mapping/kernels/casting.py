"""Which cells the rays of a scan pass.

The scratch grid of a scan is made of blocks of 8 x 8 x 8 cells, x fastest; a block holds eight bricks, and all its cells
in Morton order. A *mark* says what the scan did to a cell: 0 nothing, 1 passed, 1 + class_id hit.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.storage import BRICK_CELLS, KEY_OFFSET, spread_bits

BLOCK_BITS = 3
BLOCK_EDGE = 1 << BLOCK_BITS
BLOCK_CELLS = 1 << (3 * BLOCK_BITS)
BRICKS_PER_BLOCK = BLOCK_CELLS // BRICK_CELLS

FRACTION_BITS = 40
"""Rays are walked in whole numbers: positions and slopes are multiples of 2^-40 of a cell."""
_ONE = 1 << FRACTION_BITS

_PIECE = 64
"""Planes of the main axis that are worked on at once."""


@inline_kernel
def _offset(coordinate, axis, stride):
    """What one coordinate adds to a cell's place in the scratch grid; ``stride`` is that of the axis' blocks."""
    return (coordinate >> 3) * stride + (((coordinate & 1) | (coordinate & 2) << 2 | (coordinate & 4) << 4) << axis)


@kernel
def mark_free(origin, ends, end_keys, resolution, corner, num_blocks, marks, flags):
    """Mark with 1 every cell that a ray passes before its end cell, and flag the blocks that rays pass.

    All rays start at ``origin`` (3,) and go to ``ends`` (n, 3), or to the centres of the cells ``end_keys`` (n, 3) where
    ``ends`` is empty. ``corner`` (3,) is the lowest cell of the scratch grid of ``num_blocks`` (3,).

    A ray is cut by the walls of its main axis, along which it is longest, into slabs of at most three cells each.
    Positions at the walls follow from whole numbers without a sum along the way, so all slabs are worked out at once
    and nothing drifts. Where two walls are met at once, z goes before y and y before x, as in OctoMap; walls closer
    than about n x 2^-40 cells count as met at once in the n-th slab.
    """
    strides = np.empty(3, np.int64)
    strides[0] = BLOCK_CELLS
    strides[1] = BLOCK_CELLS * num_blocks[0]
    strides[2] = BLOCK_CELLS * num_blocks[0] * num_blocks[1]
    start, first = np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        quotient = origin[axis] / resolution
        cell = np.int64(np.floor(quotient))
        first[axis] = cell - corner[axis]
        inside = min(np.int64(np.rint((quotient - cell) * _ONE)), _ONE - 1)
        start[axis] = (first[axis] << FRACTION_BITS) + inside
    counts, steps, fractions = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    lengths = np.empty(3)
    crossed = np.empty((2, _PIECE + 1), np.int64)
    places = np.empty((2, _PIECE + 1), np.int64)
    cells = np.empty((3, _PIECE), np.int64)
    for i in range(end_keys.shape[0]):
        for axis in range(3):
            cell = end_keys[i, axis] - corner[axis]
            if ends.size > 0:
                inside = np.int64(np.rint((ends[i, axis] / resolution - end_keys[i, axis]) * _ONE))
                target = (cell << FRACTION_BITS) + min(max(inside, 0), _ONE - 1)
            else:
                target = (cell << FRACTION_BITS) + (_ONE >> 1)
            upwards = target >= start[axis]
            steps[axis] = 1 if upwards else -1
            counts[axis] = abs(cell - first[axis])
            lengths[axis] = np.float64(abs(target - start[axis]))
            inside = start[axis] - (first[axis] << FRACTION_BITS)
            fractions[axis] = inside if upwards else _ONE - inside
        if counts[0] + counts[1] + counts[2] == 0:
            continue
        a = 0
        if lengths[1] > lengths[0]:
            a = 1
        if lengths[2] > lengths[a]:
            a = 2
        # Of the other two axes, c is the one whose walls come first where both are met at once.
        b = 1 if a == 0 else 0
        c = 1 if a == 2 else 2
        n, n_b, n_c = counts[a], counts[b], counts[c]
        step_a, step_b, step_c = steps[a], steps[b], steps[c]
        # Rounding must not change the order of walls that are met at once: axes above the main one are put ahead.
        slope_b, slope_c = lengths[b] / lengths[a], lengths[c] / lengths[a]
        rise_b, rise_c = min(np.int64(slope_b * _ONE), _ONE), min(np.int64(slope_c * _ONE), _ONE)
        from_b = fractions[b] - np.int64(slope_b * fractions[a]) + (n + 4 if b > a else -n - 4)
        from_c = fractions[c] - np.int64(slope_c * fractions[a]) + (n + 4 if c > a else -n - 4)
        next_b, next_c = np.float64(_ONE - fractions[b]), np.float64(_ONE - fractions[c])
        last_b = min(max((from_b + rise_b) >> FRACTION_BITS, 0), n_b) if n > 0 else n_b
        last_c = min(max((from_c + rise_c) >> FRACTION_BITS, 0), n_c) if n > 0 else n_c
        _mark_slab(
            marks,
            flags,
            _offset(first[a], a, strides[a]),
            0,
            0,
            last_b,
            last_c,
            n > 0,
            next_b,
            next_c,
            lengths[b],
            lengths[c],
            first[b],
            first[c],
            step_b,
            step_c,
            b,
            c,
            strides[b],
            strides[c],
        )
        if n == 0:
            continue
        for piece in range(1, n, _PIECE):
            size = min(_PIECE, n - piece)
            crossed_b, crossed_c, places_b, places_c = crossed[0], crossed[1], places[0], places[1]
            for k in range(size + 1):
                count_b = min(max((from_b + rise_b * (piece + k)) >> FRACTION_BITS, 0), n_b)
                count_c = min(max((from_c + rise_c * (piece + k)) >> FRACTION_BITS, 0), n_c)
                crossed_b[k], crossed_c[k] = count_b, count_c
                places_b[k] = _offset(first[b] + step_b * count_b, b, strides[b])
                places_c[k] = _offset(first[c] + step_c * count_c, c, strides[c])
            after_b, after_c, there_b, there_c = crossed_b[1:], crossed_c[1:], places_b[1:], places_c[1:]
            entered, left, between = cells[0], cells[1], cells[2]
            for k in range(size):
                place = _offset(first[a] + step_a * (piece + k), a, strides[a])
                wall_b = (crossed_b[k] * _ONE + next_b) * lengths[c]
                wall_c = (crossed_c[k] * _ONE + next_c) * lengths[b]
                both = (crossed_b[k] != after_b[k]) & (crossed_c[k] != after_c[k])
                c_first = wall_c <= wall_b
                entered[k] = place + places_b[k] + places_c[k]
                left[k] = place + there_b[k] + there_c[k]
                between[k] = (
                    place
                    + (places_b[k] if c_first | (not both) else there_b[k])
                    + (there_c[k] if c_first & both else places_c[k])
                )
            for k in range(size):
                marks[entered[k]] = 1
                marks[left[k]] = 1
                marks[between[k]] = 1
                flags[entered[k] >> 9] = 1
                flags[left[k] >> 9] = 1
                flags[between[k] >> 9] = 1
        last_b = min(max((from_b + rise_b * n) >> FRACTION_BITS, 0), n_b)
        last_c = min(max((from_c + rise_c * n) >> FRACTION_BITS, 0), n_c)
        _mark_slab(
            marks,
            flags,
            _offset(first[a] + step_a * n, a, strides[a]),
            last_b,
            last_c,
            n_b,
            n_c,
            False,
            next_b,
            next_c,
            lengths[b],
            lengths[c],
            first[b],
            first[c],
            step_b,
            step_c,
            b,
            c,
            strides[b],
            strides[c],
        )


@kernel
def _mark_slab(
    marks, flags, place, at_b, at_c, to_b, to_c, mark_last, next_b, next_c, length_b, length_c, first_b, first_c,
    step_b, step_c, b, c, stride_b, stride_c,
):  # fmt: skip
    """Mark the cells of one slab, cell by cell, from crossing counts (at_b, at_c) to (to_b, to_c)."""
    while True:
        done = at_b >= to_b and at_c >= to_c
        if done and not mark_last:
            return
        cell = place + _offset(first_b + step_b * at_b, b, stride_b) + _offset(first_c + step_c * at_c, c, stride_c)
        marks[cell] = 1
        flags[cell >> (3 * BLOCK_BITS)] = 1
        if done:
            return
        c_first = (at_c * _ONE + next_c) * length_b <= (at_b * _ONE + next_b) * length_c
        if at_c < to_c and (c_first or at_b >= to_b):
            at_c += 1
        else:
            at_b += 1


@kernel
def mark_hits(end_keys, end_marks, corner, num_blocks, marks, flags):
    """Write the marks (n,) of hit end cells (n, 3) over those of passed cells; ends with mark 0 are left out."""
    for i in range(end_marks.size):
        if end_marks[i] > 0:
            x, y, z = end_keys[i, 0] - corner[0], end_keys[i, 1] - corner[1], end_keys[i, 2] - corner[2]
            cell = (
                _offset(x, 0, BLOCK_CELLS)
                + _offset(y, 1, BLOCK_CELLS * num_blocks[0])
                + _offset(z, 2, BLOCK_CELLS * num_blocks[0] * num_blocks[1])
            )
            marks[cell] = end_marks[i]
            flags[cell >> (3 * BLOCK_BITS)] = 1


@kernel
def clear_outside(low, high, num_blocks, marks, flags):
    """Take back the marks of cells outside [low, high) (3,), in cells of the scratch grid."""
    for block in range(flags.size):
        if flags[block] == 0:
            continue
        x, y = block % num_blocks[0], (block // num_blocks[0]) % num_blocks[1]
        z = block // (num_blocks[0] * num_blocks[1])
        for k in range(BLOCK_CELLS):
            dx = (k & 1) | (k >> 2) & 2 | (k >> 4) & 4
            dy = (k >> 1) & 1 | (k >> 3) & 2 | (k >> 5) & 4
            dz = (k >> 2) & 1 | (k >> 4) & 2 | (k >> 6) & 4
            inside = (low[0] <= 8 * x + dx < high[0]) and (low[1] <= 8 * y + dy < high[1])
            if not (inside and low[2] <= 8 * z + dz < high[2]):
                marks[block * BLOCK_CELLS + k] = 0


@kernel
def touched_bricks(words, flags, corner, num_blocks, touched, codes):
    """The bricks of flagged blocks that hold a mark: their places in the grid and their codes.

    ``words`` are the marks, eight to a word. Returns their number, and the number of those with a hit cell.
    """
    offset = KEY_OFFSET >> BLOCK_BITS
    low_x, low_y, low_z = corner[0] >> BLOCK_BITS, corner[1] >> BLOCK_BITS, corner[2] >> BLOCK_BITS
    words_per_brick = BRICK_CELLS // 8
    num_touched, num_hit = 0, 0
    hits = np.uint64(0xFEFEFEFEFEFEFEFE)
    for block in range(flags.size):
        if flags[block] == 0:
            continue
        code = np.int64(-1)
        for brick in range(block * BRICKS_PER_BLOCK, (block + 1) * BRICKS_PER_BLOCK):
            found = np.uint64(0)
            for word in range(brick * words_per_brick, (brick + 1) * words_per_brick):
                found |= words[word]
            if found == 0:
                continue
            if code < 0:
                x = block % num_blocks[0] + low_x + offset
                y = (block // num_blocks[0]) % num_blocks[1] + low_y + offset
                z = block // (num_blocks[0] * num_blocks[1]) + low_z + offset
                code = (spread_bits(x) | spread_bits(y) << 1 | spread_bits(z) << 2) * BRICKS_PER_BLOCK
            touched[num_touched] = brick
            codes[num_touched] = code + brick - block * BRICKS_PER_BLOCK
            num_touched += 1
            num_hit += (found & hits) != 0
    return num_touched, num_hit


@kernel
def clear_marks(marks, flags):
    """Zero the flagged blocks of the scratch grid, and the flags."""
    for block in range(flags.size):
        if flags[block] != 0:
            flags[block] = 0
            marks[block * BLOCK_CELLS : (block + 1) * BLOCK_CELLS] = 0
