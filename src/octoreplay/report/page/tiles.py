"""Tiles of maps: cubes of 32 x 32 x 32 cells, at the map's resolution and at coarser levels.

The cells of level k have an edge of 2^k r, r the map's resolution, and its tiles an edge of 32 2^k r. A viewer draws
near tiles at level 0 and far ones at coarser levels. Cells are ordered by Morton code, so that the cells of a tile are
consecutive: the code of a tile is that of its cells without the last 15 bits.

A tile that did not change, and tiles that are equal in several maps, are stored once (``tile_pool.TilePool``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.log_odds import label_probabilities
from octoreplay.mapping.octree import LeafSpans, codes_to_keys
from octoreplay.records import BoolArray, Float32Array, Int64Array, UInt8Array

TILE_BITS = 15
"""Bits of a cell's Morton code inside a tile."""
TILE_EDGE = 32
"""Cells along the edge of a tile."""
LARGEST = 5
"""Binary logarithm of the edge of the largest cube in a tile, in cells."""
MAX_LEVEL = 13
"""Coarsest level: eight tiles cover the key space."""
NO_TILE = 0xFFFFFFFF
"""Index of a tile without contents."""
FEW_TILES = 8
"""Number of tiles at which no coarser level is made, if it is that of all times."""

PLAIN = (("code", "<i8"), ("size", "u1"), ("label", "u1"), ("probability", "<u2"))
"""Fields of a cube: Morton code of its first cell, binary logarithm of its edge in cells, class_id, and probability of
the class in steps of 1 / 65535."""
TEAM_FIELDS = (("disagreement", "<u2"), ("seen", "<u8"), ("first", "u1"), ("contradiction", "u1"))
"""More fields of a cube of the team's map: largest ||h_i - h_j|| of two robots in steps of 1 / 500, mask of the robots
whose evidence knows it (bit i, robots from the 64th on share bit 63), robot that knew it first + 1 (0: unknown), and
CellContradiction of the evidence."""
DISAGREEMENT_STEPS = 500

Cubes = npt.NDArray[Any]
"""Structured array (M,) with the fields of PLAIN, or of PLAIN and TEAM_FIELDS, in Morton order."""
Runs = Int64Array
"""First codes and lengths (R, 2) of runs of cells along the Morton curve, in order."""


def occupied_cubes(spans: LeafSpans, labels: UInt8Array, log_odds: Float32Array) -> Cubes:
    """Return the occupied leaves of a map as cubes, from the labels (L,) and log-odds (L, C) of all leaves."""
    chosen = np.flatnonzero(labels)
    cubes = np.zeros(len(chosen), dtype=list(PLAIN))
    cubes["code"] = spans.codes[chosen]
    cubes["size"] = np.bitwise_count(spans.num_cells[chosen] - 1) // 3
    cubes["label"] = labels[chosen]
    cubes["probability"] = probability_steps(log_odds[chosen])
    return _split(cubes)


def probability_steps(log_odds: Float32Array) -> npt.NDArray[np.uint16]:
    """Return the probability of the most probable class in steps of 1 / 65535 (M,)."""
    steps = np.rint(label_probabilities(log_odds) * 65535)
    return steps.astype(np.uint16)


def free_runs(spans: LeafSpans, is_free: BoolArray) -> Runs:
    """Return the free space of a map as runs of cells. ``is_free`` (L,) marks the free leaves."""
    return _joined(spans.codes[is_free], spans.codes[is_free] + spans.num_cells[is_free])


def known_runs(spans: LeafSpans) -> Runs:
    """Return the known space of a map as runs of cells."""
    return _joined(spans.codes, spans.codes + spans.num_cells)


def runs_hold(runs: Runs, codes: Int64Array) -> BoolArray:
    """Return True for each cell of ``codes`` (n,) that is in a run."""
    rows = np.searchsorted(runs[:, 0], codes, side="right") - 1
    inside = rows >= 0
    inside[inside] = codes[inside] < runs[rows[inside]].sum(axis=1)
    return inside


def union(spaces: Sequence[Runs]) -> Runs:
    """Return the runs of the cells that are in one of several spaces."""
    runs = np.concatenate([np.empty((0, 2), np.int64), *spaces])
    runs = runs[np.argsort(runs[:, 0], kind="stable")]
    return _joined(runs[:, 0], runs.sum(axis=1))


def merged(cubes: Cubes) -> Cubes:
    """Join eight equal cubes that fill a larger one, up to the size of a tile."""
    done = []
    for size in range(LARGEST):
        small, rest = cubes[cubes["size"] == size], cubes[cubes["size"] > size]
        parents = small["code"] >> (3 * size + 3)
        firsts = np.flatnonzero(np.diff(parents, prepend=-1))
        counts = np.diff(firsts, append=len(parents))
        rows = np.repeat(firsts, counts)
        equal = np.ones(len(small), dtype=np.bool_)
        for name in small.dtype.names or ():
            if name not in ("code", "size"):
                equal &= small[name] == small[name][rows]
        full = (np.add.reduceat(equal, firsts) == 8) if len(firsts) else np.empty(0, np.bool_)
        joined = small[firsts[full]].copy()
        joined["size"] = size + 1
        done.append(small[~np.repeat(full, counts)])
        cubes = _sorted(np.concatenate([rest, joined]))
    return _sorted(np.concatenate([*done, cubes]))


