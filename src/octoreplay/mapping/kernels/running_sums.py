"""Ratio consensus with running sums, brick by brick: shares that are sent, differences that are received, maps.

Masses and running sums are integers modulo 2^30, stored as the bits of an octree's float32 values: 0 to 2^30 - 1 are
the bits of the non-negative floats below 2, so none is a NaN or -0. Many are denormal, so they are copied as floats and
computed with as integers only.

In shapes, R is the number of robots, n of bricks, C of classes, and W = ceil(C / 8) of mask words.
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
"""Columns of a table of two octrees: the one that has the layout, and the one that is brought into it."""

NUM_SCRATCH_BLOCKS = 3
"""Scratch blocks of a kernel, one for each octree that may have another layout."""

PREFETCH_AHEAD = 4
"""Number of bricks between the prefetched one and the current one."""


@inline_kernel
def _signed(bits):
    """Return the number from -2^29 to 2^29 - 1 that equals ``bits`` int32 modulo 2^30. Without casts numba widens."""
    return np.int32(np.int32(bits << SIGN_SHIFT) >> SIGN_SHIFT)


@inline_kernel
def _units(log_odds):
    """Return a float32 log-odds in units, rounded to nearest, ties to even."""
    return np.int32(np.rint(log_odds * UNITS_PER_LOG_ODDS))


@inline_kernel
def _integers(address, size):
    """Return the int32 array (size,) at an address."""
    return float_array(address, (size,)).view(np.int32)


@inline_kernel
def _prefetch_ahead(table, b, column):
    """Prefetch the brick PREFETCH_AHEAD bricks after ``b`` in ``column`` of ``table``."""
    prefetch(table, min(b + PREFETCH_AHEAD, table.known.shape[1] - 1), column)


@kernel
def _share_rows(mass_at, total_at, size, num_receivers):
    """Take the shares of all receivers from a mass and add one of them to its running sum; returns the largest |share|.

    - ``mass_at``, ``total_at``: addresses of the mass and the running sum (size,) int32, both in place.
    - ``size``: number of values.
    - ``num_receivers``: number of shares.
    """
    mass, total = _integers(mass_at, size), _integers(total_at, size)
    # For integers this small, rounding the float64 quotient gives the same result as rounding the exact one.
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
    """Take the shares of all receivers from a mass and add one of them to its running sum, both in place.

    Loop invariant: bricks before ``b`` of both octrees are updated. The layout includes that of the mass. Where a brick
    is one value, its new value is written to ``table``.

    - ``table``: BrickTable (2, n) of the running sum (TARGET) and the mass (SOURCE).
    - ``layout`` (n, W) uint64, ``known`` (n,) uint64: class rows and known cells of the running sum.
    - ``num_receivers``: number of shares.
    - ``num_classes``: C.
    - ``scratch`` float32: room for NUM_SCRATCH_BLOCKS blocks with all rows.
    - ``shares`` (n,) int32: output, largest |share| of each brick [unit].
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
            # The running sum has another layout, so the shares were taken from a copy of the mass.
            own_size = num_rows(table.known[SOURCE, b], table.masks[SOURCE], b) * OCTETS
            _share_rows(table.addresses[SOURCE, b], unused_at, own_size, num_receivers)


@kernel
def _add_rows(mass_at, new_at, old_at, size, of_evidence):
    """Add new - old to a mass; returns True if any value differs.

    - ``mass_at``: address of the mass (size,) int32, in place.
    - ``new_at``, ``old_at``: addresses of the new and old values (size,).
    - ``size``: number of values.
    - ``of_evidence``: True where the values are float32 log-odds, False where they are int32 running sums.
    """
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
    """Add differences to the masses of R robots, in place.

    Loop invariant: all robots' bricks before ``b`` are updated. The layout of a mass includes those of all the robot's
    columns. Where a brick is one value, its new value is written to ``table``.

    - ``start``, ``end``: bricks of the table, ``end`` excluded.
    - ``table``: BrickTable of all octrees, (J, n).
    - ``columns`` int64: columns of the table, robot by robot: its mass, then new, old, new, old, ...
    - ``first_columns`` (R + 1,) int64: robot r has the entries ``first_columns[r]`` to ``first_columns[r + 1]``.
    - ``of_evidence``: True where new and old are float32 log-odds, False where they are running sums.
    - ``layouts`` (R n, W) uint64, ``known`` (R n,) uint64: class rows and known cells of the masses.
    - ``num_classes``: C.
    - ``scratch`` float32: room for NUM_SCRATCH_BLOCKS blocks with all rows.
    - ``is_changed`` (R, n) float32: output, 1 where a difference is not 0, else 0.
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
    """Write mass x ``scale`` into a map where a value differs by more than ``tolerance``.

    Loop invariant: bricks before ``b`` of the map are written. The layout includes that of the mass. Where a brick is
    one value, its new value is written to ``table``.

    - ``table``: BrickTable (2, n) of the map (TARGET) and the mass (SOURCE).
    - ``layout`` (n, W) uint64, ``known`` (n,) uint64: class rows and known cells of the map.
    - ``scale``: float64, log-odds of one unit of the mass.
    - ``tolerance``: float32 [log-odds].
    - ``num_classes``: C.
    - ``scratch`` float32: room for NUM_SCRATCH_BLOCKS blocks with all rows.
    - ``changes`` (n,) float32: output, largest change of each brick [log-odds].
    - ``is_even`` (n,) bool: output, True where a changed brick's values are all equal.
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
        # The bits of non-negative floats have the order of the floats.
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
