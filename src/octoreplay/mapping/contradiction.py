"""Contradiction of evidence: comparison of what the robots of a team measured themselves (docs/metrics.md)."""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple, cast

import numpy as np

from octoreplay.config.sensor import SensorConfig
from octoreplay.log_odds import best_labels
from octoreplay.mapping.kernels import contradiction as kernels
from octoreplay.mapping.kernels.storage import BRICK_CELLS, BRICK_EDGE
from octoreplay.mapping.octree import SemanticOctree, codes_to_keys
from octoreplay.records import (
    ArrayT,
    BoolArray,
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
    UInt64Array,
)
from octoreplay.run_metrics import PairMetrics, ranked_pairs

CLEAR_LIMIT, LABEL_LIMIT = 0.035, 0.25
"""Clear contradiction and label contradiction of a pair above which a run warns.

They lie between the values of right frames and those of wrong ones (benchmarks/contradiction.py, docs/metrics.md).
"""
MIN_OVERLAP = 0.05
"""Share of the smaller evidence's cells that two robots must share to be compared, unless enough cells are occupied."""


class StateLimits(NamedTuple):
    """Limits of a cell's largest log-odds in the evidence, float32.

    A cell is occupied from ``occupied_from`` on, free up to ``free_to``, and firmly free up to ``firm_to``.
    """

    occupied_from: np.float32
    free_to: np.float32
    firm_to: np.float32


FIRM_MISSES = 5
"""Number of misses without a hit that make a cell firmly free."""


def state_limits(sensor: SensorConfig) -> StateLimits:
    """Return the limits psi / 2, phi and FIRM_MISSES phi, or the clamping limit where that is nearer to 0.

    One hit makes a cell occupied, and one miss makes it free.
    """
    return StateLimits(
        np.float32(min(sensor.hit / 2, sensor.clamp_max)),
        np.float32(max(sensor.miss, sensor.clamp_min)),
        np.float32(max(FIRM_MISSES * sensor.miss, sensor.clamp_min)),
    )


def contradicting_pairs(pairs: Sequence[PairMetrics]) -> list[PairMetrics]:
    """Return the pairs with a clear contradiction above CLEAR_LIMIT, the largest first."""
    return [pair for pair in ranked_pairs(pairs, "clear_contradiction") if pair.clear_contradiction > CLEAR_LIMIT]


class CellContradiction(enum.IntEnum):
    """Relation of the robots' evidence in a cell, lowest precedence first; all pairs of robots count.

    UNCOMPARED: fewer than two robots call the cell occupied or free. NONE: they do not differ. OTHER_LABEL: occupied
    with different labels. CONTRADICTION: occupied and free. CLEAR: occupied and, for another robot, firmly free without
    an occupied cell among the 26 neighbours.
    """

    UNCOMPARED = 0
    NONE = 1
    OTHER_LABEL = 2
    CONTRADICTION = 3
    CLEAR = 4


def cell_contradictions(evidence: Sequence[SemanticOctree], coords: Float64Array, limits: StateLimits) -> UInt8Array:
    """Return the CellContradiction (P,) uint8 of the cells that hold ``coords`` (P, 3) [m].

    ``evidence`` are the N octrees s_i with one resolution, ``limits`` those of ``state_limits``. The states of a cell
    are those that EvidenceComparer counts.
    """
    found = np.full(len(coords), CellContradiction.UNCOMPARED, np.uint8)
    states = [_cell_states(octree, coords, limits) for octree in evidence]
    for own, other in itertools.permutations(states, 2):
        is_compared = (own.labels > 0) | own.is_free
        is_compared &= (other.labels > 0) | other.is_free
        np.maximum(found, np.uint8(CellContradiction.NONE), out=found, where=is_compared)
        differs = (own.labels > 0) & (other.labels > 0) & (own.labels != other.labels)
        np.maximum(found, np.uint8(CellContradiction.OTHER_LABEL), out=found, where=differs)
        contradicts = (own.labels > 0) & other.is_free
        np.maximum(found, np.uint8(CellContradiction.CONTRADICTION), out=found, where=contradicts)
    for octree, own in zip(evidence, states, strict=True):
        firm = np.flatnonzero((found == CellContradiction.CONTRADICTION) & own.is_firm)
        found[firm[~_is_near_occupied(octree, coords[firm], limits)]] = CellContradiction.CLEAR
    return found


