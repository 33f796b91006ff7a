"""One iteration of a consensus rule, and the sum of evidence, brick by brick.

The inner loops run over the contiguous values of one brick, so that they compile to vector instructions. Only integers
are reduced over vector lanes: the order of a floating-point sum changes the result.

In shapes, R is the number of robots, n of bricks, C of classes, and W = ceil(C / 8) of mask words. Values are float32
log-odds relative to the prior.
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
    max_octet,
    prefetch_line,
    same_bits,
)
from octoreplay.mapping.kernels.storage import (
    BRICK_CELLS,
    OCTETS,
    ROW_BYTES,
    load_brick,
    octets_of,
    ones_below,
    prune_brick,
)

GRADIENT, NATURAL, MIX, ADD, MERGE, COPY, WEIGHTED = 0, 1, 2, 3, 4, 5, 6
"""Updates; octoreplay.mapping.consensus.team_step gives their equations."""


@inline_kernel
def exp_negative(x):
    """exp(x) of a float32 ``x`` <= 0 as 2^n times a minimax polynomial: relative error 5e-7, 5e-38 below x = -86."""
    bounded = max(x, np.float32(-86.0))
    # Adding 1.5 x 2^23 rounds to an integer, which is then in the lowest bits.
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
    """Prefetch the block of brick ``n`` in ``column`` of ``table``: the order of bricks differs between octrees."""
    if table.addresses[column, n] != 0:
        # Most maps have one mask word, so the first one is outside the loop.
        rows = count_ones(octets_of(table.known[column, n])) + count_ones(table.masks[column, n, 0])
        for w in range(1, table.masks.shape[2]):
            rows += count_ones(table.masks[column, n, w])
        for offset in range(0, rows * ROW_BYTES, 64):
            prefetch_line(table.addresses[column, n] + offset)


@inline_kernel
def rows_at(table, n, column, layout, known, m, scratch_at, num_classes):
    """Return the address of a brick's rows in another layout: its own block if that has the layout, else a copy.

    - ``table``, ``n``, ``column``: the brick is row ``n`` of the table's ``column``.
    - ``layout`` (k, W) uint64, ``known`` (k,) uint64, ``m``: the layout has class rows ``layout[m]`` and known cells
      ``known[m]``.
    - ``scratch_at``: address of the copy, with room for (C + 1) x 64 float32.
    - ``num_classes``: C.
    """
    place = table.addresses[column, n]
    other = np.uint64(place == 0) | (table.masks[column, n, 0] ^ layout[m, 0])
    other |= octets_of(table.known[column, n]) ^ octets_of(known[m])
    for w in range(1, layout.shape[1]):
        other |= table.masks[column, n, w] ^ layout[m, w]
    if other != 0:
        load_brick(scratch_at, table, n, column, layout, known, m, num_classes)
        place = scratch_at
    return place


OWN, BASE, EVIDENCE, LAST_EVIDENCE, FIRST_NEIGHBOUR = 0, 1, 2, 3, 4
"""Order of a robot's columns in the table: its own map, its published map (the base of the differences), its evidence
log q, its evidence at the last iteration, then its neighbours' maps."""

NUM_SCRATCH_BLOCKS = 5
"""Scratch blocks of a step: the mixed map, its difference to the evidence, and three for the gradient."""


PREFETCH_AHEAD = 4
"""Number of bricks between the prefetched one and the current one: a few microseconds."""


