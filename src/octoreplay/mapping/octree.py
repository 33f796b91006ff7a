"""The semantic octree: one log-odds per occupied class in every known cell, stored in bricks of 4 x 4 x 4 cells.

Values are deviations h - h_0 from the prior; an unknown cell has deviation 0. See kernels/storage.py for the layout.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import packets, storage
from octoreplay.mapping.kernels.storage import Bricks, BrickTable
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

Run = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Calls a function with each of some items: ``map``, or an executor's."""

BRICK_ARRAYS = ("codes", "blocks", "values", "masks", "known", "revisions")
"""The arrays with one entry for each brick."""

CACHE_LINE = 64
"""Bytes of a cache line."""


class TreeStreams(NamedTuple):
    """A depth-first octree: ``words`` (W,) uint16, ``values`` (L,) float32, one for each leaf.

    Leaves whose classes differ (V of them) have ``masks`` (V, ceil(C / 8)) uint8 of the classes with another value,
    class c is bit c % 8 of byte c // 8, and these values in ``own_values`` (M,) float32.
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
    def num_bytes(self) -> int:
        """Size of the four arrays."""
        return sum(array.nbytes for array in self)


class LeafSpans(NamedTuple):
    """The leaves of an octree as runs of finest cells along the Morton curve, in its order.

    ``codes`` (L,) int64 are the Morton codes of their first cells, ``num_cells`` (L,) int64 the lengths of the runs,
    ``deviations`` (L, C) float32 the values h - h_0.
    """

    codes: Int64Array
    num_cells: Int64Array
    deviations: Float32Array

    def leaves_at(self, codes: Int64Array) -> Int64Array:
        """The leaf (n,) that holds each cell of ``codes`` (n,), -1 where none does."""
        leaves = np.searchsorted(self.codes, codes, side="right") - 1
        inside = leaves >= 0
        held = leaves[inside]
        leaves[inside] = np.where(codes[inside] < self.codes[held] + self.num_cells[held], held, -1)
        return leaves

    def deviations_at(self, codes: Int64Array) -> Float32Array:
        """The values (n, C) of each cell of ``codes`` (n,), 0 where no leaf holds it."""
        values = np.zeros((codes.size, self.deviations.shape[1]), np.float32)
        leaves = self.leaves_at(codes)
        values[leaves >= 0] = self.deviations[leaves[leaves >= 0]]
        return values

    def cells_in(self, chosen: BoolArray) -> Int64Array:
        """The codes (n,) of all finest cells in the ``chosen`` leaves (L,)."""
        starts, lengths = self.codes[chosen], self.num_cells[chosen]
        first = np.cumsum(lengths) - lengths
        cells: Int64Array = np.arange(lengths.sum()) + np.repeat(starts - first, lengths)
        return cells


class SemanticOctree:
    """An octree over the key space [-2^18, 2^18)^3 with ``num_classes`` occupied classes.

    ``resolution`` is the finest leaf's edge in metres; key = floor(coordinate / resolution).
    """

    def __init__(self, resolution: float, num_classes: int) -> None:
        self.resolution = resolution
        self.num_classes = num_classes
        num_words = mask_bytes(num_classes)
        self.bricks = Bricks(
            codes=np.empty(0, np.int64), blocks=np.empty(0, np.int32), values=np.empty(0, np.float32),
            masks=np.empty((0, num_words), np.uint64), known=np.empty(0, np.uint64), revisions=np.empty(0, np.int64),
            table=np.full(64, -1, np.int32), counters=np.zeros(3, np.int64),
            free=np.full((num_classes + 1) * storage.OCTETS // storage.GROWTH + 1, -1, np.int32),
            rows=np.empty((0, storage.OCTETS), np.float32),
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
        num_rows = counters[storage.NUM_ROWS] - counters[storage.NUM_FREE_ROWS]
        per_brick = storage.BRICK_BYTES + self.bricks.masks.itemsize * self.bricks.masks.shape[1]
        return int(self.num_bricks * per_brick + self.bricks.table.nbytes + num_rows * storage.ROW_BYTES)

    def reserve(self, bricks: int = 0, rows: int = 0) -> None:
        """Make room for so many more bricks and rows of values."""
        old = self.bricks
        num = self.num_bricks
        changes: dict[str, Any] = {}
        if num + bricks > old.codes.size:
            for name in BRICK_ARRAYS:
                changes[name] = _grown(getattr(old, name), num, num + bricks)
        used = int(old.counters[storage.NUM_ROWS])
        if used + rows > len(old.rows):
            changes["rows"] = _grown(old.rows, used, used + rows)
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

    def raise_bricks(
        self, indices: Int64Array, masks: UInt64Array, known: UInt64Array, needs_block: BoolArray
    ) -> BoolArray:
        """Add ``known`` cells (n,) to the bricks ``indices`` (n,), and a block where one is needed (n,).

        A block gets at least the rows of ``masks`` (n, W). Index -1 is left out. Returns where cells were added (n,).
        """
        gains = np.empty(indices.size, np.bool_)
        self.reserve(rows=storage.rows_to_raise(self.bricks, indices, masks, known, needs_block))
        storage.raise_bricks(self.bricks, indices, masks, known, needs_block, self.num_classes, gains)
        return gains

    def overwrite(self, source: SemanticOctree, indices: Int64Array, revision: int = 0) -> None:
        """Replace the bricks that ``indices`` (n,) name in ``source`` by its values."""
        own = self.find_or_add(source.codes[indices])
        table = brick_table([source], source.codes[indices])
        self.reserve(rows=storage.rows_of_column(table))
        storage.replace_bricks(self.bricks, own, table)
        self.bricks.revisions[own] = revision

    def copy(self) -> Self:
        """An octree with the same content."""
        twin = type(self)(self.resolution, self.num_classes)
        rows = self.bricks.rows[: self.bricks.counters[storage.NUM_ROWS]]
        used = {name: getattr(self.bricks, name)[: self.num_bricks] for name in BRICK_ARRAYS}
        rest = {name: getattr(self.bricks, name) for name in ("table", "counters", "free")}
        copies = {name: array.copy() for name, array in (used | rest).items()}
        twin.bricks = Bricks(**copies, rows=cache_aligned(rows.shape, rows.dtype))
        twin.bricks.rows[:] = rows
        return twin

    def streams(self, indices: Int64Array | None = None, *, prune: bool = True, tolerance: float = 0.0) -> TreeStreams:
        """The octree (or the bricks ``indices`` (n,) of it) as a depth-first stream of words and leaf values.

        Eight sibling leaves whose values differ by at most ``tolerance`` are one leaf; without ``prune`` every known
        finest cell is a leaf.
        """
        order = _code_order(self, indices)
        bricks = self.bricks
        # At most so many of each: every known cell a leaf, and every class with a row different in all its cells.
        num_cells = np.bitwise_count(bricks.known[order])
        has_rows = bricks.masks[order].any(axis=1)
        one_leaf = (bricks.blocks[order] < 0) & (num_cells == storage.BRICK_CELLS) if prune else np.False_
        num_leaves = int(np.where(one_leaf, 1, num_cells).sum())
        num_masks = int(num_cells[has_rows].sum())
        num_own = int(np.bitwise_count(bricks.masks[order]).sum()) * storage.OCTETS
        streams = TreeStreams(
            np.empty(order.size * (storage.BRICK_DEPTH + 9) + 1, np.uint16),
            np.empty(num_leaves + 1, np.float32),
            np.empty((num_masks + 1, mask_bytes(self.num_classes)), np.uint8),
            np.empty(num_own + self.num_classes, np.float32),
        )
        totals = np.zeros(4, np.int64)
        scratch = _encoder_scratch(self.num_classes, is_lossy=prune and tolerance > 0)
        packets.encode_bricks(bricks, order, self.num_classes, prune, np.float32(tolerance), scratch, *streams, totals)
        words, values, masks, own_values = streams
        return TreeStreams(words[: totals[0]], values[: totals[1]], masks[: totals[2]], own_values[: totals[3]])

    def leaves(self, prior: float = 0.0, *, occupied_only: bool = False) -> LeafTable:
        """All leaves in Morton order, or those that are more likely occupied by some class than free.

        ``prior`` h_0 is added to the deviations.
        """
        streams = self.streams()
        codes, depths, is_vector = leaf_list(streams)
        if occupied_only:
            num_own = np.bitwise_count(streams.masks).sum(axis=1, dtype=np.int64)
            occupied_own = np.repeat(np.arange(num_own.size), num_own)[streams.own_values + np.float32(prior) > 0]
            chosen = streams.values + np.float32(prior) > 0
            chosen[np.flatnonzero(is_vector)[occupied_own]] = True
            chosen_vectors = chosen[is_vector]
            streams = TreeStreams(
                streams.words, streams.values[chosen], streams.masks[chosen_vectors],
                streams.own_values[np.repeat(chosen_vectors, num_own)],
            )  # fmt: skip
            codes, depths, is_vector = codes[chosen], depths[chosen], is_vector[chosen]
        sizes = np.exp2(storage.KEY_BITS - depths.astype(np.float64)) * self.resolution
        centers = codes_to_keys(codes) * self.resolution + sizes[:, None] / 2
        return LeafTable(centers, sizes, leaf_values(streams, is_vector, self.num_classes) + np.float32(prior))

    def spans(self) -> LeafSpans:
        """All leaves as runs of finest cells."""
        streams = self.streams()
        codes, depths, is_vector = leaf_list(streams)
        num_cells = np.int64(1) << (3 * (storage.KEY_BITS - depths.astype(np.int64)))
        return LeafSpans(codes, num_cells, leaf_values(streams, is_vector, self.num_classes))

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
        cell_codes = keys_to_codes(keys)
        leaf = np.searchsorted(codes, cell_codes, side="right") - 1
        spans = np.int64(1) << (3 * (storage.KEY_BITS - depths.astype(np.int64)))
        known = inside & (leaf >= 0)
        known[known] = cell_codes[known] < (codes + spans)[leaf[known]]
        log_odds = np.zeros((len(keys), self.num_classes), np.float32)
        log_odds[known] = leaf_values(streams, is_vector, self.num_classes)[leaf[known]]
        sizes = np.zeros(len(keys))
        sizes[known] = np.exp2(storage.KEY_BITS - depths[leaf[known]].astype(np.float64)) * self.resolution
        return log_odds, known, sizes


def keys_to_codes(keys: Int64Array) -> Int64Array:
    """Morton codes (n,) of the finest cells with keys (n, 3), each key from -2^18 to 2^18 - 1."""
    codes = np.empty(len(keys), np.int64)
    storage.keys_to_codes(np.ascontiguousarray(keys, np.int64), codes)
    return codes


def codes_to_keys(codes: Int64Array) -> Int64Array:
    """Keys (n, 3) of the finest cells with Morton codes (n,)."""
    keys = np.empty((codes.size, 3), np.int64)
    storage.codes_to_keys(codes, keys)
    return keys


def mask_bytes(num_classes: int) -> int:
    """Bytes of a mask with one bit for each class."""
    return -(-num_classes // 8)


def _grown(array: npt.NDArray[Any], used: int, wanted: int) -> npt.NDArray[Any]:
    """A copy of the first ``used`` rows with room for at least ``wanted``; rows never touched take no memory."""
    larger = cache_aligned((max(wanted, 2 * array.shape[0], 64), *array.shape[1:]), array.dtype)
    larger[:used] = array[:used]
    return larger


def cache_aligned(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """An array, not set, that starts at a cache line: a vector instruction that crosses two takes twice as long."""
    num_bytes = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.empty(num_bytes + CACHE_LINE, np.uint8)
    start = -room.ctypes.data % CACHE_LINE
    return room[start : start + num_bytes].view(dtype).reshape(shape)


def brick_table(octrees: Sequence[SemanticOctree], codes: Int64Array, since: int = 0, run: Run = map) -> BrickTable:
    """Where the bricks ``codes`` (n,) of each octree are, and which have a revision from ``since`` on.

    ``run`` does the octrees' columns, like ``map`` or in threads.
    """
    shape = (len(octrees), codes.size)
    num_words = max((mask_bytes(octree.num_classes) for octree in octrees), default=1)
    table = BrickTable(
        addresses=np.empty(shape, np.int64), values=np.empty(shape, np.float32),
        masks=np.empty((*shape, num_words), np.uint64), known=np.empty(shape, np.uint64),
        is_changed=np.empty(shape, np.bool_),
    )  # fmt: skip

    def fill(column: int) -> None:
        storage.fill_table(octrees[column].bricks, octrees[column].find(codes), since, table, column)

    list(run(fill, range(len(octrees))))
    return table


def _code_order(octree: SemanticOctree, indices: Int64Array | None = None) -> Int64Array:
    """Indices (n,) of the bricks (all, or ``indices``) with any known cell, sorted by their codes."""
    chosen = np.arange(octree.num_bricks) if indices is None else indices
    chosen = chosen[octree.bricks.known[chosen] != 0]
    order: Int64Array = chosen[np.argsort(octree.bricks.codes[chosen])]
    return order


def _encoder_scratch(num_classes: int, *, is_lossy: bool) -> packets.EncoderScratch:
    """What the encoder works in."""
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
    path = np.empty((3, storage.BRICK_DEPTH), np.int64)
    found = packets.read_words(_read_only(streams.words), path, *arrays)
    masks = BrickMasks(*(array[: max(found, 0)] for array in arrays))
    num_leaves = np.bitwise_count(masks.starts).sum()
    num_vectors = np.bitwise_count(masks.vector).sum()
    if found < 0 or (num_leaves, num_vectors) != (streams.num_leaves, len(streams.masks)):
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


def leaf_values(streams: TreeStreams, is_vector: BoolArray, num_classes: int) -> Float32Array:
    """Values (L, C) float32 of the leaves in order."""
    values = np.repeat(streams.values[:, None], num_classes, axis=1)
    has_own = np.zeros(values.shape, np.bool_)
    has_own[is_vector] = _class_bits(streams.masks)[:, :num_classes]
    values[has_own] = streams.own_values
    return values


def _class_bits(masks: UInt8Array) -> BoolArray:
    """Whether each class has a value of its own, (V, 8 B) of masks (V, B)."""
    return np.unpackbits(masks, axis=1, bitorder="little").view(np.bool_)


MAX_BRICKS = 1 << 24
"""Most bricks of one octree that is built from leaves: 1.1e9 cells."""
MAX_BYTES = 1 << 32
"""Most memory for the values of one octree that is built from leaves."""


def octree_from_streams(streams: TreeStreams, resolution: float, num_classes: int) -> SemanticOctree:
    """The octree of a depth-first stream. Raises ValueError when the stream is no octree, or too large a one."""
    bricks = _brick_masks(streams)
    num_own = int(np.bitwise_count(streams.masks).sum())
    if num_own != streams.own_values.size or _class_bits(streams.masks)[:, num_classes:].any():
        raise ValueError("the masks are not those of that many values of that many classes")
    octree = SemanticOctree(resolution, num_classes)
    num_bricks = int(bricks.spans.sum())
    if num_bricks > MAX_BRICKS:
        raise ValueError("the stream holds more space than an octree may")
    class_masks = np.zeros((bricks.codes.size, mask_bytes(num_classes)), np.uint64)
    num_rows = packets.read_class_masks(bricks, _read_only(streams.masks), class_masks)
    if num_rows * storage.ROW_BYTES > MAX_BYTES:
        raise ValueError("the stream holds more values than an octree may")
    octree.reserve(bricks=num_bricks, rows=num_rows)
    packets.fill_bricks(
        octree.bricks, bricks, class_masks, num_classes, _read_only(streams.values), _read_only(streams.masks),
        _read_only(streams.own_values),
    )  # fmt: skip
    return octree
