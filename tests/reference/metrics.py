"""Team metrics after a tick on the uniform grid; docs/metrics.md defines them.

``maps`` is (N, M, K): absolute log-odds of N robots, column 0 zero, the prior where a robot knows nothing. ``known`` is
(N, M): the cells that are in each robot's map. ``oracle`` is (M, K).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.records import BoolArray, Float64Array, Int64Array
from reference.rules import softmax

TIE = 1e-3
"""A robot's label agrees where the oracle's value of it is this close to the oracle's maximum."""

UNKNOWN = -1
"""Label of cells that are not in a robot's map."""


@dataclass(frozen=True)
class TwinMetrics:
    """Metrics after one tick; values of robots are in the team's order."""

    total_distance: float
    total_distance_all: float
    distance_per_cell_and_link: float
    num_known_cells: int
    label_disagreement: float
    max_change: float
    agreement: tuple[float, ...]
    agreement_occupied: tuple[float, ...]
    num_cells: tuple[int, ...]
    entropy_bits: tuple[float, ...]


def team_metrics(
    maps: Float64Array,
    known: BoolArray,
    oracle: Float64Array,
    links: Sequence[tuple[int, int]],
    max_change: float,
) -> TwinMetrics:
    """Return all metrics of one tick."""
    robots = range(len(maps))
    pairs = list(itertools.combinations(robots, 2))
    labels = robot_labels(maps, known)
    known_to_any: BoolArray = np.any(known, axis=0)
    total = sum(squared_distance(maps[i], maps[j]) for i, j in links)
    cells_and_links = sum(int((known[i] | known[j]).sum()) for i, j in links)
    agreement = [oracle_agreement(labels[i], oracle, known_to_any) for i in robots]
    return TwinMetrics(
        total_distance=total,
        total_distance_all=sum(squared_distance(maps[i], maps[j]) for i, j in pairs),
        distance_per_cell_and_link=total / cells_and_links if cells_and_links else 0.0,
        num_known_cells=int(known_to_any.sum()),
        label_disagreement=label_disagreement(labels, known_to_any),
        max_change=max_change,
        agreement=tuple(both[0] for both in agreement),
        agreement_occupied=tuple(both[1] for both in agreement),
        num_cells=tuple(int(known[i].sum()) for i in robots),
        entropy_bits=tuple(mean_entropy(maps[i][known[i]]) for i in robots),
    )


def squared_distance(a: Float64Array, b: Float64Array) -> float:
    """Return the sum over cells of ||a - b||^2; cells unknown to both maps have the prior in both and add 0."""
    return float(((a - b) ** 2).sum())


def robot_labels(maps: Float64Array, known: BoolArray) -> Int64Array:
    """Return the argmax (N, M) of each map; ties go to the lowest class, unknown cells are UNKNOWN."""
    return np.where(known, maps.argmax(axis=2), UNKNOWN)


def oracle_agreement(labels: Int64Array, oracle: Float64Array, cells: BoolArray) -> tuple[float, float]:
    """Return the share of ``cells`` where a robot's labels agree with the oracle: of all, and of the oracle's occupied.

    A share of no cells is 1.
    """
    value = np.take_along_axis(oracle, np.maximum(labels, 0)[:, None], axis=1)[:, 0]
    agrees = (labels != UNKNOWN) & (value >= oracle.max(axis=1) - TIE)
    occupied = cells & (oracle.argmax(axis=1) > 0)
    return _share(agrees, cells, empty=1.0), _share(agrees, occupied, empty=1.0)


def label_disagreement(labels: Int64Array, cells: BoolArray) -> float:
    """Return the share of ``cells`` in which any two robots' labels, including unknown, differ; 0 of no cells."""
    return _share(labels.min(axis=0) != labels.max(axis=0), cells, empty=0.0)


def mean_entropy(log_odds: Float64Array) -> float:
    """Return the mean entropy of the cells [bit]; 0 of no cells."""
    if not len(log_odds):
        return 0.0
    prob = softmax(log_odds)
    # p log p is 0 at p = 0, which occurs where exp underflows.
    terms = prob * np.log2(np.where(prob > 0, prob, 1.0))
    return float(-terms.sum(axis=1).mean())


def _share(true: BoolArray, among: BoolArray, *, empty: float) -> float:
    """Return the share of ``among`` in which ``true`` is True."""
    return float((true & among).sum() / among.sum()) if among.any() else empty
