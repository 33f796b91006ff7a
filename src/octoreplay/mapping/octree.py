"""Semantic octree: a log-odds for each occupied class in every known cell, stored in bricks of 4 x 4 x 4 cells.

Values are deviations h - h_0 from the prior; an unknown cell has deviation 0. kernels/storage.py defines the layout.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import packets, storage
from octoreplay.mapping.kernels.storage import Bricks, BrickTable
from octoreplay.mapping.key_box import KeyBox
from octoreplay.mapping.streams import (
    BrickMasks,
    TreeStreams,
    brick_masks,
    chosen_bricks,
    chosen_leaves,
    class_bits,
    encode_bricks,
    leaf_list,
    leaf_values,
    mask_bytes,
)
from octoreplay.records import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int64Array,
    LeafTable,
    UInt64Array,
    read_only,
)

KEY_BITS = storage.KEY_BITS
"""Depth of the finest cells; a key's coordinates lie in [-2^(KEY_BITS - 1), 2^(KEY_BITS - 1))."""
KEY_OFFSET = storage.KEY_OFFSET
"""2^(KEY_BITS - 1): the limit of a key's coordinates."""
BRICK_DEPTH = storage.BRICK_DEPTH
"""Depth of a brick's cube in the octree."""
BRICK_CELLS = storage.BRICK_CELLS
"""Number of finest cells in a brick."""

