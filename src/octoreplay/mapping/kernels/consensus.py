"""One iteration of a consensus rule, and the sum of evidence, brick by brick."""

from __future__ import annotations

import numpy as np
from numba import carray

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.storage import ABSENT, BRICK_CELLS, SCALAR, UNIFORM, VECTOR, collapse, float_pointer

GRADIENT, NATURAL, BAYES, LOCAL = 0, 1, 2, 3


@kernel
def exp_negative(x, out, powers, scales):
    """Exp of ``x`` (64,), all at most 0, into ``out``: 2^n times a polynomial (Cephes' expf, Moshier 1992).

    ``powers`` (64,) int32 and ``scales``, the same memory seen as float32, are scratch.
    """
    for i in range(x.size):
        value = max(x[i], np.float32(-87.0))
        n = np.floor(value * np.float32(1.44269504088896341) + np.float32(0.5))
        f = value - n * np.float32(0.693359375) + n * np.float32(2.12194440e-4)
        p = np.float32(1.9875691500e-4)
        p = p * f + np.float32(1.3981999507e-3)
        p = p * f + np.float32(8.3334519073e-3)
        p = p * f + np.float32(4.1665795894e-2)
        p = p * f + np.float32(1.6666665459e-1)
        p = p * f + np.float32(5.0000001201e-1)
        out[i] = p * f * f + f + np.float32(1.0)
        powers[i] = (np.int32(n) + np.int32(127)) << np.int32(23)
    for i in range(x.size):
        out[i] *= scales[i]


@inline_kernel
def _add_scaled(target, address, tier, c, factor, num_classes):
    """Target (64,) += factor x class c of the brick at ``address``."""
    if tier == UNIFORM:
        value = carray(float_pointer(address), (1,))[0] * factor
        for i in range(target.size):
            target[i] += value
    elif tier == SCALAR:
        data = carray(float_pointer(address), (BRICK_CELLS,))
        for i in range(target.size):
            target[i] += data[i] * factor
    elif tier == VECTOR:
        rows = carray(float_pointer(address), (num_classes, BRICK_CELLS))
        for i in range(target.size):
            target[i] += rows[c, i] * factor


@inline_kernel
def load(target, address, tier, c, num_classes):
    """Target (64,) = class c of the brick at ``address``, 0 where there is none."""
    target[:] = np.float32(0.0)
    _add_scaled(target, address, tier, c, np.float32(1.0), num_classes)


@inline_kernel
def _load_evidence(target, addresses, tiers, column, count_column, scale, c, counts, num_classes):
    """Target (64,) = class c of log q: the evidence times ``scale``, or divided by the cells' scan counts."""
    load(target, addresses[column], tiers[column], c, num_classes)
    if count_column >= 0:
        load(counts, addresses[count_column], tiers[count_column], 0, 1)
        for i in range(target.size):
            target[i] /= max(counts[i], np.float32(1.0))
    elif scale != np.float32(1.0):
        for i in range(target.size):
            target[i] *= scale


OWN, BASE, EVIDENCE, OLD_EVIDENCE, NEIGHBOURS = 0, 1, 2, 3, 4
"""Columns of the address table of a consensus step: the robot's own map, the map that it published (the base of the
differences), its evidence log q, its evidence at the last iteration, then the neighbours' maps."""


