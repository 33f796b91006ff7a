"""Depth-first streams of octrees, the content of map packets; docs/packet-format.md defines them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import packets, storage
from octoreplay.mapping.kernels.storage import Bricks
from octoreplay.records import BoolArray, Float32Array, Int32Array, Int64Array, UInt8Array, UInt64Array, read_only


class StreamSize(NamedTuple):
    """Numbers of words, leaves, vector leaves and other values of a stream."""

    num_words: int = 0
    num_leaves: int = 0
    num_vectors: int = 0
    num_own_values: int = 0

    def num_bytes(self, num_classes: int) -> int:
        """Size of the stream's four arrays [byte]."""
        num_values = self.num_leaves + self.num_own_values
        return 2 * self.num_words + 4 * num_values + mask_bytes(num_classes) * self.num_vectors


class TreeStreams(NamedTuple):
    """Depth-first octree of L leaves and C classes.

    - ``words`` (W,) uint16: one for each inner node.
    - ``values`` (L,) float32: one for each leaf.
    - ``masks`` (V, ceil(C / 8)) uint8: one for each vector leaf, a leaf in which the classes differ. Bit c % 8 of byte
      c // 8 is set where class c has another value than the leaf.
    - ``own_values`` (M,) float32: these other values, leaf by leaf in the order of the classes.
    """

    words: npt.NDArray[np.uint16]
    values: Float32Array
    masks: npt.NDArray[np.uint8]
    own_values: Float32Array

    @property
    def num_leaves(self) -> int:
        """Number of leaves."""
        return self.values.size

    @property
    def size(self) -> StreamSize:
        """Numbers of elements of the four arrays."""
        return StreamSize(self.words.size, self.values.size, len(self.masks), self.own_values.size)


class BrickMasks(NamedTuple):
    """Bricks of a stream in the order of their codes: n entries, each for one or more bricks of a leaf.

    - ``codes`` (n,): Morton code of the first brick.
    - ``spans`` (n,): number of bricks.
    - ``known`` (n,): known cells.
    - ``starts`` (n,): first cell of each leaf.
    - ``vector`` (n,): first cell of each vector leaf.
    """

    codes: Int64Array
    spans: Int64Array
    known: UInt64Array
    starts: UInt64Array
    vector: UInt64Array

    @property
    def is_leaf(self) -> BoolArray:
        """True for each entry (n,) that is one leaf, of one brick or more."""
        is_leaf: BoolArray = (self.known == storage.ALL_CELLS) & (self.starts == 1)
        return is_leaf


