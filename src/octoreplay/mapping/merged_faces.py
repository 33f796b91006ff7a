"""Surface of leaves as few rectangles: only exposed faces, and equal neighbours merged."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.records import BoolArray, Float64Array, Int64Array, LeafTable, UInt8Array

MAX_CELLS = 1 << 26
"""Largest number of finest cells in the leaves of a mesh."""
_KEY_BITS = 21


class MergedFaces(NamedTuple):
    """Rectangles on the surface of leaves.

    Attributes
    ----------
    corners : (Q, 4, 3) float64
        Corners in metres, counter-clockwise as seen from outside.
    colors : (Q, 3) uint8
        Colours.
    """

    corners: Float64Array
    colors: UInt8Array


def merged_faces(leaves: LeafTable, colors: UInt8Array, resolution: float) -> MergedFaces:
    """Return the surface of leaves with colours (L, 3) uint8; ``resolution`` is the edge of the finest cells [m].

    Faces between two leaves are left out. Squares of one colour in a plane are merged to rectangles: first along one
    axis, then equal rows along the other one. Raises ValueError for more than MAX_CELLS finest cells.
    """
    keys, leaf = finest_cells(leaves, resolution)
    packed = _packed(keys)
    members = np.sort(packed)
    parts = []
    for axis in range(3):
        for sign in (1, -1):
            step = np.zeros(3, np.int64)
            step[axis] = sign
            exposed = np.flatnonzero(~_is_member(members, _packed(keys + step)))
            rows, palette = _rectangles(keys[exposed], colors[leaf[exposed]], axis)
            parts.append((_corners(rows, axis, sign) * resolution, palette))
    return MergedFaces(np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts]))


def finest_cells(leaves: LeafTable, resolution: float) -> tuple[Int64Array, Int64Array]:
    """Return the keys (n, 3) of the finest cells in leaves, and the index (n,) of the leaf of each.

    ``resolution`` is the edge of a finest cell [m]. Raises ValueError for more than MAX_CELLS of them.
    """
    low, edges = first_cells(leaves, resolution)
    if float((edges.astype(np.float64) ** 3).sum()) > MAX_CELLS:
        raise ValueError(f"the leaves hold more than {MAX_CELLS:,} cells")
    keys, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for edge in np.unique(edges).tolist():
        chosen = np.flatnonzero(edges == edge)
        steps = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        keys.append((low[chosen, None] + steps).reshape(-1, 3))
        owners.append(np.repeat(chosen, len(steps)))
    return np.concatenate(keys), np.concatenate(owners)


def first_cells(leaves: LeafTable, resolution: float) -> tuple[Int64Array, Int64Array]:
    """Return the lowest keys (L, 3) of the finest cells in each leaf, and the leaf's edge (L,) in finest cells."""
    edges = np.rint(leaves.sizes / resolution).astype(np.int64)
    return np.rint(leaves.centers / resolution - edges[:, None] / 2).astype(np.int64), edges


def _packed(keys: Int64Array) -> Int64Array:
    """One integer for each key (n, 3), distinct for cells and their neighbours."""
    shifted = keys + (1 << (_KEY_BITS - 1))
    return np.asarray((shifted[:, 0] << 2 * _KEY_BITS) | (shifted[:, 1] << _KEY_BITS) | shifted[:, 2])


def _is_member(members: Int64Array, values: Int64Array) -> BoolArray:
    """True (n,) for values that are among the sorted members."""
    if not members.size:
        return np.zeros(values.size, np.bool_)
    place = np.minimum(np.searchsorted(members, values), members.size - 1)
    return np.asarray(members[place] == values)


def _rectangles(keys: Int64Array, colors: UInt8Array, axis: int) -> tuple[Int64Array, UInt8Array]:
    """Rectangles (Q, 5) of faces normal to an axis: plane, u, v, length along u, length along v; and their colours."""
    u_axis, v_axis = (axis + 1) % 3, (axis + 2) % 3
    shade = colors.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    table = np.column_stack([keys[:, axis], keys[:, v_axis], shade, keys[:, u_axis]])
    runs, lengths = _runs(table)
    table = np.column_stack([runs[:, 0], runs[:, 3], lengths, runs[:, 2], runs[:, 1]])
    found, heights = _runs(table)
    palette = np.stack([found[:, 3] >> 16, found[:, 3] >> 8 & 255, found[:, 3] & 255], axis=1).astype(np.uint8)
    return np.column_stack([found[:, 0], found[:, 1], found[:, 4], found[:, 2], heights]), palette


def _runs(table: Int64Array) -> tuple[Int64Array, Int64Array]:
    """First rows and lengths of runs in a table (n, k): equal but for the last column, which counts up."""
    ordered = table[np.lexsort(table.T[::-1])]
    continues = np.zeros(len(ordered), np.bool_)
    difference = np.diff(ordered, axis=0)
    continues[1:] = (difference[:, :-1] == 0).all(axis=1) & (difference[:, -1] == 1)
    starts = np.flatnonzero(~continues)
    return ordered[starts], np.diff(np.append(starts, len(ordered)))


def _corners(rectangles: Int64Array, axis: int, sign: int) -> Float64Array:
    """Corners (Q, 4, 3) of rectangles on the upper or the lower side of cells, in cells."""
    plane, u, v, width, height = rectangles.T
    corners = np.empty((len(rectangles), 4, 3))
    corners[..., axis] = plane[:, None] + (sign > 0)
    zero = np.zeros_like(u)
    across, along = [zero, width, width, zero], [zero, zero, height, height]
    if sign < 0:
        across, along = across[::-1], along[::-1]
    corners[..., (axis + 1) % 3] = u[:, None] + np.column_stack(across)
    corners[..., (axis + 2) % 3] = v[:, None] + np.column_stack(along)
    return corners
