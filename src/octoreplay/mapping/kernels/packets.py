"""Octrees as depth-first streams, and back.

Inside a brick three masks of 64 bits say everything but the values: which cells are ``known``, at which cells a leaf
``starts`` (each leaf's first cell), and which of those leaves are ``vector`` leaves. A brick of which all cells are
known and only cell 0 starts a leaf is that one leaf.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import kernel
from octoreplay.mapping.kernels.storage import (
    ALL_CELLS,
    BRICK_CELLS,
    BRICK_DEPTH,
    NUM_SCALAR,
    NUM_VECTOR,
    SCALAR,
    UNIFORM,
    VECTOR,
    add_brick,
)

CHILD_UNKNOWN, CHILD_INNER, CHILD_SCALAR, CHILD_VECTOR = 0, 1, 2, 3
ALL_LEAVES = 0xAAAA
"""The bits that a word has when all its children are leaves."""

ZERO, ONE = np.uint64(0), np.uint64(1)
EIGHT_CELLS = np.uint64(0xFF)
"""Eight sibling cells: a byte of a brick's mask."""
FIRST_CELLS = np.uint64(0x0101010101010101)
"""The first of each eight sibling cells."""
LAST_CELLS = np.uint64(0x8080808080808080)
"""The last of each eight sibling cells."""
NO_SIGN = np.float32(0.0)
"""Added to a value it makes 0 of -0, so that equal maps are equal bytes."""


@kernel
def _brick_values(bricks, index, spare):
    """A brick's values: (C, 64) if it is a VECTOR brick, else (1, 64); a UNIFORM one is spelt out in ``spare``."""
    row = bricks.rows[index]
    if bricks.tiers[index] == VECTOR:
        return bricks.vector[row]
    if bricks.tiers[index] == SCALAR:
        return bricks.scalar[row : row + 1]
    for i in range(BRICK_CELLS):
        spare[0, i] = bricks.values[index]
    return spare[:1]


@kernel
def _compare_cells(values, is_vector, changes):
    """Masks of the cells whose classes (C, 64) differ, and of those that differ from the next cell.

    ``is_vector`` and ``changes`` (64,) are scratch: comparing them cell by cell lets the loops run as vectors.
    """
    for i in range(BRICK_CELLS):
        is_vector[i] = 0
        changes[i] = 0
    for c in range(1, values.shape[0]):
        for i in range(BRICK_CELLS):
            is_vector[i] |= values[c, i] != values[0, i]
    for c in range(values.shape[0]):
        for i in range(BRICK_CELLS - 1):
            changes[i] |= values[c, i] != values[c, i + 1]
    vector, change = ZERO, ZERO
    for i in range(BRICK_CELLS):
        vector |= np.uint64(is_vector[i]) << np.uint64(i)
        change |= np.uint64(changes[i]) << np.uint64(i)
    return vector, change


@kernel
def _whole_eights(mask):
    """FIRST_CELLS of those eight sibling cells that are all in ``mask``."""
    mask &= mask >> np.uint64(4)
    mask &= mask >> np.uint64(2)
    return mask & (mask >> ONE) & FIRST_CELLS


@kernel
def vector_masks(bricks, order, masks):
    """Mask (n,) of the known cells with one value per class of each brick ``order`` (n,)."""
    flags = np.empty((2, BRICK_CELLS), dtype=np.uint8)
    for n in range(order.size):
        index = order[n]
        masks[n] = 0
        if bricks.tiers[index] == VECTOR:
            vector, _ = _compare_cells(bricks.vector[bricks.rows[index]], flags[0], flags[1])
            masks[n] = vector & bricks.known[index]


@kernel
def _middle(low, high):
    """The middle of a range, exact where its ends are equal, and never -0."""
    return low + (high - low) / np.float32(2.0) if high > low else low + NO_SIGN


@kernel
def _smooth_eights(values, known, tolerance, smooth, low, high):
    """A copy of values (1 or C, 64) in which eight known cells within the tolerance have the middle of their range.

    ``low`` and ``high`` (8, C) get the bounds of each eight cells.
    """
    width = values.shape[0]
    for e in range(8):
        apart = np.int64((known >> np.uint64(8 * e)) & EIGHT_CELLS != EIGHT_CELLS)
        for c in range(low.shape[1]):
            least = most = values[min(c, width - 1), 8 * e]
            for i in range(8 * e + 1, 8 * e + 8):
                least = min(least, values[min(c, width - 1), i])
                most = max(most, values[min(c, width - 1), i])
            low[e, c], high[e, c] = least, most
            apart += not most - least <= tolerance
        for c in range(width):
            for i in range(8 * e, 8 * e + 8):
                smooth[c, i] = values[c, i] if apart else _middle(low[e, c], high[e, c])
    return smooth[:width]


