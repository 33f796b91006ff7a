"""Counts of an evaluation in one part of the maps of a result; those of different parts add up."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from octoreplay.errors import InputError
from octoreplay.evaluate.morton_intervals import Region
from octoreplay.evaluate.scores import Agreements, TruthCounts, agreements, truth_counts
from octoreplay.evaluate.truth import Truth
from octoreplay.mapping.contradiction import EvidenceComparer, EvidencePart, state_limits
from octoreplay.mapping.metrics import MapComparer, MapComparison
from octoreplay.mapping.octree import LeafSpans, SemanticOctree
from octoreplay.records import CENTRAL, BoolArray, Int64Array
from octoreplay.result import Result
from octoreplay.stored_map import StoredMap


@dataclass(frozen=True, eq=False)
class TickCounts:
    """Counts of all maps at one stored tick.

    Attributes
    ----------
    tick : int
        Tick of the maps.
    compared : MapComparison
        Comparison of the robots' maps with the centralised one.
    central : MapComparison, optional
        The same of the centralised map with itself; None where it is not stored.
    num_region : int
        Cells that the team's evidence covers.
    has_other : bool
        True where the maps are compared with those of another result.
    with_other : tuple of Agreements
        Agreements of each map with that result; empty before its first map.
    truth : tuple of TruthCounts
        Counts of each map against the truth; empty without a truth.
    evidence : tuple of EvidencePart
        Comparison of the robots' evidence; empty where it is not stored.
    num_evidence_cells : (N,) int64
        Known cells of each robot's evidence.
    """

    tick: int
    compared: MapComparison
    central: MapComparison | None
    num_region: int
    has_other: bool
    with_other: tuple[Agreements, ...]
    truth: tuple[TruthCounts, ...]
    evidence: tuple[EvidencePart, ...]
    num_evidence_cells: Int64Array

    def plus(self, other: TickCounts) -> TickCounts:
        """Return the counts of the cells of both at the same tick."""
        both_central = self.central is not None and other.central is not None
        return replace(
            self,
            compared=self.compared + other.compared,
            central=operator.add(self.central, other.central) if both_central else None,
            num_region=self.num_region + other.num_region,
            with_other=tuple(own.plus(more) for own, more in zip(self.with_other, other.with_other, strict=True)),
            truth=tuple(own.plus(more) for own, more in zip(self.truth, other.truth, strict=True)),
            evidence=self.evidence + other.evidence,
            num_evidence_cells=self.num_evidence_cells + other.num_evidence_cells,
        )


class PartCounter:
    """Counts of the maps of one result in a box, tick by tick.

    ``other`` is a result to compare with, and ``bounds`` one of the boxes of both (``Result.boxes``). Raises InputError
    where no map is stored.
    """

    def __init__(
        self, result: Result, truth: Truth | None, other: Result | None, map_kind: str, bounds: Sequence[float]
    ) -> None:
        self._result = result
        self._bounds = bounds
        self._map_kind = map_kind
        self._truth = truth
        self._other = other
        self._other_start_ns = 0 if other is None else _first_central_ns(other)
        self.last_maps = _last_maps(result, bounds)
        self._prior = next(iter(self.last_maps.values())).prior
        self._evidence_ticks = set(result.evidence_ticks(result.robots[0]))
        self._is_observed = np.empty(0, np.bool_) if truth is None else self._observed(truth)

    def count(self, maps: Mapping[str, StoredMap]) -> TickCounts:
        """Return the counts of the maps at one stored tick."""
        tick = max(stored.tick for stored in maps.values())
        robots = self._result.robots
        has_central = CENTRAL in maps
        names = (*robots, *([CENTRAL] if has_central else []))
        octrees = [self._octree(maps, name) for name in names]
        spans = [octree.spans() for octree in octrees]
        # The team's evidence covers the cells of the centralised map, or else the cells that any robot knows.
        region = Region(spans[-1:] if has_central else spans)
        # Without a stored centralised map any other map takes its place; its agreements are not used.
        compared = MapComparer(len(robots), self._prior).compare(octrees[: len(robots)], octrees[-1], [], 0)
        central = MapComparer(1, self._prior).compare(octrees[-1:], octrees[-1], [], 0) if has_central else None
        stamp_ns = max(stored.stamp_ns for stored in maps.values())
        evidence, num_cells = self._evidence(tick)
        return TickCounts(
            tick, compared, central, region.num_cells, self._other is not None,
            () if self._other is None else self._with_other(self._other, spans, self._result.seconds(stamp_ns)),
            self._against_truth(spans, region), evidence, num_cells,
        )  # fmt: skip

    def _evidence(self, tick: int) -> tuple[tuple[EvidencePart, ...], Int64Array]:
        """Comparison of the evidence stored at a tick, and each robot's number of cells; nothing where none is."""
        robots = self._result.robots
        if tick not in self._evidence_ticks:
            return (), np.zeros(len(robots), np.int64)
        evidence = [self._result.evidence(name, tick=tick, bounds=self._bounds).octree for name in robots]
        tiles = self._result.tiles
        comparer = EvidenceComparer(
            robots, self._result.class_table.num_classes, state_limits(self._result.config.sensor),
            tile_cells=None if tiles is None else tiles.num_cells,
        )  # fmt: skip
        comparer.compare(evidence, 0)
        return (comparer.part(),), np.array([octree.num_cells for octree in evidence], np.int64)

    def _octree(self, maps: Mapping[str, StoredMap], name: str) -> SemanticOctree:
        """Octree of a map in the form that is scored, an empty one before its first stored state."""
        if name in maps:
            return maps[name].shown_octree(self._map_kind)
        return SemanticOctree(self._result.config.map.resolution, self._result.class_table.num_classes)

    def _observed(self, truth: Truth) -> BoolArray:
        """Coverage of the truth's cells by the team's evidence at the end of the run, (M,) bool."""
        central = self.last_maps.get(CENTRAL)
        covering = self.last_maps.values() if central is None else [central]
        return Region([stored.octree.spans() for stored in covering]).holds(truth.codes)

    def _with_other(self, other: Result, spans: Sequence[LeafSpans], seconds: float) -> tuple[Agreements, ...]:
        """Agreements of each map with the other result's centralised map; none before its first one."""
        at_ns = other.time_ns(seconds)
        if at_ns < self._other_start_ns:
            return ()
        reference = other.map(CENTRAL, at_ns=at_ns, bounds=self._bounds)
        leaves = reference.octree.spans()
        # The agreement counts the cells of the team and of the reference.
        num_cells = Region([*spans, leaves]).num_cells
        return tuple(agreements(own, self._prior, leaves, reference.prior, num_cells) for own in spans)

    def _against_truth(self, spans: Sequence[LeafSpans], region: Region) -> tuple[TruthCounts, ...]:
        """Counts of each map against the truth, none without a truth."""
        if self._truth is None:
            return ()
        return tuple(truth_counts(own, self._prior, self._truth, region, self._is_observed) for own in spans)


def _first_central_ns(other: Result) -> int:
    """Time of the first stored centralised map of another result."""
    ticks = other.stored_ticks(CENTRAL)
    if not ticks:
        raise InputError(f"{other.path}: holds no centralised map to compare with; replay its logs again")
    return next((metrics.stamp_ns for metrics in other.metrics if metrics.tick >= ticks[0]), 0)


def _last_maps(result: Result, bounds: Sequence[float]) -> dict[str, StoredMap]:
    """Last stored map of each robot in a box, and the centralised one if it is stored."""
    if not result.stored_ticks(result.robots[0]):
        raise InputError(f"{result.path}: holds no map; the run was interrupted before it stored one")
    names = (*result.robots, *([CENTRAL] if result.stored_ticks(CENTRAL) else []))
    return {name: result.map(name, bounds=bounds) for name in names}