class _CellStates(NamedTuple):
    """States of cells in one robot's evidence: label (P,), 0 unless occupied; free and firmly free (P,)."""

    labels: UInt8Array
    is_free: BoolArray
    is_firm: BoolArray


def _cell_states(octree: SemanticOctree, coords: Float64Array, limits: StateLimits) -> _CellStates:
    """States of the cells at coordinates (P, 3)."""
    values, known, _ = octree.lookup(coords)
    largest = values.max(axis=1, initial=-np.inf)
    labels = np.where(known & (largest >= limits.occupied_from), best_labels(values), 0).astype(np.uint8)
    return _CellStates(labels, known & (largest <= limits.free_to), known & (largest <= limits.firm_to))


def _is_near_occupied(octree: SemanticOctree, coords: Float64Array, limits: StateLimits) -> BoolArray:
    """True (P,) where one of the 26 cells around a coordinate (P, 3), or its own cell, is occupied."""
    steps = np.array(list(itertools.product((-1, 0, 1), repeat=3))) * octree.resolution
    values: Float32Array = octree.lookup((coords[:, None] + steps).reshape(-1, 3))[0]
    is_occupied = values.max(axis=1, initial=-np.inf) >= limits.occupied_from
    return np.asarray(is_occupied.reshape(len(coords), len(steps)).any(axis=1))


class BorderStates(NamedTuple):
    """States of bricks at the sides of a tile in one robot's evidence: codes (n,) and masks (n, W)."""

    robot: int
    codes: Int64Array
    states: UInt64Array


class EvidencePart(NamedTuple):
    """Comparison of the evidence in one tile.

    - ``counts`` (N, N, NUM_COUNTS): counts of the pairs, for which nothing is occupied outside the tile.
    - ``is_new``: True where the comparison began anew.
    - ``border``: states of bricks at the tile's sides that changed since the part before.
    """

    counts: Int64Array
    is_new: bool
    border: tuple[BorderStates, ...]