@kernel
def _merge(depth, place, tolerance, before, low, high, scalars, vectors, totals):
    """Make the node at ``depth``, child ``place`` of its parent, one leaf if its bounds allow; returns its state."""
    num_classes = low.shape[2]
    different = 0
    for c in range(num_classes):
        least, most = low[depth, 0, c], high[depth, 0, c]
        for k in range(1, 8):
            least = min(least, low[depth, k, c])
            most = max(most, high[depth, k, c])
        if most - least > tolerance:
            return CHILD_INNER
        low[depth - 1, place, c], high[depth - 1, place, c] = least, most
        # Not a number is no difference: there is room for vectors only where a brick below is a VECTOR brick.
        first_least, first_most = low[depth - 1, place, 0], high[depth - 1, place, 0]
        different += (least < first_least) | (least > first_least) | (most < first_most) | (most > first_most)
    for i in range(3):
        totals[i] = before[depth, i]
    if different == 0:
        scalars[totals[1]] = _middle(low[depth - 1, place, 0], high[depth - 1, place, 0])
        totals[1] += 1
        return CHILD_SCALAR
    for c in range(num_classes):
        vectors[totals[2], c] = _middle(low[depth - 1, place, c], high[depth - 1, place, c])
    totals[2] += 1
    return CHILD_VECTOR


@kernel
def _interleave(low, high):
    """A word whose even bits are the 8 bits of ``low`` and whose odd bits are those of ``high``."""
    x = low | high << np.uint64(32)
    x = (x | x << np.uint64(4)) & np.uint64(0x0F0F00000F0F)
    x = (x | x << np.uint64(2)) & np.uint64(0x333300003333)
    x = (x | x << ONE) & np.uint64(0x555500005555)
    return np.uint16(x | x >> np.uint64(31))


@kernel
def _write_brick(values, known, starts, vector, words, scalars, vectors, totals, cells):
    """Append the words and leaves of one brick that is not a leaf. ``cells`` (64,) is scratch.

    No branches: what is no word or no leaf is overwritten by the next. Unsigned places need no check of their sign.
    """
    word = ZERO
    place = np.uint64(totals[0] + 1)
    for e in range(8):
        shift = np.uint64(8 * e)
        eight = (known >> shift) & EIGHT_CELLS
        is_vector = (vector >> shift) & EIGHT_CELLS
        is_leaf = np.uint64(eight == EIGHT_CELLS) & np.uint64((starts >> shift) & EIGHT_CELLS == ONE)
        is_inner = np.uint64(eight != ZERO) & ~is_leaf
        words[place] = _interleave(is_vector, eight)
        place += is_inner
        word |= (is_inner | (is_leaf << ONE) | (is_leaf & is_vector)) << np.uint64(2 * e)
    words[totals[0]] = np.uint16(word)
    totals[0] = np.int64(place)
    scalar = starts & ~vector
    place = np.uint64(totals[1])
    for i in range(BRICK_CELLS):
        scalars[place] = values[0, i] + NO_SIGN
        place += (scalar >> np.uint64(i)) & ONE
    totals[1] = np.int64(place)
    if vector:
        place = ZERO
        for i in range(BRICK_CELLS):
            cells[place] = i
            place += (vector >> np.uint64(i)) & ONE
        for n in range(place):
            for c in range(vectors.shape[1]):
                vectors[totals[2], c] = values[c, cells[n]] + NO_SIGN
            totals[2] += 1


@kernel
def _num_shared(code, other):
    """How many nodes, from the root down, hold both of two bricks."""
    difference = (code ^ other) >> 3
    shared = BRICK_DEPTH
    while difference:
        difference >>= 3
        shared -= 1
    return shared


@kernel
def _word(states):
    """The word of a node with these states (8,) of its children."""
    word = 0
    for k in range(8):
        word |= np.int64(states[k]) << (2 * k)
    return word


