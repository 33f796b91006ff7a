"""Octrees as depth-first streams, and back."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import kernel
from octoreplay.mapping.kernels.storage import (
    ALL_CELLS,
    BRICK_CELLS,
    BRICK_DEPTH,
    CELL_BITS,
    KEY_BITS,
    SCALAR,
    UNIFORM,
    VECTOR,
    add_brick,
    make_scalar,
    make_vector,
)

CHILD_UNKNOWN, CHILD_INNER, CHILD_SCALAR, CHILD_VECTOR = 0, 1, 2, 3


@kernel
def _group_state(low, high, states, start, tolerance, num_classes):
    """State of the node whose eight children are ``start``..: what its parent's word says of it.

    ``low`` and ``high`` (C, n) bound the children's values, and get the node's own bounds at ``start``.
    """
    known = 0
    leaves = 0
    vector = False
    for k in range(8):
        state = states[start + k]
        known += state != CHILD_UNKNOWN
        leaves += state >= CHILD_SCALAR
        vector |= state == CHILD_VECTOR
    if known == 0:
        return CHILD_UNKNOWN
    if leaves < 8:
        return CHILD_INNER
    for c in range(num_classes):
        least, most = low[c, start], high[c, start]
        for k in range(1, 8):
            least = min(least, low[c, start + k])
            most = max(most, high[c, start + k])
        if most - least > tolerance:
            return CHILD_INNER
    for c in range(num_classes):
        for k in range(1, 8):
            low[c, start] = min(low[c, start], low[c, start + k])
            high[c, start] = max(high[c, start], high[c, start + k])
    return CHILD_VECTOR if vector else CHILD_SCALAR


@kernel
def _write_leaf(state, low, high, place, scalars, vectors, totals):
    """Append one leaf's value: the middle of its bounds, which is exact where they are equal."""
    if state == CHILD_SCALAR:
        scalars[totals[1]] = low[0, place] + (high[0, place] - low[0, place]) / np.float32(2.0)
        totals[1] += 1
    else:
        for c in range(vectors.shape[1]):
            vectors[totals[2], c] = low[c, place] + (high[c, place] - low[c, place]) / np.float32(2.0)
        totals[2] += 1


@kernel
def _word(states, start):
    """The 16-bit word of a node: two bits for each of its eight children, the first in the lowest bits."""
    word = 0
    for k in range(8):
        word |= np.int64(states[start + k]) << (2 * k)
    return np.uint16(word)


@kernel
def _load_cells(bricks, index, low, cells):
    """Values of a brick's cells (C, 64) and the state of each cell; returns how many classes have their own values."""
    tier = bricks.tiers[index]
    cells[:] = CHILD_SCALAR
    if tier == UNIFORM:
        low[0, :] = bricks.values[index]
    elif tier == SCALAR:
        low[0, :] = bricks.scalar[bricks.rows[index]]
    else:
        low[0, :] = bricks.vector[bricks.rows[index], 0]
        for c in range(1, low.shape[0]):
            row = bricks.vector[bricks.rows[index], c]
            for i in range(BRICK_CELLS):
                low[c, i] = row[i]
                cells[i] |= np.uint8(row[i] != low[0, i])
    known = bricks.known[index]
    if known != ALL_CELLS:
        for i in range(BRICK_CELLS):
            if (known >> np.uint64(i)) & np.uint64(1) == 0:
                cells[i] = CHILD_UNKNOWN
    return low.shape[0] if tier == VECTOR else 1


@kernel
def _reduce(low, high, states, limit, width, low_out, high_out, states_out):
    """The nodes one level up: their bounds and states from those of their eight children each."""
    for k in range(states_out.size):
        states_out[k] = _group_state(low, high, states, 8 * k, limit, width)
        for c in range(width):
            low_out[c, k] = low[c, 8 * k]
            high_out[c, k] = high[c, 8 * k]