@kernel
def consensus_step(addresses, tiers, weights, rule, gamma, num_classes, changes):
    """One iteration of a rule at one robot, brick by brick, in place in the robot's own map (column OWN).

    ``addresses`` and ``tiers`` (n, NEIGHBOURS + J) say where each brick lies; the own brick has at least the tier of
    all others. ``weights`` (J,) float32 are 2 epsilon A_ij. ``changes`` (n,) gets each brick's largest change.
    All classes of a brick that is not VECTOR are equal; the sums over classes then are ``num_classes`` times one term.
    """
    num_neighbours = weights.size
    mixed = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    delta = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    sigma = np.empty((num_classes, BRICK_CELLS), dtype=np.float32)
    base = np.empty(BRICK_CELLS, dtype=np.float32)
    other = np.empty(BRICK_CELLS, dtype=np.float32)
    top = np.empty(BRICK_CELLS, dtype=np.float32)
    total = np.empty(BRICK_CELLS, dtype=np.float32)
    dot = np.empty(BRICK_CELLS, dtype=np.float32)
    moved = np.empty(BRICK_CELLS, dtype=np.float32)
    powers = np.empty(BRICK_CELLS, dtype=np.int32)
    scales = powers.view(np.float32)
    for b in range(addresses.shape[0]):
        tier = tiers[b, OWN]
        width = num_classes if tier == VECTOR else 1
        terms = np.float32(1.0) if tier == VECTOR else np.float32(num_classes)
        cells = 1 if tier == UNIFORM else BRICK_CELLS
        top[:] = np.float32(0.0)
        for c in range(width):
            row = mixed[c, :cells]
            load(row, addresses[b, OWN], tier, c, num_classes)
            load(base[:cells], addresses[b, BASE], tiers[b, BASE], c, num_classes)
            other[:cells] = np.float32(0.0)
            for j in range(num_neighbours):
                if tiers[b, NEIGHBOURS + j] == ABSENT:
                    for i in range(cells):
                        other[i] -= base[i] * weights[j]
                else:
                    load(total[:cells], addresses[b, NEIGHBOURS + j], tiers[b, NEIGHBOURS + j], c, num_classes)
                    for i in range(cells):
                        other[i] += (total[i] - base[i]) * weights[j]
            for i in range(cells):
                row[i] += other[i]
                top[i] = max(top[i], row[i])
            if rule == BAYES:
                _add_scaled(row, addresses[b, EVIDENCE], tiers[b, EVIDENCE], c, np.float32(1.0), num_classes)
                _add_scaled(row, addresses[b, OLD_EVIDENCE], tiers[b, OLD_EVIDENCE], c, np.float32(-1.0), num_classes)
            elif rule == LOCAL:
                load(row, addresses[b, EVIDENCE], tiers[b, EVIDENCE], c, num_classes)
            else:
                load(other[:cells], addresses[b, EVIDENCE], tiers[b, EVIDENCE], c, num_classes)
                for i in range(cells):
                    delta[c, i] = row[i] - other[i]
        if rule == NATURAL:
            for c in range(width):
                for i in range(cells):
                    mixed[c, i] -= gamma * delta[c, i]
        elif rule == GRADIENT and gamma != np.float32(0.0):
            for i in range(cells):
                base[i] = -top[i]
            exp_negative(base[:cells], total[:cells], powers[:cells], scales[:cells])
            dot[:] = np.float32(0.0)
            for c in range(width):
                for i in range(cells):
                    base[i] = mixed[c, i] - top[i]
                exp_negative(base[:cells], sigma[c, :cells], powers[:cells], scales[:cells])
                for i in range(cells):
                    total[i] += terms * sigma[c, i]
                    dot[i] += terms * sigma[c, i] * delta[c, i]
            for i in range(cells):
                total[i] = np.float32(1.0) / total[i]
                dot[i] *= total[i]
            for c in range(width):
                for i in range(cells):
                    mixed[c, i] += gamma * (sigma[c, i] * total[i]) * (dot[i] - delta[c, i])
        moved[:cells] = np.float32(0.0)
        for c in range(width):
            target = carray(float_pointer(addresses[b, OWN] + c * BRICK_CELLS * 4), (cells,))
            for i in range(cells):
                moved[i] = max(moved[i], abs(mixed[c, i] - target[i]))
                target[i] = mixed[c, i]
        largest = np.float32(0.0)
        for i in range(cells):
            largest = max(largest, moved[i])
        changes[b] = largest


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
    total = np.empty(BRICK_CELLS, dtype=np.float32)
    term = np.empty(BRICK_CELLS, dtype=np.float32)
    counts = np.empty(BRICK_CELLS, dtype=np.float32)
    for b in range(addresses.shape[0]):
        width = num_classes if target_tiers[b] == VECTOR else 1
        cells = 1 if target_tiers[b] == UNIFORM else BRICK_CELLS
        for c in range(width):
            total[:] = np.float32(0.0)
            for r in range(robots):
                count_column = count_tiers_offset + r if count_tiers_offset >= 0 else -1
                _load_evidence(
                    term[:cells], addresses[b], tiers[b], r, count_column, scales[r], c, counts[:cells], num_classes
                )
                for i in range(cells):
                    total[i] += term[i]
            out = carray(float_pointer(targets[b] + c * BRICK_CELLS * 4), (cells,))
            for i in range(cells):
                out[i] = total[i]
