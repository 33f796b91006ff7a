"""Evaluation of a stored result's maps against the truth, the centralised map or another result."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate.morton_intervals import Region
from octoreplay.evaluate.records import EvaluatedTick, Evaluation, MapScores, TruthScores
from octoreplay.evaluate.scores import agreement, truth_scores
from octoreplay.evaluate.truth import WORLD_FILE, Truth, load_truth
from octoreplay.evaluate.truth_frame import truth_frame_warning
from octoreplay.mapping.contradiction import EvidenceComparer, state_limits
from octoreplay.mapping.metrics import MapComparer
from octoreplay.mapping.octree import LeafSpans, SemanticOctree
from octoreplay.records import CENTRAL, MAP_KINDS, POSTERIOR, BoolArray, FilePath
from octoreplay.replay.warnings import team_frame_warnings
from octoreplay.result import Result, open_result
from octoreplay.run_metrics import PairMetrics, TickMetrics
from octoreplay.stored_map import StoredMap


def evaluate_result(
    path: FilePath,
    *,
    truth: FilePath | None = None,
    against: FilePath = CENTRAL,
    map_kind: str = POSTERIOR,
    over_time: bool = True,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """Return the scores of all maps of a result.

    Parameters
    ----------
    path : path
        Result file.
    truth : path, optional
        A world.npz, a folder that holds one, or a labelled PLY file (``load_truth``).
    against : path or 'central'
        Reference of the agreement: the result's own centralised map, or the centralised map of another result at the
        same time since the start.
    map_kind : 'posterior' or 'mean'
        Form of the robots' maps that is scored (``StoredMap``).
    over_time : bool
        True for every stored tick, False for the last one only.
    progress : callable, optional
        Called with the finished share, 0..1, after each tick.

    Raises
    ------
    ConfigError
        ``map_kind`` is unknown.
    InputError
        A file cannot be used, or the files have different classes or resolutions.
    PacketError
        A stored map is damaged.
    """
    if map_kind not in MAP_KINDS:
        raise ConfigError(f"map: '{map_kind}' is not one of {', '.join(MAP_KINDS)}")
    path, against = Path(path), against if against == CENTRAL else Path(against)
    truth = None if truth is None else Path(truth)
    with contextlib.ExitStack() as files:
        result = files.enter_context(open_result(path))
        other = None if against == CENTRAL else files.enter_context(open_result(against))
        if other is not None:
            _check_fit(result, other)
        surface = None if truth is None else load_truth(truth, result.class_table, result.config.map.resolution)
        evaluator = _Evaluator(result, surface, other, map_kind)
        stored: Iterable[Mapping[str, StoredMap]] = result.history() if over_time else [evaluator.last_maps]
        ticks = []
        for maps in stored:
            ticks.append(evaluator.evaluate(maps))
            if progress is not None:
                progress(min(1.0, (ticks[-1].tick + 1) / (result.metrics[-1].tick + 1)))
        misplaced = None if truth is None else truth_frame_warning(result, truth)
        return Evaluation(
            str(path), None if truth is None else str(truth), str(against), map_kind, result.class_table.names,
            tuple(ticks), (*evaluator.warnings, *([misplaced] if misplaced is not None else [])),
        )  # fmt: skip


def truth_beside_logs(path: FilePath) -> Path | None:
    """Return the world.npz in the folder of one of a result's logs, None without one. Raises InputError."""
    with open_result(path) as result:
        folders = dict.fromkeys((result.path.parent / name).parent for name in result.inputs)
    return next((folder / WORLD_FILE for folder in folders if (folder / WORLD_FILE).is_file()), None)


def _check_fit(result: Result, other: Result) -> None:
    """Refuse a reference with other classes or another resolution."""
    for what, here, there in (
        ("classes differ", result.class_table.names, other.class_table.names),
        ("resolution differs", result.config.map.resolution, other.config.map.resolution),
    ):
        if here != there:
            raise InputError(f"{other.path}: {what} from {result.path}; give results with the same")


