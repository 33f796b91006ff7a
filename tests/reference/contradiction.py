"""Contradiction of evidence on the uniform grid; docs/metrics.md defines it.

``evidence`` is (N, M, C): the sums s_i of N robots in M cells. ``known`` is (N, M): the cells that each robot knows.
``keys`` (M, 3) are the cells' keys.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from octoreplay.records import BoolArray, Float32Array, Int64Array
from octoreplay.run_metrics import PairMetrics

UNKNOWN, FIRM, FREE, UNDECIDED = -4, -3, -2, -1
"""States of cells that are not occupied; an occupied cell has its class, counted from 0, as its state."""


def cell_states(
    evidence: Float32Array, known: BoolArray, occupied_from: float, free_to: float, firm_to: float
) -> Int64Array:
    """Return the states (N, M) of the cells."""
    states = np.full(known.shape, UNDECIDED)
    best = evidence.max(axis=2)
    states[best <= free_to] = FREE
    states[best <= firm_to] = FIRM
    # argmax gives the lowest class at a tie.
    states = np.where(best >= occupied_from, evidence.argmax(axis=2), states)
    states[~known] = UNKNOWN
    return states


def near_occupied(states: Int64Array, keys: Int64Array) -> BoolArray:
    """Return where a robot has an occupied cell among a cell and its 26 neighbours (N, M)."""
    distance = np.abs(keys[:, None] - keys[None]).max(axis=2)
    return np.array([[(row[distance[cell] <= 1] >= 0).any() for cell in range(len(keys))] for row in states], bool)


def pair_metrics(robot_ids: Sequence[str], states: Int64Array, keys: Int64Array) -> tuple[PairMetrics, ...]:
    """Return the metrics of the pairs of robots with known cells in common."""
    is_free = (states == FREE) | (states == FIRM)
    near = near_occupied(states, keys)
    pairs = []
    for i, j in itertools.combinations(range(len(states)), 2):
        a, b = states[i], states[j]
        overlap = int(((a != UNKNOWN) & (b != UNKNOWN)).sum())
        if not overlap:
            continue
        first_free = int(((a >= 0) & is_free[j]).sum())
        second_free = int(((b >= 0) & is_free[i]).sum())
        clear = int(((a >= 0) & (b == FIRM) & ~near[j]).sum() + ((b >= 0) & (a == FIRM) & ~near[i]).sum())
        both = int(((a >= 0) & (b >= 0)).sum())
        other_label = int(((a >= 0) & (b >= 0) & (a != b)).sum())
        pairs.append(
            PairMetrics(
                robot_ids[i], robot_ids[j], overlap, first_free + second_free + both,
                _share(first_free + second_free, first_free + second_free + both),
                _share(clear, first_free + second_free + both),
                _share(first_free, first_free + both), _share(second_free, second_free + both), both,
                _share(other_label, both),
            )
        )  # fmt: skip
    return tuple(pairs)


def _share(part: int, whole: int) -> float:
    """Return part / whole; NaN where the whole is 0."""
    return part / whole if whole else math.nan
