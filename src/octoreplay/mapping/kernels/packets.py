"""Conversion of octrees to depth-first streams and back, and the codes of packets.

Three 64-bit masks describe the leaves of a brick: the ``known`` cells, the ``starts`` (first cell of each leaf), and
the ``vector`` leaves (first cells of leaves in which the classes differ). A brick is one leaf where all cells are known
and only cell 0 starts a leaf.

A vector leaf is stored as one value, a mask of the classes with other values, and these values. The one value is that
of most classes (ties go to the lowest class), so equal maps give equal streams, however they are stored.

Before compression each number becomes a code of one byte: the slot of an equal recent number, or 0 for a *literal*, a
number that is stored in full.

A *stream* has ``words`` (uint16, one for each inner node: two bits for each of its eight children), ``values``
(float32, one for each leaf), ``masks`` (uint8, ceil(C / 8) bytes for each vector leaf) and ``own_values`` (float32, the
other values of the vector leaves). ``totals`` (4,) int64 counts what is written of each.

In shapes, n is the number of bricks, C of classes, L of leaves, V of vector leaves, and W = ceil(C / 8) of mask words.
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
"""Bits of a word in which all children are leaves."""

ZERO, ONE = np.uint64(0), np.uint64(1)
FIRST_OCTET = np.uint64(0xFF)
"""The cells of the first octet: a byte of a brick's mask."""
LAST_CELLS = np.uint64(0x8080808080808080)
"""Mask of the last cell of each octet."""
NO_SIGN = np.float32(0.0)
"""Added to values: it turns -0 into 0, so that equal maps give equal bytes."""


SLOTS = 256
"""Number of slots for recent numbers; slot 0 is not used."""


class EncoderScratch(NamedTuple):
    """Scratch memory of encode_bricks.

    Of one brick:

    - ``block`` (8 + 8 C, 8): rows; the first eight are the shared rows of the octets.
    - ``octets`` (8 + 8 C,), ``classes`` (8 + 8 C,): octet and class of each row; ``octets`` starts with 0 to 7.
    - ``flags`` (2, 64): flags of the cells.
    - ``octet_rows`` (8, C), ``octet_sizes`` (8,): class rows of each octet, and their number.
    - ``class_values`` (C,): values of one leaf.

    Of the open nodes from the root down to the brick:

    - ``before`` (BRICK_DEPTH + 1, 4): the totals before each node was written.
    - ``states`` (BRICK_DEPTH, 8): states of each node's children.
    - ``low``, ``high`` (BRICK_DEPTH + 1, 8, C): bounds of their values; one and the same array without a tolerance,
      because the bounds are then equal.
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
    """Copy a brick's rows, with shared rows for all eight octets; returns the number of rows.

    - ``bricks``, ``index``: brick of an octree; it may be stored as one value.
    - ``block`` (8 + 8 C, 8) float32: output, rows.
    - ``octets``, ``classes`` (8 + 8 C,) int64: output from row 8 on, octet and class of each class row.
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
    """Return the masks of cells in which classes differ, and of cells that differ from the next cell of their octet.

    - ``block`` (8 + 8 C, 8) int32: bits of the values, so that a NaN equals itself.
    - ``rows``: number of rows.
    - ``octets`` (rows,) int64: octet of each row.
    - ``is_vector``, ``changes`` (64,) uint8: scratch; one byte for each cell lets the loops compile to vector
      instructions.
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
def _uniform_octets(mask):
    """Return the first cell of each octet that is completely in the ``mask`` uint64."""
    mask &= mask >> np.uint64(4)
    mask &= mask >> np.uint64(2)
    return mask & (mask >> ONE) & FIRST_CELLS


@kernel
def _midpoint(low, high):
    """Midpoint of the range ``low`` to ``high`` float32; exact where both are equal, and never -0."""
    return low + (high - low) / np.float32(2.0) if high > low else low + NO_SIGN


@kernel
def _row_bounds(block, r):
    """Return the lowest and the highest value of row ``r`` of ``block`` (k, 8) float32."""
    least = most = block[r, 0]
    for k in range(1, OCTETS):
        least = min(least, block[r, k])
        most = max(most, block[r, k])
    return least, most


@kernel
def _class_bounds(block, rows, octets, classes, low, high):
    """Find the bounds of each octet's values, class by class.

    - ``block``, ``rows``, ``octets``, ``classes``: as left by _copy_block.
    - ``low``, ``high`` (8, C) float32: output.
    """
    for r in range(rows):
        least, most = _row_bounds(block, r)
        if r < OCTETS:
            for c in range(low.shape[1]):
                low[r, c], high[r, c] = least, most
        else:
            low[octets[r], classes[r]], high[octets[r], classes[r]] = least, most


@kernel
def _smooth_octets(block, rows, octets, known, tolerance):
    """Replace the rows of an octet by their midpoints if all its cells are known and all its rows are within tolerance.

    - ``block``, ``rows``, ``octets``: as left by _copy_block; ``block`` in place.
    - ``known`` uint64: known cells.
    - ``tolerance``: float32, largest range of a row.
    """
    apart = ZERO
    for r in range(rows):
        least, most = _row_bounds(block, r)
        e = np.uint64(octets[r])
        is_known = (known >> (np.uint64(8) * e)) & FIRST_OCTET == FIRST_OCTET
        apart |= np.uint64(not (is_known and most - least <= tolerance)) << e
    for r in range(rows):
        if not (apart >> np.uint64(octets[r])) & ONE:
            least, most = _row_bounds(block, r)
            for k in range(OCTETS):
                block[r, k] = _midpoint(least, most)


@kernel
def _write_leaf(class_values, place, values, masks, own_values, totals):
    """Write a leaf: the value of most classes, then mask and other values; returns the number of other values.

    Values are compared bit by bit, so that a NaN equals itself.

    - ``class_values`` (C,) float32: values of the leaf.
    - ``place``: position of the leaf in ``values``.
    - ``values``, ``masks``, ``own_values``, ``totals``: stream; the number of values is not changed.
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
    """Make a node one leaf if all its children are within tolerance; returns its state.

    - ``depth``, ``place``: the node is child ``place`` of its parent at depth - 1; its children are at ``depth``.
    - ``tolerance``: float32, largest difference of the leaves.
    - ``before``, ``low``, ``high``, ``class_values``: of EncoderScratch.
    - ``values``, ``masks``, ``own_values``, ``totals``: stream; cut back to its size before the node.
    """
    for c in range(class_values.size):
        least, most = low[depth, 0, c], high[depth, 0, c]
        for k in range(1, 8):
            least = min(least, low[depth, k, c])
            most = max(most, high[depth, k, c])
        if most - least > tolerance:
            return CHILD_INNER
        low[depth - 1, place, c], high[depth - 1, place, c] = least, most
        class_values[c] = _midpoint(least, most)
    for i in range(4):
        totals[i] = before[depth, i]
    num_own = _write_leaf(class_values, totals[1], values, masks, own_values, totals)
    totals[1] += 1
    return CHILD_VECTOR if num_own > 0 else CHILD_SCALAR


