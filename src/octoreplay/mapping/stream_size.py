"""Size of an octree's stream, counted again only where the octree changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octoreplay.mapping.kernels import packets
from octoreplay.mapping.kernels.storage import BRICK_DEPTH, BRICK_EDGE
from octoreplay.mapping.octree import SemanticOctree, code_order
from octoreplay.mapping.streams import StreamSize, empty_streams, encoder_scratch
from octoreplay.records import BoolArray, Float32Array, Int64Array

_CHUNK_LEVELS = 2
_CHUNK_DEPTH = BRICK_DEPTH - _CHUNK_LEVELS
CHUNK_CELLS = BRICK_EDGE << _CHUNK_LEVELS
"""Edge of a chunk [cells]."""


class StreamPart(NamedTuple):
    """Size of the stream of one tile of an octree.

    A tile consists of whole nodes of the octree, ``num_levels`` levels above the chunks.

    - ``size``: size of the part of the stream below and in these nodes.
    - ``codes`` (n,): the nodes.
    - ``leaf_codes`` (m,), ``leaf_values`` (m, C), ``leaf_counts`` (m, 4): those of the nodes that are one leaf.
    """

    num_levels: int
    size: StreamSize
    codes: Int64Array
    leaf_codes: Int64Array
    leaf_values: Float32Array
    leaf_counts: Int64Array


class _Leaves(NamedTuple):
    """Nodes of one level that are leaves: codes (m,), values (m, C) and the numbers of their streams (m, 4)."""

    codes: Int64Array
    values: Float32Array
    counts: Int64Array


class StreamMeter:
    """Size of the stream of one octree, which may change and grow between calls but loses no brick.

    The octree is divided into chunks, the nodes two levels above its bricks. The stream of a chunk does not depend on
    other bricks, but for the nodes above it.
    """

    def __init__(self, octree: SemanticOctree) -> None:
        self._octree = octree
        # A chunk's index in this octree is its row in the arrays below.
        self._chunks = SemanticOctree(1.0, 1)
        self._chunk_of_brick: Int64Array = np.empty(0, np.int64)
        self._totals: Int64Array = np.zeros((0, 4), np.int64)
        self._leaf_values: Float32Array = np.zeros((0, octree.num_classes), np.float32)
        # Number of nodes of each level above the chunks.
        self._num_nodes = [0] * _CHUNK_DEPTH
        # As of the last change; the part is None until it is asked for.
        self._size = StreamSize()
        self._part: StreamPart | None = None

    def update(self, since: int) -> StreamSize:
        """Return the size of the lossless stream; bricks with revisions below ``since`` are as at the last call."""
        octree = self._octree
        codes = octree.codes[self._chunk_of_brick.size :] >> 3 * _CHUNK_LEVELS
        self._chunk_of_brick = np.concatenate([self._chunk_of_brick, self._chunks.find_or_add(codes)])
        num_chunks = self._chunks.num_bricks
        num_new = num_chunks - len(self._totals)
        if num_new:
            self._totals = np.concatenate([self._totals, np.zeros((num_new, 4), np.int64)])
            self._leaf_values = np.concatenate([self._leaf_values, np.zeros((num_new, octree.num_classes), np.float32)])
        stale = np.zeros(num_chunks, np.bool_)
        stale[self._chunk_of_brick[octree.revisions >= since]] = True
        if stale.any():
            self._measure(stale)
            totals, leaves = self._sum()
            totals[0] += sum(self._num_nodes)
            _merge(totals, leaves, _CHUNK_DEPTH)
            self._size, self._part = StreamSize(*totals.tolist()), None
        return self._size

    def part(self, tile_cells: int) -> StreamPart:
        """Return the size as of the last ``update`` for ``joined_size``; tiles have an edge of ``tile_cells``.

        ``tile_cells`` is a power of two, and at least CHUNK_CELLS.
        """
        num_levels = (tile_cells // CHUNK_CELLS).bit_length() - 1
        if self._part is not None and self._part.num_levels == num_levels:
            return self._part
        totals, leaves = self._sum()
        totals[0] += sum(self._num_nodes[:num_levels])
        leaves = _merge(totals, leaves, num_levels)
        codes = np.unique(self._chunks.codes[self._totals[:, 0] > 0] >> 3 * num_levels)
        self._part = StreamPart(num_levels, StreamSize(*totals.tolist()), codes, *leaves)
        return self._part

    def _measure(self, stale: BoolArray) -> None:
        """Measure the chunks where ``stale`` (m,) is True."""
        octree = self._octree
        order = code_order(octree, np.flatnonzero(stale[self._chunk_of_brick]))
        chunks = self._chunk_of_brick[order]
        starts = np.flatnonzero(np.diff(chunks, prepend=-1, append=-1))
        rows = chunks[starts[:-1]]
        is_first = not self._totals[rows].any(axis=1).all()
        streams = empty_streams(octree.bricks, order, octree.num_classes)
        packets.measure_chunks(
            octree.bricks, order, starts, rows, octree.num_classes, encoder_scratch(octree.num_classes), *streams,
            _CHUNK_DEPTH, self._totals, self._leaf_values,
        )  # fmt: skip
        if is_first:
            self._num_nodes = _num_ancestors(self._chunks.codes[self._totals[:, 0] > 0], _CHUNK_DEPTH)

    def _sum(self) -> tuple[Int64Array, _Leaves]:
        """Sum (4,) over the chunks without the nodes above them, and the chunks that are leaves."""
        totals, own_words = self._totals.sum(axis=0), self._totals[:, 0] - _CHUNK_DEPTH
        totals[0] = own_words[self._totals[:, 0] > 0].sum()
        leaves = np.flatnonzero(own_words == 0)
        return totals, _Leaves(self._chunks.codes[leaves], self._leaf_values[leaves], self._totals[leaves])


def joined_size(parts: Sequence[StreamPart]) -> StreamSize:
    """Return the size of the stream of an octree from its tiles, at least one, of one edge."""
    num_levels = _CHUNK_DEPTH - parts[0].num_levels
    totals = np.array([part.size for part in parts]).sum(axis=0)
    totals[0] += sum(_num_ancestors(np.concatenate([part.codes for part in parts]), num_levels))
    leaves = (np.concatenate(arrays) for arrays in zip(*(part[-3:] for part in parts), strict=True))
    _merge(totals, _Leaves(*leaves), num_levels)
    return StreamSize(*totals.tolist())


def joined_unpruned_size(sizes: Sequence[StreamSize], parts: Sequence[StreamPart]) -> StreamSize:
    """Return the size of the stream of an octree without pruning from those of its tiles, at least one.

    The streams of ``sizes`` begin at the root; ``parts`` are the tiles' sizes with pruning.
    """
    num_levels = _CHUNK_DEPTH - parts[0].num_levels
    totals = np.array(sizes).sum(axis=0)
    totals[0] -= sum(sum(_num_ancestors(part.codes, num_levels)) for part in parts)
    totals[0] += sum(_num_ancestors(np.concatenate([part.codes for part in parts]), num_levels))
    return StreamSize(*totals.tolist())


def _merge(totals: Int64Array, leaves: _Leaves, num_levels: int) -> _Leaves:
    """Merge equal leaves up to ``num_levels`` levels; updates ``totals`` (4,) and returns the leaves of that level.

    Eight equal leaves under one node are one leaf, and the node has no word.
    """
    codes, values, counts = leaves
    for _ in range(num_levels):
        if codes.size < 8:
            return _Leaves(codes[:0], values[:0], counts[:0])
        order = np.argsort(codes)
        codes, values, counts = codes[order], values[order], counts[order]
        parents, first, number = np.unique(codes >> 3, return_index=True, return_counts=True)
        groups = first[number == 8][:, None] + np.arange(8)
        equal = (values[groups] == values[groups[:, :1]]).all(axis=(1, 2))
        chosen = groups[equal, 0]
        totals[0] -= chosen.size
        totals[1:] -= 7 * counts[chosen, 1:].sum(axis=0)
        codes, values, counts = parents[number == 8][equal], values[chosen], counts[chosen]
    return _Leaves(codes, values, counts)


def _num_ancestors(codes: Int64Array, num_levels: int) -> list[int]:
    """Number of nodes of each of the ``num_levels`` levels above the nodes ``codes`` (n,)."""
    numbers = []
    for _ in range(num_levels):
        codes = np.unique(codes >> 3)
        numbers.append(codes.size)
    return numbers
