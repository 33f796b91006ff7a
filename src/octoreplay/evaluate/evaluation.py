"""Evaluation of a stored result's maps against the truth, the centralised map or another result."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from octoreplay.errors import ConfigError, InputError
from octoreplay.evaluate.counts import PartCounter, TickCounts
from octoreplay.evaluate.records import EvaluatedTick, Evaluation, MapScores, TruthScores
from octoreplay.evaluate.truth import WORLD_FILE, Truth, load_truth
from octoreplay.evaluate.truth_frame import truth_frame_warning
from octoreplay.mapping.joined_contradiction import JoinedEvidence
from octoreplay.records import CENTRAL, MAP_KINDS, POSTERIOR, FilePath
from octoreplay.replay.warnings import team_frame_warnings
from octoreplay.result import Result, open_result
from octoreplay.run_metrics import PairMetrics, TickMetrics


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
        counted: dict[int, TickCounts] = {}
        boxes = list(result.boxes(beside=[] if other is None else [other]))
        for number, bounds in enumerate(boxes):
            counter = PartCounter(result, surface, other, map_kind, bounds)
            for maps in result.history(bounds=bounds) if over_time else [counter.last_maps]:
                counts = counter.count(maps)
                earlier = counted.get(counts.tick)
                counted[counts.tick] = counts if earlier is None else earlier.plus(counts)
                if progress is not None:
                    share = min(1.0, (counts.tick + 1) / (result.metrics[-1].tick + 1))
                    progress((number + share) / len(boxes))
        evaluator = _Evaluator(result, surface)
        ticks = [evaluator.evaluate(counts) for counts in counted.values()]
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


class _Evaluator:
    """Scores of the maps of one result from the counts of all their parts, tick by tick.

    ``warnings`` are the sentences on the frames of the last tick with evidence.
    """

    def __init__(self, result: Result, truth: Truth | None) -> None:
        self._result = result
        self._truth = truth
        self._metrics = {metrics.tick: metrics for metrics in result.metrics}
        self.warnings: tuple[str, ...] = ()

    def evaluate(self, counts: TickCounts) -> EvaluatedTick:
        """Return the scores of the maps at one stored tick."""
        metrics = self._metrics.get(counts.tick)
        if metrics is None:
            raise InputError(
                f"{self._result.path}: damaged: tick {counts.tick} has maps but no metrics; replay the logs again"
            )
        seconds = self._result.seconds(metrics.stamp_ns)
        names = (*self._result.robots, *([CENTRAL] if counts.central is not None else []))
        disagreement, scores = self._map_scores(counts, metrics)
        if counts.with_other:
            scores = [_Scores(*score[:2], *pair.shares) for score, pair in zip(scores, counts.with_other, strict=True)]
        elif counts.has_other:
            scores = [_Scores(*score[:2], math.nan, math.nan) for score in scores]
        if not counts.num_region:
            # Empty maps neither agree nor differ.
            disagreement, scores = math.nan, [_Scores(*score[:2], math.nan, math.nan) for score in scores]
        is_active = {robot.robot_id: robot.active for robot in metrics.robots}
        return EvaluatedTick(
            counts.tick,
            seconds,
            disagreement,
            tuple(
                MapScores(
                    robot_id=name,
                    is_active=is_active.get(name, True),
                    **score._asdict(),
                    truth=truth,
                )
                for name, score, truth in zip(names, scores, self._truth_scores(counts, len(names)), strict=True)
            ),
            self._pairs(counts, metrics),
        )

    def _pairs(self, counts: TickCounts, metrics: TickMetrics) -> tuple[PairMetrics, ...]:
        """Contradiction of the evidence stored at a tick, none where it is not stored; keeps the tick's warnings."""
        if not counts.evidence:
            return ()
        robots = self._result.robots
        pairs = JoinedEvidence(robots, self._result.class_table.num_classes).joined(counts.evidence)
        num_cells = {name: n for name, n in zip(robots, counts.num_evidence_cells.tolist(), strict=True) if n}
        # Evidence in different frames is not compared.
        pairs = tuple(pair for pair in pairs if metrics.frame_of(pair.first) == metrics.frame_of(pair.second))
        self.warnings = team_frame_warnings(dataclasses.replace(metrics, pairs=pairs), num_cells)
        return pairs

    def _map_scores(self, counts: TickCounts, metrics: TickMetrics) -> tuple[float, list[_Scores]]:
        """Label disagreement between the robots, and the scores of each map that need no truth."""
        compared = counts.compared
        agreements = list(zip(compared.agreement.tolist(), compared.agreement_occupied.tolist(), strict=True))
        disagreement = compared.label_disagreement
        if counts.central is None or metrics.num_components > 1:
            agreements = [(robot.agreement, robot.agreement_occupied) for robot in metrics.robots]
        if metrics.num_components > 1:
            # Maps in different frames are not compared; the run did that within each frame.
            disagreement = metrics.label_disagreement
        scores = [
            _Scores(num_cells, entropy, *pair)
            for num_cells, entropy, pair in zip(
                compared.num_cells.tolist(), compared.entropy_bits.tolist(), agreements, strict=True
            )
        ]
        if counts.central is not None:
            central = counts.central
            scores.append(_Scores(int(central.num_cells[0]), float(central.entropy_bits[0]), 1.0, 1.0))
        return disagreement, scores

    def _truth_scores(self, counts: TickCounts, num_maps: int) -> Sequence[TruthScores | None]:
        """Scores of each map against the truth, None without a truth."""
        if self._truth is None:
            return [None] * num_maps
        if not counts.truth[0].num_observed:
            raise InputError(
                f"{self._truth.path}: no surface lies in the cells that the maps of {self._result.path} know; give it"
                " in metres, in the team's frame"
            )
        num_surface = int(self._truth.is_class.sum())
        return [of_map.scores(num_surface) for of_map in counts.truth]


class _Scores(NamedTuple):
    """Scores of a map that need no truth: fields of MapScores."""

    num_cells: int
    entropy_bits: float
    agreement: float
    agreement_occupied: float
