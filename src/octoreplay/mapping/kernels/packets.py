"""Octrees as depth-first streams, and back.

Inside a brick three masks of 64 bits say everything but the values: which cells are ``known``, at which cells a leaf
``starts`` (each leaf's first cell), and which of those leaves are ``vector`` leaves, whose classes differ. A brick of
which all cells are known and only cell 0 starts a leaf is that one leaf.

A vector leaf is one value and a mask of the classes with another one. The value is the one that most classes have (the
lowest such class's where several have as many), so that equal maps are equal streams, however they are stored.

Before they are compressed numbers become codes of one byte: the slot in which a recent number stands, or 0 for a new
one, a literal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.mapping.kernels.compiler import kernel
from octoreplay.mapping.kernels.intrinsics import count_ones, lowest_one, same_bits
from octoreplay.mapping.kernels.storage import (
    ALL_CELLS,
    BRICK_CELLS,
    BRICK_DEPTH,
    FIRST_CELLS,
    OCTETS,
    add_brick,
    block_rows,
    new_block,
    num_rows,
    octets_of,
    ones_below,
    share_first_class,
)
from octoreplay.records import Float32Array, Int64Array, UInt8Array

CHILD_UNKNOWN, CHILD_INNER, CHILD_SCALAR, CHILD_VECTOR = 0, 1, 2, 3
ALL_LEAVES = 0xAAAA
"""The bits that a word has when all its children are leaves."""

ZERO, ONE = np.uint64(0), np.uint64(1)
EIGHT_CELLS = np.uint64(0xFF)
"""An octet: a byte of a brick's mask."""
LAST_CELLS = np.uint64(0x8080808080808080)
"""The last cell of each octet."""
NO_SIGN = np.float32(0.0)
"""Added to a value it makes 0 of -0, so that equal maps are equal bytes."""


SLOTS = 256
"""Slots for recent numbers; slot 0 stays empty."""


class EncoderScratch(NamedTuple):
    """What encode_bricks works in.

    The block of one brick: its values (8 + 8 C, 8), and the octet and class of each row; flags (2, 64) of its cells;
    the rows of each octet (8, C) and their number (8,); the values of one leaf (C,). Then the open nodes from the root
    down to the brick: what was written before each (BRICK_DEPTH + 1, 4), its children's states (BRICK_DEPTH, 8), and
    the bounds ``low`` and ``high`` (BRICK_DEPTH + 1, 8, C) of their values; without a tolerance the bounds are equal,
    and one array serves as both.
    """

    block: Float32Array
    octets: Int64Array
    classes: Int64Array
    flags: UInt8Array
    octet_rows: Int64Array
    octet_sizes: Int64Array
    class_values: Float32Array
    before: Int64Array
    states: UInt8Array
    low: Float32Array
    high: Float32Array


@kernel
def _copy_block(bricks, index, block, octets, classes):
    """Copy a brick's rows to ``block`` (8 + 8 C, 8), all eight shared ones; one value is spelt out.

    Returns the number of rows. Row r >= 8 holds the values of class ``classes[r]`` in octet ``octets[r]``.
    """
    rows = OCTETS
    for w in range(bricks.masks.shape[1]):
        bits = bricks.masks[index, w]
        while bits:
            bit = lowest_one(bits)
            octets[rows] = bit >> 3
            classes[rows] = 8 * w + (bit & 7)
            rows += 1
            bits &= bits - ONE
    source = np.int64(bricks.blocks[index])
    present = octets_of(bricks.known[index])
    for r in range(rows):
        is_stored = source >= 0 and (r >= OCTETS or present >> np.uint64(8 * r) & ONE)
        if is_stored:
            for k in range(OCTETS):
                block[r, k] = bricks.rows[source, k] + NO_SIGN
            source += 1
        else:
            for k in range(OCTETS):
                block[r, k] = bricks.values[index] + NO_SIGN if source < 0 else np.float32(0.0)
    return rows


