"""Comparison of a map with the reference cell by cell, and the number of leaves of a lossless octree."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from octoreplay.records import Float64Array, Int64Array, LeafTable
from reference.twin import TwinTick

Key = tuple[int, int, int]


@dataclass(frozen=True)
class MapDifference:
    """Difference between a map's leaves and the reference.

    - ``max_abs``: largest |log-odds difference| over the reference's cells; unknown cells count as the prior.
    - ``missing``: number of cells that are known in the reference but in no leaf.
    - ``spurious``: number of cells in a leaf that are unknown in the reference, including cells that no scan touches.
    - ``overlapping``: number of additional leaves that hold the same cell.
    - ``worst_key``: key of the cell with max_abs.
    """

    max_abs: float
    missing: int
    spurious: int
    overlapping: int
    worst_key: Key


def compare_map(keys: Int64Array, tick: TwinTick, robot: int, leaves: LeafTable, resolution: float) -> MapDifference:
    """Return the difference between a robot's leaves (with the prior) and the reference over ``keys`` (M, 3)."""
    leaf_keys, leaf_log_odds = expand_leaves(leaves, resolution)
    distinct, first = np.unique(_codes(leaf_keys), return_index=True)
    places = np.minimum(np.searchsorted(distinct, _codes(keys)), max(len(distinct) - 1, 0))
    rows = np.full(len(keys), -1, dtype=np.int64)
    if len(distinct):
        found = distinct[places] == _codes(keys)
        rows[found] = first[places[found]]
    held = rows >= 0
    theirs = np.full((len(keys), tick.maps.shape[2] - 1), tick.prior)
    theirs[held] = leaf_log_odds[rows[held]]
    difference = np.abs(theirs - tick.log_odds(robot)).max(axis=1, initial=0.0)
    worst = int(difference.argmax())
    known = tick.known[robot]
    x, y, z = keys[worst].tolist()
    return MapDifference(
        max_abs=float(difference[worst]),
        missing=int((known & ~held).sum()),
        spurious=int((held & ~known).sum()) + len(distinct) - int(held.sum()),
        overlapping=len(leaf_keys) - len(distinct),
        worst_key=(x, y, z),
    )


def _codes(keys: Int64Array) -> Int64Array:
    """Return one integer for each key."""
    if len(keys) and np.abs(keys).max() >= 1 << 20:
        raise AssertionError("a cell lies more than 2^20 cells from the origin")
    codes: Int64Array = ((keys[:, 0] + (1 << 20)) << 42) | ((keys[:, 1] + (1 << 20)) << 21) | (keys[:, 2] + (1 << 20))
    return codes


def expand_leaves(leaves: LeafTable, resolution: float) -> tuple[Int64Array, Float64Array]:
    """Return the finest cells (X, 3) in the leaves, and their log-odds (X, C)."""
    cells = np.rint(leaves.sizes / resolution).astype(np.int64)
    if not np.allclose(cells * resolution, leaves.sizes, rtol=1e-6, atol=0.0):
        raise AssertionError("a leaf's size is no whole number of cells")
    first = np.rint((leaves.centers - leaves.sizes[:, None] / 2) / resolution).astype(np.int64)
    keys, rows = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for edge in np.unique(cells):
        of_size = np.flatnonzero(cells == edge)
        offsets = np.array(list(itertools.product(range(edge), repeat=3)), dtype=np.int64)
        keys.append((first[of_size, None, :] + offsets[None, :, :]).reshape(-1, 3))
        rows.append(np.repeat(of_size, len(offsets)))
    return np.concatenate(keys), leaves.log_odds[np.concatenate(rows)].astype(np.float64)


def num_lossless_leaves(keys: Int64Array, values: Float64Array, max_levels: int = 20) -> int:
    """Return the number of leaves after merging eight sibling leaves with bit-equal values (M, C), level by level.

    Siblings at level l are the cells with equal keys after floor division by 2^l; unknown cells are in no leaf.
    """
    level: dict[Key, bytes] = {
        (key[0], key[1], key[2]): row.tobytes()
        for key, row in zip(keys.tolist(), np.ascontiguousarray(values), strict=True)
    }
    num_leaves = 0
    for _ in range(max_levels):
        parents: dict[Key, list[bytes]] = {}
        for (x, y, z), value in level.items():
            parents.setdefault((x // 2, y // 2, z // 2), []).append(value)
        merged = dict(_merged(parents))
        num_leaves += len(level) - 8 * len(merged)
        level = merged
    return num_leaves + len(level)


def _merged(parents: dict[Key, list[bytes]]) -> Iterator[tuple[Key, bytes]]:
    """Yield the parents of which all eight children are leaves with equal values."""
    for key, children in parents.items():
        if len(children) == 8 and len(set(children)) == 1:
            yield key, children[0]