class EvidenceComparer:
    """Incremental comparison of the robots' evidence: only bricks that changed are compared again.

    ``robot_ids`` are the names of the N robots, ``limits`` those of ``state_limits``. The ``revisions`` of the evidence
    must increase with every change. ``tile_cells`` is the edge of the tile that the evidence lies in, where a whole is
    compared in tiles.
    """

    def __init__(
        self, robot_ids: Sequence[str], num_classes: int, limits: StateLimits, *, tile_cells: int | None = None
    ) -> None:
        self._robot_ids = tuple(robot_ids)
        self._tile_cells = tile_cells
        self._num_classes = num_classes
        self._limits = limits
        self._num_masks = kernels.LABEL + num_classes.bit_length()
        self.forget()

    def forget(self) -> None:
        """Compare all bricks at the next call. Needed after a robot's evidence is replaced by another octree."""
        num_robots = len(self._robot_ids)
        # A brick's index in this octree is its row in the slots.
        self._bricks = SemanticOctree(1.0, 1)
        self._slots: Int32Array = np.empty((0, num_robots), np.int32)
        self._counted: UInt64Array = np.empty((0, self._num_masks), np.uint64)
        self._latest = self._counted
        self._num_slots = 0
        self._counts: Int64Array = np.zeros((num_robots, num_robots, kernels.NUM_COUNTS), np.int64)
        self._is_new = True
        self._changed_border: list[BorderStates] = []

    def compare(
        self, evidence: Sequence[SemanticOctree], since: int, threads: Executor | None = None
    ) -> tuple[PairMetrics, ...]:
        """Return the metrics of each pair of robots that share known cells, in the robots' order.

        ``evidence`` are the N octrees s_i. Bricks with a revision below ``since`` are those of the last call. The
        result does not depend on ``threads``.
        """
        since = since if self._num_slots else 0
        self._changed_border = []
        changed = [np.flatnonzero(octree.revisions >= since) for octree in evidence]
        if not any(new.size for new in changed):
            return pairs_of(self._robot_ids, self._counts)
        rows = [self._bricks.find_or_add(octree.codes[new]) for octree, new in zip(evidence, changed, strict=True)]
        self._add_slots(rows)

        def refresh(robot: int) -> UInt8Array:
            return self._refresh(robot, evidence[robot], changed[robot], rows[robot])

        marks = (map if threads is None else threads.map)(refresh, range(len(evidence)))
        for robot, stale in enumerate(marks):
            kernels.update_counts(self._slots, self._counted, self._latest, robot, stale, self._counts)
            if self._tile_cells is not None:
                self._changed_border.append(self._border_states(robot, np.flatnonzero(stale), self._tile_cells))
        return pairs_of(self._robot_ids, self._counts)

    def part(self) -> EvidencePart:
        """Return what the last call of ``compare`` gives to ``JoinedEvidence``; call it once after each."""
        is_new, self._is_new = self._is_new, False
        return EvidencePart(self._counts.copy(), is_new, tuple(self._changed_border))

    def _border_states(self, robot: int, rows: Int64Array, tile_cells: int) -> BorderStates:
        """States of one robot's bricks at the sides of the tile, of the bricks in some rows."""
        codes = self._bricks.codes[rows]
        places = codes_to_keys(codes * BRICK_CELLS) % tile_cells
        at_side = np.flatnonzero(((places == 0) | (places == tile_cells - BRICK_EDGE)).any(axis=1))
        return BorderStates(robot, codes[at_side], self._latest[self._slots[rows[at_side], robot]])

    def _add_slots(self, rows: Sequence[Int64Array]) -> None:
        """Add a slot with an unknown state where a robot has a brick for the first time."""
        num_rows = self._bricks.num_bricks
        if num_rows > len(self._slots):
            self._slots = _with_rows(self._slots, num_rows, -1)
        for robot, own_rows in enumerate(rows):
            fresh = own_rows[self._slots[own_rows, robot] < 0]
            self._slots[fresh, robot] = np.arange(self._num_slots, self._num_slots + fresh.size)
            self._num_slots += fresh.size
        if self._num_slots > len(self._counted):
            self._counted = _with_rows(self._counted, self._num_slots, 0)
            self._latest = _with_rows(self._latest, len(self._counted), 0)

    def _refresh(self, robot: int, octree: SemanticOctree, indices: Int64Array, rows: Int64Array) -> UInt8Array:
        """Update the latest states of a robot's bricks; returns a mark for each row, not 0 for changed states."""
        team, neighbours = self._bricks.bricks, np.empty((3, 3, 3), np.int64)
        marks = np.zeros(self._bricks.num_bricks, np.uint8)
        kernels.classify_bricks(
            octree.bricks, indices, self._slots[rows, robot], *self._limits, self._num_classes, self._latest
        )
        kernels.mark_stale(team, self._slots, self._counted, self._latest, robot, rows, neighbours, marks)
        kernels.update_near(team, self._slots, self._latest, robot, marks, neighbours, np.empty((3, 3, 3), np.uint64))
        return marks


def pairs_of(robot_ids: Sequence[str], counts: Int64Array) -> tuple[PairMetrics, ...]:
    """Return the metrics of the pairs with known cells in common from their counts (N, N, NUM_COUNTS)."""
    overlaps = counts[:, :, kernels.OVERLAP]
    return tuple(_pair(robot_ids, counts, i, j) for i, j in np.argwhere(np.triu(overlaps, 1) > 0).tolist())


def _pair(robot_ids: Sequence[str], counts: Int64Array, i: int, j: int) -> PairMetrics:
    """Metrics of the robots i < j."""
    overlap, first_free, first_clear, both, other_label = counts[i, j].tolist()
    _, second_free, second_clear, _, _ = counts[j, i].tolist()
    occupied = first_free + second_free + both
    return PairMetrics(
        first=robot_ids[i],
        second=robot_ids[j],
        overlap_cells=overlap,
        occupied_cells=occupied,
        contradiction=_share(first_free + second_free, occupied),
        clear_contradiction=_share(first_clear + second_clear, occupied),
        contradiction_of_first=_share(first_free, first_free + both),
        contradiction_of_second=_share(second_free, second_free + both),
        both_occupied_cells=both,
        label_contradiction=_share(other_label, both),
    )


def _share(part: int, whole: int) -> float:
    """Return part / whole; NaN where the whole is 0."""
    return part / whole if whole else math.nan


def _with_rows(array: ArrayT, wanted: int, value: int) -> ArrayT:
    """Copy an array into one of at least ``wanted`` rows; the new rows hold ``value``."""
    larger = np.full((max(wanted, 2 * len(array), 64), array.shape[1]), value, array.dtype)
    larger[: len(array)] = array
    return cast("ArrayT", larger)