@kernel
def _compare_cells(block, rows, octets, is_vector, changes):
    """Masks of the cells whose classes differ, and of those that differ from the next cell of their octet.

    ``block`` (8 + 8 C, 8) int32 are the bits of its values: what is no number equals itself. ``is_vector`` and
    ``changes`` (64,) are scratch: comparing them cell by cell lets the loops run as vectors.
    """
    shared = block.reshape(block.size)
    for i in range(BRICK_CELLS):
        is_vector[i] = 0
        changes[i] = shared[i] != shared[i + 1]
    for r in range(OCTETS, rows):
        first = np.int64(octets[r]) * OCTETS
        for k in range(OCTETS):
            is_vector[first + k] |= block[r, k] != shared[first + k]
        for k in range(OCTETS - 1):
            changes[first + k] |= block[r, k] != block[r, k + 1]
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
def _middle(low, high):
    """The middle of a range, exact where its ends are equal, and never -0."""
    return low + (high - low) / np.float32(2.0) if high > low else low + NO_SIGN


@kernel
def _row_bounds(block, r):
    """The lowest and the highest value of a row."""
    least = most = block[r, 0]
    for k in range(1, OCTETS):
        least = min(least, block[r, k])
        most = max(most, block[r, k])
    return least, most


@kernel
def _class_bounds(block, rows, octets, classes, low, high):
    """Bounds ``low`` and ``high`` (8, C) of each octet's values, class by class."""
    for r in range(rows):
        least, most = _row_bounds(block, r)
        if r < OCTETS:
            for c in range(low.shape[1]):
                low[r, c], high[r, c] = least, most
        else:
            low[octets[r], classes[r]], high[octets[r], classes[r]] = least, most


@kernel
def _smooth_octets(block, rows, octets, known, tolerance):
    """Set the rows of each octet that is known and within the tolerance in all of them to the middle of their range."""
    apart = ZERO
    for r in range(rows):
        least, most = _row_bounds(block, r)
        e = np.uint64(octets[r])
        is_known = (known >> (np.uint64(8) * e)) & EIGHT_CELLS == EIGHT_CELLS
        apart |= np.uint64(not (is_known and most - least <= tolerance)) << e
    for r in range(rows):
        if not (apart >> np.uint64(octets[r])) & ONE:
            least, most = _row_bounds(block, r)
            for k in range(OCTETS):
                block[r, k] = _middle(least, most)


@kernel
def _write_leaf(class_values, place, values, masks, own_values, totals):
    """Write the values (C,) of a leaf: the one that most classes have at ``place``; then mask and other values.

    They are compared bit by bit, so that what is no number equals itself. Returns how many have a value of their own.
    """
    num_classes = class_values.size
    best, most = 0, 0
    for c in range(num_classes):
        equal = 0
        for other in range(num_classes):
            equal += same_bits(class_values[other]) == same_bits(class_values[c])
        if equal > most:
            best, most = c, equal
    values[place] = class_values[best]
    if most == num_classes:
        return 0
    for b in range(masks.shape[1]):
        masks[totals[2], b] = 0
    num_own = 0
    for c in range(num_classes):
        own_values[totals[3] + num_own] = class_values[c]
        is_own = same_bits(class_values[c]) != same_bits(class_values[best])
        masks[totals[2], c >> 3] |= np.uint8(is_own) << np.uint8(c & 7)
        num_own += is_own
    totals[2] += 1
    totals[3] += num_own
    return num_own


@kernel
def _merge(depth, place, tolerance, before, low, high, class_values, values, masks, own_values, totals):
    """Make the node at ``depth``, child ``place`` of its parent, one leaf if its bounds allow; returns its state."""
    for c in range(class_values.size):
        least, most = low[depth, 0, c], high[depth, 0, c]
        for k in range(1, 8):
            least = min(least, low[depth, k, c])
            most = max(most, high[depth, k, c])
        if most - least > tolerance:
            return CHILD_INNER
        low[depth - 1, place, c], high[depth - 1, place, c] = least, most
        class_values[c] = _middle(least, most)
    for i in range(4):
        totals[i] = before[depth, i]
    num_own = _write_leaf(class_values, totals[1], values, masks, own_values, totals)
    totals[1] += 1
    return CHILD_VECTOR if num_own > 0 else CHILD_SCALAR


@kernel
def _interleave(low, high):
    """A word whose even bits are the 8 bits of ``low`` and whose odd bits are those of ``high``."""
    x = low | high << np.uint64(32)
    x = (x | x << np.uint64(4)) & np.uint64(0x0F0F00000F0F)
    x = (x | x << np.uint64(2)) & np.uint64(0x333300003333)
    x = (x | x << ONE) & np.uint64(0x555500005555)
    return np.uint16(x | x >> np.uint64(31))