Run = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Function that calls another one with each of some items: ``map``, or the ``map`` of an executor."""

NUM_PARTS = 16
"""Number of parts of work in threads."""

BRICK_ARRAYS = ("codes", "blocks", "values", "masks", "known", "revisions")
"""Names of the arrays with one entry for each brick."""

COPIED_ARRAYS = (*BRICK_ARRAYS, "table", "counters", "free")
"""Names of all arrays of the bricks but the rows of values."""

CACHE_LINE = 64
"""Size of a cache line [byte]."""

MAPPED_BYTES = 1 << 18
"""Size from which arrays get memory of their own from the system, which gets it back at once [byte]. Growing octrees
would leave gaps in the memory of the C library that add up to a third of a process."""


class LeafSpans(NamedTuple):
    """Leaves of an octree in Morton order, each as a span of consecutive finest cells along the Morton curve.

    - ``codes`` (L,) int64: Morton code of each leaf's first cell.
    - ``num_cells`` (L,) int64: number of finest cells.
    - ``deviations`` (L, C) float32: values h - h_0 [log-odds].
    """

    codes: Int64Array
    num_cells: Int64Array
    deviations: Float32Array

    def leaves_at(self, codes: Int64Array) -> Int64Array:
        """Return the position (n,) of the leaf that holds each cell of ``codes`` (n,), -1 where the cell is unknown."""
        leaves = np.searchsorted(self.codes, codes, side="right") - 1
        inside = leaves >= 0
        held = leaves[inside]
        leaves[inside] = np.where(codes[inside] < self.codes[held] + self.num_cells[held], held, -1)
        return leaves

    def deviations_at(self, codes: Int64Array) -> Float32Array:
        """Return the deviations (n, C) float32 of each cell of ``codes`` (n,), 0 where the cell is unknown."""
        values = np.zeros((codes.size, self.deviations.shape[1]), np.float32)
        leaves = self.leaves_at(codes)
        values[leaves >= 0] = self.deviations[leaves[leaves >= 0]]
        return values

    def cells_in(self, chosen: BoolArray) -> Int64Array:
        """Return the codes (n,) of all finest cells in the leaves where ``chosen`` (L,) is True."""
        starts, lengths = self.codes[chosen], self.num_cells[chosen]
        first = np.cumsum(lengths) - lengths
        cells: Int64Array = np.arange(lengths.sum()) + np.repeat(starts - first, lengths)
        return cells


class SemanticOctree:
    """Octree over the key space [-2^18, 2^18)^3 with C = ``num_classes`` occupied classes.

    ``resolution`` is the edge of the finest leaves [m]; key = floor(coordinate / resolution).
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
        """Number of bricks, including partly known ones."""
        return int(self.bricks.counters[storage.NUM_BRICKS])

    @property
    def codes(self) -> Int64Array:
        """Morton codes (n,) of the bricks, in the order of creation."""
        return self.bricks.codes[: self.num_bricks]

    @property
    def known(self) -> UInt64Array:
        """Masks (n,) of each brick's known cells: bit i stands for cell i."""
        return self.bricks.known[: self.num_bricks]

    @property
    def revisions(self) -> Int64Array:
        """Revision (n,) of each brick's last change; callers number the revisions."""
        return self.bricks.revisions[: self.num_bricks]

    @property
    def num_cells(self) -> int:
        """Number of known finest cells."""
        return int(np.bitwise_count(self.known).sum())

    @property
    def memory_bytes(self) -> int:
        """Memory allocated for the bricks in use, with values, masks and hash table [byte]."""
        counters = self.bricks.counters
        num_rows = counters[storage.NUM_ROWS] - counters[storage.NUM_FREE_ROWS]
        per_brick = storage.BRICK_BYTES + self.bricks.masks.itemsize * self.bricks.masks.shape[1]
        return int(self.num_bricks * per_brick + self.bricks.table.nbytes + num_rows * storage.ROW_BYTES)

    def reserve(self, bricks: int = 0, rows: int = 0) -> None:
        """Make room for ``bricks`` more bricks and ``rows`` more rows of values."""
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
        """Return the index (n,) of each brick of ``codes`` (n,), -1 where it is absent."""
        indices = np.empty(codes.size, np.int64)
        storage.find_all(self.bricks, codes, indices)
        return indices

    def find_or_add(self, codes: Int64Array) -> Int64Array:
        """Return the index (n,) of each brick of ``codes`` (n,); missing bricks are added without known cells."""
        indices = np.empty(codes.size, np.int64)
        if not codes.size:
            return indices
        self.reserve(bricks=codes.size)
        storage.find_or_add(self.bricks, codes, indices)
        return indices

    def expand_bricks(
        self, indices: Int64Array, masks: UInt64Array, known: UInt64Array, needs_block: BoolArray
    ) -> BoolArray:
        """Add known cells and class rows to the bricks ``indices`` (n,); index -1 is skipped. Values do not change.

        ``known`` (n,) are the cells to add, ``masks`` (n, W) the class rows that a block has at least, and
        ``needs_block`` (n,) is True where a brick of one value becomes a block. Returns where cells were added (n,).
        """
        has_new_cells = np.empty(indices.size, np.bool_)
        self.reserve(rows=storage.rows_to_expand(self.bricks, indices, masks, known, needs_block))
        storage.expand_bricks(self.bricks, indices, masks, known, needs_block, self.num_classes, has_new_cells)
        return has_new_cells

    def overwrite(self, source: SemanticOctree, indices: Int64Array, revision: int = 0) -> None:
        """Overwrite bricks with those at ``indices`` (n,) of ``source``, and set their revision."""
        own = self.find_or_add(source.codes[indices])
        table = brick_table([source], source.codes[indices])
        self.reserve(rows=storage.rows_of_column(table))
        storage.replace_bricks(self.bricks, own, table)
        self.bricks.revisions[own] = revision

    def copy(self) -> Self:
        """Return an octree with the same content."""
        twin = type(self)(self.resolution, self.num_classes)
        state = self.__getstate__()
        twin.__setstate__({name: value.copy() if name in COPIED_ARRAYS else value for name, value in state.items()})
        return twin

    def __getstate__(self) -> dict[str, Any]:
        """Return the content without unused memory, for ``pickle``."""
        rest = {name: getattr(self.bricks, name) for name in COPIED_ARRAYS if name not in BRICK_ARRAYS}
        used = {name: getattr(self.bricks, name)[: self.num_bricks] for name in BRICK_ARRAYS}
        rows = self.bricks.rows[: self.bricks.counters[storage.NUM_ROWS]]
        return {"resolution": self.resolution, "num_classes": self.num_classes, **used, **rest, "rows": rows}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the content of ``__getstate__``, with a copy of the rows."""
        self.resolution, self.num_classes = state["resolution"], state["num_classes"]
        rows = cache_aligned(state["rows"].shape, np.float32)
        rows[:] = state["rows"]
        self.bricks = Bricks(**{name: state[name] for name in COPIED_ARRAYS}, rows=rows)

    def streams(self, indices: Int64Array | None = None, *, prune: bool = True, tolerance: float = 0.0) -> TreeStreams:
        """Return the octree, or its bricks ``indices`` (n,), as a depth-first stream.

        Eight sibling leaves whose values differ by at most ``tolerance`` become one leaf. Without ``prune``, every
        known finest cell is a leaf.
        """
        return encode_bricks(self.bricks, code_order(self, indices), self.num_classes, prune=prune, tolerance=tolerance)

    def leaves(self, prior: float = 0.0, *, occupied_only: bool = False, most_bytes: int | None = None) -> LeafTable:
        """Return all leaves in Morton order, or those with a class that is more probable than free.

        ``prior`` is h_0 [log-odds], which is added to the deviations. Raises ValueError where the table would take more
        than ``most_bytes``.
        """
        streams = self.streams(self._occupied_bricks(prior) if occupied_only else None)
        codes, depths, is_vector = leaf_list(streams)
        if occupied_only:
            num_own = np.bitwise_count(streams.masks).sum(axis=1, dtype=np.int64)
            occupied_own = np.repeat(np.arange(num_own.size), num_own)[streams.own_values + np.float32(prior) > 0]
            is_occupied = streams.values + np.float32(prior) > 0
            is_occupied[np.flatnonzero(is_vector)[occupied_own]] = True
            chosen = np.flatnonzero(is_occupied)
            streams = chosen_leaves(streams, is_vector, chosen)
            codes, depths, is_vector = codes[chosen], depths[chosen], is_vector[chosen]
        if most_bytes is not None and codes.size * (LEAF_BYTES + 5 * self.num_classes) > most_bytes:
            raise ValueError(f"{codes.size} leaves of {self.num_classes} classes take more than {most_bytes} bytes")
        log_odds = leaf_values(streams, is_vector, self.num_classes)
        log_odds += np.float32(prior)
        sizes = np.exp2(KEY_BITS - depths.astype(np.float64)) * self.resolution
        centers = codes_to_keys(codes) * self.resolution + sizes[:, None] / 2
        return LeafTable(centers, sizes, log_odds)

    def _occupied_bricks(self, prior: float) -> Int64Array:
        """Return the indices (n,) of the bricks with a value above free, which include those of all occupied leaves."""
        largest = np.empty(self.num_bricks, np.float32)
        storage.largest_values(self.bricks, largest)
        return np.flatnonzero(largest + np.float32(prior) > 0)

    def spans(self) -> LeafSpans:
        """Return all leaves as spans of finest cells."""
        streams = self.streams()
        codes, depths, is_vector = leaf_list(streams)
        num_cells = np.int64(1) << (3 * (KEY_BITS - depths.astype(np.int64)))
        return LeafSpans(codes, num_cells, leaf_values(streams, is_vector, self.num_classes))

    def lookup(self, coords: Float64Array) -> tuple[Float32Array, BoolArray, Float64Array]:
        """Return deviations (P, C) float32, known (P,), and size of the leaf (P,) [m] at coordinates (P, 3) [m].

        Deviations and size are 0 where the map is unknown.
        """
        streams = self.streams()
        codes, depths, is_vector = leaf_list(streams)
        with np.errstate(invalid="ignore"):
            keys = np.floor(np.asarray(coords, np.float64) / self.resolution)
            inside = np.all((keys >= -KEY_OFFSET) & (keys < KEY_OFFSET), axis=1)
            keys = np.where(inside[:, None], keys, 0).astype(np.int64)
        cell_codes = keys_to_codes(keys)
        leaf = np.searchsorted(codes, cell_codes, side="right") - 1
        spans = np.int64(1) << (3 * (KEY_BITS - depths.astype(np.int64)))
        known = inside & (leaf >= 0)
        known[known] = cell_codes[known] < (codes + spans)[leaf[known]]
        log_odds = np.zeros((len(keys), self.num_classes), np.float32)
        # Dense values of all leaves would take more memory than the map.
        is_chosen = np.zeros(codes.size, np.bool_)
        is_chosen[leaf[known]] = True
        chosen = np.flatnonzero(is_chosen)
        values = leaf_values(chosen_leaves(streams, is_vector, chosen), is_vector[chosen], self.num_classes)
        log_odds[known] = values[np.cumsum(is_chosen)[leaf[known]] - 1]
        sizes = np.zeros(len(keys))
        sizes[known] = np.exp2(KEY_BITS - depths[leaf[known]].astype(np.float64)) * self.resolution
        return log_odds, known, sizes


def keys_to_codes(keys: Int64Array) -> Int64Array:
    """Return the Morton codes (n,) of the finest cells with ``keys`` (n, 3), each in [-2^18, 2^18)."""
    codes = np.empty(len(keys), np.int64)
    storage.keys_to_codes(np.ascontiguousarray(keys, np.int64), codes)
    return codes


def codes_to_keys(codes: Int64Array) -> Int64Array:
    """Return the keys (n, 3) of the finest cells with the Morton ``codes`` (n,)."""
    keys = np.empty((codes.size, 3), np.int64)
    storage.codes_to_keys(codes, keys)
    return keys


def brick_keys(codes: Int64Array) -> Int64Array:
    """Return the keys (n, 3) of the lowest cells of bricks with the Morton ``codes`` (n,)."""
    return codes_to_keys(codes << storage.CELL_BITS)


def _grown(array: npt.NDArray[Any], used: int, wanted: int) -> npt.NDArray[Any]:
    """Copy the first ``used`` rows into an array of at least ``wanted`` rows; unused rows take no physical memory."""
    larger = cache_aligned((max(wanted, 2 * array.shape[0], 64), *array.shape[1:]), array.dtype)
    larger[:used] = array[:used]
    return larger


def cache_aligned(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return an uninitialised array that starts at a cache line: a vector load across two lines takes twice as long."""
    num_bytes = math.prod(shape) * np.dtype(dtype).itemsize
    if num_bytes >= MAPPED_BYTES:
        return np.frombuffer(mmap.mmap(-1, num_bytes), dtype).reshape(shape)
    room = np.empty(num_bytes + CACHE_LINE, np.uint8)
    start = -room.ctypes.data % CACHE_LINE
    return room[start : start + num_bytes].view(dtype).reshape(shape)