@kernel
def _interleave(low, high):
    """Return the word with the 8 bits of ``low`` uint64 as even bits and those of ``high`` uint64 as odd bits."""
    x = low | high << np.uint64(32)
    x = (x | x << np.uint64(4)) & np.uint64(0x0F0F00000F0F)
    x = (x | x << np.uint64(2)) & np.uint64(0x333300003333)
    x = (x | x << ONE) & np.uint64(0x555500005555)
    return np.uint16(x | x >> np.uint64(31))


@kernel
def _write_words(known, starts, vector, words, totals):
    """Append the words of one brick that is not a leaf.

    Free of branches: an entry that is no word is overwritten by the next one. Unsigned positions need no sign check.

    - ``known``, ``starts``, ``vector`` uint64: masks of the brick.
    - ``words``, ``totals``: stream.
    """
    word = ZERO
    place = np.uint64(totals[0] + 1)
    for e in range(8):
        shift = np.uint64(8 * e)
        octet_cells = (known >> shift) & FIRST_OCTET
        is_vector = (vector >> shift) & FIRST_OCTET
        is_leaf = np.uint64(octet_cells == FIRST_OCTET) & np.uint64((starts >> shift) & FIRST_OCTET == ONE)
        is_inner = np.uint64(octet_cells != ZERO) & ~is_leaf
        words[place] = _interleave(is_vector, octet_cells)
        place += is_inner
        word |= (is_inner | (is_leaf << ONE) | (is_leaf & is_vector)) << np.uint64(2 * e)
    words[totals[0]] = np.uint16(word)
    totals[0] = np.int64(place)