@kernel
def encode_bricks(bricks, order, prune, tolerance, words, scalars, vectors):
    """Write the octree over the bricks ``order`` (n,), sorted by code, in depth-first order.

    ``words`` gets 16 bits per inner node, two for each child; ``scalars`` and ``vectors`` (m, C) the leaves' values.
    Eight leaves that differ by at most ``tolerance`` are one leaf; nothing is merged without ``prune``.
    Returns the number of words, scalars and vectors.
    """
    num_classes = bricks.vector.shape[1]
    limit = tolerance if prune else np.float32(-1.0)
    low = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    low8 = np.empty((num_classes, 8), dtype=np.float32)
    # The bounds of a node's values; without a tolerance they are equal, and one array serves as both.
    lossy = limit > np.float32(0.0)
    high = np.empty_like(low) if lossy else low
    high8 = np.empty_like(low8) if lossy else low8
    cells = np.empty(BRICK_CELLS, dtype=np.uint8)
    eights = np.empty(8, dtype=np.uint8)
    totals = np.zeros(3, dtype=np.int64)
    # The open nodes from the root down: where each one's word stands, what was written before it, its children.
    starts = np.zeros((BRICK_DEPTH + 1, 3), dtype=np.int64)
    states = np.zeros((BRICK_DEPTH + 1, 8), dtype=np.uint8)
    node_low = np.zeros((BRICK_DEPTH + 1, num_classes, 8), dtype=np.float32)
    node_high = np.zeros((BRICK_DEPTH + 1, num_classes, 8), dtype=np.float32)
    for n in range(order.size):
        index = order[n]
        code = bricks.codes[index]
        first = 0
        if n > 0:
            difference = code ^ bricks.codes[order[n - 1]]
            while difference >> (3 * (BRICK_DEPTH - 1 - first)) == 0:
                first += 1
            for depth in range(BRICK_DEPTH - 1, first, -1):
                _close(depth, bricks.codes[order[n - 1]], limit, starts, states, node_low, node_high,
                       words, scalars, vectors, totals)  # fmt: skip
            first += 1
        for depth in range(first, BRICK_DEPTH):
            starts[depth, :] = totals
            states[depth, :] = CHILD_UNKNOWN
            totals[0] += 1
        parent = BRICK_DEPTH - 1
        place = code & 7
        if bricks.tiers[index] == UNIFORM and prune:
            state = CHILD_SCALAR if bricks.known[index] else CHILD_UNKNOWN
            node_low[parent, :, place] = bricks.values[index]
            node_high[parent, :, place] = bricks.values[index]
        else:
            width = _load_cells(bricks, index, low, cells)
            if lossy:
                high[:width, :] = low[:width, :]
            _reduce(low, high, cells, limit, width, low8, high8, eights)
            state = _group_state(low8, high8, eights, 0, limit, width)
            for c in range(num_classes):
                node_low[parent, c, place] = low8[c if width > 1 else 0, 0]
                node_high[parent, c, place] = high8[c if width > 1 else 0, 0]
        states[parent, place] = state
        if state >= CHILD_SCALAR:
            _write_leaf(state, node_low[parent], node_high[parent], place, scalars, vectors, totals)
        elif state == CHILD_INNER:
            words[totals[0]] = _word(eights, 0)
            totals[0] += 1
            for e in range(8):
                if eights[e] >= CHILD_SCALAR:
                    _write_leaf(eights[e], low8, high8, e, scalars, vectors, totals)
                elif eights[e] == CHILD_INNER:
                    words[totals[0]] = _word(cells, 8 * e)
                    totals[0] += 1
                    for i in range(8 * e, 8 * e + 8):
                        if cells[i] != CHILD_UNKNOWN:
                            _write_leaf(cells[i], low, high, i, scalars, vectors, totals)
    if order.size > 0:
        for depth in range(BRICK_DEPTH - 1, -1, -1):
            _close(depth, bricks.codes[order[order.size - 1]], limit, starts, states, node_low, node_high,
                   words, scalars, vectors, totals)  # fmt: skip
    return totals


