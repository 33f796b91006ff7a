"""One iteration of a consensus rule, and the sum of evidence, brick by brick.

The loops run over whole bricks that lie in one piece, so that they become vector instructions. Only integers are
reduced over lanes: the order of a floating point sum is part of the result.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import (
    add_octet,
    copy_octet,
    count_ones,
    float_array,
    fma,
    lowest_one,
    prefetch_line,
    raise_octet,
    same_bits,
)
from octoreplay.mapping.kernels.storage import BRICK_CELLS, OCTETS, ROW_BYTES, collapse, load, octets_of, ones_below

GRADIENT, NATURAL, BAYES, MERGE, LOCAL = 0, 1, 2, 3, 4


@inline_kernel
def exp_negative(x):
    """Exp of a float32 that is at most 0, within a relative 5e-7; 5e-38 below -86. 2^n times a minimax polynomial."""
    bounded = max(x, np.float32(-86.0))
    # Adding 1.5 x 2^23 rounds to an integer, which then stands in the lowest bits.
    shifted = fma(bounded, np.float32(1.44269504088896341), np.float32(12582912.0))
    f = fma(shifted - np.float32(12582912.0), np.float32(-0.69314718056), bounded)
    p = fma(np.float32(0.008312521), f, np.float32(0.041890156))
    p = fma(p, f, np.float32(0.16667114))
    p = fma(p, f, np.float32(0.4999923))
    p = fma(p, f, np.float32(1.0))
    p = fma(p, f, np.float32(1.0))
    return same_bits(same_bits(p) + (same_bits(shifted) << np.int32(23)))


@inline_kernel
def prefetch(table, n, column):
    """Ask for a brick's block ahead of its use: bricks lie in another order in every octree."""
    if table.addresses[column, n] != 0:
        # Most maps have one word to a mask.
        rows = count_ones(octets_of(table.known[column, n])) + count_ones(table.masks[column, n, 0])
        for w in range(1, table.masks.shape[2]):
            rows += count_ones(table.masks[column, n, w])
        for offset in range(0, rows * ROW_BYTES, 64):
            prefetch_line(table.addresses[column, n] + offset)


@inline_kernel
def rows_at(table, n, column, layout, known, m, scratch_at, num_classes):
    """Where a brick's values lie with the rows for ``known[m]`` and ``layout[m]``: in its block, or ``scratch_at``."""
    place = table.addresses[column, n]
    other = np.uint64(place == 0) | (table.masks[column, n, 0] ^ layout[m, 0])
    other |= octets_of(table.known[column, n]) ^ octets_of(known[m])
    for w in range(1, layout.shape[1]):
        other |= table.masks[column, n, w] ^ layout[m, w]
    if other != 0:
        load(scratch_at, table, n, column, layout, known, m, num_classes)
        place = scratch_at
    return place


OWN, BASE, EVIDENCE, OLD_EVIDENCE, FIRST_NEIGHBOUR = 0, 1, 2, 3, 4
"""A robot's columns of the table: its own map, the map that it published (the base of the differences), its evidence
log q, its evidence at the last iteration, then its neighbours' maps."""

NUM_SCRATCH_BLOCKS = 5
"""Blocks that a step works in: the mixed map, its distance to the evidence, and three for the gradient."""


PREFETCH_AHEAD = 4
"""Bricks between the one that is asked for and the one in work: a few microseconds."""


