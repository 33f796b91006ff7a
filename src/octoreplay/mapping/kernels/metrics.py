"""Comparison of a team's maps, brick by brick. The loops over a brick's cells compile to vector instructions.

In shapes, N is the number of robots, n of bricks, L of links and C of classes; *width* is C, or 1 for a brick in which
the classes are equal in all maps.
"""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import inline_kernel, kernel
from octoreplay.mapping.kernels.consensus import PREFETCH_AHEAD, exp_negative, prefetch
from octoreplay.mapping.kernels.intrinsics import copy_octet, count_ones, float_array, fma, lowest_one, same_bits
from octoreplay.mapping.kernels.storage import BRICK_CELLS, OCTETS, ROW_BYTES, octets_of


@inline_kernel
def _log(x):
    """Natural logarithm of a float32 ``x`` from 1 to 1e30: exponent and polynomial (Cephes' logf, Moshier 1992)."""
    # The exponent counts from sqrt(1/2), so that the mantissa m lies in [sqrt(1/2), sqrt(2)).
    exponent = np.int32(np.int32(same_bits(x) - np.int32(0x3F3504F3)) >> np.int32(23))
    m = same_bits(same_bits(x) - (exponent << np.int32(23))) - np.float32(1.0)
    p = np.float32(7.0376836292e-2)
    p = fma(p, m, np.float32(-1.1514610310e-1))
    p = fma(p, m, np.float32(1.1676998740e-1))
    p = fma(p, m, np.float32(-1.2420140846e-1))
    p = fma(p, m, np.float32(1.4249322787e-1))
    p = fma(p, m, np.float32(-1.6668057665e-1))
    p = fma(p, m, np.float32(2.0000714765e-1))
    p = fma(p, m, np.float32(-2.4999993993e-1))
    p = fma(p, m, np.float32(3.3333331174e-1))
    return fma(fma(p, m, np.float32(-0.5)), m * m, fma(np.float32(exponent), np.float32(0.69314718056), m))


@kernel
def _load_classes(target_at, table, n, column, width):
    """Write a brick to an address as (width, 64) float32; unknown cells get 0.

    - ``target_at``: address of the values.
    - ``table``, ``n``, ``column``: the brick is row ``n`` of the table's ``column``.
    - ``width``: number of classes, or 1.
    """
    target = float_array(target_at, (width, BRICK_CELLS))
    address = table.addresses[column, n]
    if address == 0:
        value = table.values[column, n]
        for c in range(width):
            for i in range(BRICK_CELLS):
                target[c, i] = value
        return
    octets = octets_of(table.known[column, n])
    row_at = address
    for e in range(OCTETS):
        is_present = octets >> np.uint64(8 * e) & np.uint64(1)
        for c in range(width):
            if is_present:
                copy_octet(target_at + (c * OCTETS + e) * ROW_BYTES, row_at)
            else:
                for k in range(OCTETS):
                    target[c, 8 * e + k] = np.float32(0.0)
        row_at += np.int64(is_present) * ROW_BYTES
    for w in range(table.masks.shape[2]):
        bits = table.masks[column, n, w]
        while bits:
            bit = lowest_one(bits)
            c = 8 * w + (bit & 7)
            copy_octet(target_at + (c * OCTETS + (bit >> 3)) * ROW_BYTES, row_at)
            row_at += ROW_BYTES
            bits &= bits - np.uint64(1)


@kernel
def _total(cells):
    """Sum of ``cells`` (64,) float32 in a fixed order; overwrites them."""
    for i in range(8):
        cells[i] += cells[i + 8] + cells[i + 16] + cells[i + 24]
        cells[i] += cells[i + 32] + cells[i + 40] + cells[i + 48] + cells[i + 56]
    total = 0.0
    for i in range(8):
        total += cells[i]
    return total