def brick_table(octrees: Sequence[SemanticOctree], codes: Int64Array, since: int = 0, run: Run = map) -> BrickTable:
    """Return the locations of the bricks ``codes`` (n,) in each octree; bricks of revision >= ``since`` are changed.

    ``run`` fills the columns, one call for each octree.
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


def parts_of(num_bricks: int, threads: Executor | None) -> list[Int64Array]:
    """Return the positions 0 to ``num_bricks`` - 1 in non-empty parts of consecutive ones: one part without threads."""
    parts = np.array_split(np.arange(num_bricks), 1 if threads is None else NUM_PARTS)
    return [part for part in parts if part.size]


def code_order(octree: SemanticOctree, indices: Int64Array | None = None) -> Int64Array:
    """Return the indices (n,) of the bricks (all, or ``indices``) with a known cell, in the order of their codes."""
    chosen = np.arange(octree.num_bricks) if indices is None else indices
    chosen = chosen[octree.bricks.known[chosen] != 0]
    order: Int64Array = chosen[np.argsort(octree.bricks.codes[chosen])]
    return order


MAX_BRICKS = 1 << 24
"""Maximum number of bricks in an octree that is built from a stream: 1.1e9 cells."""
MAX_BYTES = 1 << 34
"""Maximum size of an octree that is built from a stream [byte]."""
LEAF_BYTES = 64
"""Memory for each leaf of a leaf table besides its log-odds, while the table is made [byte]."""
TABLE_BYTES = 16
"""Largest size of the hash table for each brick [byte]."""


def octree_from_streams(
    streams: TreeStreams,
    resolution: float,
    num_classes: int,
    most_bytes: int = MAX_BYTES,
    box: KeyBox | None = None,
) -> SemanticOctree:
    """Return the octree of a depth-first stream; with ``box``, without leaves and bricks that lie outside of it.

    Raises ValueError where the stream is malformed, and where its octree would take more than ``most_bytes``.
    """
    bricks = brick_masks(streams)
    num_own = int(np.bitwise_count(streams.masks).sum())
    if num_own != streams.own_values.size or class_bits(streams.masks)[:, num_classes:].any():
        raise ValueError("the masks do not match the numbers of values and classes")
    if box is not None:
        near = box.overlaps(bricks.codes << storage.CELL_BITS, bricks.spans << storage.CELL_BITS)
        bricks, streams = chosen_bricks(bricks, streams, near)
    return octree_from_bricks(bricks, streams, resolution, num_classes, most_bytes)


def octree_from_bricks(
    bricks: BrickMasks, streams: TreeStreams, resolution: float, num_classes: int, most_bytes: int = MAX_BYTES
) -> SemanticOctree:
    """Return the octree of bricks with the values of ``streams``, whose words are not read.

    Raises ValueError where it would take more than ``most_bytes``.
    """
    octree = SemanticOctree(resolution, num_classes)
    num_bricks = int(bricks.spans.sum())
    if num_bricks > MAX_BRICKS:
        raise ValueError(f"the stream has more than {MAX_BRICKS} bricks")
    per_brick = storage.BRICK_BYTES + octree.bricks.masks.itemsize * octree.bricks.masks.shape[1] + TABLE_BYTES
    num_bytes = num_bricks * per_brick
    if num_bytes > most_bytes:
        raise ValueError(f"the stream's {num_bricks} bricks take more than {most_bytes} bytes")
    class_masks = np.zeros((bricks.codes.size, mask_bytes(num_classes)), np.uint64)
    num_rows = packets.read_class_masks(bricks, read_only(streams.masks), class_masks)
    if num_bytes + num_rows * storage.ROW_BYTES > most_bytes:
        raise ValueError(f"the values of the stream take more than {most_bytes} bytes")
    octree.reserve(bricks=num_bricks, rows=num_rows)
    packets.fill_bricks(
        octree.bricks, bricks, class_masks, num_classes, read_only(streams.values), read_only(streams.masks),
        read_only(streams.own_values),
    )  # fmt: skip
    return octree
