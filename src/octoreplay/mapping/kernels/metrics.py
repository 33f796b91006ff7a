"""The maps of a team compared brick by brick."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels.compiler import kernel
from octoreplay.mapping.kernels.consensus import exp_negative, load
from octoreplay.mapping.kernels.storage import BRICK_CELLS, VECTOR


@kernel
def _brick_labels(address, tier, prior, num_classes, labels, best, row):
    """Argmax class (64,) of a brick and its log-odds; free is 0, ties go to the lower id."""
    labels[:] = 0
    best[:] = np.float32(0.0)
    width = num_classes if tier == VECTOR else 1
    for c in range(width):
        load(row, address, tier, c, num_classes)
        for i in range(BRICK_CELLS):
            value = row[i] + prior
            higher = value > best[i]
            labels[i] = np.uint8(c + 1) if higher else labels[i]
            best[i] = value if higher else best[i]


@kernel
def compare_maps(addresses, tiers, known, link_ends, prior, num_classes, distances, counts, entropies):
    """Each brick's part of the metrics, for N robots (columns 0..N-1 of ``addresses``) and the oracle (column N).

    ``known`` (n, N) are the robots' masks and ``link_ends`` (L, 2) the links' robots. Outputs per brick:
    ``distances`` (n, 2): sum of squared differences over the links, and over all pairs of robots;
    ``counts`` (n, 3 + 3 N): cells known to any robot, those that the oracle calls occupied, those with differing
    labels; then per robot known cells, agreeing cells, agreeing cells that the oracle calls occupied;
    ``entropies`` (n, N): sum over the robot's known cells in nats.
    """
    robots = known.shape[1]
    labels = np.empty((robots + 1, BRICK_CELLS), dtype=np.uint8)
    best = np.empty(BRICK_CELLS, dtype=np.float32)
    best_oracle = np.empty(BRICK_CELLS, dtype=np.float32)
    rows = np.empty((robots, BRICK_CELLS), dtype=np.float32)
    row = np.empty(BRICK_CELLS, dtype=np.float32)
    oracle = np.empty((num_classes + 1, BRICK_CELLS), dtype=np.float32)
    seen = np.empty((robots, BRICK_CELLS), dtype=np.bool_)
    powers = np.empty(BRICK_CELLS, dtype=np.int32)
    scales = powers.view(np.float32)
    exps = np.empty(BRICK_CELLS, dtype=np.float32)
    total = np.empty(BRICK_CELLS, dtype=np.float32)
    weighted = np.empty(BRICK_CELLS, dtype=np.float32)
    for b in range(addresses.shape[0]):
        for r in range(robots):
            _brick_labels(addresses[b, r], tiers[b, r], prior, num_classes, labels[r], best, row)
            for i in range(BRICK_CELLS):
                seen[r, i] = (known[b, r] >> np.uint64(i)) & np.uint64(1)
            width = num_classes if tiers[b, r] == VECTOR else 1
            terms = np.float32(1.0) if tiers[b, r] == VECTOR else np.float32(num_classes)
            for i in range(BRICK_CELLS):
                exps[i] = -best[i]
            exp_negative(exps, total, powers, scales)
            weighted[:] = np.float32(0.0)
            for c in range(width):
                load(row, addresses[b, r], tiers[b, r], c, num_classes)
                for i in range(BRICK_CELLS):
                    row[i] += prior - best[i]
                exp_negative(row, exps, powers, scales)
                for i in range(BRICK_CELLS):
                    total[i] += terms * exps[i]
                    weighted[i] += terms * exps[i] * (row[i] + best[i])
            entropy = 0.0
            for i in range(BRICK_CELLS):
                if seen[r, i]:
                    entropy += best[i] + np.log(total[i]) - weighted[i] / total[i]
            entropies[b, r] = entropy
        _brick_labels(addresses[b, robots], tiers[b, robots], prior, num_classes, labels[robots], best_oracle, row)
        oracle[0, :] = np.float32(0.0)
        for c in range(num_classes):
            load(oracle[c + 1], addresses[b, robots], tiers[b, robots], c, num_classes)
            for i in range(BRICK_CELLS):
                oracle[c + 1, i] += prior
        counts[b, :] = 0
        for i in range(BRICK_CELLS):
            anyone = False
            first = labels[0, i] if seen[0, i] else 255
            differs = False
            for r in range(robots):
                anyone |= seen[r, i]
                differs |= (labels[r, i] if seen[r, i] else 255) != first
            if not anyone:
                continue
            occupied = labels[robots, i] > 0
            counts[b, 0] += 1
            counts[b, 1] += occupied
            counts[b, 2] += differs
            for r in range(robots):
                if seen[r, i]:
                    agrees = oracle[labels[r, i], i] >= best_oracle[i] - np.float32(1e-3)
                    counts[b, 3 + 3 * r] += 1
                    counts[b, 4 + 3 * r] += agrees
                    counts[b, 5 + 3 * r] += agrees and occupied
        _brick_distances(addresses[b], tiers[b], link_ends, num_classes, rows, row, weighted, total, distances[b])


@kernel
def _brick_distances(
    addresses, tiers, link_ends, num_classes, rows, mean, over_links, over_pairs, distances
):  # fmt: skip
    """Squared differences of one brick, summed over the links and over all pairs: N sum_i ||h_i - mean||^2."""
    robots = rows.shape[0]
    width = 1
    for r in range(robots):
        if tiers[r] == VECTOR:
            width = num_classes
    over_links[:] = np.float32(0.0)
    over_pairs[:] = np.float32(0.0)
    for c in range(width):
        mean[:] = np.float32(0.0)
        for r in range(robots):
            load(rows[r], addresses[r], tiers[r], c, num_classes)
        # Differences to robot 0 are exact where the maps are close, which a mean of large values would not be.
        for r in range(1, robots):
            for i in range(BRICK_CELLS):
                mean[i] += rows[r, i] - rows[0, i]
        for i in range(BRICK_CELLS):
            mean[i] /= np.float32(robots)
        for r in range(robots):
            for i in range(BRICK_CELLS):
                difference = (rows[r, i] - rows[0, i]) - mean[i]
                over_pairs[i] += difference * difference
        for k in range(link_ends.shape[0]):
            a, z = link_ends[k, 0], link_ends[k, 1]
            for i in range(BRICK_CELLS):
                difference = rows[a, i] - rows[z, i]
                over_links[i] += difference * difference
    repeats = num_classes if width == 1 else 1
    distances[0] = over_links.sum() * repeats
    distances[1] = over_pairs.sum() * repeats * robots