@kernel
def _add_gradient(mixed_at, delta_at, scratch_at, room, octets, num_shared, rows, num_classes, gamma):
    """Add gamma x the gradient to the mixed map h~.

    A shared row counts once for each class of its octet that has no class row.

    - ``mixed_at``: address of h~ (rows, 8), in place.
    - ``delta_at``: address of h~ - log q (rows, 8).
    - ``scratch_at``: address of three arrays of ``room`` bytes and three of 64 float32.
    - ``room``: bytes of a block with all rows.
    - ``octets`` (rows,) int64: shared row of each class row's octet.
    - ``num_shared``, ``rows``: number of shared rows, and of all rows.
    - ``num_classes``: C.
    - ``gamma``: float32.
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
        max_octet(spread_at + octets[r] * ROW_BYTES, mixed_at + r * ROW_BYTES)
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
    """Write the shared row of each class row's octet; returns the numbers of shared rows and of all rows.

    - ``layout`` (k, W) uint64, ``known`` (k,) uint64, ``m``: the block has class rows ``layout[m]`` and known cells
      ``known[m]``.
    - ``octets`` (rows,) int64: output; the entries of shared rows are not set.
    """
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
    """Add weight x (map - base) of three maps to the mixed map, all (size,) float32.

    - ``mixed_at``, ``base_at``: addresses of the mixed map, in place, and of the base.
    - ``a_at``, ``b_at``, ``c_at``: addresses of the maps.
    - ``a_weight``, ``b_weight``, ``c_weight``: float32.
    - ``size``: number of values.
    """
    mixed, base = float_array(mixed_at, (size,)), float_array(base_at, (size,))
    a, b, c = float_array(a_at, (size,)), float_array(b_at, (size,)), float_array(c_at, (size,))
    for i in range(size):
        term = fma(a[i] - base[i], a_weight, mixed[i])
        term = fma(b[i] - base[i], b_weight, term)
        mixed[i] = fma(c[i] - base[i], c_weight, term)


@kernel
def _largest_over_classes(values_at, terms_at, octets, num_shared, rows, num_classes):
    """Write the largest value over all classes of each cell into the shared rows of non-negative values.

    - ``values_at``: address of the values (rows, 8), in place; class rows are kept.
    - ``terms_at``: address of 64 float32, output: number of classes of each shared row's cells without a class row.
    - ``octets``, ``num_shared``, ``rows``, ``num_classes``: as for ``_add_gradient``.
    """
    shared_size = num_shared * OCTETS
    values, terms = float_array(values_at, (shared_size,)), float_array(terms_at, (shared_size,))
    for i in range(shared_size):
        terms[i] = np.float32(num_classes)
    for r in range(num_shared, rows):
        for k in range(OCTETS):
            terms[octets[r] * OCTETS + k] -= np.float32(1.0)
    for i in range(shared_size):
        # Where every class has a row of its own, the shared row stands for none.
        values[i] = values[i] if terms[i] > np.float32(0.0) else np.float32(0.0)
    for r in range(num_shared, rows):
        max_octet(values_at + octets[r] * ROW_BYTES, values_at + r * ROW_BYTES)


@kernel
def _write_certainties(certainty_at, map_at, terms_at, octets, num_shared, rows, num_classes):
    """Write each cell's largest |log-odds| over the classes into all its rows.

    - ``certainty_at``, ``map_at``: addresses of the output and the map (rows, 8).
    - ``terms_at``, ``octets``, ``num_shared``, ``rows``, ``num_classes``: as for ``_largest_over_classes``.
    """
    size = rows * OCTETS
    certainty, values = float_array(certainty_at, (size,)), float_array(map_at, (size,))
    for i in range(size):
        certainty[i] = abs(values[i])
    _largest_over_classes(certainty_at, terms_at, octets, num_shared, rows, num_classes)
    for r in range(num_shared, rows):
        copy_octet(certainty_at + r * ROW_BYTES, certainty_at + octets[r] * ROW_BYTES)


@kernel
def _add_weighted(mixed_at, base_at, map_at, own_certainty_at, certainty_at, weight, size):
    """Add weight x c_map / (c_base + c_map) x (map - base) to the mixed map, all (size,) float32.

    - ``mixed_at``, ``base_at``, ``map_at``: addresses of the mixed map, in place, the base and the map.
    - ``own_certainty_at``, ``certainty_at``: addresses of the certainties of the base and of the map.
    - ``weight``: float32.
    - ``size``: number of values.
    """
    mixed, base, other = float_array(mixed_at, (size,)), float_array(base_at, (size,)), float_array(map_at, (size,))
    own_certainty, certainty = float_array(own_certainty_at, (size,)), float_array(certainty_at, (size,))
    for i in range(size):
        # Where both are 0, so are both maps.
        total = max(own_certainty[i] + certainty[i], np.float32(1e-30))
        mixed[i] += weight * (certainty[i] / total) * (other[i] - base[i])


@kernel
def _is_at_rest(base_at, map_at, scratch_at, spare_at, terms_at, octets, num_shared, rows, room, gate):
    """Return True where the gate holds a link's flow back in all cells of a brick.

    A cell is at rest where the same classes, all that tie, have the largest log-odds in both maps, counting free space
    with 0, and no class differs by ``gate`` x m or more.

    - ``base_at``, ``map_at``: addresses of the maps of both ends, as published (rows, 8).
    - ``scratch_at``: address of three blocks of ``room`` bytes; the first holds m of the cells, and is kept.
    - ``spare_at``: address of one more block.
    - ``terms_at``: address of the number of classes of the shared rows, 64 float32.
    - ``octets``, ``num_shared``, ``rows``, ``room``: as for ``_add_gradient``.
    - ``gate``: float32 above 0.
    """
    size, shared_size = rows * OCTETS, num_shared * OCTETS
    base, other, largest = float_array(base_at, (size,)), float_array(map_at, (size,)), float_array(scratch_at, (size,))
    change_at, base_best_at, other_best_at = scratch_at + room, scratch_at + 2 * room, spare_at
    change, base_best = float_array(change_at, (size,)), float_array(base_best_at, (size,))
    other_best, terms = float_array(other_best_at, (size,)), float_array(terms_at, (shared_size,))
    zero = np.float32(0.0)
    for i in range(size):
        change[i] = abs(other[i] - base[i])
        base_best[i] = max(base[i], zero)
        other_best[i] = max(other[i], zero)
    for i in range(shared_size):
        # Where every class has a row of its own, the shared row stands for none.
        has_classes = terms[i] > zero
        change[i] = change[i] if has_classes else zero
        base_best[i] = base_best[i] if has_classes else zero
        other_best[i] = other_best[i] if has_classes else zero
    for r in range(num_shared, rows):
        max_octet(change_at + octets[r] * ROW_BYTES, change_at + r * ROW_BYTES)
        max_octet(base_best_at + octets[r] * ROW_BYTES, base_best_at + r * ROW_BYTES)
        max_octet(other_best_at + octets[r] * ROW_BYTES, other_best_at + r * ROW_BYTES)
    is_open = np.int32(0)
    for i in range(shared_size):
        is_open |= np.int32(change[i] > zero) & np.int32(change[i] >= gate * largest[i])
    if is_open != 0:
        return False
    for r in range(num_shared, rows):
        copy_octet(base_best_at + r * ROW_BYTES, base_best_at + octets[r] * ROW_BYTES)
        copy_octet(other_best_at + r * ROW_BYTES, other_best_at + octets[r] * ROW_BYTES)
    for i in range(shared_size):
        differs = np.int32(base[i] == base_best[i]) ^ np.int32(other[i] == other_best[i])
        of_free = np.int32(base_best[i] == zero) ^ np.int32(other_best[i] == zero)
        is_open |= of_free | (differs if terms[i] > zero else np.int32(0))
    for i in range(shared_size, size):
        is_open |= np.int32(base[i] == base_best[i]) ^ np.int32(other[i] == other_best[i])
    return is_open == 0


@kernel
def _add_flows(
    mixed_at, base_at, map_at, scratch_at, spare_at, terms_at, octets, num_shared, rows, room, num_classes, weight,
    share, gate, quantum,
):  # fmt: skip
    """Add the flow of one link to the mixed map: e trunc(weight (map - base) / e), or 0 in a brick at rest.

    The step e of a cell is the largest power of two that is not above m, times ``share``, and at least the quantum; m
    is the cell's largest |log-odds| in either map. Both ends of a link find the same amount with opposite signs,
    because float32 differences, products with the same weight and truncation are odd functions.

    - ``mixed_at``: address of the mixed map (rows, 8), in place.
    - ``base_at``, ``map_at``: addresses of the maps of both ends, as published (rows, 8).
    - ``scratch_at``, ``spare_at``: addresses of three blocks of ``room`` bytes and of one more.
    - ``terms_at``: address of 64 float32.
    - ``octets``, ``num_shared``, ``rows``, ``room``, ``num_classes``: as for ``_add_gradient``.
    - ``weight``, ``share``, ``gate``, ``quantum``: float32; ``share`` is a power of two, ``gate`` 0 holds nothing back.
    """
    size, shared_size = rows * OCTETS, num_shared * OCTETS
    mixed, base, other = float_array(mixed_at, (size,)), float_array(base_at, (size,)), float_array(map_at, (size,))
    steps = float_array(scratch_at, (size,))
    for i in range(size):
        steps[i] = max(abs(base[i]), abs(other[i]))
    _largest_over_classes(scratch_at, terms_at, octets, num_shared, rows, num_classes)
    if gate > np.float32(0.0) and _is_at_rest(
        base_at, map_at, scratch_at, spare_at, terms_at, octets, num_shared, rows, room, gate
    ):
        return
    for i in range(shared_size):
        # Without its mantissa a float is the largest power of two that is not above it.
        power = same_bits(np.int32(same_bits(steps[i]) & np.int32(0x7F800000)))
        steps[i] = max(power * share, quantum)
    for r in range(num_shared, rows):
        copy_octet(scratch_at + r * ROW_BYTES, scratch_at + octets[r] * ROW_BYTES)
    for i in range(size):
        mixed[i] += steps[i] * np.trunc(weight * (other[i] - base[i]) / steps[i])


@kernel
def team_step(
    start, end, table, columns, first_columns, weights, flow_weights, flow_shares, flow_gates, has_plain, quantum,
    gammas, update, num_classes, clamp_min, clamp_max, layouts, known, needs_update, scratch, int_scratch, changes,
    is_even,
):  # fmt: skip
    """One iteration of R robots, in place in their own maps.

    Loop invariant: all robots' bricks before ``b`` are updated and none from ``b`` on. A step at brick ``b`` reads
    columns of brick ``b`` only, and no robot's own map is a column of another robot, so the order of bricks and robots
    does not matter.

    The layout of an own brick includes the known cells and class rows of all the robot's columns, and an own brick is
    one value only where all these columns are. Where an own brick is one value, its new value is written to ``table``.

    - ``start``, ``end``: bricks of the table to update, ``end`` excluded.
    - ``table``: BrickTable of all maps, (J, n).
    - ``columns`` int64: columns of the table, robot by robot: OWN, BASE, EVIDENCE, LAST_EVIDENCE, then its neighbours'.
    - ``first_columns`` (R + 1,) int64: robot r has the entries ``first_columns[r]`` to ``first_columns[r + 1]``.
    - ``weights`` float32: 2 epsilon A_ij at the entries of neighbours without flows, parallel to ``columns``.
    - ``flow_weights`` float32: 2 epsilon A_ij at the entries of neighbours with flows, parallel to ``columns``.
    - ``flow_shares`` float32: step of a flow divided by the cell's largest power of two, parallel to ``columns``.
    - ``flow_gates`` (R,) float32: least difference of a moving cell, relative to its largest |log-odds|; 0 for none.
    - ``has_plain`` (R,) bool: True where any of a robot's ``weights`` is not 0.
    - ``quantum``: float32, least step of flows, and grid of the new values of GRADIENT, NATURAL and
      WEIGHTED; 0 for none.
    - ``gammas`` (R,) float32: gradient step sizes.
    - ``update``: GRADIENT, NATURAL, MIX, ADD, MERGE, COPY or WEIGHTED.
    - ``num_classes``: C.
    - ``clamp_min``, ``clamp_max``: float32, limits of the log-odds, used by MERGE alone.
    - ``layouts`` (R n, W) uint64, ``known`` (R n,) uint64: class rows and known cells of the own bricks.
    - ``needs_update`` (R, n) bool: the other bricks are skipped.
    - ``scratch`` float32: room for NUM_SCRATCH_BLOCKS blocks with all rows, one more for each of a robot's columns, and
      3 x 64 values.
    - ``int_scratch`` (2, k) int64: k at least the number of rows of a block and of a robot's columns.
    - ``changes`` (R, n) float32: output, largest absolute change of a log-odds in each brick.
    - ``is_even`` (R, n) bool: output, True where a changed brick's values are all equal.
    """
    robots = gammas.size
    room = (num_classes + 1) * BRICK_CELLS * 4
    mixed_at = np.int64(scratch.ctypes.data)
    delta_at, gradient_at = mixed_at + room, mixed_at + 2 * room
    terms_at = mixed_at + NUM_SCRATCH_BLOCKS * room
    spare_at = terms_at + 3 * BRICK_CELLS * 4
    # Where a map is 0 there is no power of two.
    least_step = max(quantum, np.float32(1e-30))
    octets, places = int_scratch[0], int_scratch[1]
    for b in range(start, end):
        for column in range(table.addresses.shape[0]):
            prefetch(table, min(b + PREFETCH_AHEAD, end - 1), column)
        for robot in range(robots):
            if not needs_update[robot, b]:
                continue
            m = robot * needs_update.shape[1] + b
            num_shared, rows = _row_octets(layouts, known, m, octets)
            size = rows * OCTETS
            first = first_columns[robot]
            num_columns = first_columns[robot + 1] - first
            for k in range(num_columns):
                if k == LAST_EVIDENCE and update != ADD and update != MERGE:
                    continue
                places[k] = rows_at(table, b, columns[first + k], layouts, known, m, spare_at + k * room, num_classes)
            own_at, base_at = places[OWN], places[BASE]
            own = float_array(own_at, (size,))
            mixed = float_array(mixed_at, (size,))
            delta = float_array(delta_at, (size,))
            # The differences are summed before the own value is added: the sum is exactly 0 where all maps agree.
            for i in range(size):
                mixed[i] = np.float32(0.0)
            for k in range(FIRST_NEIGHBOUR, num_columns):
                if flow_weights[first + k] != np.float32(0.0):
                    _add_flows(
                        mixed_at, base_at, places[k], gradient_at, delta_at, terms_at, octets, num_shared, rows, room,
                        num_classes, flow_weights[first + k], flow_shares[first + k], flow_gates[robot], least_step,
                    )  # fmt: skip
            if update == WEIGHTED:
                _write_certainties(delta_at, base_at, terms_at, octets, num_shared, rows, num_classes)
                for k in range(FIRST_NEIGHBOUR, num_columns):
                    _write_certainties(gradient_at, places[k], terms_at, octets, num_shared, rows, num_classes)
                    _add_weighted(mixed_at, base_at, places[k], delta_at, gradient_at, weights[first + k], size)
            is_plain = has_plain[robot] and update != WEIGHTED
            for k in range(FIRST_NEIGHBOUR, num_columns if is_plain else 0, 3):
                b_at, b_weight, c_at, c_weight = base_at, np.float32(0.0), base_at, np.float32(0.0)
                if k + 1 < num_columns:
                    b_at, b_weight = places[k + 1], weights[first + k + 1]
                if k + 2 < num_columns:
                    c_at, c_weight = places[k + 2], weights[first + k + 2]
                _add_differences(mixed_at, base_at, places[k], b_at, c_at, weights[first + k], b_weight, c_weight, size)
            evidence = float_array(places[EVIDENCE], (size,))
            if update == COPY:
                for i in range(size):
                    mixed[i] = evidence[i]
            elif update in (MIX, WEIGHTED):
                for i in range(size):
                    mixed[i] += own[i]
            elif update in (ADD, MERGE):
                old = float_array(places[LAST_EVIDENCE], (size,))
                for i in range(size):
                    mixed[i] += own[i] + (evidence[i] - old[i])
                if update == MERGE:
                    for i in range(size):
                        mixed[i] = min(max(mixed[i], clamp_min), clamp_max)
            else:
                for i in range(size):
                    mixed[i] += own[i]
                    delta[i] = mixed[i] - evidence[i]
                if update == NATURAL:
                    for i in range(size):
                        mixed[i] -= gammas[robot] * delta[i]
                elif gammas[robot] != np.float32(0.0):
                    _add_gradient(
                        mixed_at, delta_at, gradient_at, room, octets, num_shared, rows, num_classes, gammas[robot]
                    )
            if update in (GRADIENT, NATURAL, WEIGHTED) and quantum > np.float32(0.0):
                for i in range(size):
                    mixed[i] = np.rint(mixed[i] / quantum) * quantum
            # The bits of non-negative floats have the order of the floats.
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
    """Set values and revisions of changed bricks and prune them; returns the largest change.

    Only bricks that are even, or that got new known cells, can be pruned.

    - ``bricks``: Bricks, in place.
    - ``indices`` (n,) int64: brick indices; -1 is skipped.
    - ``table``, ``column``: BrickTable and the octree's column, with the new values of bricks without a block.
    - ``changes`` (n,) float32: largest change of a log-odds in each brick.
    - ``is_even`` (n,) bool: True where all values of a brick are equal.
    - ``known_changed`` (n,) bool: True where cells became known.
    - ``revision``: revision of the changed bricks.
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
            prune_brick(bricks, index)
    return largest