@kernel
def _add_gradient(mixed_at, delta_at, scratch_at, room, octets, num_shared, rows, num_classes, gamma):
    """Mixed (rows, 8) += gamma x the gradient, with ``delta`` (rows, 8) = h~ - log q; all given by address.

    The shared rows stand for all the classes of their octet that have no row; ``octets`` (rows,) are the shared rows of
    the others' octets. ``scratch_at`` has place for three arrays of ``room`` bytes and three of a brick's cells.
    """
    size, shared_size = rows * OCTETS, num_shared * OCTETS
    mixed, delta = float_array(mixed_at, (size,)), float_array(delta_at, (size,))
    sigma_at, spread_at, other_at = scratch_at, scratch_at + room, scratch_at + 2 * room
    sigma, spread = float_array(sigma_at, (size,)), float_array(spread_at, (size,))
    other = float_array(other_at, (size,))
    terms_at = scratch_at + 3 * room
    total_at, dot_at = terms_at + BRICK_CELLS * 4, terms_at + BRICK_CELLS * 8
    terms = float_array(terms_at, (shared_size,))
    total, dot = float_array(total_at, (shared_size,)), float_array(dot_at, (shared_size,))
    for i in range(shared_size):
        terms[i] = np.float32(num_classes)
        spread[i] = max(mixed[i], np.float32(0.0))
    for r in range(num_shared, rows):
        first = octets[r] * OCTETS
        for k in range(OCTETS):
            terms[first + k] -= np.float32(1.0)
        raise_octet(spread_at + octets[r] * ROW_BYTES, mixed_at + r * ROW_BYTES)
    for r in range(num_shared, rows):
        copy_octet(spread_at + r * ROW_BYTES, spread_at + octets[r] * ROW_BYTES)
    for i in range(size):
        share = exp_negative(mixed[i] - spread[i])
        sigma[i] = share
        other[i] = share * delta[i]
    for i in range(shared_size):
        total[i] = terms[i] * sigma[i]
        dot[i] = terms[i] * other[i]
    for r in range(num_shared, rows):
        add_octet(total_at + octets[r] * ROW_BYTES, sigma_at + r * ROW_BYTES)
        add_octet(dot_at + octets[r] * ROW_BYTES, other_at + r * ROW_BYTES)
    for i in range(shared_size):
        share = np.float32(1.0) / (total[i] + exp_negative(-spread[i]))
        spread[i] = gamma * share
        other[i] = dot[i] * share
    for r in range(num_shared, rows):
        copy_octet(spread_at + r * ROW_BYTES, spread_at + octets[r] * ROW_BYTES)
        copy_octet(other_at + r * ROW_BYTES, other_at + octets[r] * ROW_BYTES)
    for i in range(size):
        mixed[i] = fma(sigma[i] * spread[i], other[i] - delta[i], mixed[i])


@kernel
def _row_octets(layout, known, m, octets):
    """The shared row of the octet of each row of a single class; returns the number of shared rows and of all rows."""
    present = octets_of(known[m])
    num_shared = count_ones(present)
    rows = num_shared
    for w in range(layout.shape[1]):
        bits = layout[m, w]
        while bits:
            octets[rows] = ones_below(present, lowest_one(bits) & 56)
            rows += 1
            bits &= bits - np.uint64(1)
    return num_shared, rows


@kernel
def _add_differences(mixed_at, base_at, a_at, b_at, c_at, a_weight, b_weight, c_weight, size):
    """Mixed (size,) += the sum of weight x (source - base) of three sources; all given by address."""
    mixed, base = float_array(mixed_at, (size,)), float_array(base_at, (size,))
    a, b, c = float_array(a_at, (size,)), float_array(b_at, (size,)), float_array(c_at, (size,))
    for i in range(size):
        term = fma(a[i] - base[i], a_weight, mixed[i])
        term = fma(b[i] - base[i], b_weight, term)
        mixed[i] = fma(c[i] - base[i], c_weight, term)


