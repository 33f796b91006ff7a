"""Map of a team at one time: mean of the robots' maps, their disagreement, and the evidence behind each cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from octoreplay.log_odds import best_labels
from octoreplay.mapping.contradiction import CellContradiction, StateLimits, cell_contradictions, state_limits
from octoreplay.mapping.octree import LeafSpans, SemanticOctree, codes_to_keys
from octoreplay.records import Float32Array, Float64Array, Int64Array, UInt8Array
from octoreplay.report.map_part import MapPart
from octoreplay.report.page.tiles import (
    DISAGREEMENT_STEPS,
    PLAIN,
    TEAM_FIELDS,
    Cubes,
    Runs,
    free_runs,
    merged,
    occupied_cubes,
    probability_steps,
    runs_hold,
    union,
)
from octoreplay.result import Result
from octoreplay.stored_map import StoredMap

SEVERAL = 255
"""Value of the field ``first`` where several robots knew a cell in the same period."""

_CHUNK = 100_000
"""Number of cells of which the log-odds of all robots are in memory at a time."""
_MASK_BITS = 63


@dataclass(frozen=True, eq=False)
class RobotMap:
    """Part of a map of one robot: index of the robot, the stored map, and the leaves of its posterior.

    ``octree`` holds the map with some cells around the part.
    """

    index: int
    stored: StoredMap
    spans: LeafSpans
    octree: SemanticOctree

    @classmethod
    def of(cls, index: int, stored: StoredMap) -> RobotMap:
        """Return a map with its leaves."""
        return cls(index, stored, stored.shown_octree().spans(), stored.octree)

    @cached_property
    def log_odds(self) -> Float32Array:
        """Log-odds of the leaves with the prior (L, C)."""
        values: Float32Array = self.spans.deviations + np.float32(self.stored.prior)
        return values

    @cached_property
    def labels(self) -> UInt8Array:
        """Labels of the leaves (L,), 0 for free."""
        return best_labels(self.log_odds)

    def cubes(self) -> Cubes:
        """Return the occupied leaves as cubes."""
        return occupied_cubes(self.spans, self.labels, self.log_odds)

    @cached_property
    def free_space(self) -> Runs:
        """Free space as runs of cells."""
        return free_runs(self.spans, self.labels == 0)


class Evidence:
    """Ticks, out of some of a result, at which robots' evidence is stored.

    ``has_history`` is True where the evidence of several ticks is stored. ``limits`` are those of its states.
    """

    def __init__(self, result: Result, ticks: Sequence[int]) -> None:
        self.result = result
        self.stored = {name: set(result.evidence_ticks(name)) for name in result.robots}
        self.ticks = [tick for tick in ticks if any(tick in stored for stored in self.stored.values())]
        self.has_history = len(self.ticks) > 1
        self.limits: StateLimits = state_limits(result.config.effective_sensor)


class EvidencePart:
    """Part of the robots' evidence at one tick after the other: the last one up to a tick, or the first one."""

    def __init__(self, evidence: Evidence, part: MapPart) -> None:
        self.of_result = evidence
        self._part = part
        self._tick = -1
        self._maps: list[RobotMap] = []

    def at(self, tick: int) -> tuple[int, list[RobotMap]]:
        """Return the tick of the evidence that belongs to a tick, and the evidence; -1 and nothing without any."""
        ticks = self.of_result.ticks
        wanted = max((t for t in ticks if t <= tick), default=ticks[0] if ticks else -1)
        if wanted != self._tick:
            self._tick, self._maps = wanted, []
            for index, name in enumerate(self.of_result.result.robots):
                if wanted in self.of_result.stored[name]:
                    self._maps.append(self._map(index, name, wanted))
        return self._tick, self._maps

    def _map(self, index: int, robot_id: str, tick: int) -> RobotMap:
        """Evidence of a robot."""
        wider = self._part.evidence(self.of_result.result, robot_id, tick=tick)
        stored = wider.cut(self._part.bounds) if len(self._part.bounds) else wider
        return RobotMap(index, stored, stored.octree.spans(), wider.octree)


class TeamMap:
    """Part of a team's map at one tick after the other."""

    def __init__(self, evidence: EvidencePart) -> None:
        self._evidence = evidence
        self._first = _FirstRobots()
        self._contradiction_tick = -1
        self._contradictions = _NO_CELLS

    def at(self, tick: int, maps: Sequence[RobotMap]) -> tuple[Cubes, Runs]:
        """Return the occupied cells of the team's map with the fields of PLAIN and TEAM_FIELDS, and its free space.

        ``maps`` are those of robots with a common frame. Cells that are free in the team's map although the evidence of
        a robot calls them occupied have the label 0.
        """
        evidence_tick, evidence = self._evidence.at(tick)
        frame = maps[0].stored.frame_id if maps else ""
        evidence = [own for own in evidence if own.stored.frame_id == frame]
        if self._evidence.of_result.has_history and evidence_tick <= tick:
            self._first.advance(evidence_tick, evidence)
        if evidence_tick != self._contradiction_tick:
            self._contradiction_tick = evidence_tick
            self._contradictions = _contradictions(evidence, self._evidence.of_result.limits)
        codes = _occupied_codes(maps)
        if evidence_tick <= tick:
            contradicted = self._contradictions.values >= CellContradiction.CONTRADICTION
            codes = np.union1d(codes, self._contradictions.codes[contradicted])
        cells = np.zeros(len(codes), dtype=[*PLAIN, *TEAM_FIELDS])
        cells["code"] = codes
        for start in range(0, len(codes), _CHUNK):
            _fill(cells[start : start + _CHUNK], maps)
        for own in evidence:
            knows = own.spans.leaves_at(codes) >= 0
            cells["seen"] |= np.where(knows, np.uint64(1) << np.uint64(min(own.index, _MASK_BITS)), np.uint64(0))
        if self._evidence.of_result.has_history:
            cells["first"] = self._first.of(codes)
        cells["contradiction"] = self._contradictions.at(codes)
        cells = cells[(cells["label"] > 0) | (cells["contradiction"] >= CellContradiction.CONTRADICTION)]
        return merged(cells), union([own.free_space for own in maps])