@kernel
def encode_bricks(bricks, order, prune, tolerance, words, scalars, vectors, totals):
    """Write the octree over the bricks ``order`` (n,), sorted by code, each with a known cell, depth-first.

    ``words`` gets 16 bits per inner node, two for each child; ``scalars`` and ``vectors`` (m, C) the leaves' values;
    words and scalars have room for one more. Eight leaves that differ by at most ``tolerance`` are one leaf; nothing is
    merged without ``prune``. ``totals`` (3,) counts what is written of each, from 0.
    """
    num_classes = bricks.vector.shape[1]
    lossy = prune and tolerance > 0
    spare = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    flags = np.empty((2, BRICK_CELLS), dtype=np.uint8)
    cells = np.empty(BRICK_CELLS, dtype=np.uint8)
    # The open nodes from the root down to the brick: what was written before each, its children's states and bounds.
    # Without a tolerance the bounds are equal, and one array serves as both.
    before = np.empty((BRICK_DEPTH + 1, 3), dtype=np.int64)
    states = np.empty((BRICK_DEPTH, 8), dtype=np.uint8)
    low = np.empty((BRICK_DEPTH + 1, 8, num_classes), dtype=np.float32)
    high = np.empty((BRICK_DEPTH + 1, 8, num_classes), dtype=np.float32) if lossy else low
    shared = 0
    for n in range(order.size):
        index = order[n]
        code = bricks.codes[index]
        known = bricks.known[index]
        for depth in range(shared, BRICK_DEPTH):
            for i in range(3):
                before[depth, i] = totals[i]
            for k in range(8):
                states[depth, k] = CHILD_UNKNOWN
            totals[0] += 1
        place = code & 7
        state = CHILD_INNER
        if prune and known == ALL_CELLS and bricks.tiers[index] == UNIFORM:
            for c in range(num_classes):
                low[BRICK_DEPTH - 1, place, c] = high[BRICK_DEPTH - 1, place, c] = bricks.values[index]
            scalars[totals[1]] = bricks.values[index] + NO_SIGN
            totals[1] += 1
            state = CHILD_SCALAR
        else:
            values = _brick_values(bricks, index, spare)
            if lossy:
                values = _smooth_eights(values, known, tolerance, spare, low[BRICK_DEPTH], high[BRICK_DEPTH])
            vector, change = _compare_cells(values, flags[0], flags[1])
            merged = _whole_eights(known & (~change | LAST_CELLS)) if prune else ZERO
            if merged == FIRST_CELLS:
                if not lossy:
                    for e in range(8):
                        for c in range(num_classes):
                            low[BRICK_DEPTH, e, c] = values[min(c, values.shape[0] - 1), 8 * e]
                for i in range(3):
                    before[BRICK_DEPTH, i] = totals[i]
                state = _merge(np.int64(BRICK_DEPTH), place, tolerance, before, low, high, scalars, vectors, totals)
            if state == CHILD_INNER:
                starts = known & ~(merged * (EIGHT_CELLS - ONE))
                _write_brick(values, known, starts, vector & starts, words, scalars, vectors, totals, cells)
        states[BRICK_DEPTH - 1, place] = state
        # The nodes that the next brick is not in are complete; the root always stays a node.
        shared = 1
        if n + 1 < order.size:
            shared = _num_shared(code, bricks.codes[order[n + 1]])
        for depth in range(BRICK_DEPTH - 1, shared - 1, -1):
            word = _word(states[depth])
            place = (code >> (3 * (BRICK_DEPTH - depth))) & 7
            state = CHILD_INNER
            if word & ALL_LEAVES == ALL_LEAVES:
                state = _merge(depth, place, tolerance, before, low, high, scalars, vectors, totals)
            if state == CHILD_INNER:
                words[before[depth, 0]] = word
            states[depth - 1, place] = state
    if order.size > 0:
        words[0] = _word(states[0])


@kernel
def _gather(word):
    """The even bits of a word, as 8 bits."""
    x = word & np.uint64(0x5555)
    x = (x | x >> ONE) & np.uint64(0x3333)
    x = (x | x >> np.uint64(2)) & np.uint64(0x0F0F)
    return (x | x >> np.uint64(4)) & EIGHT_CELLS


@kernel
def _read_brick(words, used):
    """The masks known, starts and vector of the brick with word ``used``, and the next word; 0 for malformed words."""
    known, starts, vector = ZERO, ZERO, ZERO
    word = np.uint64(words[used])
    used += 1
    for e in range(8):
        shift = np.uint64(8 * e)
        state = (word >> np.uint64(2 * e)) & np.uint64(3)
        if state == np.uint64(CHILD_INNER):
            if used == words.size:
                return known, starts, vector, 0
            is_vector = _gather(np.uint64(words[used]))
            eight = _gather(np.uint64(words[used]) >> ONE)
            used += 1
            # A finest cell is no inner node.
            if is_vector & ~eight:
                return known, starts, vector, 0
            known |= eight << shift
            starts |= eight << shift
            vector |= is_vector << shift
        elif state:
            known |= EIGHT_CELLS << shift
            starts |= ONE << shift
            vector |= (state & ONE) << shift
    return known, starts, vector, used


