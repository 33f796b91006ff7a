"""Contradiction of evidence that was compared in tiles.

All counts of a pair of robots add up over tiles but those of clear contradictions: a firmly free cell beside a tile's
side may have an occupied neighbour in another tile. These cells are taken off.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from octoreplay.mapping.contradiction import BorderStates, EvidencePart, pairs_of
from octoreplay.mapping.kernels import contradiction as kernels
from octoreplay.mapping.kernels.storage import BRICK_CELLS, BRICK_EDGE
from octoreplay.mapping.octree import KEY_OFFSET, SemanticOctree, codes_to_keys, keys_to_codes
from octoreplay.records import Int32Array, Int64Array, UInt64Array
from octoreplay.run_metrics import PairMetrics

_AROUND: Int64Array = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
"""Steps to the bricks around a brick, and to itself."""


class JoinedEvidence:
    """Contradiction of the evidence of a whole from the parts of its tiles, call by call.

    ``robot_ids`` are the names of the N robots.
    """

    def __init__(self, robot_ids: Sequence[str], num_classes: int) -> None:
        self._robot_ids = tuple(robot_ids)
        self._num_masks = kernels.LABEL + num_classes.bit_length()
        self._forget()

    def _forget(self) -> None:
        """Begin anew."""
        num_robots = len(self._robot_ids)
        # A brick's index in this octree is its row in the arrays below. All bricks are at the sides of tiles.
        self._bricks = SemanticOctree(1.0, 1)
        self._slots: Int32Array = np.empty((0, num_robots), np.int32)
        self._states: UInt64Array = np.zeros((0, self._num_masks), np.uint64)
        # The mask NEAR of each state within its tile.
        self._near: UInt64Array = np.zeros(0, np.uint64)
        self._taken_off: Int64Array = np.zeros((num_robots, num_robots), np.int64)

    def joined(self, parts: Sequence[EvidencePart]) -> tuple[PairMetrics, ...]:
        """Return the metrics of the pairs from the parts of all tiles, at least one, as ``EvidenceComparer`` does."""
        if any(part.is_new for part in parts):
            self._forget()
        self._update([states for part in parts for states in part.border])
        counts = np.sum([part.counts for part in parts], axis=0)
        counts[:, :, kernels.OCCUPIED_CLEAR] -= self._taken_off
        return pairs_of(self._robot_ids, counts)

    def _update(self, border: Sequence[BorderStates]) -> None:
        """Take over new states of bricks, and count what they change."""
        border = [states for states in border if states.codes.size]
        if not border:
            return
        rows = [self._bricks.find_or_add(states.codes) for states in border]
        self._add_slots(border, rows)
        stale = np.zeros(self._bricks.num_bricks, np.bool_)
        stale[np.concatenate(rows)] = True
        stale[self._neighbours(np.flatnonzero(stale))] = True
        stale_rows = np.flatnonzero(stale)
        self._taken_off -= self._num_not_clear(stale_rows)
        for states, own_rows in zip(border, rows, strict=True):
            slots = self._slots[own_rows, states.robot]
            self._states[slots] = states.states
            self._near[slots] = states.states[:, kernels.NEAR]
        marks = np.where(stale, kernels.STALE_NEAR, 0).astype(np.uint8)
        scratch = np.empty((3, 3, 3), np.int64), np.empty((3, 3, 3), np.uint64)
        for robot in range(len(self._robot_ids)):
            of_robot = np.where(self._slots[:, robot] >= 0, marks, 0).astype(np.uint8)
            kernels.update_near(self._bricks.bricks, self._slots, self._states, robot, of_robot, *scratch)
        self._taken_off += self._num_not_clear(stale_rows)

    def _add_slots(self, border: Sequence[BorderStates], rows: Sequence[Int64Array]) -> None:
        """Add a slot with an unknown state where a robot has a brick for the first time."""
        num_new = self._bricks.num_bricks - len(self._slots)
        self._slots = np.concatenate([self._slots, np.full((num_new, len(self._robot_ids)), -1, np.int32)])
        for states, own_rows in zip(border, rows, strict=True):
            fresh = own_rows[self._slots[own_rows, states.robot] < 0]
            self._slots[fresh, states.robot] = len(self._states) + np.arange(fresh.size)
            self._states = np.concatenate([self._states, np.zeros((fresh.size, self._num_masks), np.uint64)])
            self._near = np.concatenate([self._near, np.zeros(fresh.size, np.uint64)])

    def _neighbours(self, rows: Int64Array) -> Int64Array:
        """Rows of the bricks around some bricks."""
        keys = codes_to_keys(self._bricks.codes[rows] * BRICK_CELLS)
        around = (keys[:, None] + _AROUND * BRICK_EDGE).reshape(-1, 3)
        around = around[((around >= -KEY_OFFSET) & (around < KEY_OFFSET)).all(axis=1)]
        found = self._bricks.find(np.unique(keys_to_codes(around) // BRICK_CELLS))
        return found[found >= 0]

    def _num_not_clear(self, rows: Int64Array) -> Int64Array:
        """Numbers (N, N) of cells in some bricks that i calls occupied and j firmly free with something beside them.

        What is beside them is occupied for j, and in another tile.
        """
        slots = self._slots[rows]
        states = np.where(slots[:, :, None] >= 0, self._states[slots], np.uint64(0))
        near_elsewhere = states[:, :, kernels.NEAR] & ~self._near[slots]
        not_clear = states[:, :, kernels.FIRM] & near_elsewhere
        occupied = np.bitwise_or.reduce(states[:, :, kernels.LABEL :], axis=2)
        found = np.zeros_like(self._taken_off)
        for robot in range(len(self._robot_ids)):
            some = np.flatnonzero(not_clear[:, robot])
            found[:, robot] = np.bitwise_count(occupied[some] & not_clear[some, robot, None]).sum(axis=0)
        return found