@kernel
def _close(depth, code, limit, starts, states, node_low, node_high, words, scalars, vectors, totals):
    """Finish the open node at ``depth`` above the brick ``code``: write its word, or make it one leaf."""
    width = node_low.shape[1]
    state = CHILD_INNER
    if depth > 0:
        state = _group_state(node_low[depth], node_high[depth], states[depth], 0, limit, width)
        parent, place = depth - 1, (code >> (3 * (BRICK_DEPTH - depth))) & 7
        states[parent, place] = state
        node_low[parent, :, place] = node_low[depth, :, 0]
        node_high[parent, :, place] = node_high[depth, :, 0]
    if state == CHILD_INNER:
        words[starts[depth, 0]] = _word(states[depth], 0)
        return
    totals[:] = starts[depth]
    if state >= CHILD_SCALAR:
        _write_leaf(state, node_low[depth - 1], node_high[depth - 1], place, scalars, vectors, totals)


@kernel
def walk_leaves(words, codes, depths, is_vector):
    """The leaves of a depth-first octree: Morton code of their lowest cell, depth and kind, (L,) each.

    Returns the number of leaves, or -1 when the words are no octree of at most L leaves.
    """
    if words.size == 0:
        return 0
    path_word = np.zeros(KEY_BITS + 1, dtype=np.int64)
    path_child = np.zeros(KEY_BITS + 1, dtype=np.int64)
    path_code = np.zeros(KEY_BITS + 1, dtype=np.int64)
    count = 0
    used = 1
    depth = 0
    path_word[0] = words[0]
    while depth >= 0:
        child = path_child[depth]
        if child == 8:
            depth -= 1
            continue
        path_child[depth] = child + 1
        state = (path_word[depth] >> (2 * child)) & 3
        code = path_code[depth] | child << (3 * (KEY_BITS - 1 - depth))
        if state == CHILD_INNER:
            if depth == KEY_BITS - 1 or used == words.size:
                return -1
            depth += 1
            path_word[depth] = words[used]
            path_child[depth] = 0
            path_code[depth] = code
            used += 1
        elif state >= CHILD_SCALAR:
            if count == codes.size:
                return -1
            codes[count] = code
            depths[count] = depth + 1
            is_vector[count] = state == CHILD_VECTOR
            count += 1
    return count if used == words.size else -1


@kernel
def fill_from_leaves(bricks, codes, depths, is_vector, scalars, vectors):
    """Write leaves (L,) into an octree without bricks. Room must be there."""
    num_scalars, num_vectors = 0, 0
    last_code, index = np.int64(-1), np.int64(-1)
    for n in range(codes.size):
        span = np.int64(1) << (3 * (KEY_BITS - depths[n]))
        brick_code = codes[n] >> CELL_BITS
        if depths[n] <= BRICK_DEPTH:
            for k in range(span >> CELL_BITS):
                index = add_brick(bricks, brick_code + k)
                bricks.known[index] = ALL_CELLS
                if is_vector[n]:
                    make_vector(bricks, index)
                    for c in range(vectors.shape[1]):
                        bricks.vector[bricks.rows[index], c, :] = vectors[num_vectors, c]
                else:
                    bricks.values[index] = scalars[num_scalars]
        else:
            if brick_code != last_code:
                index = add_brick(bricks, brick_code)
                last_code = brick_code
                make_scalar(bricks, index)
            start = codes[n] & (BRICK_CELLS - 1)
            if is_vector[n]:
                make_vector(bricks, index)
            for i in range(start, start + span):
                bricks.known[index] |= np.uint64(1) << np.uint64(i)
            row = bricks.rows[index]
            if is_vector[n]:
                for c in range(vectors.shape[1]):
                    for i in range(start, start + span):
                        bricks.vector[row, c, i] = vectors[num_vectors, c]
            elif bricks.tiers[index] == VECTOR:
                for c in range(vectors.shape[1]):
                    for i in range(start, start + span):
                        bricks.vector[row, c, i] = scalars[num_scalars]
            else:
                for i in range(start, start + span):
                    bricks.scalar[row, i] = scalars[num_scalars]
        if is_vector[n]:
            num_vectors += 1
        else:
            num_scalars += 1
