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

TIE = 1e-4
"""Values within this share of the cell's largest |log-odds| of the maximum are ties with it."""

UNKNOWN = -1
"""Label of cells that are not in a robot's map."""


@dataclass(frozen=True)
class TwinMetrics:
    """Metrics after one tick; values of robots are in the team's order."""

    total_distance_published: float
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
    *,
    published: Float64Array,
    least_tolerance: float,
    labelled: Float64Array | None = None,
) -> TwinMetrics:
    """Return all metrics of one tick.

    ``published`` (N, M, K) are the maps before the iterations. ``least_tolerance`` of ties is N times the largest
    difference of two neighbours at rest, N quantum / (2 epsilon A_min); 0 without flows. ``labelled`` (N, M, K) are the
    posteriors of the maps, divided by the numbers of robots whose mean they are; default: ``maps``.
    """
    robots = range(len(maps))
    pairs = list(itertools.combinations(robots, 2))
    labelled = maps if labelled is None else labelled
    labels = robot_labels(labelled, known)
    known_to_any: BoolArray = np.any(known, axis=0)
    total = sum(squared_distance(maps[i], maps[j]) for i, j in links)
    cells_and_links = sum(int((known[i] | known[j]).sum()) for i, j in links)
    oracle_ties = ties(oracle, least_tolerance)
    agreement = [oracle_agreement(labels[i], oracle, oracle_ties, known_to_any) for i in robots]
    return TwinMetrics(
        total_distance_published=sum(squared_distance(published[i], published[j]) for i, j in links),
        total_distance=total,
        total_distance_all=sum(squared_distance(maps[i], maps[j]) for i, j in pairs),
        distance_per_cell_and_link=total / cells_and_links if cells_and_links else 0.0,
        num_known_cells=int(known_to_any.sum()),
        label_disagreement=label_disagreement(labels, ties(labelled, least_tolerance), known_to_any),
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


def ties(log_odds: Float64Array, least_tolerance: float) -> BoolArray:
    """Return which values (..., K) are the maximum of their cell or tie with it.

    The tolerance is relative to the cell's largest |log-odds|, and at least ``least_tolerance``.
    """
    tolerance = np.maximum(TIE * np.abs(log_odds).max(axis=-1, keepdims=True), least_tolerance)
    near: BoolArray = log_odds >= log_odds.max(axis=-1, keepdims=True) - tolerance
    return near


def oracle_agreement(
    labels: Int64Array, oracle: Float64Array, oracle_ties: BoolArray, cells: BoolArray
) -> tuple[float, float]:
    """Return the share of ``cells`` where a robot's labels agree with the oracle: of all, and of the oracle's occupied.

    A label agrees where the oracle's value of it ties with the oracle's maximum. A share of no cells is 1.
    """
    agrees = (labels != UNKNOWN) & _of_label(oracle_ties, labels)
    occupied = cells & (oracle.argmax(axis=1) > 0)
    return _share(agrees, cells, empty=1.0), _share(agrees, occupied, empty=1.0)


def label_disagreement(labels: Int64Array, map_ties: BoolArray, cells: BoolArray) -> float:
    """Return the share of ``cells`` in which any two robots' labels, including unknown, differ; 0 of no cells.

    Two known labels do not differ where the value of one robot for the other's label ties with its maximum.
    """
    differs = np.zeros(len(cells), dtype=bool)
    for i, j in itertools.combinations(range(len(labels)), 2):
        both_known = (labels[i] != UNKNOWN) & (labels[j] != UNKNOWN)
        tied = both_known & (_of_label(map_ties[i], labels[j]) | _of_label(map_ties[j], labels[i]))
        differs |= (labels[i] != labels[j]) & ~tied
    return _share(differs, cells, empty=0.0)


def _of_label(values: BoolArray, labels: Int64Array) -> BoolArray:
    """Return the value (M,) of each cell's label; that of class 0 for unknown labels."""
    of_label: BoolArray = np.take_along_axis(values, np.maximum(labels, 0)[:, None], axis=1)[:, 0]
    return of_label


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
