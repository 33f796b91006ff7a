"""Parts of octrees: cells in a box, leaves cut at planes, and coarser cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import storage
from octoreplay.mapping.key_box import KeyBox, first_keys
from octoreplay.mapping.merged_faces import first_cells
from octoreplay.mapping.octree import (
    KEY_BITS,
    SemanticOctree,
    code_order,
    codes_to_keys,
    keys_to_codes,
    octree_from_bricks,
)
from octoreplay.mapping.streams import TreeStreams, bricks_of_leaves, chosen_leaves, leaf_list
from octoreplay.records import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, LeafTable

PART_BRICKS = 1 << 16
"""Least number of bricks whose leaves are made coarser at a time."""


class LeafPieces(NamedTuple):
    """Leaves that were cut into nodes of the octree: n pieces in Morton order.

    - ``codes`` (n,) int64: Morton code of each piece's first cell.
    - ``depths`` (n,) int32: depth of each piece.
    - ``leaves`` (n,) int64: position of the leaf of each piece.
    - ``places`` (n, 3) int64: number of cuts along each axis that are at or below the piece.
    """

    codes: Int64Array
    depths: Int32Array
    leaves: Int64Array
    places: Int64Array

    def taken(self, chosen: BoolArray | Int64Array) -> LeafPieces:
        """Return the pieces where ``chosen`` (n,) is True, or those at positions ``chosen`` (k,)."""
        return LeafPieces(self.codes[chosen], self.depths[chosen], self.leaves[chosen], self.places[chosen])


def cut_leaves(codes: Int64Array, depths: Int32Array, cuts: Sequence[Int64Array]) -> LeafPieces:
    """Return the largest nodes into which planes cut leaves.

    Parameters
    ----------
    codes, depths : (L,) int64, (L,) int32
        Morton code of each leaf's first cell, and depth of each leaf.
    cuts : sequence of (k,) int64
        Ascending keys for each of the three axes: a plane lies below the cells with such a key.
    """
    leaves = np.arange(codes.size)
    found = []
    while True:
        low = codes_to_keys(codes)
        high = low + (np.int64(1) << (KEY_BITS - depths.astype(np.int64)))[:, None] - 1
        places, ends = (
            np.column_stack([np.searchsorted(cuts[axis], keys[:, axis], side="right") for axis in range(3)])
            for keys in (low, high)
        )
        whole = (places == ends).all(axis=1)
        found.append(LeafPieces(codes, depths, leaves, places).taken(whole))
        if whole.all():
            break
        depths, leaves = np.repeat(depths[~whole] + np.int32(1), 8), np.repeat(leaves[~whole], 8)
        codes = np.repeat(codes[~whole], 8) + (np.arange(depths.size) % 8 << 3 * (KEY_BITS - depths.astype(np.int64)))
    pieces = LeafPieces(*map(np.concatenate, zip(*found, strict=True)))
    return pieces.taken(np.argsort(pieces.codes))


def cut(octree: SemanticOctree, box: KeyBox) -> SemanticOctree:
    """Return an octree with the cells in a box; all other cells are unknown."""
    near = np.flatnonzero(box.overlaps(octree.codes << storage.CELL_BITS, storage.BRICK_CELLS))
    streams = octree.streams(near)
    codes, depths, is_vector = leaf_list(streams)
    pieces = cut_leaves(codes, depths, list(np.column_stack(box)))
    pieces = pieces.taken((pieces.places == 1).all(axis=1))
    bricks = bricks_of_leaves(pieces.codes, pieces.depths, is_vector[pieces.leaves])
    content = chosen_leaves(streams, is_vector, pieces.leaves)
    return octree_from_bricks(bricks, content, octree.resolution, octree.num_classes)


def coarsened(octree: SemanticOctree, max_depth: int) -> SemanticOctree:
    """Return an octree whose finest cells are the nodes at ``max_depth``, 1 to KEY_BITS, of another octree.

    Its resolution is 2^(KEY_BITS - max_depth) times that of the other one. A node takes the values of that known cell
    in it which has the largest value of any class, the first one in Morton order of equal ones. So it is occupied if
    one of its cells is, whatever the prior and the scale of the values are.
    """
    level = KEY_BITS - max_depth
    if level == 0:
        return octree
    order = code_order(octree)
    # The bricks of a node are in one part; all leaves at once would take several times the memory of the octree.
    starts = np.flatnonzero(np.diff(octree.codes[order] >> 3 * max(level - storage.BRICK_BITS, 0), prepend=-1))
    borders = np.searchsorted(starts, np.arange(PART_BRICKS, order.size, PART_BRICKS))
    parts = np.split(order, np.unique(starts[borders[borders < starts.size]]))
    found = [_coarse_leaves(octree, part, level) for part in parts]
    codes, depths, is_vector, *content = (np.concatenate(columns) for columns in zip(*found, strict=True))
    bricks = bricks_of_leaves(codes, depths, is_vector)
    streams = TreeStreams(np.empty(0, np.uint16), *content)
    return octree_from_bricks(bricks, streams, octree.resolution * 2**level, octree.num_classes)


def _coarse_leaves(octree: SemanticOctree, indices: Int64Array, level: int) -> tuple[npt.NDArray[Any], ...]:
    """Return the coarse leaves of some bricks: codes, depths and flags of vector leaves, then values as in streams."""
    streams = octree.streams(indices)
    codes, depths, is_vector = leaf_list(streams)
    nodes = codes >> 3 * level
    firsts = np.flatnonzero(np.diff(nodes, prepend=-1))
    largest = _largest_values(streams, is_vector)
    of_node = np.maximum.reduceat(largest, firsts) if firsts.size else largest
    best = np.flatnonzero(largest == np.repeat(of_node, np.diff(firsts, append=nodes.size)))
    rows = best[np.unique(nodes[best], return_index=True)[1]]
    # The coarse octree has its own root; a leaf's depth in it counts from there.
    coarse_depths = np.minimum(depths[firsts] + np.int32(level), np.int32(KEY_BITS))
    content = chosen_leaves(streams, is_vector, rows)
    return keys_to_codes(codes_to_keys(codes[firsts]) >> level), coarse_depths, is_vector[rows], *content[1:]


def _largest_values(streams: TreeStreams, is_vector: BoolArray) -> Float32Array:
    """Return the largest value (L,) of any class in each leaf."""
    largest = streams.values.copy()
    num_own = np.bitwise_count(streams.masks).sum(axis=1, dtype=np.int64)
    np.maximum.at(largest, np.repeat(np.flatnonzero(is_vector), num_own), streams.own_values)
    return largest


class LeafTile(NamedTuple):
    """Leaves of a table in one square tile of the x-y plane, cut at its borders: n pieces.

    Tile (``column``, ``row``) begins at these multiples of its edge along x and y. ``leaves`` (n,) int64 are the
    positions of the pieces' leaves in the table; ``centers`` (n, 3) and ``sizes`` (n,) float64 are those of the
    pieces [m].
    """

    column: int
    row: int
    leaves: Int64Array
    centers: Float64Array
    sizes: Float64Array


def leaf_tiles(leaves: LeafTable, resolution: float, edge: float) -> Iterator[LeafTile]:
    """Yield the tiles with an edge [m] that hold cells of some leaves, row by row.

    A finest cell, of edge ``resolution`` [m], belongs to the tile that holds its centre, as in ``KeyBox.of``.
    """
    low, edges = first_cells(leaves, resolution)
    depths = (KEY_BITS - np.log2(edges)).astype(np.int32)
    starts = np.floor((low.min(axis=0) + 0.5) * resolution / edge).astype(np.int64)
    ends = np.ceil((low + edges[:, None]).max(axis=0) * resolution / edge).astype(np.int64)
    cuts = [first_keys(np.arange(starts[axis], ends[axis] + 1) * edge, resolution) for axis in (0, 1)]
    pieces = cut_leaves(keys_to_codes(low), depths, [*cuts, np.empty(0, np.int64)])
    sizes = np.exp2(KEY_BITS - pieces.depths.astype(np.float64)) * resolution
    centers = codes_to_keys(pieces.codes) * resolution + sizes[:, None] / 2
    order = np.lexsort(pieces.places[:, :2].T)
    borders = np.flatnonzero(np.diff(pieces.places[order, :2], axis=0).any(axis=1)) + 1
    for members in np.split(order, borders):
        column, row = (starts[:2] + pieces.places[members[0], :2] - 1).tolist()
        yield LeafTile(column, row, pieces.leaves[members], centers[members], sizes[members])