@kernel
def team_step(
    start, end, table, columns, first_columns, weights, gammas, rule, num_classes, clamp_min, clamp_max, layouts, known,
    is_awake, scratch, int_scratch, changes, is_even,
):  # fmt: skip
    """One iteration of a rule at R robots, brick by brick for all of them, in place in their own maps.

    ``table`` says where the bricks ``start`` to ``end`` of all maps lie. Robot r's ``columns`` of it are those from
    ``first_columns[r]`` to ``first_columns[r + 1]``: OWN, BASE, EVIDENCE, OLD_EVIDENCE, then its neighbours', with
    their ``weights`` 2 epsilon A_ij at the same places. ``layouts`` (R n, W) and ``known`` (R n,) are the masks and the
    known cells of the own bricks, which hold those of all the robot's columns; an own brick is one value only where all
    others are. Only bricks that are awake (R, n) are worked on. ``changes`` (R, n) get their largest changes,
    ``is_even`` (R, n) where all values are equal then; what is one value is left in the table. Rule MERGE clamps.

    ``scratch`` float32 has room for NUM_SCRATCH_BLOCKS blocks with every row, one more for each of a robot's columns,
    and 3 x 64 values; ``int_scratch`` int64 for two numbers for each row of a block and each of a robot's columns.
    """
    robots = gammas.size
    room = (num_classes + 1) * BRICK_CELLS * 4
    mixed_at = np.int64(scratch.ctypes.data)
    delta_at, gradient_at = mixed_at + room, mixed_at + 2 * room
    spare_at = mixed_at + NUM_SCRATCH_BLOCKS * room + 3 * BRICK_CELLS * 4
    octets, places = int_scratch[0], int_scratch[1]
    for b in range(start, end):
        for column in range(table.addresses.shape[0]):
            prefetch(table, min(b + PREFETCH_AHEAD, end - 1), column)
        for robot in range(robots):
            if not is_awake[robot, b]:
                continue
            m = robot * is_awake.shape[1] + b
            num_shared, rows = _row_octets(layouts, known, m, octets)
            size = rows * OCTETS
            first = first_columns[robot]
            num_columns = first_columns[robot + 1] - first
            for k in range(num_columns):
                if k == OLD_EVIDENCE and rule != BAYES and rule != MERGE:
                    continue
                places[k] = rows_at(table, b, columns[first + k], layouts, known, m, spare_at + k * room, num_classes)
            own_at, base_at = places[OWN], places[BASE]
            own = float_array(own_at, (size,))
            mixed = float_array(mixed_at, (size,))
            delta = float_array(delta_at, (size,))
            # The sum of the differences comes first: it is exactly 0 where all maps agree.
            for i in range(size):
                mixed[i] = np.float32(0.0)
            for k in range(FIRST_NEIGHBOUR, num_columns, 3):
                b_at, b_weight, c_at, c_weight = base_at, np.float32(0.0), base_at, np.float32(0.0)
                if k + 1 < num_columns:
                    b_at, b_weight = places[k + 1], weights[first + k + 1]
                if k + 2 < num_columns:
                    c_at, c_weight = places[k + 2], weights[first + k + 2]
                _add_differences(mixed_at, base_at, places[k], b_at, c_at, weights[first + k], b_weight, c_weight, size)
            evidence = float_array(places[EVIDENCE], (size,))
            if rule == LOCAL:
                for i in range(size):
                    mixed[i] = evidence[i]
            elif rule in (BAYES, MERGE):
                old = float_array(places[OLD_EVIDENCE], (size,))
                for i in range(size):
                    mixed[i] += own[i] + (evidence[i] - old[i])
                if rule == MERGE:
                    for i in range(size):
                        mixed[i] = min(max(mixed[i], clamp_min), clamp_max)
            else:
                for i in range(size):
                    mixed[i] += own[i]
                    delta[i] = mixed[i] - evidence[i]
                if rule == NATURAL:
                    for i in range(size):
                        mixed[i] -= gammas[robot] * delta[i]
                elif gammas[robot] != np.float32(0.0):
                    _add_gradient(
                        mixed_at, delta_at, gradient_at, room, octets, num_shared, rows, num_classes, gammas[robot]
                    )
            # Numbers that are not negative are in the order of their bits.
            largest = np.int32(0)
            for i in range(size):
                largest = max(largest, same_bits(abs(mixed[i] - own[i])))
            changes[robot, b] = same_bits(largest)
            if largest > 0:
                column = columns[first + OWN]
                table.values[column, b] = mixed[0]
                different = np.int32(0)
                for i in range(size):
                    different = np.int32(different | np.int32(mixed[i] != mixed[0]))
                is_even[robot, b] = different == 0
                if table.addresses[column, b] != 0:
                    for i in range(size):
                        own[i] = mixed[i]


