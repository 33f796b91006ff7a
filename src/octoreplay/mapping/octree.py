"""The semantic octree: one log-odds per occupied class in every known cell, stored in bricks of 4 x 4 x 4 cells.

Values are deviations h - h_0 from the prior; an unknown cell has deviation 0. See kernels/storage.py for the layout.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self, cast

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import packets, storage
from octoreplay.mapping.kernels.storage import Bricks
from octoreplay.records import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    LeafTable,
    UInt8Array,
    UInt64Array,
)


class TreeStreams(NamedTuple):
    """A depth-first octree: ``words`` (W,) uint16, ``scalars`` (S,) and ``vectors`` (V, C) float32."""

    words: npt.NDArray[np.uint16]
    scalars: Float32Array
    vectors: Float32Array

    @property
    def num_leaves(self) -> int:
        """Number of leaves."""
        return int(self.scalars.size + self.vectors.shape[0])

    @property
    def num_bytes(self) -> int:
        """Size of the three arrays."""
        return self.words.nbytes + self.scalars.nbytes + self.vectors.nbytes


class SemanticOctree:
    """An octree over the key space [-2^18, 2^18)^3 with ``num_classes`` occupied classes.

    ``resolution`` is the finest leaf's edge in metres; key = floor(coordinate / resolution).
    """

    def __init__(self, resolution: float, num_classes: int) -> None:
        self.resolution = resolution
        self.num_classes = num_classes
        self.bricks = Bricks(
            codes=np.empty(0, np.int64), tiers=np.empty(0, np.uint8), rows=np.empty(0, np.int32),
            values=np.empty(0, np.float32), known=np.empty(0, np.uint64), revisions=np.empty(0, np.int64),
            table=np.full(64, -1, np.int32), counters=np.zeros(4, np.int64), free_scalar=np.empty(0, np.int32),
            scalar=np.empty((0, storage.BRICK_CELLS), np.float32),
            vector=np.empty((0, num_classes, storage.BRICK_CELLS), np.float32),
        )  # fmt: skip

    @property
    def num_bricks(self) -> int:
        """Number of bricks, the partly known ones included."""
        return int(self.bricks.counters[storage.NUM_BRICKS])

    @property
    def codes(self) -> Int64Array:
        """Morton codes of the bricks (n,), in order of creation."""
        return self.bricks.codes[: self.num_bricks]

    @property
    def known(self) -> UInt64Array:
        """Masks of the known cells (n,): bit i stands for cell i."""
        return self.bricks.known[: self.num_bricks]

    @property
    def revisions(self) -> Int64Array:
        """The revision (n,) in which each brick changed last, as its writers numbered it."""
        return self.bricks.revisions[: self.num_bricks]

    @property
    def num_cells(self) -> int:
        """Number of known finest cells."""
        return int(np.bitwise_count(self.known).sum())

    @property
    def memory_bytes(self) -> int:
        """Bytes allocated for the bricks in use: their values, masks and bookkeeping."""
        counters = self.bricks.counters
        rows = counters[storage.NUM_SCALAR] - counters[storage.NUM_FREE_SCALAR]
        per_brick = sum(array.itemsize for array in self.bricks[:6])
        return int(
            self.num_bricks * per_brick
            + self.bricks.table.nbytes
            + rows * storage.BRICK_CELLS * 4
            + counters[storage.NUM_VECTOR] * storage.BRICK_CELLS * 4 * self.num_classes
        )

    def reserve(self, bricks: int = 0, scalar: int = 0, vector: int = 0) -> None:
        """Make room for so many more bricks and rows of values."""
        old = self.bricks
        counters = old.counters
        num = self.num_bricks
        changes: dict[str, Any] = {}
        if num + bricks > old.codes.size:
            for name in ("codes", "tiers", "rows", "values", "known", "revisions"):
                changes[name] = _grown(getattr(old, name), num, num + bricks)
        free = int(counters[storage.NUM_FREE_SCALAR])
        used = int(counters[storage.NUM_SCALAR])
        if used + scalar - free > old.scalar.shape[0]:
            changes["scalar"] = _grown(old.scalar, used, used + scalar - free)
            changes["free_scalar"] = _grown(old.free_scalar, free, changes["scalar"].shape[0])
        used = int(counters[storage.NUM_VECTOR])
        if used + vector > old.vector.shape[0]:
            changes["vector"] = _grown(old.vector, used, used + vector)
        size = old.table.size
        while size < 2 * (num + bricks):
            size *= 2
        if size > old.table.size:
            changes["table"] = np.full(size, -1, np.int32)
        if changes:
            self.bricks = old._replace(**changes)
        if "table" in changes:
            storage.rebuild_table(self.bricks)

    def find(self, codes: Int64Array) -> Int64Array:
        """Index of each brick code (n,) int64, -1 where there is no such brick."""
        indices = np.empty(codes.size, np.int64)
        storage.find_all(self.bricks, codes, indices)
        return indices

    def find_or_add(self, codes: Int64Array) -> Int64Array:
        """Index of each brick code (n,) int64; missing bricks are added, all unknown."""
        self.reserve(bricks=codes.size)
        indices = np.empty(codes.size, np.int64)
        storage.find_or_add(self.bricks, codes, indices)
        return indices

    def raise_tiers(self, tiers: UInt8Array) -> None:
        """Raise brick i to at least tier ``tiers[i]``, for all bricks (n,)."""
        present = self.bricks.tiers[: self.num_bricks]
        self.reserve(
            scalar=int(np.count_nonzero((tiers == storage.SCALAR) & (present == storage.UNIFORM))),
            vector=int(np.count_nonzero((tiers == storage.VECTOR) & (present != storage.VECTOR))),
        )
        storage.make_tiers(self.bricks, tiers)

    def addresses(self, indices: Int64Array) -> tuple[Int64Array, UInt8Array]:
        """Memory addresses and tiers (n,) of the bricks ``indices`` (n,); valid until this octree grows."""
        addresses = np.empty(indices.size, np.int64)
        tiers = np.empty(indices.size, np.uint8)
        storage.brick_addresses(
            self.bricks, indices, self.bricks.scalar.ctypes.data, self.bricks.vector.ctypes.data,
            self.bricks.values.ctypes.data, addresses, tiers,
        )  # fmt: skip
        return addresses, tiers

    def overwrite(self, source: SemanticOctree, indices: Int64Array, revision: int = 0) -> None:
        """Replace the bricks that ``indices`` (n,) name in ``source`` by its values."""
        own = self.find_or_add(source.codes[indices])
        tiers = self.bricks.tiers[: self.num_bricks].copy()
        tiers[own] = np.maximum(tiers[own], source.bricks.tiers[indices])
        self.raise_tiers(tiers)
        storage.copy_bricks(source.bricks, indices, self.bricks, own)
        self.bricks.revisions[own] = revision

    def copy(self) -> Self:
        """An octree with the same content."""
        twin = type(self)(self.resolution, self.num_classes)
        twin.bricks = Bricks(*(cast("Any", array).copy() for array in self.bricks))
        return twin

    def streams(self, indices: Int64Array | None = None, *, prune: bool = True, tolerance: float = 0.0) -> TreeStreams:
        """The octree (or the bricks ``indices`` (n,) of it) as a depth-first stream of words and leaf values.

        Eight sibling leaves whose values differ by at most ``tolerance`` are one leaf; without ``prune`` every known
        finest cell is a leaf.
        """
        order = _code_order(self, indices)
        tiers = self.bricks.tiers[order]
        num_cells = np.bitwise_count(self.bricks.known[order])
        num_uniform = np.count_nonzero((tiers == storage.UNIFORM) & (num_cells == storage.BRICK_CELLS)) if prune else 0
        num_leaves = int(num_cells.sum()) - num_uniform * (storage.BRICK_CELLS - 1)
        words = np.empty(order.size * (storage.BRICK_DEPTH + 9) + 1, np.uint16)
        scalars = np.empty(num_leaves + 1, np.float32)
        vectors = np.empty((int(num_cells[tiers == storage.VECTOR].sum()), self.num_classes), np.float32)
        totals = np.zeros(3, np.int64)
        packets.encode_bricks(self.bricks, order, prune, np.float32(tolerance), words, scalars, vectors, totals)
        return TreeStreams(words[: totals[0]], scalars[: totals[1]], vectors[: totals[2]])

    def leaves(self, prior: float = 0.0, *, occupied_only: bool = False) -> LeafTable:
        """All leaves in Morton order, or those that are more likely occupied by some class than free.

        ``prior`` h_0 is added to the deviations.
        """
        streams = self.streams()
        codes, depths, is_vector = leaf_list(streams)
        if occupied_only:
            scalars = streams.scalars + np.float32(prior) > 0
            vectors = (streams.vectors + np.float32(prior) > 0).any(axis=1)
            chosen = np.empty(codes.size, np.bool_)
            chosen[is_vector], chosen[~is_vector] = vectors, scalars
            codes, depths, is_vector = codes[chosen], depths[chosen], is_vector[chosen]
            streams = TreeStreams(streams.words, streams.scalars[scalars], streams.vectors[vectors])
        sizes = np.exp2(storage.KEY_BITS - depths.astype(np.float64)) * self.resolution
        keys = np.empty((codes.size, 3), np.int64)
        storage.codes_to_keys(codes, keys)
        centers = keys * self.resolution + sizes[:, None] / 2
        return LeafTable(centers, sizes, leaf_values(streams, is_vector) + np.float32(prior))

    def lookup(self, coords: Float64Array) -> tuple[Float32Array, BoolArray, Float64Array]:
        """What is at each coordinate (P, 3) [m]: deviations (P, C) float32, known (P,), size of the leaf (P,) [m].

        An unknown place has deviation 0 and the size 0.
        """
        streams = self.streams()
        codes, depths, is_vector = leaf_list(streams)
        with np.errstate(invalid="ignore"):
            keys = np.floor(np.asarray(coords, np.float64) / self.resolution)
            inside = np.all((keys >= -storage.KEY_OFFSET) & (keys < storage.KEY_OFFSET), axis=1)
            keys = np.where(inside[:, None], keys, 0).astype(np.int64)
        cell_codes = np.empty(len(keys), np.int64)
        storage.keys_to_codes(keys, cell_codes)
        leaf = np.searchsorted(codes, cell_codes, side="right") - 1
        spans = np.int64(1) << (3 * (storage.KEY_BITS - depths.astype(np.int64)))
        known = inside & (leaf >= 0)
        known[known] = cell_codes[known] < (codes + spans)[leaf[known]]
        log_odds = np.zeros((len(keys), self.num_classes), np.float32)
        log_odds[known] = leaf_values(streams, is_vector)[leaf[known]]
        sizes = np.zeros(len(keys))
        sizes[known] = np.exp2(storage.KEY_BITS - depths[leaf[known]].astype(np.float64)) * self.resolution
        return log_odds, known, sizes


def _grown(array: npt.NDArray[Any], used: int, wanted: int) -> npt.NDArray[Any]:
    """A copy of the first ``used`` rows with room for at least ``wanted``; rows never touched take no memory."""
    larger = np.empty((max(wanted, 2 * array.shape[0], 64), *array.shape[1:]), array.dtype)
    larger[:used] = array[:used]
    return larger


def _code_order(octree: SemanticOctree, indices: Int64Array | None = None) -> Int64Array:
    """Indices (n,) of the bricks (all, or ``indices``) with any known cell, sorted by their codes."""
    chosen = np.arange(octree.num_bricks) if indices is None else indices
    chosen = chosen[octree.bricks.known[chosen] != 0]
    order: Int64Array = chosen[np.argsort(octree.bricks.codes[chosen])]
    return order


def unpruned_bytes(octree: SemanticOctree) -> int:
    """Size of the octree's streams without pruning, counted without writing them."""
    order = _code_order(octree)
    if order.size == 0:
        return 0
    codes, known = octree.bricks.codes[order], octree.bricks.known[order]
    # A brick opens as many nodes above it as the digits of its code that differ from the last one's, without the last.
    num_bits = np.frexp((codes[1:] ^ codes[:-1]).astype(np.float64))[1]
    num_nodes = storage.BRICK_DEPTH + int(((num_bits - 1) // 3).sum())
    num_words = num_nodes + order.size + np.count_nonzero(known.view(np.uint8))
    masks = np.empty(order.size, np.uint64)
    packets.vector_masks(octree.bricks, order, masks)
    num_vectors = int(np.bitwise_count(masks).sum())
    num_scalars = int(np.bitwise_count(known).sum()) - num_vectors
    return int(2 * num_words + 4 * num_scalars + 4 * num_vectors * octree.num_classes)


def _read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A view that cannot be written: what comes from a packet cannot either, and kernels are compiled once for both."""
    view = array.view()
    view.flags.writeable = False
    return view


class BrickMasks(NamedTuple):
    """What words say of the bricks, in code order: first code, number of bricks from there on, masks; (n,) each.

    ``known`` are the known cells, ``starts`` the first cell of each leaf, ``vector`` those of the vector leaves.
    """

    codes: Int64Array
    spans: Int64Array
    known: UInt64Array
    starts: UInt64Array
    vector: UInt64Array

    @property
    def is_leaf(self) -> BoolArray:
        """Which entries (n,) are one leaf, of one brick or more."""
        is_leaf: BoolArray = (self.known == storage.ALL_CELLS) & (self.starts == 1)
        return is_leaf


def _brick_masks(streams: TreeStreams) -> BrickMasks:
    """The bricks of a stream. Raises ValueError when the words are no octree with so many leaves."""
    size = min(streams.num_leaves, 8 * streams.words.size)
    arrays = (*np.empty((2, size), np.int64), *np.empty((3, size), np.uint64))
    found = packets.read_words(_read_only(streams.words), *arrays)
    masks = BrickMasks(*(array[: max(found, 0)] for array in arrays))
    num_vectors = np.bitwise_count(masks.vector).sum()
    num_scalars = np.bitwise_count(masks.starts).sum() - num_vectors
    if found < 0 or (num_scalars, num_vectors) != (streams.scalars.size, streams.vectors.shape[0]):
        raise ValueError("the words are no octree with that many leaves")
    return masks


def _cells(masks: UInt64Array) -> BoolArray:
    """Whether each cell is in its brick's mask: (64 n,) of masks (n,)."""
    return np.unpackbits(masks.astype("<u8").view(np.uint8), bitorder="little").view(np.bool_)


def leaf_list(streams: TreeStreams) -> tuple[Int64Array, Int32Array, BoolArray]:
    """Each leaf's Morton code (of its lowest finest cell), depth and whether it holds a vector: (L,) each.

    Raises ValueError when the words are no octree with so many leaves.
    """
    masks = _brick_masks(streams)
    first_cells = np.flatnonzero(_cells(masks.starts))
    bricks, cells = first_cells >> storage.CELL_BITS, first_cells & (storage.BRICK_CELLS - 1)
    codes = masks.codes[bricks] << storage.CELL_BITS | cells
    # The second cell of a leaf of eight or more is known and starts none.
    eights = _cells((masks.known & ~masks.starts) >> np.uint64(1))[first_cells]
    depths = np.int32(storage.KEY_BITS) - eights.astype(np.int32)
    whole = np.flatnonzero(masks.is_leaf[bricks])
    depths[whole] = storage.BRICK_DEPTH - np.log2(masks.spans[bricks[whole]]).astype(np.int32) // 3
    return codes, depths, _cells(masks.vector)[first_cells]


def leaf_values(streams: TreeStreams, is_vector: BoolArray) -> Float32Array:
    """Values (L, C) float32 of the leaves in order."""
    values = np.empty((is_vector.size, streams.vectors.shape[1]), np.float32)
    values[is_vector] = streams.vectors
    values[~is_vector] = streams.scalars[:, None]
    return values


MAX_BRICKS = 1 << 24
"""Most bricks of one octree that is built from leaves: 1.1e9 cells."""
MAX_BYTES = 1 << 32
"""Most memory for the values of one octree that is built from leaves."""


def octree_from_streams(streams: TreeStreams, resolution: float) -> SemanticOctree:
    """The octree of a depth-first stream. Raises ValueError when the stream is no octree, or too large a one."""
    masks = _brick_masks(streams)
    octree = SemanticOctree(resolution, streams.vectors.shape[1])
    num_bricks = int(masks.spans.sum())
    if num_bricks > MAX_BRICKS:
        raise ValueError("the stream holds more space than an octree may")
    is_vector = masks.vector != 0
    num_vector = int(masks.spans[is_vector].sum())
    num_scalar = int(np.count_nonzero(~is_vector & ~masks.is_leaf))
    if (num_scalar + num_vector * octree.num_classes) * storage.BRICK_CELLS * 4 > MAX_BYTES:
        raise ValueError("the stream holds more values than an octree may")
    octree.reserve(bricks=num_bricks, scalar=num_scalar, vector=num_vector)
    packets.fill_bricks(octree.bricks, *masks, _read_only(streams.scalars), _read_only(streams.vectors))
    return octree