def _first_central_ns(other: Result) -> int:
    """Time of the first stored centralised map of another result."""
    ticks = other.stored_ticks(CENTRAL)
    if not ticks:
        raise InputError(f"{other.path}: holds no centralised map to compare with; replay its logs again")
    return next((metrics.stamp_ns for metrics in other.metrics if metrics.tick >= ticks[0]), 0)


def _last_maps(result: Result) -> dict[str, StoredMap]:
    """Last stored map of each robot, and the centralised one if it is stored."""
    if not result.stored_ticks(result.robots[0]):
        raise InputError(f"{result.path}: holds no map; the run was interrupted before it stored one")
    names = (*result.robots, *([CENTRAL] if result.stored_ticks(CENTRAL) else []))
    return {name: result.map(name) for name in names}


class _Counts(NamedTuple):
    """Scores of a map that need no truth: fields of MapScores."""

    num_cells: int
    entropy_bits: float
    agreement: float
    agreement_occupied: float


class _Evaluator:
    """Evaluates the maps of one result, tick by tick."""

    def __init__(self, result: Result, truth: Truth | None, other: Result | None, map_kind: str) -> None:
        self._result = result
        self._map_kind = map_kind
        self._truth = truth
        self._other = other
        self._other_start_ns = 0 if other is None else _first_central_ns(other)
        self._metrics = {metrics.tick: metrics for metrics in result.metrics}
        self.last_maps = _last_maps(result)
        self._prior = next(iter(self.last_maps.values())).prior
        self._comparer = EvidenceComparer(
            result.robots, result.class_table.num_classes, state_limits(result.config.sensor)
        )
        self._evidence_ticks = set(result.evidence_ticks(result.robots[0]))
        self.warnings: tuple[str, ...] = ()
        self._is_observed = np.empty(0, np.bool_) if truth is None else self._observed(truth)

    def evaluate(self, maps: Mapping[str, StoredMap]) -> EvaluatedTick:
        """Return the scores of the maps at one stored tick."""
        tick = max(stored.tick for stored in maps.values())
        metrics = self._metrics.get(tick)
        if metrics is None:
            raise InputError(
                f"{self._result.path}: damaged: tick {tick} has maps but no metrics; replay the logs again"
            )
        seconds = self._result.seconds(metrics.stamp_ns)
        names = (*self._result.robots, *([CENTRAL] if CENTRAL in maps else []))
        octrees = [self._octree(maps, name) for name in names]
        spans = [octree.spans() for octree in octrees]
        # The team's evidence covers the cells of the centralised map, or else the cells that any robot knows.
        region = Region(spans[-1:] if CENTRAL in names else spans)
        disagreement, counts = self._counts(names, octrees, metrics)
        if self._other is not None:
            agreements = self._agreements_with_other(self._other, spans, seconds)
            counts = [_Counts(*count[:2], *pair) for count, pair in zip(counts, agreements, strict=True)]
        if not region.num_cells:
            # Empty maps neither agree nor differ.
            disagreement, counts = math.nan, [_Counts(*count[:2], math.nan, math.nan) for count in counts]
        is_active = {robot.robot_id: robot.active for robot in metrics.robots}
        return EvaluatedTick(
            tick,
            seconds,
            disagreement,
            tuple(
                MapScores(
                    robot_id=name,
                    is_active=is_active.get(name, True),
                    **count._asdict(),
                    truth=self._truth_scores(leaves, region),
                )
                for name, count, leaves in zip(names, counts, spans, strict=True)
            ),
            self._pairs(tick),
        )

    def _pairs(self, tick: int) -> tuple[PairMetrics, ...]:
        """Contradiction of the evidence stored at a tick, none where it is not stored; keeps the tick's warnings."""
        if tick not in self._evidence_ticks:
            return ()
        evidence = [self._result.evidence(robot_id, tick=tick).octree for robot_id in self._result.robots]
        self._comparer.forget()
        pairs = self._comparer.compare(evidence, 0)
        num_cells = {
            name: octree.num_cells
            for name, octree in zip(self._result.robots, evidence, strict=True)
            if octree.num_cells
        }
        # Evidence in different frames is not compared.
        metrics = self._metrics[tick]
        pairs = tuple(pair for pair in pairs if metrics.frame_of(pair.first) == metrics.frame_of(pair.second))
        self.warnings = team_frame_warnings(dataclasses.replace(metrics, pairs=pairs), num_cells)
        return pairs

    def _octree(self, maps: Mapping[str, StoredMap], name: str) -> SemanticOctree:
        """Octree of a map in the form that is scored, an empty one before its first stored state."""
        if name in maps:
            return maps[name].shown_octree(self._map_kind)
        return SemanticOctree(self._result.config.map.resolution, self._result.class_table.num_classes)

    def _observed(self, truth: Truth) -> BoolArray:
        """Coverage of the truth's cells by the team's evidence at the end of the run, (M,) bool."""
        central = self.last_maps.get(CENTRAL)
        covering = self.last_maps.values() if central is None else [central]
        is_observed = Region([stored.octree.spans() for stored in covering]).holds(truth.codes)
        if not (is_observed & truth.is_class).any():
            raise InputError(
                f"{truth.path}: no surface lies in the cells that the maps of {self._result.path} know; give it in"
                " metres, in the team's frame"
            )
        return is_observed

    def _counts(
        self, names: Sequence[str], octrees: Sequence[SemanticOctree], metrics: TickMetrics
    ) -> tuple[float, list[_Counts]]:
        """Label disagreement between the robots, and the scores of each map that need no truth."""
        robots = octrees[: len(self._result.robots)]
        # Without a stored centralised map any other map takes its place; its agreements are not used below.
        compared = MapComparer(len(robots), self._prior).compare(robots, octrees[-1], [], 0)
        agreements = list(zip(compared.agreement.tolist(), compared.agreement_occupied.tolist(), strict=True))
        disagreement = compared.label_disagreement
        if CENTRAL not in names or metrics.num_components > 1:
            agreements = [(robot.agreement, robot.agreement_occupied) for robot in metrics.robots]
        if metrics.num_components > 1:
            # Maps in different frames are not compared; the run did that within each frame.
            disagreement = metrics.label_disagreement
        counts = [
            _Counts(num_cells, entropy, *pair)
            for num_cells, entropy, pair in zip(
                compared.num_cells.tolist(), compared.entropy_bits.tolist(), agreements, strict=True
            )
        ]
        if CENTRAL in names:
            central = MapComparer(1, self._prior).compare(octrees[-1:], octrees[-1], [], 0)
            counts.append(_Counts(int(central.num_cells[0]), float(central.entropy_bits[0]), 1.0, 1.0))
        return disagreement, counts

    def _agreements_with_other(
        self, other: Result, spans: Sequence[LeafSpans], seconds: float
    ) -> list[tuple[float, float]]:
        """Agreements of each map with the other result's centralised map at that time; NaN before its first one."""
        at_ns = other.time_ns(seconds)
        if at_ns < self._other_start_ns:
            return [(math.nan, math.nan)] * len(spans)
        reference = other.map(CENTRAL, at_ns=at_ns)
        leaves = reference.octree.spans()
        # The agreement counts the cells of the team and of the reference.
        num_cells = Region([*spans, leaves]).num_cells
        return [agreement(own, self._prior, leaves, reference.prior, num_cells) for own in spans]

    def _truth_scores(self, spans: LeafSpans, region: Region) -> TruthScores | None:
        """Scores of one map against the truth, None without a truth."""
        if self._truth is None:
            return None
        return truth_scores(spans, self._prior, self._truth, region, self._is_observed)