@kernel
def read_words(words, codes, spans, known, starts, vector):
    """The bricks of a depth-first octree: code, number of bricks from there on, and the three masks, (L,) each.

    Only a leaf is larger than a brick. Returns the number of entries, or -1 when the words are no octree with at most
    L leaves.
    """
    if words.size == 0:
        return 0
    # The open nodes from the root down: word, next child, and code of the first brick.
    path_word = np.empty(BRICK_DEPTH, dtype=np.int64)
    path_child = np.empty(BRICK_DEPTH, dtype=np.int64)
    path_code = np.empty(BRICK_DEPTH, dtype=np.int64)
    path_word[0], path_child[0], path_code[0] = words[0], 0, 0
    depth = 0
    count = 0
    used = np.int64(1)
    while depth >= 0:
        child = path_child[depth]
        if child == 8:
            depth -= 1
            continue
        path_child[depth] = child + 1
        state = (path_word[depth] >> (2 * child)) & 3
        code = path_code[depth] | child << (3 * (BRICK_DEPTH - 1 - depth))
        if state == CHILD_INNER and used == words.size:
            return -1
        if state == CHILD_INNER and depth < BRICK_DEPTH - 1:
            depth += 1
            path_word[depth] = words[used]
            path_child[depth] = 0
            path_code[depth] = code
            used += 1
            continue
        if state == CHILD_INNER:
            cells, first_cells, vector_cells, used = _read_brick(words, used)
            if used == 0:
                return -1
        else:
            cells = ALL_CELLS if state != CHILD_UNKNOWN else ZERO
            first_cells = ONE
            vector_cells = np.uint64(state == CHILD_VECTOR)
        if cells:
            if count == codes.size:
                return -1
            codes[count] = code
            spans[count] = np.int64(1) << (3 * (BRICK_DEPTH - 1 - depth))
            known[count] = cells
            starts[count] = first_cells
            vector[count] = vector_cells
            count += 1
    return count if used == words.size else -1


@kernel
def _fill_brick(values, known, starts, vector, scalars, first_scalar, vectors, first_vector, cells, rows):
    """Write a brick's values (C or 1, 64) from its leaves, the first of which are named; returns how many there are.

    ``cells`` and ``rows`` (64,) are scratch.
    """
    scalar = starts & ~vector
    num_scalars = ZERO
    if scalar:
        for i in range(BRICK_CELLS):
            num_scalars += (scalar >> np.uint64(i)) & ONE
            # The last scalar leaf that started; what vector cells get from it is overwritten below.
            value = scalars[first_scalar + max(num_scalars, ONE) - ONE]
            values[0, i] = value if (known >> np.uint64(i)) & ONE else np.float32(0.0)
    else:
        for i in range(BRICK_CELLS):
            values[0, i] = 0.0
    num_vectors = ZERO
    if vector:
        for c in range(1, values.shape[0]):
            for i in range(BRICK_CELLS):
                values[c, i] = values[0, i]
        count = ZERO
        in_vector = ZERO
        for i in range(BRICK_CELLS):
            bit = np.uint64(i)
            num_vectors += (vector >> bit) & ONE
            in_vector = (vector >> bit) & ONE if (starts >> bit) & ONE else in_vector
            cells[count] = i
            rows[count] = first_vector + num_vectors - ONE
            count += (known >> bit) & in_vector
        for n in range(count):
            for c in range(values.shape[0]):
                values[c, cells[n]] = vectors[rows[n], c]
    return num_scalars, num_vectors


@kernel
def fill_bricks(bricks, codes, spans, known, starts, vector, scalars, vectors):
    """Write the bricks that ``read_words`` gave (n,) into an octree without bricks. Room must be there."""
    first_scalar, first_vector = ZERO, ZERO
    cells = np.empty(BRICK_CELLS, dtype=np.uint8)
    rows = np.empty(BRICK_CELLS, dtype=np.uint64)
    for n in range(codes.size):
        is_leaf = known[n] == ALL_CELLS and starts[n] == ONE
        num_scalars, num_vectors = ONE, ZERO
        for k in range(spans[n]):
            index = add_brick(bricks, codes[n] + k)
            bricks.known[index] = known[n]
            if is_leaf and not vector[n]:
                bricks.values[index] = scalars[first_scalar]
                continue
            counter = NUM_VECTOR if vector[n] else NUM_SCALAR
            row = bricks.counters[counter]
            bricks.counters[counter] = row + 1
            bricks.tiers[index] = VECTOR if vector[n] else SCALAR
            bricks.rows[index] = row
            values = bricks.vector[row] if vector[n] else bricks.scalar[row : row + 1]
            num_scalars, num_vectors = _fill_brick(
                values, known[n], starts[n], vector[n], scalars, first_scalar, vectors, first_vector, cells, rows
            )
        first_scalar += num_scalars
        first_vector += num_vectors