@kernel
def _label_cells(rows, oracle, prior, oracle_prior, tie_share, least_tie, labels, best, oracle_there, least_tied):
    """Find the most probable class of each cell; free is 0, equal values go to the lower id.

    - ``rows`` (width, 64) float32: deviations of the map.
    - ``oracle`` (width, 64) float32: deviations of the oracle.
    - ``prior``, ``oracle_prior``: float32, prior that is added to each.
    - ``tie_share``, ``least_tie``: float32, tolerance of ties as a share of the cell's largest |log-odds|, and its
      least value.
    - ``labels`` (64,) int32: output, class ids.
    - ``best`` (64,) float32: output, log-odds of the label.
    - ``oracle_there`` (64,) float32: output, the oracle's log-odds of the same label.
    - ``least_tied`` (64,) float32: output, least log-odds that ties with ``best``.
    """
    for i in range(BRICK_CELLS):
        labels[i] = np.int32(0)
        best[i] = np.float32(0.0)
        oracle_there[i] = np.float32(0.0)
        least_tied[i] = np.float32(0.0)
    for c in range(rows.shape[0]):
        for i in range(BRICK_CELLS):
            value = rows[c, i] + prior
            higher = value > best[i]
            labels[i] = np.int32(c + 1) if higher else labels[i]
            oracle_there[i] = oracle[c, i] + oracle_prior if higher else oracle_there[i]
            best[i] = value if higher else best[i]
            least_tied[i] = max(least_tied[i], abs(value))
    for i in range(BRICK_CELLS):
        least_tied[i] = best[i] - max(tie_share * least_tied[i], least_tie)


@kernel
def _largest(rows, prior, largest):
    """Find the largest log-odds of each cell, free included.

    - ``rows`` (width, 64) float32: deviations of the map.
    - ``prior``: float32 log-odds h_0.
    - ``largest`` (64,) float32: output.
    """
    for i in range(BRICK_CELLS):
        largest[i] = np.float32(0.0)
    for c in range(rows.shape[0]):
        for i in range(BRICK_CELLS):
            largest[i] = max(largest[i], rows[c, i] + prior)


@kernel
def _num_differing(bricks, labels, least_tied, differs, label_priors):
    """Number of cells in which two robots' labels differ and do not tie.

    - ``bricks`` (N, width, 64) float32: deviations of the robots.
    - ``labels`` (N, 64) int32: class ids, -1 where unknown.
    - ``least_tied`` (N, 64) float32: least log-odds of each robot that ties with its largest.
    - ``differs`` (64,) int32: not 0 where labels differ.
    - ``label_priors`` (N,) float32: prior of each robot's labels.
    """
    num = 0
    for i in range(BRICK_CELLS):
        if differs[i] == 0:
            continue
        found = False
        for r in range(1, labels.shape[0]):
            for k in range(r):
                one, other = labels[r, i], labels[k, i]
                if one == other:
                    continue
                if one < 0 or other < 0:
                    found = True
                    break
                there, here = np.float32(0.0), np.float32(0.0)
                if other > 0:
                    there = bricks[r, min(other, bricks.shape[1]) - 1, i] + label_priors[r]
                if one > 0:
                    here = bricks[k, min(one, bricks.shape[1]) - 1, i] + label_priors[k]
                if there < least_tied[r, i] and here < least_tied[k, i]:
                    found = True
                    break
            if found:
                break
        num += np.int64(found)
    return num


@kernel
def _brick_entropy(rows, terms, prior, best, seen, total, weighted):
    """Sum of the cells' entropies [nat].

    - ``rows`` (width, 64) float32: deviations of the map.
    - ``terms``: float32, number of equal classes that a row stands for.
    - ``prior``: float32 log-odds h_0.
    - ``best`` (64,) float32: largest log-odds of each cell.
    - ``seen`` (64,) int32: 1 for the cells that are summed, else 0.
    - ``total``, ``weighted`` (64,) float32: scratch.
    """
    for i in range(BRICK_CELLS):
        total[i] = np.float32(0.0)
        weighted[i] = np.float32(0.0)
    for c in range(rows.shape[0]):
        for i in range(BRICK_CELLS):
            below = (rows[c, i] + prior) - best[i]
            share = exp_negative(below)
            total[i] += share
            weighted[i] = fma(share, below, weighted[i])
    for i in range(BRICK_CELLS):
        free = exp_negative(-best[i])
        whole = fma(terms, total[i], free)
        entropy = _log(whole) - fma(terms, weighted[i], -free * best[i]) / whole
        weighted[i] = entropy if seen[i] > 0 else np.float32(0.0)
    return _total(weighted)


