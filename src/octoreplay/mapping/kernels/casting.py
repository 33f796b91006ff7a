"""Ray casting: the cells that the rays of a scan pass and hit.

The scratch grid of a scan consists of blocks of 8 x 8 x 8 cells in x-fastest order; a block holds eight bricks, and its
cells are in Morton order. A *mark* is one byte for each cell: 0 untouched, 1 passed, 1 + class_id hit. A *flag* is one
byte for each block: 1 where the block holds a mark. A cell's *place* is its position in the scratch grid.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import allocating_kernel, inline_kernel, kernel
from octoreplay.mapping.kernels.storage import BRICK_CELLS, KEY_OFFSET, spread_bits

BLOCK_BITS = 3
BLOCK_EDGE = 1 << BLOCK_BITS
BLOCK_CELLS = 1 << (3 * BLOCK_BITS)
BRICKS_PER_BLOCK = BLOCK_CELLS // BRICK_CELLS

FRACTION = 2.0**-32
"""Resolution of positions and slopes in cells. Rays are traversed without rounding: a coordinate of the scratch grid
with such a fraction is exact in float64."""

VECTOR = 16
"""Number of slabs computed together; rows of scratch memory have room for as many more."""

_PIECE = 64
"""Number of slabs in one pass of the inner loops."""


@inline_kernel
def _offset(coordinate, unit, stride):
    """Return the uint32 term of one coordinate in a cell's place.

    - ``coordinate``: cell along the axis.
    - ``unit``: 1, 2 or 4 for x, y or z.
    - ``stride``: cells between neighbouring blocks along the axis.
    """
    within = np.uint32(coordinate & 1) | np.uint32((coordinate & 2) << 2) | np.uint32((coordinate & 4) << 4)
    return np.uint32((coordinate >> BLOCK_BITS) * stride) + np.uint32(within * unit)


@kernel
def fill_tables(num_blocks, tables):
    """Write the terms of a cell's place along x, y and z, in rising order and then in falling order.

    - ``num_blocks`` (3,) int64: size of the scratch grid in blocks.
    - ``tables`` (6, longest edge of the grid + VECTOR) uint32: output.
    """
    longest, stride = tables.shape[1] - VECTOR, BLOCK_CELLS
    for axis in range(num_blocks.size):
        for k in range(longest):
            place = _offset(np.uint32(k), np.uint32(1 << axis), np.uint32(stride))
            tables[axis, k] = place
            tables[3 + axis, longest - 1 - k] = place
        stride *= num_blocks[axis]


@allocating_kernel
def mark_free(start, ends, end_keys, resolution, corner, num_blocks, tables, marks, flags):
    """Mark with 1 every cell that a ray passes before its end cell, and flag the blocks that rays pass.

    Loop invariant: the passed cells of rays before ``i`` are marked and their blocks are flagged.

    The walls of a ray's main axis, along which it is longest, cut it into slabs of at most three cells each. The
    position at wall k is computed from the integer k, not accumulated from wall to wall, so all slabs are computed
    together and errors do not add up. Where a ray crosses two walls at once, it crosses z before y and y before x, as
    in OctoMap; walls closer than about n x 2^-32 cells count as crossed at once in slab n.

    - ``start`` (3,) float64: start of all rays, in cells of the scratch grid, a multiple of FRACTION.
    - ``ends`` (n, 3) float64: end points in the team's frame [m]; size 0 where rays end at the centres of end cells.
    - ``end_keys`` (n, 3) int32: keys of the end cells.
    - ``resolution``: edge of a cell [m].
    - ``corner`` (3,) int64: key of the scratch grid's lowest cell.
    - ``num_blocks`` (3,) int64: size of the scratch grid in blocks.
    - ``tables`` uint32: as filled by fill_tables.
    - ``marks`` uint8, ``flags`` uint8: of the scratch grid, in place.
    """
    longest, stride = tables.shape[1] - VECTOR, BLOCK_CELLS
    strides = np.empty(3, np.uint32)
    for axis in range(3):
        strides[axis] = stride
        stride *= num_blocks[axis]
    lengths = np.empty(3)
    places_b, places_c = np.empty(_PIECE + VECTOR, np.uint32), np.empty(_PIECE + VECTOR, np.uint32)
    coords_b, coords_c = np.empty(_PIECE + VECTOR, np.int32), np.empty(_PIECE + VECTOR, np.int32)
    entered, left, between = np.empty(_PIECE, np.uint32), np.empty(_PIECE, np.uint32), np.empty(_PIECE, np.uint32)
    for i in range(end_keys.shape[0]):
        for axis in range(3):
            inside = _fraction(ends[i, axis], end_keys[i, axis], resolution) if ends.size > 0 else 0.5
            lengths[axis] = end_keys[i, axis] - corner[axis] + inside - start[axis]
        a = 0
        if abs(lengths[1]) > abs(lengths[0]):
            a = 1
        if abs(lengths[2]) > abs(lengths[a]):
            a = 2
        # Of the other two axes, c is the one that is crossed first where both walls are met at once.
        b, c = np.int64(a == 0), 2 - np.int64(a == 2)
        length_a, length_b, length_c = abs(lengths[a]), abs(lengths[b]), abs(lengths[c])
        up_a, up_b, up_c = lengths[a] >= 0.0, lengths[b] >= 0.0, lengths[c] >= 0.0
        step_b, step_c = 2 * up_b - 1, 2 * up_c - 1
        first_a, first_b, first_c = np.int32(start[a]), np.int32(start[b]), np.int32(start[c])
        last_a = np.int32(end_keys[i, a] - corner[a])
        last_b, last_c = np.int32(end_keys[i, b] - corner[b]), np.int32(end_keys[i, c] - corner[c])
        n = abs(last_a - first_a)
        # The walls ahead of cell k along b and c are at distances proportional to k x scale + shift.
        scale_b, shift_b = step_b * length_c, (up_b - start[b]) * step_b * length_c
        scale_c, shift_c = step_c * length_b, (up_c - start[c]) * step_c * length_b
        near_b, near_c, far_b, far_c = last_b, last_c, first_b, first_c
        if n > 0:
            distance = start[a] - first_a if up_a else first_a + 1 - start[a]
            from_b, rise_b = _line(start[b], step_b, length_b / length_a, distance, (2 * (b > a) - 1) * (n + 4))
            from_c, rise_c = _line(start[c], step_c, length_c / length_a, distance, (2 * (c > a) - 1) * (n + 4))
            low_b, high_b = min(first_b, last_b), max(first_b, last_b)
            low_c, high_c = min(first_c, last_c), max(first_c, last_c)
            near_b = min(max(np.int32(from_b + rise_b), low_b), high_b)
            near_c = min(max(np.int32(from_c + rise_c), low_c), high_c)
            unit_b, unit_c, stride_b, stride_c = np.uint32(1 << b), np.uint32(1 << c), strides[b], strides[c]
            for piece in range(1, n, _PIECE):
                size = min(_PIECE, n - piece)
                begin = first_a + piece if up_a else longest - 1 - first_a + piece
                places_a = tables[a if up_a else a + 3, begin:]
                # The count is rounded up to whole vectors; values behind the piece are not used.
                whole = (size + VECTOR) // VECTOR * VECTOR
                for k in range(whole):
                    coord_b = min(max(np.int32(from_b + rise_b * np.float64(piece + k)), low_b), high_b)
                    coord_c = min(max(np.int32(from_c + rise_c * np.float64(piece + k)), low_c), high_c)
                    coords_b[k], coords_c[k] = coord_b, coord_c
                    places_b[k] = _offset(np.uint32(coord_b), unit_b, stride_b)
                    places_c[k] = _offset(np.uint32(coord_c), unit_c, stride_c)
                whole = (size + VECTOR - 1) // VECTOR * VECTOR
                for k in range(whole):
                    place_a, place_b, place_c = places_a[k], places_b[k], places_c[k]
                    next_b, next_c = places_b[k + 1], places_c[k + 1]
                    entered[k] = place_a + place_b + place_c
                    left[k] = place_a + next_b + next_c
                    c_first = coords_c[k] * scale_c + shift_c <= coords_b[k] * scale_b + shift_b
                    # Where only one coordinate changes, this is again the cell entered or the cell left.
                    b_between = place_b if c_first else next_b
                    c_between = next_c if c_first else place_c
                    between[k] = place_a + b_between + c_between
                _flag_blocks(flags, places_a, places_b, places_c, begin & (BLOCK_EDGE - 1), size)
                for k in range(size):
                    marks[entered[k]] = 1
                    marks[left[k]] = 1
                    marks[between[k]] = 1
            far_b = min(max(np.int32(from_b + rise_b * n), low_b), high_b)
            far_c = min(max(np.int32(from_c + rise_c * n), low_c), high_c)
        _mark_end_slabs(
            marks, flags, tables[a], tables[b], tables[c], (first_a, first_b, first_c), (near_b, near_c, far_b, far_c),
            (last_a, last_b, last_c), (scale_b, shift_b, scale_c, shift_c, step_b, step_c)
        )  # fmt: skip


@inline_kernel
def _fraction(coord, cell, resolution):
    """Position of ``coord`` [m] in ``cell`` (edge ``resolution`` [m]), in [0, 1), rounded to a multiple of FRACTION."""
    return min(max(np.rint((coord / resolution - cell) / FRACTION) * FRACTION, 0.0), 1.0 - FRACTION)


@inline_kernel
def _line(start, step, slope, distance, margin):
    """Return a ray's position along an axis as (a, b): a + k b is in the cell behind wall k of the main axis.

    Rounding must not decide the order of walls that are crossed at once. An axis that goes first is moved ahead by the
    largest rounding error, ``margin`` x FRACTION; an axis that goes last is moved back by a negative margin.

    - ``start``: start of the ray along the axis [cell].
    - ``step``: 1 or -1, direction along the axis.
    - ``slope``: cells along the axis for each cell along the main axis, 0 to 1.
    - ``distance``: distance of the start from wall 0 along the main axis [cell].
    - ``margin``: multiple of FRACTION.
    """
    rise = min(np.floor(slope / FRACTION) * FRACTION, 1.0)
    ahead = margin * FRACTION - np.floor(slope * distance / FRACTION) * FRACTION
    # In falling direction, a position on a wall is in the cell behind the wall.
    return start - (step < 0) * FRACTION + step * ahead, step * rise


@inline_kernel
def _flag_blocks(flags, places_a, places_b, places_c, skipped, size):
    """Flag the blocks that a piece of slabs passes.

    - ``flags`` uint8: in place.
    - ``places_a``, ``places_b``, ``places_c`` (size + 1,) uint32: terms of the place along the three axes.
    - ``skipped``: cells between the start of the first slab's block and the first slab.
    - ``size``: number of slabs.
    """
    b, c = np.int64(places_b[0]) >> (3 * BLOCK_BITS), np.int64(places_c[0]) >> (3 * BLOCK_BITS)
    for stretch in range((size + skipped + BLOCK_EDGE - 1) >> BLOCK_BITS):
        # Within one block along the main axis, a ray is in at most two blocks along each of the other axes.
        begin = max(stretch * BLOCK_EDGE - skipped, 0)
        end = min(stretch * BLOCK_EDGE + BLOCK_EDGE - skipped, size)
        a = np.int64(places_a[begin]) >> (3 * BLOCK_BITS)
        other_b, other_c = np.int64(places_b[end]) >> (3 * BLOCK_BITS), np.int64(places_c[end]) >> (3 * BLOCK_BITS)
        flags[a + b + c] = 1
        flags[a + other_b + c] = 1
        flags[a + b + other_c] = 1
        flags[a + other_b + other_c] = 1
        b, c = other_b, other_c


@inline_kernel
def _mark_end_slabs(marks, flags, table_a, table_b, table_c, firsts, walls, lasts, sides):
    """Mark the cells of a ray's first and last slab one by one, without the ray's end cell.

    - ``marks`` uint8, ``flags`` uint8: in place.
    - ``table_a``, ``table_b``, ``table_c`` uint32: terms of the place along the main axis a and along b and c.
    - ``firsts``: first cell along a, b and c.
    - ``walls``: cells along b and c at the end of the first slab, and at the start of the last one.
    - ``lasts``: last cell along a, b and c.
    - ``sides``: scale and shift of b and of c, steps along b and c; see mark_free.
    """
    scale_b, shift_b, scale_c, shift_c, step_b, step_c = sides
    first_a, at_b, at_c = firsts
    to_b, to_c, far_b, far_c = walls
    last_a, last_b, last_c = lasts
    place_a = table_a[first_a]
    in_last = first_a == last_a
    while True:
        done = at_b == to_b and at_c == to_c
        if done and in_last:
            break
        cell = np.int64(place_a + table_b[at_b] + table_c[at_c])
        marks[cell] = 1
        flags[cell >> (3 * BLOCK_BITS)] = 1
        if done:
            at_b, at_c, to_b, to_c, place_a, in_last = far_b, far_c, last_b, last_c, table_a[last_a], True
        elif at_c != to_c and (at_b == to_b or at_c * scale_c + shift_c <= at_b * scale_b + shift_b):
            at_c += step_c
        else:
            at_b += step_b


@kernel
def mark_hits(end_places, end_marks, marks, flags):
    """Write the marks of hit end cells over those of passed cells.

    - ``end_places`` (n,) uint32: places of the end cells.
    - ``end_marks`` (n,) uint8: marks; 0 is skipped.
    - ``marks`` uint8, ``flags`` uint8: of the scratch grid, in place.
    """
    for i in range(end_marks.size):
        if end_marks[i] > 0:
            place = end_places[i]
            marks[place] = end_marks[i]
            flags[place >> np.uint32(3 * BLOCK_BITS)] = 1


@kernel
def clear_outside(low, high, num_blocks, marks, flags):
    """Clear the marks of cells outside a box.

    - ``low``, ``high`` (3,) int64: the box [low, high) in cells of the scratch grid.
    - ``num_blocks`` (3,) int64: size of the scratch grid in blocks.
    - ``marks`` uint8: in place.
    - ``flags`` uint8: flagged blocks.
    """
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
def take_bricks(words, strengths, flags, corner, num_blocks, codes, brick_words, brick_strengths):
    """Move the bricks that hold a mark out of the scratch grid, which is empty afterwards; returns their number m.

    - ``words`` uint64: marks of the scratch grid, eight to a word; 0 afterwards.
    - ``strengths`` uint64: strengths, parallel to ``words``; size 0 for none.
    - ``flags`` uint8: flagged blocks; 0 afterwards.
    - ``corner`` (3,) int64: key of the scratch grid's lowest cell.
    - ``num_blocks`` (3,) int64: size of the scratch grid in blocks.
    - ``codes`` (>= m,) int64: output, Morton codes of the bricks.
    - ``brick_words`` (>= m, 8) uint64: output, marks of the bricks.
    - ``brick_strengths`` (>= m, 8) uint64: output, strengths of the bricks; size 0 for none.
    """
    offset = KEY_OFFSET >> BLOCK_BITS
    low_x, low_y, low_z = corner[0] >> BLOCK_BITS, corner[1] >> BLOCK_BITS, corner[2] >> BLOCK_BITS
    words_per_brick = brick_words.shape[1]
    num_bricks = 0
    for block in range(flags.size):
        if flags[block] == 0:
            continue
        flags[block] = 0
        code = np.int64(-1)
        for part in range(BRICKS_PER_BLOCK):
            # numba tests signed indices for being negative.
            first = np.uint64((block * BRICKS_PER_BLOCK + part) * words_per_brick)
            found = np.uint64(0)
            for word in range(words_per_brick):
                place = first + np.uint64(word)
                found |= words[place]
                brick_words[num_bricks, word] = words[place]
                words[place] = 0
            if found == 0:
                continue
            if strengths.size > 0:
                for word in range(words_per_brick):
                    brick_strengths[num_bricks, word] = strengths[first + np.uint64(word)]
            if code < 0:
                x = block % num_blocks[0] + low_x + offset
                y = (block // num_blocks[0]) % num_blocks[1] + low_y + offset
                z = block // (num_blocks[0] * num_blocks[1]) + low_z + offset
                code = (spread_bits(x) | spread_bits(y) << 1 | spread_bits(z) << 2) * BRICKS_PER_BLOCK
            codes[num_bricks] = code + part
            num_bricks += 1
    return num_bricks