def coarser(cubes: Cubes) -> Cubes:
    """Return the cubes of the next coarser level.

    A cell is occupied where one of its eight cells is. Its class is the most frequent one of them, the lower one of a
    tie; masks are joined, and the other values are the largest ones.
    """
    if not len(cubes):
        return cubes
    parents = cubes["code"] >> 3
    firsts = np.flatnonzero(np.diff(parents, prepend=-1))
    result = np.zeros(len(firsts), dtype=cubes.dtype)
    result["code"] = parents[firsts]
    result["size"] = np.maximum(cubes["size"][firsts], 1) - 1
    result["label"] = _majority(cubes["label"], np.repeat(np.arange(len(firsts)), np.diff(firsts, append=len(parents))))
    for name in cubes.dtype.names or ():
        if name == "seen":
            result[name] = np.bitwise_or.reduceat(cubes[name], firsts)
        elif name == "first":
            # The lowest index but 0, which is no robot, and wraps around to the largest number.
            result[name] = np.minimum.reduceat(cubes[name] - np.uint8(1), firsts) + np.uint8(1)
        elif name not in ("code", "size", "label"):
            result[name] = np.maximum.reduceat(cubes[name], firsts)
    return result


def coarser_runs(runs: Runs) -> Runs:
    """Return the runs of the cells of the next coarser level that hold a cell of ``runs``."""
    return _joined(runs[:, 0] >> 3, ((runs[:, 0] + runs[:, 1] - 1) >> 3) + 1)


def cube_columns(cubes: Cubes) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of the cubes of one tile; ``steps`` is the step from the code before, from 0 for the first."""
    columns = {name: cubes[name] for name in cubes.dtype.names or () if name != "code"}
    columns["steps"] = np.diff(cubes["code"] & (1 << TILE_BITS) - 1, prepend=0)
    return columns


def run_columns(runs: Runs) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of the runs of one tile: cells before each run since the last one, and its length - 1."""
    starts = runs[:, 0] & (1 << TILE_BITS) - 1
    return {"gaps": np.diff(starts, prepend=0), "lengths": runs[:, 1] - 1}


def tiles_of(codes: Int64Array) -> Iterator[tuple[int, slice]]:
    """Yield each tile's code and its rows in ascending ``codes`` (M,)."""
    tiles = codes >> TILE_BITS
    firsts = np.flatnonzero(np.diff(tiles, prepend=-1))
    ends = np.append(firsts[1:], len(tiles))
    for first, end in zip(firsts.tolist(), ends.tolist(), strict=False):
        yield int(tiles[first]), slice(first, end)


def split_runs(runs: Runs) -> Runs:
    """Cut runs at the borders of tiles."""
    first, last = runs[:, 0] >> TILE_BITS, (runs[:, 0] + runs[:, 1] - 1) >> TILE_BITS
    counts = last - first + 1
    row = np.repeat(np.arange(len(runs)), counts)
    tile = first[row] + np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    starts = np.maximum(runs[row, 0], tile << TILE_BITS)
    ends = np.minimum(runs[row, 0] + runs[row, 1], (tile + 1) << TILE_BITS)
    return np.column_stack([starts, ends - starts])


def tile_places(codes: Int64Array, levels: UInt8Array) -> npt.NDArray[np.int16]:
    """Return the places (n, 3) of tiles on their level's grid of tiles, from their codes (n,) and levels (n,)."""
    cells = codes << (TILE_BITS + 3 * levels.astype(np.int64))
    places: npt.NDArray[np.int16] = (codes_to_keys(cells) >> (5 + levels.astype(np.int64))[:, None]).astype(np.int16)
    return places


def _split(cubes: Cubes) -> Cubes:
    """Cut cubes that are larger than a tile."""
    excess = np.maximum(cubes["size"].astype(np.int64) - LARGEST, 0)
    if not excess.any():
        return cubes
    counts = np.int64(1) << (3 * excess)
    pieces = np.repeat(cubes, counts)
    number = np.arange(len(pieces)) - np.repeat(np.cumsum(counts) - counts, counts)
    pieces["size"] = np.minimum(pieces["size"], LARGEST)
    pieces["code"] += number << TILE_BITS
    return pieces


def _sorted(cubes: Cubes) -> Cubes:
    """Cubes in Morton order."""
    return cubes[np.argsort(cubes["code"], kind="stable")]


def _joined(starts: Int64Array, ends: Int64Array) -> Runs:
    """Runs from ascending starts (R,) to ends (R,); runs that touch or overlap by one cell are joined."""
    if not len(starts):
        return np.empty((0, 2), np.int64)
    begins = np.flatnonzero(np.concatenate([[True], starts[1:] > np.maximum.accumulate(ends)[:-1]]))
    last = np.concatenate([begins[1:], [len(starts)]]) - 1
    return np.column_stack([starts[begins], np.maximum.accumulate(ends)[last] - starts[begins]])


def _majority(labels: UInt8Array, groups: Int64Array) -> UInt8Array:
    """Most frequent label of each group, the lower one of a tie; 0 only where all are 0. ``groups`` ascend from 0."""
    pairs, counts = np.unique(groups << 8 | labels, return_counts=True)
    counts = np.where(pairs & 0xFF == 0, 0, counts)
    order = np.lexsort((pairs & 0xFF, -counts, pairs >> 8))
    _, first = np.unique(pairs[order] >> 8, return_index=True)
    majority: UInt8Array = (pairs[order][first] & 0xFF).astype(np.uint8)
    return majority
