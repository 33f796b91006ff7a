"""Contradiction of evidence, brick by brick: the state of each cell in one robot's evidence, and counts of robot pairs.

The *state* of a brick is a row of W masks (uint64, bit i stands for cell i): at KNOWN the known cells, at FREE the free
ones, at FIRM those that were freed several times, at NEAR the occupied cells and their 26 neighbours, and from LABEL on
the binary digits of the cells' labels, lowest first. A label is the class_id 1..C of an occupied cell, else 0.

Each brick of the team has a row of *slots*, with the position of each robot's state, -1 where a robot does not have the
brick. In shapes, N is the number of robots, n of bricks, m of rows and s of slots.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import count_ones
from octoreplay.mapping.kernels.storage import (
    BRICK_DEPTH,
    OCTETS,
    find_brick,
    gather_bits,
    octets_of,
    ones_below,
    spread_bits,
)

KNOWN, FREE, FIRM, NEAR, LABEL = 0, 1, 2, 3, 4
"""Positions of the masks in a state."""
OVERLAP, OCCUPIED_FREE, OCCUPIED_CLEAR, BOTH_OCCUPIED, OTHER_LABEL = 0, 1, 2, 3, 4
"""Positions of the counts of a pair."""
NUM_COUNTS = 5

EVEN_CELLS = (np.uint64(0x5555555555555555), np.uint64(0x3333333333333333), np.uint64(0x0F0F0F0F0F0F0F0F))
"""Cells of a brick with an even coordinate x, y or z."""
LOWER_CELLS = (np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0000FFFF0000FFFF), np.uint64(0x00000000FFFFFFFF))
"""Cells of a brick with a coordinate x, y or z below 2."""
NUM_COORDS = 1 << BRICK_DEPTH
"""Number of bricks along an axis of the key space."""
STALE, STALE_NEAR = 1, 2
"""Marks of rows: the state has to be counted again; its mask NEAR has to be computed again before."""


@kernel
def _first_shared_class(bricks, index, octet, num_classes):
    """Lowest class without a class row in an octet of a block, 0 where all classes have one.

    - ``bricks``: Bricks.
    - ``index``: brick index.
    - ``octet``: position of the octet in the brick.
    - ``num_classes``: C.
    """
    for c in range(num_classes):
        if not bricks.masks[index, c >> 3] >> np.uint64(8 * octet + (c & 7)) & np.uint64(1):
            return c
    return 0


@kernel
def classify_bricks(bricks, indices, places, occupied_from, free_to, firm_to, num_classes, states):
    """Write the states of bricks of one robot's evidence, without the mask NEAR.

    A cell's label is the class with the largest value; ties go to the lower id.

    - ``bricks``: Bricks of the evidence.
    - ``indices`` (n,) int64: brick indices.
    - ``places`` (n,) int32: position of each brick in ``states``.
    - ``occupied_from``: float32 log-odds; a cell is occupied where its largest value is at least this.
    - ``free_to``: float32 log-odds below ``occupied_from``; a cell is free where its largest value is at most this.
    - ``firm_to``: float32 log-odds; a free cell is firmly free where its largest value is at most this.
    - ``num_classes``: C.
    - ``states`` (s, W) uint64: output.
    """
    for n in range(indices.size):
        index, i = indices[n], places[n]
        block, known = np.int64(bricks.blocks[index]), bricks.known[index]
        states[i, KNOWN], states[i, FREE], states[i, FIRM] = known, np.uint64(0), np.uint64(0)
        for w in range(LABEL, states.shape[1]):
            states[i, w] = np.uint64(0)
        if block < 0:
            # All classes are equal: the label is the lowest class.
            if bricks.values[index] <= free_to:
                states[i, FREE] = known
                states[i, FIRM] = known if bricks.values[index] <= firm_to else np.uint64(0)
            elif bricks.values[index] >= occupied_from:
                states[i, LABEL] = known
            continue
        octets = octets_of(known)
        shared_row = block
        for e in range(OCTETS):
            if not octets >> np.uint64(8 * e) & np.uint64(1):
                continue
            shared_class = _first_shared_class(bricks, index, e, num_classes)
            for k in range(OCTETS):
                cell = np.uint64(1) << np.uint64(8 * e + k)
                if not known & cell:
                    continue
                best, best_class = bricks.rows[shared_row, k], shared_class
                word_row = block + count_ones(octets)
                for w in range(bricks.masks.shape[1]):
                    mask = bricks.masks[index, w]
                    row = word_row + ones_below(mask, 8 * e)
                    for c in range(8 * w, 8 * w + 8):
                        if mask >> np.uint64(8 * e + (c & 7)) & np.uint64(1):
                            value = bricks.rows[row, k]
                            if value > best or (value == best and c < best_class):
                                best, best_class = value, c
                            row += 1
                    word_row += count_ones(mask)
                if best <= free_to:
                    states[i, FREE] |= cell
                    states[i, FIRM] |= cell if best <= firm_to else np.uint64(0)
                elif best >= occupied_from:
                    label = best_class + 1
                    for w in range(LABEL, states.shape[1]):
                        if label >> (w - LABEL) & 1:
                            states[i, w] |= cell
            shared_row += 1


@inline_kernel
def _occupied(states, slot):
    """Mask of the occupied cells of the state ``states[slot]``."""
    cells = states[slot, LABEL]
    for w in range(LABEL + 1, states.shape[1]):
        cells |= states[slot, w]
    return cells


@kernel
def _dilated(cells, before, after, axis):
    """Mask of a brick's ``cells`` and their neighbours along an ``axis`` (0, 1, 2).

    ``before`` and ``after`` are the masks of the neighbouring bricks at the lower and the upper end.
    """
    even, lower = EVEN_CELLS[axis], LOWER_CELLS[axis]
    step, jump = np.uint64(1 << axis), np.uint64(7 << axis)
    across = np.uint64(9 << axis)
    up = (cells & even) << step | (cells & ~even & lower) << jump | (before & ~even & ~lower) >> across
    down = (cells & ~even) >> step | (cells & even & ~lower) >> jump | (after & even & lower) << across
    return cells | up | down


@kernel
def _neighbour_rows(team_bricks, code, neighbours):
    """Write the rows of the 27 bricks around a brick, itself included, into ``neighbours`` (3, 3, 3) int64.

    Indices are z, y, x; -1 is an absent brick. ``team_bricks`` are the Bricks that number the rows, ``code`` int64 is
    the brick's code.
    """
    x, y, z = gather_bits(code), gather_bits(code >> 1), gather_bits(code >> 2)
    for k in range(27):
        other_x, other_y, other_z = x + k % 3 - 1, y + k // 3 % 3 - 1, z + k // 9 - 1
        row = np.int64(-1)
        if min(other_x, other_y, other_z) >= 0 and max(other_x, other_y, other_z) < NUM_COORDS:
            other = spread_bits(other_x) | spread_bits(other_y) << 1 | spread_bits(other_z) << 2
            row = np.int64(find_brick(team_bricks, other))
        neighbours[k // 9, k // 3 % 3, k % 3] = row


@kernel
def mark_stale(team_bricks, slots, counted, latest, robot, rows, neighbours, marks):
    """Mark the bricks of one robot that have another state than when they were counted.

    A brick with other occupied cells makes the masks NEAR of its neighbours stale, a new brick its own.

    - ``team_bricks``: Bricks that number the rows.
    - ``slots`` (m, N) int32.
    - ``counted`` (s, W) uint64: states as counted.
    - ``latest`` (s, W) uint64: states now.
    - ``robot``: index of the robot.
    - ``rows`` (n,) int64: rows of the robot's bricks that may have changed.
    - ``neighbours`` (3, 3, 3) int64: scratch.
    - ``marks`` (m,) uint8: in place, STALE and STALE_NEAR are added.
    """
    for n in range(rows.size):
        slot = np.int64(slots[rows[n], robot])
        for w in range(latest.shape[1]):
            if w != NEAR and latest[slot, w] != counted[slot, w]:
                marks[rows[n]] |= STALE
        if counted[slot, KNOWN] == 0:
            marks[rows[n]] |= STALE | STALE_NEAR
        if _occupied(latest, slot) == _occupied(counted, slot):
            continue
        _neighbour_rows(team_bricks, team_bricks.codes[rows[n]], neighbours)
        for k in range(27):
            row = neighbours[k // 9, k // 3 % 3, k % 3]
            if row >= 0 and slots[row, robot] >= 0:
                marks[row] |= STALE | STALE_NEAR


@kernel
def update_near(team_bricks, slots, latest, robot, marks, neighbours, cells):
    """Compute the masks NEAR of the bricks of one robot that are marked STALE_NEAR.

    - ``team_bricks``: Bricks that number the rows.
    - ``slots`` (m, N) int32.
    - ``latest`` (s, W) uint64: states, in place.
    - ``robot``: index of the robot.
    - ``marks`` (m,) uint8.
    - ``neighbours`` (3, 3, 3) int64, ``cells`` (3, 3, 3) uint64: scratch.
    """
    for row in range(marks.size):
        if not marks[row] & STALE_NEAR:
            continue
        _neighbour_rows(team_bricks, team_bricks.codes[row], neighbours)
        for z in range(3):
            for y in range(3):
                for x in range(3):
                    other = neighbours[z, y, x]
                    slot = np.int64(slots[other, robot]) if other >= 0 else np.int64(-1)
                    cells[z, y, x] = _occupied(latest, slot) if slot >= 0 else np.uint64(0)
                cells[z, y, 1] = _dilated(cells[z, y, 1], cells[z, y, 0], cells[z, y, 2], 0)
            cells[z, 1, 1] = _dilated(cells[z, 1, 1], cells[z, 0, 1], cells[z, 2, 1], 1)
        latest[slots[row, robot], NEAR] = _dilated(cells[1, 1, 1], cells[0, 1, 1], cells[2, 1, 1], 2)


@kernel
def _count_pair(counts, sign, robot, own_states, own, other_robot, other_states, other):
    """Add the counts of one brick of two robots, or subtract them.

    - ``counts`` (N, N, NUM_COUNTS) int64: in place, as in ``update_counts``.
    - ``sign``: 1 or -1.
    - ``robot``: index of the one robot.
    - ``own_states`` (s, W) uint64, ``own``: its state is ``own_states[own]``.
    - ``other_robot``: index of the other robot.
    - ``other_states`` (s, W) uint64, ``other``: its state is ``other_states[other]``.
    """
    occupied, other_occupied = _occupied(own_states, own), _occupied(other_states, other)
    both = occupied & other_occupied
    differs = np.uint64(0)
    for w in range(LABEL, own_states.shape[1]):
        differs |= own_states[own, w] ^ other_states[other, w]
    clear = own_states[own, FIRM] & ~own_states[own, NEAR]
    other_clear = other_states[other, FIRM] & ~other_states[other, NEAR]
    first, second = min(robot, other_robot), max(robot, other_robot)
    counts[first, second, OVERLAP] += sign * count_ones(own_states[own, KNOWN] & other_states[other, KNOWN])
    counts[first, second, BOTH_OCCUPIED] += sign * count_ones(both)
    counts[first, second, OTHER_LABEL] += sign * count_ones(both & differs)
    counts[robot, other_robot, OCCUPIED_FREE] += sign * count_ones(occupied & other_states[other, FREE])
    counts[other_robot, robot, OCCUPIED_FREE] += sign * count_ones(other_occupied & own_states[own, FREE])
    counts[robot, other_robot, OCCUPIED_CLEAR] += sign * count_ones(occupied & other_clear)
    counts[other_robot, robot, OCCUPIED_CLEAR] += sign * count_ones(other_occupied & clear)


@kernel
def update_counts(slots, counted, latest, robot, marks, counts):
    """Count the latest states of one robot's marked bricks in place of those that were counted.

    Loop invariant: ``counts`` are those of ``counted``.

    - ``slots`` (m, N) int32.
    - ``counted`` (s, W) uint64: states as counted, in place.
    - ``latest`` (s, W) uint64: states now.
    - ``robot``: index of the robot.
    - ``marks`` (m,) uint8: rows to count.
    - ``counts`` (N, N, NUM_COUNTS) int64: in place. [i, j] counts at OCCUPIED_FREE the cells that i calls occupied and
      j calls free, and at OCCUPIED_CLEAR those of them that are firmly free and have no occupied cell of j beside them.
      For i < j it counts at
      OVERLAP the cells that both know, at BOTH_OCCUPIED those that both call occupied, and at OTHER_LABEL those of them
      with different labels. The rest is unused.
    """
    for row in range(marks.size):
        if not marks[row]:
            continue
        slot = np.int64(slots[row, robot])
        for other_robot in range(slots.shape[1]):
            other = np.int64(slots[row, other_robot])
            if other_robot != robot and other >= 0:
                _count_pair(counts, -1, robot, counted, slot, other_robot, counted, other)
                _count_pair(counts, 1, robot, latest, slot, other_robot, counted, other)
        for w in range(counted.shape[1]):
            counted[slot, w] = latest[slot, w]
