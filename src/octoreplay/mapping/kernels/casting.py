"""Which cells the rays of a scan pass.

The scratch grid of a scan is made of blocks of 8 x 8 x 8 cells, x fastest; a block holds eight bricks and its cells in
Morton order. A *mark* says what the scan did to a cell: 0 nothing, 1 passed, 1 + class_id hit.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.storage import BRICK_CELLS, KEY_OFFSET, spread_bits

BLOCK_BITS = 3
BLOCK_EDGE = 1 << BLOCK_BITS
BLOCK_CELLS = 1 << (3 * BLOCK_BITS)
BRICKS_PER_BLOCK = BLOCK_CELLS // BRICK_CELLS

FRACTION = 2.0**-32
"""Rays are walked without rounding: positions and slopes are multiples of this part of a cell, and a coordinate of the
scratch grid with such a fraction fits a float64."""

_PIECE = 64
"""Planes of the main axis that are worked on at once."""


@inline_kernel
def _offset(coordinate, unit, stride):
    """What one coordinate adds to a cell's place in the scratch grid, in 32 bits.

    ``unit`` is 1, 2 and 4 for x, y and z, ``stride`` that of the axis' blocks.
    """
    within = np.uint32(np.uint32(coordinate & 1) | np.uint32(np.uint32(coordinate & 2) << 2))
    within = np.uint32(within | np.uint32(np.uint32(coordinate & 4) << 4))
    return np.uint32(np.uint32(np.uint32(coordinate >> BLOCK_BITS) * stride) + np.uint32(within * unit))


@kernel
def mark_free(origin, ends, end_keys, resolution, corner, num_blocks, marks, flags):
    """Mark with 1 every cell that a ray passes before its end cell, and flag the blocks that rays pass.

    All rays start at ``origin`` (3,) and go to ``ends`` (n, 3), or where that is empty to the centres of the cells
    ``end_keys`` (n, 3). ``corner`` (3,) is the lowest cell of the scratch grid of ``num_blocks`` (3,).

    A ray is cut by the walls of its main axis, along which it is longest, into slabs of at most three cells each.
    Positions at the walls follow from whole numbers without a sum along the way, so all slabs are worked out at once
    and nothing drifts. Where two walls are met at once, z goes before y and y before x, as in OctoMap; walls closer
    than about n x 2^-32 cells count as met at once in the n-th slab.
    """
    strides, units = np.empty(3, np.uint32), np.empty(3, np.uint32)
    strides[0] = BLOCK_CELLS
    strides[1] = BLOCK_CELLS * num_blocks[0]
    strides[2] = BLOCK_CELLS * num_blocks[0] * num_blocks[1]
    first, last, steps = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    start, lengths = np.empty(3), np.empty(3)
    for axis in range(3):
        units[axis] = 1 << axis
        cell = np.int64(np.floor(origin[axis] / resolution))
        first[axis] = cell - corner[axis]
        start[axis] = first[axis] + _fraction(origin[axis], cell, resolution)
    coords_b, coords_c = np.empty(_PIECE + 16, np.int32), np.empty(_PIECE + 16, np.int32)
    places_b, places_c = np.empty(_PIECE + 16, np.uint32), np.empty(_PIECE + 16, np.uint32)
    # Places along each axis, upwards and downwards, with room for whole vectors.
    longest = BLOCK_EDGE * max(num_blocks[0], num_blocks[1], num_blocks[2])
    tables = np.zeros((2, 3, longest + 16), np.uint32)
    for axis in range(3):
        for k in range(longest):
            tables[0, axis, k] = _offset(np.uint32(k), units[axis], strides[axis])
            tables[1, axis, longest - 1 - k] = tables[0, axis, k]
    entered, left, between = np.empty(_PIECE, np.uint32), np.empty(_PIECE, np.uint32), np.empty(_PIECE, np.uint32)
    after_b, after_c, there_b, there_c = coords_b[1:], coords_c[1:], places_b[1:], places_c[1:]
    for i in range(end_keys.shape[0]):
        for axis in range(3):
            last[axis] = end_keys[i, axis] - corner[axis]
            inside = _fraction(ends[i, axis], end_keys[i, axis], resolution) if ends.size > 0 else 0.5
            length = last[axis] + inside - start[axis]
            steps[axis] = 1 if length >= 0.0 else -1
            lengths[axis] = abs(length)
        a = 0
        if lengths[1] > lengths[0]:
            a = 1
        if lengths[2] > lengths[a]:
            a = 2
        # Of the other two axes, c is the one whose walls come first where both are met at once.
        b = 1 if a == 0 else 0
        c = 1 if a == 2 else 2
        n = abs(last[a] - first[a])
        first_a, step_a, stride_a = first[a], steps[a], strides[a]
        unit_a, unit_b, unit_c = units[a], units[b], units[c]
        first_b, last_b, step_b, stride_b = first[b], last[b], steps[b], strides[b]
        first_c, last_c, step_c, stride_c = first[c], last[c], steps[c], strides[c]
        # Which of the walls ahead of cells k_b and k_c comes first: they are k x scale + shift away.
        scale_b, shift_b = step_b * lengths[c], ((step_b > 0) - start[b]) * step_b * lengths[c]
        scale_c, shift_c = step_c * lengths[b], ((step_c > 0) - start[c]) * step_c * lengths[b]
        sides = (scale_b, shift_b, scale_c, shift_c, step_b, step_c, unit_b, unit_c, stride_b, stride_c)
        at_b, at_c = first_b, first_c
        if n > 0:
            distance = start[a] - first_a if step_a > 0 else first_a + 1 - start[a]
            from_b, rise_b = _line(start[b], step_b, lengths[b] / lengths[a], distance, n, b > a)
            from_c, rise_c = _line(start[c], step_c, lengths[c] / lengths[a], distance, n, c > a)
            low_b, high_b = np.int32(min(first_b, last_b)), np.int32(max(first_b, last_b))
            low_c, high_c = np.int32(min(first_c, last_c)), np.int32(max(first_c, last_c))
            at_b = np.int64(min(max(np.int32(from_b + rise_b), low_b), high_b))
            at_c = np.int64(min(max(np.int32(from_c + rise_c), low_c), high_c))
            _mark_slab(
                marks, flags, _offset(first_a, unit_a, stride_a), first_b, first_c, at_b, at_c, True, sides
            )  # fmt: skip
            for piece in range(1, n, _PIECE):
                size = min(_PIECE, n - piece)
                begin = first_a + piece if step_a > 0 else longest - 1 - first_a + piece
                places_a = tables[0 if step_a > 0 else 1, a, begin:]
                # Whole vectors: what lies behind the piece is worked out and not used.
                whole = (size + 16) // 16 * 16
                for k in range(whole):
                    coord_b = min(max(np.int32(from_b + rise_b * np.float64(piece + k)), low_b), high_b)
                    coord_c = min(max(np.int32(from_c + rise_c * np.float64(piece + k)), low_c), high_c)
                    coords_b[k], coords_c[k] = coord_b, coord_c
                    places_b[k] = _offset(np.uint32(coord_b), unit_b, stride_b)
                    places_c[k] = _offset(np.uint32(coord_c), unit_c, stride_c)
                whole = (size + 15) // 16 * 16
                for k in range(whole):
                    both = (coords_b[k] != after_b[k]) & (coords_c[k] != after_c[k])
                    c_first = coords_c[k] * scale_c + shift_c <= coords_b[k] * scale_b + shift_b
                    place_a, place_b, place_c = places_a[k], places_b[k], places_c[k]
                    next_b, next_c = there_b[k], there_c[k]
                    b_between = next_b if both & (not c_first) else place_b
                    c_between = next_c if both & c_first else place_c
                    entered[k] = np.uint32(np.uint32(place_a + place_b) + place_c)
                    left[k] = np.uint32(np.uint32(place_a + next_b) + next_c)
                    between[k] = np.uint32(np.uint32(place_a + b_between) + c_between)
                _flag_blocks(flags, places_a, places_b, places_c, begin & (BLOCK_EDGE - 1), size)
                for k in range(size):
                    marks[entered[k]] = 1
                    marks[left[k]] = 1
                    marks[between[k]] = 1
            at_b = np.int64(min(max(np.int32(from_b + rise_b * n), low_b), high_b))
            at_c = np.int64(min(max(np.int32(from_c + rise_c * n), low_c), high_c))
        _mark_slab(marks, flags, _offset(last[a], unit_a, stride_a), at_b, at_c, last_b, last_c, False, sides)


@inline_kernel
def _fraction(coord, cell, resolution):
    """Where in its cell a coordinate [m] lies, in [0, 1), rounded to a multiple of FRACTION."""
    return min(max(np.rint((coord / resolution - cell) / FRACTION) * FRACTION, 0.0), 1.0 - FRACTION)


@inline_kernel
def _line(start, step, slope, distance, n, goes_first):
    """Position along an axis at the k-th wall of the main one: first + k x second is in the cell behind the wall.

    ``start`` is the origin's position, ``slope`` at most 1, and ``distance`` the origin's from wall k = 0 behind it.
    Rounding must not decide the order of walls that are met at once: an axis that ``goes_first`` is put ahead by what
    n roundings can amount to, the others behind.
    """
    rise = min(np.floor(slope / FRACTION) * FRACTION, 1.0)
    ahead = (n + 4 if goes_first else -n - 4) * FRACTION - np.floor(slope * distance / FRACTION) * FRACTION
    # Going down, a position on a wall is in the cell behind the wall.
    return (start + ahead, rise) if step > 0 else (start - FRACTION - ahead, -rise)


@inline_kernel
def _flag_blocks(flags, places_a, places_b, places_c, skipped, size):
    """Flag the blocks that ``size`` slabs pass, the first of them ``skipped`` cells from where its block begins."""
    b, c = np.int64(places_b[0]) >> (3 * BLOCK_BITS), np.int64(places_c[0]) >> (3 * BLOCK_BITS)
    for stretch in range((size + skipped + BLOCK_EDGE - 1) >> BLOCK_BITS):
        # Within one block of the main axis a ray lies in at most two blocks along each of the others.
        begin = max(stretch * BLOCK_EDGE - skipped, 0)
        end = min(stretch * BLOCK_EDGE + BLOCK_EDGE - skipped, size)
        a = np.int64(places_a[begin]) >> (3 * BLOCK_BITS)
        other_b, other_c = np.int64(places_b[end]) >> (3 * BLOCK_BITS), np.int64(places_c[end]) >> (3 * BLOCK_BITS)
        flags[a + b + c] = 1
        flags[a + other_b + c] = 1
        flags[a + b + other_c] = 1
        flags[a + other_b + other_c] = 1
        b, c = other_b, other_c


@kernel
def _mark_slab(marks, flags, place, at_b, at_c, to_b, to_c, mark_last, sides):
    """Mark the cells of one slab, one by one, from (at_b, at_c) to (to_b, to_c)."""
    scale_b, shift_b, scale_c, shift_c, step_b, step_c, unit_b, unit_c, stride_b, stride_c = sides
    while True:
        done = at_b == to_b and at_c == to_c
        if done and not mark_last:
            return
        cell = np.int64(place) + _offset(at_b, unit_b, stride_b) + _offset(at_c, unit_c, stride_c)
        marks[cell] = 1
        flags[cell >> (3 * BLOCK_BITS)] = 1
        if done:
            return
        c_first = at_c * scale_c + shift_c <= at_b * scale_b + shift_b
        if at_c != to_c and (c_first or at_b == to_b):
            at_c += step_c
        else:
            at_b += step_b


@kernel
def mark_hits(end_keys, end_marks, corner, num_blocks, marks, flags):
    """Write the marks (n,) of hit end cells (n, 3) over those of passed cells; ends with mark 0 are left out."""
    stride_x, stride_y = np.uint32(BLOCK_CELLS), np.uint32(BLOCK_CELLS * num_blocks[0])
    stride_z = np.uint32(BLOCK_CELLS * num_blocks[0] * num_blocks[1])
    for i in range(end_marks.size):
        if end_marks[i] > 0:
            x, y, z = end_keys[i, 0] - corner[0], end_keys[i, 1] - corner[1], end_keys[i, 2] - corner[2]
            cell = np.int64(_offset(x, np.uint32(1), stride_x))
            cell += np.int64(_offset(y, np.uint32(2), stride_y)) + np.int64(_offset(z, np.uint32(4), stride_z))
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
            for cell in range(block * BLOCK_CELLS, (block + 1) * BLOCK_CELLS):
                marks[cell] = 0
