"""One iteration of a consensus rule, and the sum of evidence, brick by brick.

The loops run over whole bricks that lie in one piece, so that they become vector instructions. Only integers are
reduced over lanes: the order of a floating point sum is part of the result.
"""

from __future__ import annotations

import numpy as np
from numba import carray

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.intrinsics import float_pointer, fma, prefetch_line, same_bits
from octoreplay.mapping.kernels.storage import (
    ABSENT,
    BRICK_CELLS,
    SCALAR,
    UNIFORM,
    VECTOR,
    collapse,
)

GRADIENT, NATURAL, BAYES, LOCAL = 0, 1, 2, 3


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


@kernel
def prefetch(address, tier, num_classes):
    """Ask for a brick's data ahead of its use: bricks lie in another order in every octree."""
    if tier == ABSENT:
        return
    size = 4 if tier == UNIFORM else BRICK_CELLS * 4
    if tier == VECTOR:
        size *= num_classes
    for offset in range(0, size, 64):
        prefetch_line(address + offset)


@kernel
def load(target, address, tier, width):
    """Target (width x 64,) = the brick at ``address``, repeated over the classes; 0 where there is none."""
    if tier == VECTOR or (tier == SCALAR and width == 1):
        source = carray(float_pointer(address), target.shape)
        for i in range(target.size):
            target[i] = source[i]
    elif tier == SCALAR:
        cells = carray(float_pointer(address), (BRICK_CELLS,))
        rows = target.reshape((width, BRICK_CELLS))
        for c in range(width):
            for i in range(BRICK_CELLS):
                rows[c, i] = cells[i]
    else:
        value = carray(float_pointer(address), (1,))[0] if tier == UNIFORM else np.float32(0.0)
        for i in range(target.size):
            target[i] = value


@kernel
def _add_difference(target, base, address, tier, width, weight):
    """Target (width x 64,) += weight x (the brick at ``address`` - base)."""
    if tier == VECTOR or (tier == SCALAR and width == 1):
        source = carray(float_pointer(address), target.shape)
        for i in range(target.size):
            target[i] = fma(source[i] - base[i], weight, target[i])
    elif tier == SCALAR:
        cells = carray(float_pointer(address), (BRICK_CELLS,))
        rows = target.reshape((width, BRICK_CELLS))
        base_rows = base.reshape((width, BRICK_CELLS))
        for c in range(width):
            for i in range(BRICK_CELLS):
                rows[c, i] = fma(cells[i] - base_rows[c, i], weight, rows[c, i])
    else:
        value = carray(float_pointer(address), (1,))[0] if tier == UNIFORM else np.float32(0.0)
        for i in range(target.size):
            target[i] = fma(value - base[i], weight, target[i])


OWN, BASE, EVIDENCE, OLD_EVIDENCE, NEIGHBOURS = 0, 1, 2, 3, 4
"""Columns of the address table of a consensus step: the robot's own map, the map that it published (the base of the
differences), its evidence log q, its evidence at the last iteration, then the neighbours' maps."""


PREFETCH_AHEAD = 6
"""Bricks between the one that is asked for and the one in work: a few microseconds."""


@kernel
def _add_gradient(mixed_at, delta_at, sigma_at, top_at, width, terms, gamma):
    """Mixed (width, 64) += gamma x the gradient, with ``delta`` (width, 64) = h~ - log q; all given by address.

    Every row stands for ``terms`` equal classes. ``sigma`` (width, 64) and ``top`` (3, 64) are scratch.
    """
    mixed = carray(float_pointer(mixed_at), (width, BRICK_CELLS))
    delta = carray(float_pointer(delta_at), (width, BRICK_CELLS))
    sigma = carray(float_pointer(sigma_at), (width, BRICK_CELLS))
    top = carray(float_pointer(top_at), (BRICK_CELLS,))
    total = carray(float_pointer(top_at + BRICK_CELLS * 4), (BRICK_CELLS,))
    dot = carray(float_pointer(top_at + BRICK_CELLS * 8), (BRICK_CELLS,))
    for i in range(BRICK_CELLS):
        top[i] = np.float32(0.0)
        total[i] = np.float32(0.0)
        dot[i] = np.float32(0.0)
    for c in range(width):
        for i in range(BRICK_CELLS):
            top[i] = max(top[i], mixed[c, i])
    for c in range(width):
        for i in range(BRICK_CELLS):
            share = exp_negative(mixed[c, i] - top[i])
            sigma[c, i] = share
            total[i] += share
            dot[i] = fma(share, delta[c, i], dot[i])
    for i in range(BRICK_CELLS):
        share = np.float32(1.0) / fma(terms, total[i], exp_negative(-top[i]))
        dot[i] *= terms * share
        total[i] = gamma * share
    for c in range(width):
        for i in range(BRICK_CELLS):
            mixed[c, i] = fma(sigma[c, i] * total[i], dot[i] - delta[c, i], mixed[c, i])