@kernel
def join_columns(table, columns, needs_update, known, has_block, layout):
    """Join the layouts of several columns of a table; outputs are combined with what the arrays hold.

    - ``table``: BrickTable, (J, n).
    - ``columns`` (k,) int64: columns to join.
    - ``needs_update`` (n,) bool: set to True where a brick changed in any column, to False where no cell is known.
    - ``known`` (n,) uint64: cells known in any column.
    - ``has_block`` (n,) bool: True where the brick has a block in any column.
    - ``layout`` (n, W) uint64: class rows of any column.
    """
    for column in columns:
        for b in range(known.size):
            needs_update[b] |= table.is_changed[column, b]
            known[b] |= table.known[column, b]
            has_block[b] |= table.addresses[column, b] != 0
        for w in range(layout.shape[1]):
            for b in range(known.size):
                layout[b, w] |= table.masks[column, b, w]
    for b in range(known.size):
        needs_update[b] &= known[b] != 0


@kernel
def sum_evidence(bricks, indices, table, layout, known, counts, scales, num_classes, scratch, octets, no_rows):
    """Write the sum over N robots of log q into bricks.

    log q of robot i is its evidence x ``scales[i]``, divided by each cell's number of scans where ``counts`` has
    columns.

    - ``bricks``: Bricks of the target, in place.
    - ``indices`` (n,) int64: brick indices of the target; -1 is skipped.
    - ``table``: BrickTable of the robots' evidence, (N, n).
    - ``layout`` (n, W) uint64, ``known`` (n,) uint64: class rows and known cells of the target's bricks.
    - ``counts``: BrickTable of the robots' scan counts, (N, n), or (0, n) for none.
    - ``scales`` (N,) float32: factor of each robot's evidence.
    - ``num_classes``: C.
    - ``scratch`` float32: room for 3 blocks with all rows.
    - ``octets`` int64: room for one number for each row of a block.
    - ``no_rows`` (n, 1) uint64: empty masks.
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
            load_brick(term_at, table, b, r, layout, known, b, num_classes)
            if counts.addresses.shape[0] > 0:
                load_brick(count_at, counts, b, r, no_rows, known, b, 1)
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