def mask_bytes(num_classes: int) -> int:
    """Size of a mask with one bit for each class [byte]."""
    return -(-num_classes // 8)


def encode_bricks(
    bricks: Bricks, order: Int64Array, num_classes: int, *, prune: bool = True, tolerance: float = 0.0
) -> TreeStreams:
    """Return the octree over the bricks ``order`` (n,), which are in the order of their codes, as a stream.

    Eight sibling leaves whose values differ by at most ``tolerance`` become one leaf. Without ``prune``, every known
    finest cell is a leaf.
    """
    streams = empty_streams(bricks, order, num_classes, prune=prune)
    totals = np.zeros(4, np.int64)
    scratch = encoder_scratch(num_classes, is_lossy=prune and tolerance > 0)
    packets.encode_bricks(bricks, order, num_classes, prune, np.float32(tolerance), scratch, *streams, totals)
    words, values, masks, own_values = streams
    return TreeStreams(words[: totals[0]], values[: totals[1]], masks[: totals[2]], own_values[: totals[3]])


def empty_streams(bricks: Bricks, order: Int64Array, num_classes: int, *, prune: bool = True) -> TreeStreams:
    """Return memory for the stream of the bricks ``order`` (n,), with room for what the encoder writes."""
    # Upper bounds: every known cell is a leaf, and the cells of every class row are different.
    num_cells = np.bitwise_count(bricks.known[order])
    has_rows = bricks.masks[order].any(axis=1)
    one_leaf = (bricks.blocks[order] < 0) & (num_cells == storage.BRICK_CELLS) if prune else np.False_
    num_leaves = int(np.where(one_leaf, 1, num_cells).sum())
    num_masks = int(num_cells[has_rows].sum())
    num_own = int(np.bitwise_count(bricks.masks[order]).sum()) * storage.OCTETS
    return TreeStreams(
        np.empty(order.size * (storage.BRICK_DEPTH + 9) + 1, np.uint16),
        np.empty(num_leaves + 1, np.float32),
        np.empty((num_masks + 1, mask_bytes(num_classes)), np.uint8),
        np.empty(num_own + num_classes, np.float32),
    )


def encoder_scratch(num_classes: int, *, is_lossy: bool = False) -> packets.EncoderScratch:
    """Return scratch memory for the encoder."""
    most_rows = storage.OCTETS * (num_classes + 1)
    low = np.empty((storage.BRICK_DEPTH + 1, 8, num_classes), np.float32)
    return packets.EncoderScratch(
        block=np.empty((most_rows, storage.OCTETS), np.float32),
        octets=np.arange(most_rows),
        classes=np.zeros(most_rows, np.int64),
        flags=np.empty((2, storage.BRICK_CELLS), np.uint8),
        octet_rows=np.empty((storage.OCTETS, num_classes), np.int64),
        octet_sizes=np.empty(storage.OCTETS, np.int64),
        class_values=np.empty(num_classes, np.float32),
        before=np.empty((storage.BRICK_DEPTH + 1, 4), np.int64),
        states=np.empty((storage.BRICK_DEPTH, 8), np.uint8),
        low=low,
        high=np.empty_like(low) if is_lossy else low,
    )


def brick_masks(streams: TreeStreams) -> BrickMasks:
    """Return the bricks of a stream.

    Raises ValueError where the words do not describe an octree with the stream's number of leaves.
    """
    size = min(streams.num_leaves, 8 * streams.words.size)
    arrays = (*np.empty((2, size), np.int64), *np.empty((3, size), np.uint64))
    path = np.empty((3, storage.BRICK_DEPTH), np.int64)
    # Arrays of packets are read-only; with all of them read-only, kernels are compiled for one signature.
    found = packets.read_words(read_only(streams.words), path, *arrays)
    masks = BrickMasks(*(array[: max(found, 0)] for array in arrays))
    num_leaves = np.bitwise_count(masks.starts).sum()
    num_vectors = np.bitwise_count(masks.vector).sum()
    if found < 0 or (num_leaves, num_vectors) != (streams.num_leaves, len(streams.masks)):
        raise ValueError("the words do not describe an octree with that many leaves")
    return masks


def leaf_list(streams: TreeStreams) -> tuple[Int64Array, Int32Array, BoolArray]:
    """Return the leaves' Morton codes (of their lowest finest cells), depths, and flags of vector leaves: (L,) each.

    Raises ValueError where the words do not describe an octree with the stream's number of leaves.
    """
    masks = brick_masks(streams)
    first_cells = np.flatnonzero(_cells(masks.starts))
    bricks, cells = first_cells >> storage.CELL_BITS, first_cells & (storage.BRICK_CELLS - 1)
    codes = masks.codes[bricks] << storage.CELL_BITS | cells
    # In a leaf of eight cells or more, the second cell is known and does not start a leaf.
    eights = _cells((masks.known & ~masks.starts) >> np.uint64(1))[first_cells]
    depths = np.int32(storage.KEY_BITS) - eights.astype(np.int32)
    whole = np.flatnonzero(masks.is_leaf[bricks])
    depths[whole] = storage.BRICK_DEPTH - np.log2(masks.spans[bricks[whole]]).astype(np.int32) // 3
    return codes, depths, _cells(masks.vector)[first_cells]


def leaf_values(streams: TreeStreams, is_vector: BoolArray, num_classes: int) -> Float32Array:
    """Return the values (L, C) float32 of all leaves; ``is_vector`` (L,) marks the vector leaves."""
    values = np.repeat(streams.values[:, None], num_classes, axis=1)
    has_own = np.zeros(values.shape, np.bool_)
    has_own[is_vector] = class_bits(streams.masks)[:, :num_classes]
    values[has_own] = streams.own_values
    return values


def bricks_of_leaves(codes: Int64Array, depths: Int32Array, is_vector: BoolArray) -> BrickMasks:
    """Return the bricks of leaves (L,) that are given in the form of ``leaf_list``, in Morton order."""
    num_cells = np.int64(1) << 3 * (storage.KEY_BITS - depths.astype(np.int64))
    bricks = codes >> storage.CELL_BITS
    firsts = np.flatnonzero(np.diff(bricks, prepend=-1))
    starts = np.uint64(1) << (codes & (storage.BRICK_CELLS - 1)).astype(np.uint64)
    # A leaf in a brick is one cell, an octet or the whole brick.
    known = np.where(num_cells == 1, starts, np.where(num_cells == storage.OCTETS, starts * 0xFF, storage.ALL_CELLS))
    vector = np.where(is_vector, starts, np.uint64(0))
    masks = (np.bitwise_or.reduceat(cells, firsts) for cells in (known, starts, vector))
    return BrickMasks(bricks[firsts], np.maximum(num_cells[firsts] >> storage.CELL_BITS, 1), *masks)


def chosen_bricks(bricks: BrickMasks, streams: TreeStreams, chosen: BoolArray) -> tuple[BrickMasks, TreeStreams]:
    """Return the bricks of a stream where ``chosen`` (n,) is True, and their values, with all words."""
    leaves = np.repeat(chosen, np.bitwise_count(bricks.starts))
    vectors = np.repeat(chosen, np.bitwise_count(bricks.vector))
    own = np.repeat(vectors, np.bitwise_count(streams.masks).sum(axis=1, dtype=np.int64))
    kept = BrickMasks(
        bricks.codes[chosen], bricks.spans[chosen], bricks.known[chosen], bricks.starts[chosen], bricks.vector[chosen]
    )
    return kept, TreeStreams(streams.words, streams.values[leaves], streams.masks[vectors], streams.own_values[own])


def chosen_leaves(streams: TreeStreams, is_vector: BoolArray, leaves: Int64Array) -> TreeStreams:
    """Return the values of the leaves at positions ``leaves`` (n,), which may repeat, with all words.

    ``is_vector`` (L,) is that of all leaves.
    """
    vectors = (np.cumsum(is_vector) - 1)[leaves[is_vector[leaves]]]
    num_own = np.bitwise_count(streams.masks).sum(axis=1, dtype=np.int64)
    counts = num_own[vectors]
    # Places in the values of all vector leaves: those of each leaf, one after the other.
    shifts = (np.cumsum(num_own) - num_own)[vectors] - (np.cumsum(counts) - counts)
    own = np.arange(counts.sum()) + np.repeat(shifts, counts)
    return TreeStreams(streams.words, streams.values[leaves], streams.masks[vectors], streams.own_values[own])


def class_bits(masks: UInt8Array) -> BoolArray:
    """Return the bits (V, 8 B) of masks (V, B)."""
    return np.unpackbits(masks, axis=1, bitorder="little").view(np.bool_)


def _cells(masks: UInt64Array) -> BoolArray:
    """Return the bits (64 n,) of brick masks (n,)."""
    return np.unpackbits(masks.astype("<u8").view(np.uint8), bitorder="little").view(np.bool_)
