"""Contradiction of evidence, brick by brick: the state of each cell in one robot's evidence, and counts of robot pairs.

The *state* of a brick is a row of B + 2 masks (uint64, bit i stands for cell i): at KNOWN the known cells, at FREE the
free ones, and from LABEL on the binary digits of the cells' labels, lowest first. A label is the class_id 1..C of an
occupied cell, else 0. B is the number of binary digits of C.

In shapes, N is the number of robots, n of bricks, m of rows and s of slots.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import count_ones
from octoreplay.mapping.kernels.storage import OCTETS, octets_of, ones_below

KNOWN, FREE, LABEL = 0, 1, 2
"""Positions of the masks in a state."""
OVERLAP, OCCUPIED_FREE, BOTH_OCCUPIED, OTHER_LABEL = 0, 1, 2, 3
"""Positions of the counts of a pair."""
NUM_COUNTS = 4


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
def classify_bricks(bricks, indices, occupied_from, free_to, num_classes, states):
    """Write the states of bricks of one robot's evidence.

    A cell's label is the class with the largest value; ties go to the lower id.

    - ``bricks``: Bricks of the evidence.
    - ``indices`` (n,) int64: brick indices.
    - ``occupied_from``: float32 log-odds; a cell is occupied where its largest value is at least this.
    - ``free_to``: float32 log-odds below ``occupied_from``; a cell is free where its largest value is at most this.
    - ``num_classes``: C.
    - ``states`` (n, B + 2) uint64: output.
    """
    for i in range(indices.size):
        index = indices[i]
        block, known = np.int64(bricks.blocks[index]), bricks.known[index]
        for w in range(states.shape[1]):
            states[i, w] = np.uint64(0)
        states[i, KNOWN] = known
        if block < 0:
            # All classes are equal: the label is the lowest class.
            if bricks.values[index] <= free_to:
                states[i, FREE] = known
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
def _count_pair(counts, sign, robot, own_states, own, other_robot, other_states, other):
    """Add the counts of one brick of two robots, or subtract them.

    - ``counts`` (N, N, NUM_COUNTS) int64: in place, as in ``update_counts``.
    - ``sign``: 1 or -1.
    - ``robot``: index of the one robot.
    - ``own_states`` (k, B + 2) uint64, ``own``: its state is ``own_states[own]``.
    - ``other_robot``: index of the other robot.
    - ``other_states`` (s, B + 2) uint64, ``other``: its state is ``other_states[other]``.
    """
    occupied, other_occupied = _occupied(own_states, own), _occupied(other_states, other)
    both = occupied & other_occupied
    differs = np.uint64(0)
    for w in range(LABEL, own_states.shape[1]):
        differs |= own_states[own, w] ^ other_states[other, w]
    first, second = min(robot, other_robot), max(robot, other_robot)
    counts[first, second, OVERLAP] += sign * count_ones(own_states[own, KNOWN] & other_states[other, KNOWN])
    counts[first, second, BOTH_OCCUPIED] += sign * count_ones(both)
    counts[first, second, OTHER_LABEL] += sign * count_ones(both & differs)
    counts[robot, other_robot, OCCUPIED_FREE] += sign * count_ones(occupied & other_states[other, FREE])
    counts[other_robot, robot, OCCUPIED_FREE] += sign * count_ones(other_occupied & own_states[own, FREE])


@kernel
def update_counts(slots, states, robot, rows, new_states, counts):
    """Replace the states of one robot's bricks and update the counts of its pairs.

    Loop invariant: ``counts`` are those of ``states``.

    - ``slots`` (m, N) int32: slot of each robot's state of a brick, -1 where the robot does not have the brick.
    - ``states`` (s, B + 2) uint64: the states by slot, in place.
    - ``robot``: index of the robot.
    - ``rows`` (n,) int64: rows of its bricks in ``slots``; the robot has a slot in each of them.
    - ``new_states`` (n, B + 2) uint64: the new states.
    - ``counts`` (N, N, NUM_COUNTS) int64: in place. [i, j, OCCUPIED_FREE] counts the cells that i calls occupied and j
      calls free. For i < j, [i, j] counts at OVERLAP the cells that both know, at BOTH_OCCUPIED those that both call
      occupied, and at OTHER_LABEL those of them with different labels. The rest is unused.
    """
    for n in range(rows.size):
        slot = np.int64(slots[rows[n], robot])
        is_same = True
        for w in range(states.shape[1]):
            is_same &= states[slot, w] == new_states[n, w]
        if is_same:
            continue
        for other_robot in range(slots.shape[1]):
            other = np.int64(slots[rows[n], other_robot])
            if other_robot != robot and other >= 0:
                _count_pair(counts, -1, robot, states, slot, other_robot, states, other)
                _count_pair(counts, 1, robot, new_states, n, other_robot, states, other)
        for w in range(states.shape[1]):
            states[slot, w] = new_states[n, w]