@kernel
def _write_vectors(
    block, rows, octets, classes, octet_rows, octet_sizes, class_values, starts, vector, values, masks, own_values,
    totals,
):  # fmt: skip
    """Append the masks and other values of a brick's vector leaves.

    - ``block``, ``rows``, ``octets``, ``classes``: as left by _copy_block.
    - ``octet_rows``, ``octet_sizes``, ``class_values``: of EncoderScratch; overwritten.
    - ``starts``, ``vector`` uint64: masks of the brick.
    - ``values``, ``masks``, ``own_values``, ``totals``: stream; the brick's values start at ``totals[1]``.
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
        # The shared value may differ from that of most classes.
        for c in range(num_classes):
            class_values[c] = shared
        for j in range(octet_sizes[e]):
            r = octet_rows[e, j]
            class_values[classes[r]] = block[r, k]
        place = totals[1] + ones_below(starts, i)
        _write_leaf(class_values, place, values, masks, own_values, totals)


@kernel
def _num_common_nodes(code, other):
    """Number of nodes, from the root down, that contain both bricks with the Morton codes ``code`` and ``other``."""
    difference = (code ^ other) >> 3
    shared = BRICK_DEPTH
    while difference:
        difference >>= 3
        shared -= 1
    return shared


@kernel
def _word(states):
    """Return the word of a node whose children have the ``states`` (8,) uint8."""
    word = 0
    for k in range(8):
        word |= np.int64(states[k]) << (2 * k)
    return word


@kernel
def encode_bricks(bricks, order, num_classes, prune, tolerance, scratch, words, values, masks, own_values, totals):
    """Write the octree over some bricks as a depth-first stream.

    Loop invariant: the stream holds the bricks before ``n``. The words of the nodes that contain brick n - 1 and brick
    n are still open: their places are reserved, and their children's states and bounds are in ``scratch``.

    - ``bricks``: Bricks of the octree.
    - ``order`` (n,) int64: brick indices in the order of their codes; each brick has a known cell.
    - ``num_classes``: C.
    - ``prune``: True where eight equal sibling leaves become one leaf.
    - ``tolerance``: float32; siblings that differ by at most as much are equal.
    - ``scratch``: EncoderScratch.
    - ``words``, ``values``, ``masks``, ``own_values``: output, stream, with room for one word, one leaf, one mask and
      C other values more than needed.
    - ``totals`` (4,) int64: output from 0.
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
            merged = _uniform_octets(known & (~change | LAST_CELLS)) if prune else ZERO
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
                starts = known & ~(merged * (FIRST_OCTET - ONE))
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
        # Nodes that do not contain the next brick are complete; the root is never merged.
        shared = 1
        if n + 1 < order.size:
            shared = _num_common_nodes(code, bricks.codes[order[n + 1]])
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
def measure_chunks(
    bricks, order, starts, rows, num_classes, scratch, words, values, masks, own_values, chunk_depth, totals,
    leaf_values,
):  # fmt: skip
    """Count the lossless streams of some chunks: nodes at one depth.

    - ``bricks``, ``order``, ``num_classes``, ``scratch``: as for encode_bricks; the bricks of a chunk are consecutive.
    - ``starts`` (m + 1,) int64: position of each chunk's first brick in ``order``, then n.
    - ``rows`` (m,) int64: row of each chunk in ``totals`` and ``leaf_values``.
    - ``words``, ``values``, ``masks``, ``own_values``: scratch, as for encode_bricks.
    - ``chunk_depth``: depth of the chunks.
    - ``totals`` (r, 4) int64: output, numbers of each array's elements; the words include those of the nodes above.
    - ``leaf_values`` (r, C) float32: output, values of each chunk that is one leaf.
    """
    for n in range(rows.size):
        counts, leaf = totals[rows[n]], leaf_values[rows[n]]
        for i in range(4):
            counts[i] = 0
        encode_bricks(
            bricks, order[starts[n] : starts[n + 1]], num_classes, True, np.float32(0.0), scratch, words, values, masks,
            own_values, counts,
        )  # fmt: skip
        if counts[0] == chunk_depth:
            own = 0
            for c in range(num_classes):
                leaf[c] = values[0]
                if counts[2] > 0 and masks[0, c >> 3] >> np.uint8(c & 7) & np.uint8(1):
                    leaf[c] = own_values[own]
                    own += 1


@kernel
def _even_bits(word):
    """Return the even bits of ``word`` uint64 as 8 bits."""
    x = word & np.uint64(0x5555)
    x = (x | x >> ONE) & np.uint64(0x3333)
    x = (x | x >> np.uint64(2)) & np.uint64(0x0F0F)
    return (x | x >> np.uint64(4)) & FIRST_OCTET


@kernel
def _read_brick(words, used):
    """Return the masks known, starts and vector of the brick with word ``used``, and the next word; 0 if malformed."""
    known, starts, vector = ZERO, ZERO, ZERO
    word = np.uint64(words[used])
    used += 1
    for e in range(8):
        shift = np.uint64(8 * e)
        state = (word >> np.uint64(2 * e)) & np.uint64(3)
        if state == np.uint64(CHILD_INNER):
            if used == words.size:
                return known, starts, vector, 0
            is_vector = _even_bits(np.uint64(words[used]))
            octet_cells = _even_bits(np.uint64(words[used]) >> ONE)
            used += 1
            # A finest cell cannot be an inner node.
            if is_vector & ~octet_cells:
                return known, starts, vector, 0
            known |= octet_cells << shift
            starts |= octet_cells << shift
            vector |= is_vector << shift
        elif state:
            known |= FIRST_OCTET << shift
            starts |= ONE << shift
            vector |= (state & ONE) << shift
    return known, starts, vector, used


