"""Conversion of labelled surfaces to cells: points on triangles, and the majority class of each cell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from octoreplay.records import Float64Array, Int64Array, UInt8Array

BATCH = 64_000
"""Approximate number of points in a batch, small enough for the caches of a processor."""


def num_cuts(corners: Float64Array, spacing: float) -> Int64Array:
    """Return into how many parts (T,) the edges of triangles (T, 3, 3) are cut, each at most ``spacing`` long [m]."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    cuts: Int64Array = np.maximum(1, np.ceil(edges.max(axis=1) / spacing)).astype(np.int64)
    return cuts


def points_on_triangles(corners: Float64Array, spacing: float) -> Iterator[tuple[Float64Array, Int64Array]]:
    """Yield batches of points (P, 3) at most ``spacing`` apart on triangles (T, 3, 3), and their triangles (P,) [m].

    Each triangle is cut into n x n equal ones, n = ``num_cuts``; the points are their centroids.
    """
    cuts = num_cuts(corners, spacing)
    for n in np.unique(cuts).tolist():
        members = np.flatnonzero(cuts == n)
        rows = max(1, BATCH // n)
        for first in range(0, n, rows):
            weights = _centroid_weights(n, first, min(first + rows, n))
            step = max(1, BATCH // len(weights))
            for start in range(0, len(members), step):
                part = members[start : start + step]
                points = np.einsum("pk,tkd->tpd", weights, corners[part]).reshape(-1, 3)
                yield points, np.repeat(part, len(weights))


def _centroid_weights(n: int, first: int, end: int) -> Float64Array:
    """Return barycentric weights (P, 3) of the centroids in rows ``first`` to ``end`` of a triangle cut into n x n."""
    i, j = np.meshgrid(np.arange(first, end), np.arange(n), indexing="ij")
    upright = np.stack([i, j], axis=-1)[i + j < n] + 1 / 3
    inverted = np.stack([i, j], axis=-1)[i + j < n - 1] + 2 / 3
    uv = np.concatenate([upright, inverted]) / n
    weights: Float64Array = np.column_stack([uv, 1.0 - uv.sum(axis=1)])
    return weights


class CellVotes:
    """Number of points of each class in each cell, counted batch by batch."""

    def __init__(self) -> None:
        self._votes = _Votes(np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.int64))
        self._waiting: list[_Votes] = []

    def add(self, cells: Int64Array, class_ids: UInt8Array, counts: Int64Array | None = None) -> None:
        """Count points: their cells (P,), as any integer ids, and their classes (P,).

        ``counts`` (P,) are numbers of points of one cell and class; 1 without them.
        """
        self._waiting.append(_counted(cells, class_ids, counts))
        if sum(len(votes.cells) for votes in self._waiting) > max(BATCH, len(self._votes.cells)):
            self._merge()

    def winners(self) -> tuple[Int64Array, UInt8Array]:
        """Return the cells (M,) in ascending order and their majority classes (M,); ties go to the lower class_id."""
        self._merge()
        cells, class_ids, counts = self._votes
        order = np.lexsort((class_ids, -counts, cells))
        winners, first = np.unique(cells[order], return_index=True)
        return winners, class_ids[order[first]]

    def _merge(self) -> None:
        """Add the waiting batches to the counts."""
        cells, class_ids, counts = zip(self._votes, *self._waiting, strict=True)
        self._votes = _counted(np.concatenate(cells), np.concatenate(class_ids), np.concatenate(counts))
        self._waiting = []


class _Votes(NamedTuple):
    """Number of points (V,) of each pair of cell (V,) and class (V,) that occurs."""

    cells: Int64Array
    class_ids: UInt8Array
    counts: Int64Array


def _counted(cells: Int64Array, class_ids: UInt8Array, weights: Int64Array | None = None) -> _Votes:
    """Count points (P,) by cell and class, each once or ``weights`` (P,) times."""
    found, place = np.unique(cells, return_inverse=True)
    pairs, place = np.unique(place << 8 | class_ids, return_inverse=True)
    counts = np.bincount(place, weights, len(pairs)).astype(np.int64)
    return _Votes(found[pairs >> 8], (pairs & 0xFF).astype(np.uint8), counts)