@kernel
def _write_words(known, starts, vector, words, totals):
    """Append the words of one brick that is not a leaf.

    No branches: what is no word is overwritten by the next. Unsigned places need no check of their sign.
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


@kernel
def _write_vectors(
    block, rows, octets, classes, octet_rows, octet_sizes, class_values, starts, vector, values, masks, own_values,
    totals,
):  # fmt: skip
    """Append the masks and other values of a brick's vector leaves, the first of which stands at ``totals[1]``.

    ``octet_rows``, ``octet_sizes`` and ``class_values`` are set.
    """
    num_classes = class_values.size
    for e in range(OCTETS):
        octet_sizes[e] = 0
    for r in range(OCTETS, rows):
        e = octets[r]
        octet_rows[e, octet_sizes[e]] = r
        octet_sizes[e] += 1
    left = vector
    while left:
        i = lowest_one(left)
        left &= left - ONE
        e, k = i >> 3, i & 7
        shared = block[e, k]
        for b in range(masks.shape[1]):
            masks[totals[2], b] = 0
        num_own = 0
        for j in range(octet_sizes[e]):
            r = octet_rows[e, j]
            own_values[totals[3] + num_own] = block[r, k]
            is_own = same_bits(block[r, k]) != same_bits(shared)
            masks[totals[2], classes[r] >> 3] |= np.uint8(is_own) << np.uint8(classes[r] & 7)
            num_own += is_own
        if 2 * num_own < num_classes:
            totals[2] += 1
            totals[3] += num_own
            continue
        # The shared value may not be the one that most classes have.
        for c in range(num_classes):
            class_values[c] = shared
        for j in range(octet_sizes[e]):
            r = octet_rows[e, j]
            class_values[classes[r]] = block[r, k]
        place = totals[1] + ones_below(starts, i)
        _write_leaf(class_values, place, values, masks, own_values, totals)


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
def encode_bricks(bricks, order, num_classes, prune, tolerance, scratch, words, values, masks, own_values, totals):
    """Write the octree over the bricks ``order`` (n,), sorted by code, each with a known cell, depth-first.

    ``words`` gets 16 bits per inner node, two for each child; ``values``, ``masks`` and ``own_values`` the leaves.
    There is room for more than is needed: one word, one leaf, one mask, and C values. Eight leaves that differ by at
    most ``tolerance`` are one leaf; nothing is merged without ``prune``. ``totals`` (4,) counts what is written of
    each, from 0. ``scratch`` is an EncoderScratch whose first octets are 0 to 7.
    """
    lossy = prune and tolerance > 0
    block, octets, classes, flags, octet_rows, octet_sizes, class_values, before, states, low, high = scratch
    shared = 0
    for n in range(order.size):
        index = order[n]
        code = bricks.codes[index]
        known = bricks.known[index]
        for depth in range(shared, BRICK_DEPTH):
            for i in range(4):
                before[depth, i] = totals[i]
            for k in range(8):
                states[depth, k] = CHILD_UNKNOWN
            totals[0] += 1
        place = code & 7
        state = CHILD_INNER
        if prune and known == ALL_CELLS and bricks.blocks[index] < 0:
            value = bricks.values[index] + NO_SIGN
            for c in range(num_classes):
                low[BRICK_DEPTH - 1, place, c] = high[BRICK_DEPTH - 1, place, c] = value
            values[totals[1]] = value
            totals[1] += 1
            state = CHILD_SCALAR
        else:
            rows = _copy_block(bricks, index, block, octets, classes)
            if lossy:
                _class_bounds(block, rows, octets, classes, low[BRICK_DEPTH], high[BRICK_DEPTH])
                _smooth_octets(block, rows, octets, known, tolerance)
            vector, change = _compare_cells(block.view(np.int32), rows, octets, flags[0], flags[1])
            merged = _whole_eights(known & (~change | LAST_CELLS)) if prune else ZERO
            if merged == FIRST_CELLS:
                if not lossy:
                    _class_bounds(block, rows, octets, classes, low[BRICK_DEPTH], high[BRICK_DEPTH])
                for i in range(4):
                    before[BRICK_DEPTH, i] = totals[i]
                state = _merge(
                    np.int64(BRICK_DEPTH), place, tolerance, before, low, high, class_values, values, masks,
                    own_values, totals,
                )  # fmt: skip
            if state == CHILD_INNER:
                starts = known & ~(merged * (EIGHT_CELLS - ONE))
                vector &= starts
                _write_words(known, starts, vector, words, totals)
                last = np.uint64(totals[1])
                for e in range(OCTETS):
                    for k in range(OCTETS):
                        values[last] = block[e, k]
                        last += (starts >> np.uint64(8 * e + k)) & ONE
                if vector:
                    _write_vectors(
                        block, rows, octets, classes, octet_rows, octet_sizes, class_values, starts, vector, values,
                        masks, own_values, totals,
                    )  # fmt: skip
                totals[1] = np.int64(last)
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
                state = _merge(
                    depth, place, tolerance, before, low, high, class_values, values, masks, own_values, totals
                )
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
def read_words(words, path, codes, spans, known, starts, vector):
    """The bricks of a depth-first octree: code, number of bricks from there on, and the three masks, (L,) each.

    Only a leaf is larger than a brick. Returns the number of entries, or -1 when the words are no octree with at most
    L leaves. ``path`` (3, BRICK_DEPTH) int64 is set.
    """
    if words.size == 0:
        return 0
    # The open nodes from the root down: word, next child, and code of the first brick.
    path_word, path_child, path_code = path[0], path[1], path[2]
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
def read_class_masks(entries, masks, class_masks):
    """Which classes have values of their own in each octet of the bricks that ``read_words`` gave: ``class_masks``.

    They are (n, W), from 0; ``masks`` (V, W) are those of the vector leaves. Returns the rows that the bricks take.
    """
    leaf = 0
    total = 0
    for n in range(entries.codes.size):
        is_leaf = entries.known[n] == ALL_CELLS and entries.starts[n] == ONE
        vector = entries.vector[n]
        while vector:
            octets = FIRST_CELLS if is_leaf else ONE << (np.uint64(lowest_one(vector)) & ~np.uint64(7))
            vector &= vector - ONE
            for w in range(masks.shape[1]):
                class_masks[n, w] |= np.uint64(masks[leaf, w]) * octets
            leaf += 1
        if entries.vector[n] or not is_leaf:
            total += entries.spans[n] * block_rows(num_rows(entries.known[n], class_masks, n))
    return total


@kernel
def _fill_shared(bricks, block, known, starts, values, first):
    """Write the shared values of a block from its leaves' values, from ``first`` on; returns the number of leaves."""
    count, row = ZERO, block
    for e in range(OCTETS):
        cells = (known >> np.uint64(8 * e)) & EIGHT_CELLS
        if cells == ZERO:
            continue
        for k in range(OCTETS):
            count += (starts >> np.uint64(8 * e + k)) & ONE
            # The last leaf that started.
            value = values[first + max(count, ONE) - ONE]
            bricks.rows[row, k] = value if (cells >> np.uint64(k)) & ONE else np.float32(0.0)
        row += 1
    return count