@kernel
def _pair_distance(bricks, square, mean):
    """Sum of the squared differences over all pairs of robots.

    It is N sum_i d_i^2 - (sum_i d_i)^2 with the differences d_i to robot 0, which are exact where the maps are close.

    - ``bricks`` (N, width, 64) float32: deviations of the robots.
    - ``square``, ``mean`` (64,) float32: scratch.
    """
    robots = bricks.shape[0]
    distance = 0.0
    for c in range(bricks.shape[1]):
        zero = bricks[0, c]
        for i in range(BRICK_CELLS):
            square[i] = np.float32(0.0)
            mean[i] = np.float32(0.0)
        for r in range(1, robots):
            row = bricks[r, c]
            for i in range(BRICK_CELLS):
                difference = row[i] - zero[i]
                mean[i] += difference
                square[i] = fma(difference, difference, square[i])
        for i in range(BRICK_CELLS):
            square[i] = np.float32(robots) * square[i] - mean[i] * mean[i]
        distance += _total(square)
    return distance


@kernel
def _link_distance(bricks, link_ends, square):
    """Sum of the squared differences over the links.

    - ``bricks`` (N, width, 64) float32: deviations of the robots.
    - ``link_ends`` (L, 2) int64: robot indices.
    - ``square`` (64,) float32: scratch.
    """
    for i in range(BRICK_CELLS):
        square[i] = np.float32(0.0)
    for k in range(link_ends.shape[0]):
        for c in range(bricks.shape[1]):
            row, other = bricks[link_ends[k, 0], c], bricks[link_ends[k, 1], c]
            for i in range(BRICK_CELLS):
                difference = row[i] - other[i]
                square[i] = fma(difference, difference, square[i])
    return _total(square)


