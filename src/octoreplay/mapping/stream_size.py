"""Size of an octree's stream, counted again only where the octree changed."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.kernels import packets
from octoreplay.mapping.kernels.storage import BRICK_DEPTH
from octoreplay.mapping.octree import SemanticOctree, code_order
from octoreplay.mapping.streams import StreamSize, empty_streams, encoder_scratch
from octoreplay.records import BoolArray, Float32Array, Int64Array

_CHUNK_LEVELS = 2
_CHUNK_DEPTH = BRICK_DEPTH - _CHUNK_LEVELS


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
        self._num_upper_words = 0

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
        return self._sum()

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
            self._num_upper_words = _num_ancestors(self._chunks.codes[self._totals[:, 0] > 0])

    def _sum(self) -> StreamSize:
        """Sum over the chunks, with the nodes above them."""
        totals, own_words = self._totals.sum(axis=0), self._totals[:, 0] - _CHUNK_DEPTH
        totals[0] = own_words[self._totals[:, 0] > 0].sum() + self._num_upper_words
        leaves = np.flatnonzero(own_words == 0)
        codes, values, counts = self._chunks.codes[leaves], self._leaf_values[leaves], self._totals[leaves]
        while codes.size >= 8:
            # Eight equal leaves under one node are one leaf, and the node has no word.
            order = np.argsort(codes)
            codes, values, counts = codes[order], values[order], counts[order]
            parents, first, number = np.unique(codes >> 3, return_index=True, return_counts=True)
            groups = first[number == 8][:, None] + np.arange(8)
            equal = (values[groups] == values[groups[:, :1]]).all(axis=(1, 2))
            chosen = groups[equal, 0]
            totals[0] -= chosen.size
            totals[1:] -= 7 * counts[chosen, 1:].sum(axis=0)
            codes, values, counts = parents[number == 8][equal], values[chosen], counts[chosen]
        return StreamSize(*totals.tolist())


def _num_ancestors(codes: Int64Array) -> int:
    """Number of nodes above the chunks ``codes`` (n,)."""
    num = 0
    for _ in range(_CHUNK_DEPTH):
        codes = np.unique(codes >> 3)
        num += codes.size
    return num
