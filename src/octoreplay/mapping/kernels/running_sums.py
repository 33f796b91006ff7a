"""Ratio consensus with running sums, brick by brick: what a robot gives, what it takes, and the map that follows.

Masses and their running sums are integers modulo 2^30 that stand in the place of an octree's float32 values, as their
bits: 0 to 2^30 - 1 are the non-negative floats below 2, so none is a NaN or -0. Many are denormal; they are moved as
floats and computed with as integers only.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.consensus import prefetch, rows_at
from octoreplay.mapping.kernels.intrinsics import float_array, same_bits
from octoreplay.mapping.kernels.storage import BRICK_CELLS, OCTETS, num_rows

NUM_BITS = 30
MODULUS = 1 << NUM_BITS
LOW_BITS = np.int32(MODULUS - 1)
SIGN_SHIFT = np.int32(32 - NUM_BITS)
UNITS_PER_LOG_ODDS = np.float32(1 << 17)

TARGET, SOURCE = 0, 1
"""Columns of a table with two: the octree whose layout the other takes, and what it is made from."""

NUM_SCRATCH_BLOCKS = 3
"""Blocks that a kernel works in, one for each octree that may have another layout."""

PREFETCH_AHEAD = 4


@inline_kernel
def _signed(bits):
    """The number from -2^29 to 2^29 - 1 that equals ``bits`` modulo 2^30. Int32 must be said: numba widens sums."""
    return np.int32(np.int32(bits << SIGN_SHIFT) >> SIGN_SHIFT)


@inline_kernel
def _units(log_odds):
    """A float32 log-odds in units, rounded to nearest, ties to even."""
    return np.int32(np.rint(log_odds * UNITS_PER_LOG_ODDS))


@inline_kernel
def _integers(address, size):
    """The int32 array (size,) at an address."""
    return float_array(address, (size,)).view(np.int32)


@inline_kernel
def _prefetch_ahead(table, b, column):
    """Ask for a brick of an octree that comes soon."""
    prefetch(table, min(b + PREFETCH_AHEAD, table.known.shape[1] - 1), column)


@kernel
def _share_rows(mass_at, total_at, size, num_receivers):
    """Move the shares of so many receivers from a mass (size,), and one of them into the sum; the largest share."""
    mass, total = _integers(mass_at, size), _integers(total_at, size)
    # The float64 quotient of such small integers lies on the same side of each half as the exact one.
    parts, receivers = np.float64(num_receivers + 1), np.int32(num_receivers)
    largest = np.int32(0)
    for i in range(size):
        share = np.int32(np.rint(np.float64(_signed(mass[i])) / parts))
        largest = max(largest, np.int32(abs(share)))
        total[i] = np.int32(total[i] + share) & LOW_BITS
        mass[i] = np.int32(mass[i] - np.int32(receivers * share)) & LOW_BITS
    return largest


@kernel
def share_out(table, layout, known, num_receivers, num_classes, scratch, shares):
    """Move shares from a mass, the table's SOURCE, and add one to its running sum, the TARGET, both in place.

    ``layout`` (n, W) and ``known`` (n,) are the sum's, which hold the mass's. ``shares`` (n,) int32 get the largest
    |share| of each brick. What is one value is left in the table.
    """
    room = (num_classes + 1) * BRICK_CELLS * 4
    mass_scratch = np.int64(scratch.ctypes.data)
    total_scratch, unused_at = mass_scratch + room, mass_scratch + 2 * room
    for b in range(shares.size):
        _prefetch_ahead(table, b, SOURCE)
        _prefetch_ahead(table, b, TARGET)
        shares[b] = 0
        if known[b] == 0:
            continue
        size = num_rows(known[b], layout, b) * OCTETS
        mass_at = rows_at(table, b, SOURCE, layout, known, b, mass_scratch, num_classes)
        total_at = rows_at(table, b, TARGET, layout, known, b, total_scratch, num_classes)
        shares[b] = _share_rows(mass_at, total_at, size, num_receivers)
        if table.addresses[TARGET, b] == 0:
            table.values[TARGET, b] = float_array(total_at, (size,))[0]
        if table.addresses[SOURCE, b] == 0:
            table.values[SOURCE, b] = float_array(mass_at, (size,))[0]
        elif mass_at == mass_scratch:
            # The sum has other rows: what left the copy leaves the mass itself too.
            own_size = num_rows(table.known[SOURCE, b], table.masks[SOURCE], b) * OCTETS
            _share_rows(table.addresses[SOURCE, b], unused_at, own_size, num_receivers)


@kernel
def _add_rows(mass_at, new_at, old_at, size, of_evidence):
    """Mass (size,) += new - old, which are sums or else log-odds; whether any value differs."""
    mass, different = _integers(mass_at, size), np.int32(0)
    if of_evidence:
        now, last = float_array(new_at, (size,)), float_array(old_at, (size,))
        for i in range(size):
            step = np.int32(_units(now[i]) - _units(last[i])) & LOW_BITS
            different = np.int32(different | step)
            mass[i] = np.int32(mass[i] + step) & LOW_BITS
    else:
        new, old = _integers(new_at, size), _integers(old_at, size)
        for i in range(size):
            step = np.int32(new[i] - old[i]) & LOW_BITS
            different = np.int32(different | step)
            mass[i] = np.int32(mass[i] + step) & LOW_BITS
    return different != 0


@kernel
def add_differences(
    start, end, table, columns, first_columns, of_evidence, layouts, known, num_classes, scratch, is_changed
):
    """Add differences to the masses of R robots, brick by brick for all of them, in place.

    ``table`` says where the bricks ``start`` to ``end`` lie. Robot r's ``columns`` of it are those from
    ``first_columns[r]`` to ``first_columns[r + 1]``: its mass, then new, old, new, old, ..., which are running sums, or
    log-odds if ``of_evidence``. ``layouts`` (R n, W) and ``known`` (R n,) are those of the masses, which hold those of
    all the robot's columns. ``is_changed`` (R, n) float32 is 1 where a difference is not 0. What is one value is left
    in the table.
    """
    room = (num_classes + 1) * BRICK_CELLS * 4
    mass_scratch = np.int64(scratch.ctypes.data)
    new_scratch, old_scratch = mass_scratch + room, mass_scratch + 2 * room
    robots, bricks = is_changed.shape
    for b in range(start, end):
        for column in range(table.addresses.shape[0]):
            _prefetch_ahead(table, b, column)
        for robot in range(robots):
            m = robot * bricks + b
            is_changed[robot, b] = 0.0
            if known[m] == 0:
                continue
            size = num_rows(known[m], layouts, m) * OCTETS
            own = columns[first_columns[robot]]
            mass_at = rows_at(table, b, own, layouts, known, m, mass_scratch, num_classes)
            for k in range(first_columns[robot] + 1, first_columns[robot + 1], 2):
                new_at = rows_at(table, b, columns[k], layouts, known, m, new_scratch, num_classes)
                old_at = rows_at(table, b, columns[k + 1], layouts, known, m, old_scratch, num_classes)
                if _add_rows(mass_at, new_at, old_at, size, of_evidence):
                    is_changed[robot, b] = 1.0
            if table.addresses[own, b] == 0:
                table.values[own, b] = float_array(mass_at, (size,))[0]


@kernel
def recover(table, layout, known, scale, tolerance, num_classes, scratch, changes, is_even):
    """Write the mass in the table's SOURCE times ``scale`` into the map in its TARGET, if it differs by ``tolerance``.

    ``layout`` (n, W) and ``known`` (n,) are the map's, which hold the mass's. ``changes`` (n,) get the largest changes,
    ``is_even`` (n,) where all values are equal then. What is one value is left in the table.
    """
    room = (num_classes + 1) * BRICK_CELLS * 4
    map_scratch = np.int64(scratch.ctypes.data)
    for b in range(changes.size):
        _prefetch_ahead(table, b, SOURCE)
        _prefetch_ahead(table, b, TARGET)
        changes[b] = 0.0
        if known[b] == 0:
            continue
        size = num_rows(known[b], layout, b) * OCTETS
        mass = _integers(rows_at(table, b, SOURCE, layout, known, b, map_scratch + room, num_classes), size)
        values = float_array(rows_at(table, b, TARGET, layout, known, b, map_scratch, num_classes), (size,))
        # Numbers that are not negative are in the order of their bits.
        largest = np.int32(0)
        for i in range(size):
            value = np.float32(np.float64(_signed(mass[i])) * scale)
            change = abs(value - values[i])
            change = change if change > tolerance else np.float32(0.0)
            largest = max(largest, same_bits(change))
            values[i] = value if change > 0.0 else values[i]
        changes[b] = same_bits(largest)
        if largest > 0:
            table.values[TARGET, b] = values[0]
            different = np.int32(0)
            for i in range(size):
                different = np.int32(different | np.int32(values[i] != values[0]))
            is_even[b] = different == 0