@kernel
def compare_maps(
    table, link_ends, prior, label_priors, tie_share, least_tie, num_classes, distances_only, scratch, int_scratch,
    places, distances, counts, entropies,
):  # fmt: skip
    """Contribution of each brick to the metrics.

    Loop invariant: the rows ``places[:b]`` of the outputs are complete, and no other row is written.

    - ``table``: BrickTable (N + 1, n) of the robots' maps and, in the last column, the oracle.
    - ``link_ends`` (L, 2) int64: robot indices.
    - ``prior``: float32 log-odds h_0.
    - ``label_priors`` (N,) float32: prior of each robot's labels, h_0 / N for the mean over N robots.
    - ``tie_share``: float32, tolerance of ties as a share of a cell's largest |log-odds|.
    - ``least_tie``: float32, least tolerance of ties.
    - ``num_classes``: C.
    - ``distances_only``: True where ``counts`` and ``entropies`` are not written.
    - ``scratch`` float32: room for N + 1 bricks of all classes and 6 + N of one class.
    - ``int_scratch`` (3 + N, 64) int32.
    - ``places`` (n,) int64: row of each brick in the outputs.
    - ``distances`` (m, 2) float64: output, squared differences summed over the links and over all pairs of robots.
    - ``counts`` (m, 4 + 3 N) int32: output, cells known to any robot, of these the oracle's occupied ones, cells with
      differing labels, cells known to either end summed over the links; then for each robot its known cells, agreeing
      cells, and agreeing cells that are occupied in the oracle.
    - ``entropies`` (m, N) float64: output, entropies summed over the robot's known cells [nat].
    """
    robots = table.known.shape[0] - 1
    is_complete = link_ends.shape[0] == robots * (robots - 1) // 2
    cells_at = np.int64(scratch.ctypes.data)
    bricks_at = cells_at + (6 + robots) * BRICK_CELLS * 4
    # Arrays are made from addresses: slices of arrays that own memory are reference-counted at every use.
    cells = float_array(cells_at, (6 + robots, BRICK_CELLS))
    best, oracle_best, oracle_there, total, weighted = cells[0], cells[1], cells[2], cells[3], cells[4]
    oracle_tied, least_tied = cells[5], cells[6:]
    differs, occupied, seen, labels = int_scratch[0], int_scratch[1], int_scratch[2], int_scratch[3:]
    for b in range(places.size):
        place = places[b]
        width = 1
        anyone = np.uint64(0)
        for r in range(robots + 1):
            for w in range(table.masks.shape[2]):
                width = num_classes if table.masks[r, b, w] else width
            anyone |= table.known[r, b] if r < robots else np.uint64(0)
        terms = np.float32(num_classes) if width == 1 else np.float32(1.0)
        bricks = float_array(bricks_at, (robots + 1, width, BRICK_CELLS))
        ahead = min(b + PREFETCH_AHEAD, places.size - 1)
        for r in range(robots + 1):
            prefetch(table, ahead, r)
            _load_classes(bricks_at + r * width * BRICK_CELLS * 4, table, b, r, width)
        repeats = num_classes if width == 1 else 1
        distances[place, 1] = repeats * _pair_distance(bricks[:robots], total, weighted)
        distances[place, 0] = distances[place, 1]
        if not is_complete:
            distances[place, 0] = repeats * _link_distance(bricks, link_ends, total)
        if distances_only:
            continue
        link_cells = 0
        for k in range(link_ends.shape[0]):
            link_cells += count_ones(table.known[link_ends[k, 0], b] | table.known[link_ends[k, 1], b])
        oracle = bricks[robots]
        _label_cells(
            oracle, oracle, prior, prior, tie_share, least_tie, labels[0], oracle_best, oracle_there, oracle_tied
        )
        num_occupied = np.int32(0)
        for i in range(BRICK_CELLS):
            in_any = np.int32(anyone >> np.uint64(i) & np.uint64(1))
            occupied[i] = in_any if labels[0, i] > 0 else np.int32(0)
            num_occupied = np.int32(num_occupied + occupied[i])
            differs[i] = np.int32(0)
        for r in range(robots):
            mask = table.known[r, b]
            if r == 0 or mask != table.known[r - 1, b]:
                for i in range(BRICK_CELLS):
                    seen[i] = np.int32(mask >> np.uint64(i) & np.uint64(1))
            _label_cells(
                bricks[r], oracle, label_priors[r], prior, tie_share, least_tie, labels[r], best, oracle_there,
                least_tied[r],
            )  # fmt: skip
            if label_priors[r] != prior:
                _largest(bricks[r], prior, best)
            entropies[place, r] = _brick_entropy(bricks[r], terms, prior, best, seen, total, weighted)
            # Casts keep the sums int32; int64 sums use half as many vector lanes.
            agreeing, agreeing_occupied = np.int32(0), np.int32(0)
            for i in range(BRICK_CELLS):
                agrees = seen[i] if oracle_there[i] >= oracle_tied[i] else np.int32(0)
                agreeing = np.int32(agreeing + agrees)
                agreeing_occupied = np.int32(agreeing_occupied + (agrees & occupied[i]))
                # Unknown counts as a label.
                labels[r, i] = labels[r, i] if seen[i] > 0 else np.int32(-1)
                differs[i] |= labels[r, i] ^ labels[0, i]
            counts[place, 4 + 3 * r] = count_ones(mask)
            counts[place, 5 + 3 * r] = agreeing
            counts[place, 6 + 3 * r] = agreeing_occupied
        counts[place, 0] = count_ones(anyone)
        counts[place, 1] = num_occupied
        counts[place, 2] = _num_differing(bricks[:robots], labels, least_tied, differs, label_priors)
        counts[place, 3] = link_cells