def together(maps: Mapping[str, StoredMap]) -> list[str]:
    """Return the robots of the largest group with a common frame, in their order."""
    groups: dict[str, list[str]] = {}
    for name, stored in maps.items():
        groups.setdefault(stored.frame_id, []).append(name)
    return max(groups.values(), key=len, default=[])


def _occupied_codes(maps: Sequence[RobotMap]) -> Int64Array:
    """Codes of the finest cells that a robot's map calls occupied, ascending."""
    found = [own.spans.cells_in(own.labels > 0) for own in maps]
    return np.unique(np.concatenate([np.empty(0, np.int64), *found]))


def _fill(cells: Cubes, maps: Sequence[RobotMap]) -> None:
    """Write label, probability and disagreement of cells."""
    codes = cells["code"]
    values = np.stack([own.spans.deviations_at(codes) for own in maps])
    knows = np.stack([own.spans.leaves_at(codes) >= 0 for own in maps])
    prior = np.float32(maps[0].stored.prior)
    log_odds = values.sum(axis=0) / np.maximum(knows.sum(axis=0), 1).astype(np.float32)[:, None] + prior
    cells["label"] = best_labels(log_odds)
    cells["probability"] = probability_steps(log_odds)
    means = values / np.array([own.stored.num_robots for own in maps], np.float32)[:, None, None]
    largest = np.zeros(len(codes), np.float32)
    for index, own in enumerate(means):
        for other in means[index + 1 :]:
            np.maximum(largest, np.square(own - other).sum(axis=1), out=largest)
    cells["disagreement"] = np.rint(np.minimum(np.sqrt(largest) * DISAGREEMENT_STEPS, 65535))


class _CellValues(NamedTuple):
    """Values (M,) of some cells with codes (M,), ascending; all other cells have the value 0."""

    codes: Int64Array
    values: UInt8Array

    def at(self, codes: Int64Array) -> UInt8Array:
        """Return the value at each of ``codes`` (n,)."""
        values = np.zeros(len(codes), np.uint8)
        if len(self.codes):
            rows = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
            np.copyto(values, self.values[rows], where=self.codes[rows] == codes)
        return values

    def with_more(self, codes: Int64Array, values: UInt8Array) -> _CellValues:
        """Return these cells and some others, (n,) each."""
        together = np.concatenate([self.codes, codes])
        order = np.argsort(together, kind="stable")
        return _CellValues(together[order], np.concatenate([self.values, values])[order])


_NO_CELLS = _CellValues(np.empty(0, np.int64), np.empty(0, np.uint8))


def _contradictions(evidence: Sequence[RobotMap], limits: StateLimits) -> _CellValues:
    """Return the CellContradiction of the cells that the evidence of a robot calls occupied."""
    occupied = []
    for own in evidence:
        largest = own.spans.deviations.max(axis=1, initial=-np.inf)
        occupied.append(own.spans.cells_in(largest >= limits.occupied_from))
    codes = np.unique(np.concatenate([np.empty(0, np.int64), *occupied]))
    if not len(codes):
        return _NO_CELLS
    octrees = [own.octree for own in evidence]
    coords: Float64Array = (codes_to_keys(codes) + np.float64(0.5)) * octrees[0].resolution
    return _CellValues(codes, cell_contradictions(octrees, coords, limits))


class _FirstRobots:
    """First robot whose evidence knew each cell."""

    def __init__(self) -> None:
        self._tick = -1
        self._known: list[list[tuple[int, Runs]]] = []
        self._cells = _NO_CELLS

    def advance(self, tick: int, evidence: Sequence[RobotMap]) -> None:
        """Add the evidence of a tick."""
        if tick > self._tick:
            self._tick = tick
            everything = [
                (own.index, free_runs(own.spans, np.ones(len(own.spans.codes), np.bool_))) for own in evidence
            ]
            self._known.append(everything)

    def of(self, codes: Int64Array) -> UInt8Array:
        """Return the index + 1 of the first robot of each cell (n,), 0 for none, SEVERAL for several at once."""
        new = np.setdiff1d(codes, self._cells.codes, assume_unique=True)
        first = np.zeros(len(new), np.uint8)
        for known in self._known:
            now = np.zeros(len(new), np.uint8)
            for index, runs in known:
                holds = runs_hold(runs, new)
                now = np.where(holds, np.where(now > 0, SEVERAL, min(index + 1, SEVERAL - 1)), now).astype(np.uint8)
            first = np.where(first > 0, first, now)
        self._cells = self._cells.with_more(new[first > 0], first[first > 0])
        return self._cells.at(codes)