@kernel
def _fill_own(bricks, index, entries, n, masks, leaf, own_values, first):
    """Write the rows of single classes of a brick from its vector leaves, from ``leaf`` and value ``first`` on.

    Returns the next leaf and value.
    """
    block = np.int64(bricks.blocks[index])
    present = octets_of(entries.known[n])
    first_row = block + count_ones(present)
    row = first_row
    for w in range(masks.shape[1]):
        bits = bricks.masks[index, w]
        while bits:
            octet = block + ones_below(present, lowest_one(bits) & 56)
            for k in range(OCTETS):
                bricks.rows[row, k] = bricks.rows[octet, k]
            row += 1
            bits &= bits - ONE
    known, starts, vector = entries.known[n], entries.starts[n], entries.vector[n]
    is_leaf = known == ALL_CELLS and starts == ONE
    while vector:
        i = np.uint64(lowest_one(vector))
        vector &= vector - ONE
        # The leaf is the whole brick, an octet or a cell.
        shift = i & ~np.uint64(7)
        is_octet = (starts >> shift) & EIGHT_CELLS == ONE and (known >> shift) & EIGHT_CELLS == EIGHT_CELLS
        first_bit, end_bit = (ZERO, np.uint64(64)) if is_leaf else (shift, shift + ONE)
        first_cell, end_cell = (0, OCTETS) if is_octet else (np.int64(i & np.uint64(7)), np.int64(i & np.uint64(7)) + 1)
        before = 0
        for w in range(masks.shape[1]):
            of_brick = bricks.masks[index, w]
            classes = np.uint64(masks[leaf, w])
            while classes:
                c = np.uint64(lowest_one(classes))
                classes &= classes - ONE
                for bit in range(first_bit + c, end_bit + c, 8):
                    row = first_row + before + ones_below(of_brick, bit)
                    for k in range(first_cell, end_cell):
                        bricks.rows[row, k] = own_values[first]
                first += 1
            before += count_ones(of_brick)
        leaf += 1
    return leaf, first