@kernel
def finish_step(bricks, indices, table, column, changes, is_even, known_changed, revision):
    """Store what is one value, set the revision of the bricks ``indices`` (n,) that changed, and prune them.

    Only those that are even, or whose known cells were added (``known_changed``), can have become one value. Returns
    the largest of the ``changes`` (n,).
    """
    largest = np.float32(0.0)
    for b in range(indices.size):
        index = indices[b]
        if index < 0 or not (changes[b] > 0.0 or known_changed[b]):
            continue
        largest = max(largest, changes[b])
        bricks.revisions[index] = revision
        if bricks.blocks[index] < 0:
            bricks.values[index] = table.values[column, b]
        elif is_even[b] or known_changed[b]:
            collapse(bricks, index)
    return largest


@kernel
def join_columns(table, columns, is_awake, known, has_block, layout):
    """What a robot's bricks need to hold those of the ``columns``: known cells (n,), a block, and rows (n, W).

    All are joined to what the arrays hold. ``is_awake`` (n,) gains the bricks that changed, and loses those that have
    no known cell.
    """
    for column in columns:
        for b in range(known.size):
            is_awake[b] |= table.is_changed[column, b]
            known[b] |= table.known[column, b]
            has_block[b] |= table.addresses[column, b] != 0
        for w in range(layout.shape[1]):
            for b in range(known.size):
                layout[b, w] |= table.masks[column, b, w]
    for b in range(known.size):
        is_awake[b] &= known[b] != 0


@kernel
def sum_evidence(bricks, indices, table, layout, known, counts, scales, num_classes, scratch, octets, no_rows):
    """The sum over robots of log q, written to the bricks ``indices`` (n,), whose masks are ``layout`` (n, W).

    ``known`` (n,) are their known cells; index -1 is left out. ``table`` says where the robots' evidence lies. It is
    divided by each cell's scans where the table ``counts`` has columns, and otherwise multiplied by ``scales`` (N,).
    ``scratch`` float32 has room for 3 blocks with every row, ``octets`` int64 for a number for each row of a block, and
    ``no_rows`` (n, 1) are empty masks.
    """
    term_at = np.int64(scratch.ctypes.data)
    room = (num_classes + 1) * BRICK_CELLS * 4
    count_at, total_at = term_at + room, term_at + 2 * room
    for b in range(indices.size):
        index = indices[b]
        if index < 0:
            continue
        num_shared, rows = _row_octets(layout, known, b, octets)
        size = rows * OCTETS
        term = float_array(term_at, (size,))
        count = float_array(count_at, (size,))
        total = float_array(total_at, (size,))
        for i in range(size):
            total[i] = np.float32(0.0)
            count[i] = np.float32(1.0)
        for r in range(table.addresses.shape[0]):
            load(term_at, table, b, r, layout, known, b, num_classes)
            if counts.addresses.shape[0] > 0:
                load(count_at, counts, b, r, no_rows, known, b, 1)
                for own in range(num_shared, rows):
                    copy_octet(count_at + own * ROW_BYTES, count_at + octets[own] * ROW_BYTES)
            for i in range(size):
                total[i] += term[i] * scales[r] / max(count[i], np.float32(1.0))
        block = np.int64(bricks.blocks[index])
        if block < 0:
            bricks.values[index] = total[0]
        else:
            for row in range(rows):
                copy_octet(np.int64(bricks.rows.ctypes.data) + (block + row) * ROW_BYTES, total_at + row * ROW_BYTES)