@kernel
def read_words(words, path, codes, spans, known, starts, vector):
    """Read the bricks of a stream; returns the number of entries, -1 where the words are no octree of at most L leaves.

    Only leaves are larger than a brick.

    Loop invariant: ``path[:, : depth + 1]`` are the open nodes, and the outputs hold all bricks before the next child
    of the last one.

    - ``words`` uint16: of the stream.
    - ``path`` (3, BRICK_DEPTH) int64: scratch; word, next child and first brick's code of each open node.
    - ``codes`` (L,) int64: output, Morton code of the first brick of each entry.
    - ``spans`` (L,) int64: output, number of bricks of each entry.
    - ``known``, ``starts``, ``vector`` (L,) uint64: output, masks of each entry.
    """
    if words.size == 0:
        return 0
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
    """Find the class rows of the bricks of a stream; returns the number of rows that they take.

    - ``entries``: arrays (n,) filled by read_words.
    - ``masks`` (V, W) uint8: of the stream.
    - ``class_masks`` (n, W) uint64: output from 0, class rows of each entry.
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
    """Write the shared rows of a block; returns the number of its leaves.

    - ``bricks``: Bricks, in place.
    - ``block``: first row of the block.
    - ``known``, ``starts`` uint64: masks of the brick.
    - ``values`` float32, ``first``: of the stream; the brick's leaves start at ``first``.
    """
    count, row = ZERO, block
    for e in range(OCTETS):
        cells = (known >> np.uint64(8 * e)) & FIRST_OCTET
        if cells == ZERO:
            continue
        for k in range(OCTETS):
            count += (starts >> np.uint64(8 * e + k)) & ONE
            # The leaf that contains the cell is the last one that started.
            value = values[first + max(count, ONE) - ONE]
            bricks.rows[row, k] = value if (cells >> np.uint64(k)) & ONE else np.float32(0.0)
        row += 1
    return count


@kernel
def _fill_class_rows(bricks, index, entries, n, masks, leaf, own_values, first):
    """Write the class rows of a brick; returns the positions of the next vector leaf and other value.

    - ``bricks``, ``index``: brick, in place.
    - ``entries``, ``n``: entry of the brick.
    - ``masks`` (V, W) uint8, ``leaf``: of the stream; the brick's vector leaves start at ``leaf``.
    - ``own_values`` float32, ``first``: of the stream; the brick's other values start at ``first``.
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
        is_octet = (starts >> shift) & FIRST_OCTET == ONE and (known >> shift) & FIRST_OCTET == FIRST_OCTET
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
    """Write the bricks of a stream into an octree without bricks. Needs room for bricks and rows.

    Loop invariant: the entries before ``n`` are written; ``first_value``, ``first_leaf`` and ``first_own`` are the
    positions of the next entry's leaf, vector leaf and other value in the stream.

    - ``bricks``: Bricks, in place.
    - ``entries``: arrays (n,) filled by read_words.
    - ``class_masks`` (n, W) uint64: class rows found by read_class_masks.
    - ``num_classes``: C.
    - ``values`` (L,) float32, ``masks`` (V, W) uint8, ``own_values`` float32: of the stream.
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
                next_leaf, next_own = _fill_class_rows(
                    bricks, index, entries, n, masks, first_leaf, own_values, first_own
                )
                share_first_class(bricks.rows, block, entries.known[n], bricks.masks, index, num_classes)
        first_value += num_leaves
        first_leaf, first_own = next_leaf, next_own


@kernel
def _slot(number):
    """Return the slot, 1 to SLOTS - 1, of ``number`` (at most 32 bits)."""
    return max(np.int64((np.uint64(number) * np.uint64(0x9E3779B1)) >> np.uint64(24)) & (SLOTS - 1), 1)


@kernel
def write_codes(numbers, recent, codes, literals):
    """Write numbers as codes and literals; returns the number of literals.

    Free of branches: an entry that is no literal is overwritten by the next one.

    Loop invariant: ``recent`` holds the last number of each slot among those before ``i``, as in read_codes.

    - ``numbers`` (n,) uint32.
    - ``recent`` (SLOTS,) uint32: scratch from 0, numbers in the slots.
    - ``codes`` (n,) uint8: output, slot of the number if it is there, else 0.
    - ``literals`` (4, n) uint8: output, bytes of the numbers with code 0, lowest byte first.
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
    """Read the numbers that write_codes wrote.

    Loop invariant: ``recent`` holds the last number of each slot among those before ``i``, as in write_codes.

    - ``codes`` (n,) uint8.
    - ``literals`` (4, at least 1 + number of codes 0) uint8.
    - ``recent`` (SLOTS,) uint32: scratch from 0, numbers in the slots.
    - ``numbers`` (n,) uint32: output.
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