@kernel
def consensus_step(addresses, tiers, weights, rule, gamma, num_classes, scratch, changes):
    """One iteration of a rule at one robot, brick by brick, in place in the robot's own map (column OWN).

    ``addresses`` and ``tiers`` (n, NEIGHBOURS + J) say where each brick lies; the own brick has at least the tier of
    all others. ``weights`` (J,) float32 are 2 epsilon A_ij. ``scratch`` float32 has room for 5 bricks of all classes
    and 3 of one. ``changes`` (n,) gets each brick's largest change.
    All classes of a brick that is not VECTOR are equal; the sums over classes then are ``num_classes`` times one term.
    """
    own_at, room = np.int64(scratch.ctypes.data), num_classes * BRICK_CELLS * 4
    mixed_at, delta_at, sigma_at, top_at = own_at + room, own_at + 2 * room, own_at + 3 * room, own_at + 5 * room
    last = addresses.shape[0] - 1
    for b in range(addresses.shape[0]):
        ahead = min(b + PREFETCH_AHEAD, last)
        tier = tiers[b, OWN]
        width = num_classes if tier == VECTOR else 1
        terms = np.float32(1.0) if tier == VECTOR else np.float32(num_classes)
        size = width * BRICK_CELLS
        own = carray(float_pointer(own_at), (size,))
        mixed = carray(float_pointer(mixed_at), (size,))
        delta = carray(float_pointer(delta_at), (size,))
        prefetch(addresses[ahead, OWN], tiers[ahead, OWN], num_classes)
        load(own, addresses[b, OWN], tier, width)
        base = own
        if addresses[b, BASE] != addresses[b, OWN]:
            base = carray(float_pointer(own_at + 4 * room), (size,))
            load(base, addresses[b, BASE], tiers[b, BASE], width)
        # The sum of the differences comes first: it is exactly 0 where all maps agree.
        for i in range(size):
            mixed[i] = np.float32(0.0)
        for j in range(weights.size):
            column = NEIGHBOURS + j
            prefetch(addresses[ahead, column], tiers[ahead, column], num_classes)
            _add_difference(mixed, base, addresses[b, column], tiers[b, column], width, weights[j])
        prefetch(addresses[ahead, EVIDENCE], tiers[ahead, EVIDENCE], num_classes)
        load(delta, addresses[b, EVIDENCE], tiers[b, EVIDENCE], width)
        if rule == LOCAL:
            for i in range(size):
                mixed[i] = delta[i]
        elif rule == BAYES:
            old = carray(float_pointer(sigma_at), (size,))
            load(old, addresses[b, OLD_EVIDENCE], tiers[b, OLD_EVIDENCE], width)
            for i in range(size):
                mixed[i] += own[i] + (delta[i] - old[i])
        else:
            for i in range(size):
                mixed[i] += own[i]
                delta[i] = mixed[i] - delta[i]
            if rule == NATURAL:
                for i in range(size):
                    mixed[i] -= gamma * delta[i]
            elif gamma != np.float32(0.0):
                _add_gradient(mixed_at, delta_at, sigma_at, top_at, width, terms, gamma)
        # Numbers that are not negative are in the order of their bits.
        largest = np.int32(0)
        for i in range(size):
            largest = max(largest, same_bits(abs(mixed[i] - own[i])))
        changes[b] = same_bits(largest)
        if largest > 0:
            target = carray(float_pointer(addresses[b, OWN]), (size,))
            for i in range(1 if tier == UNIFORM else size):
                target[i] = mixed[i]


@kernel
def finish_step(bricks, changes, known_changed, revision):
    """Set the revision of every brick that changed and prune those that became uniform."""
    for index in range(changes.size):
        if changes[index] > 0.0 or known_changed[index]:
            bricks.revisions[index] = revision
            collapse(bricks, index)


@kernel
def needed_tiers(tiers, needed):
    """The tier (n,) that each own brick must have to hold the result: the highest that is present in its row."""
    for b in range(tiers.shape[0]):
        highest = UNIFORM
        for j in range(tiers.shape[1]):
            if tiers[b, j] != ABSENT and tiers[b, j] > highest:
                highest = tiers[b, j]
        needed[b] = highest


@kernel
def sum_evidence(addresses, tiers, count_tiers_offset, scales, num_classes, targets, target_tiers):
    """The sum over robots of log q for each brick, written to ``targets`` (n,) addresses: the oracle.

    ``addresses`` and ``tiers`` (n, N) are the robots' evidence; columns N.. hold the scan counts where
    ``count_tiers_offset`` is N, and -1 means that the evidence is multiplied by ``scales`` (N,).
    """
    robots = scales.size
    all_terms = np.empty(num_classes * BRICK_CELLS, dtype=np.float32)
    all_counts = np.empty(num_classes * BRICK_CELLS, dtype=np.float32)
    all_totals = np.empty(num_classes * BRICK_CELLS, dtype=np.float32)
    for b in range(addresses.shape[0]):
        width = num_classes if target_tiers[b] == VECTOR else 1
        size = width * BRICK_CELLS
        term, count, total = all_terms[:size], all_counts[:size], all_totals[:size]
        for i in range(size):
            total[i] = np.float32(0.0)
        for r in range(robots):
            load(term, addresses[b, r], tiers[b, r], width)
            for i in range(size):
                count[i] = np.float32(1.0)
            if count_tiers_offset >= 0:
                # Counts are an octree of one class: its VECTOR bricks have one row, like the SCALAR ones.
                column = count_tiers_offset + r
                count_tier = SCALAR if tiers[b, column] == VECTOR else tiers[b, column]
                load(count, addresses[b, column], count_tier, width)
            for i in range(size):
                total[i] += term[i] * scales[r] / max(count[i], np.float32(1.0))
        out = carray(float_pointer(targets[b]), (size,))
        for i in range(1 if target_tiers[b] == UNIFORM else size):
            out[i] = total[i]