@kernel
def fill_bricks(bricks, entries, class_masks, num_classes, values, masks, own_values):
    """Write the bricks that ``read_words`` gave (n,) into an octree without bricks. Room must be there.

    ``class_masks`` (n, W) are those of ``read_class_masks``.
    """
    first_value, first_leaf, first_own = ZERO, 0, 0
    for n in range(entries.codes.size):
        is_value = entries.known[n] == ALL_CELLS and entries.starts[n] == ONE and not entries.vector[n]
        num_leaves, next_leaf, next_own = ONE, first_leaf, first_own
        for k in range(entries.spans[n]):
            index = add_brick(bricks, entries.codes[n] + k)
            bricks.known[index] = entries.known[n]
            if is_value:
                bricks.values[index] = values[first_value]
                continue
            block = new_block(bricks, num_rows(entries.known[n], class_masks, n))
            bricks.blocks[index] = block
            num_leaves = _fill_shared(bricks, block, entries.known[n], entries.starts[n], values, first_value)
            if entries.vector[n]:
                for w in range(class_masks.shape[1]):
                    bricks.masks[index, w] = class_masks[n, w]
                next_leaf, next_own = _fill_own(bricks, index, entries, n, masks, first_leaf, own_values, first_own)
                share_first_class(bricks.rows, block, entries.known[n], bricks.masks, index, num_classes)
        first_value += num_leaves
        first_leaf, first_own = next_leaf, next_own


@kernel
def _slot(number):
    """The slot, 1 to SLOTS - 1, in which a number of at most 32 bits stands when it is a recent one."""
    return max(np.int64((np.uint64(number) * np.uint64(0x9E3779B1)) >> np.uint64(24)) & (SLOTS - 1), 1)


@kernel
def write_codes(numbers, recent, codes, literals):
    """Write the slot in which each number (n,) uint32 already stands as its code (n,), or 0 and its bytes as a literal.

    ``recent`` (SLOTS,) uint32 are the numbers in the slots, from 0. ``literals`` (4, n) get their bytes, the lowest
    first; returns their number. No branches: what is no literal is overwritten by the next.
    """
    count = 0
    for i in range(numbers.size):
        number = numbers[i]
        slot = _slot(number)
        is_new = recent[slot] != number
        recent[slot] = number
        codes[i] = 0 if is_new else slot
        literals[0, count] = number & 0xFF
        literals[1, count] = (number >> 8) & 0xFF
        literals[2, count] = (number >> 16) & 0xFF
        literals[3, count] = number >> 24
        count += is_new
    return count


@kernel
def read_codes(codes, literals, recent, numbers):
    """The ``numbers`` (n,) uint32 of which ``write_codes`` made the codes (n,) and the literals.

    ``recent`` is from 0, and ``literals`` (4, at least 1 + the codes that are 0).
    """
    count = 0
    for i in range(codes.size):
        is_new = codes[i] == 0
        literal = (
            np.uint32(literals[0, count]) | np.uint32(literals[1, count]) << np.uint32(8)
            | np.uint32(literals[2, count]) << np.uint32(16) | np.uint32(literals[3, count]) << np.uint32(24)
        )  # fmt: skip
        recent_number = recent[codes[i]]
        number = literal if is_new else recent_number
        recent[_slot(number) if is_new else np.int64(codes[i])] = number
        numbers[i] = number
        count += is_new
