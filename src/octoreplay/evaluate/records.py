"""Records of an evaluation: scores of each map at each stored tick (docs/evaluation.md)."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from octoreplay.data_table import Table
from octoreplay.records import CENTRAL
from octoreplay.run_metrics import PairMetrics, PairTotals


@dataclass(frozen=True)
class TruthScores:
    """Scores of one map against the truth; NaN where a score has no cells to count.

    Attributes
    ----------
    iou : tuple of float
        Intersection over union of each of the C classes, over the cells that the team's evidence covers.
    mean_iou : float
        Mean of ``iou`` over the classes that the truth has in these cells.
    mean_iou_known : float
        The same mean over the cells that this map knows.
    occupied_accuracy, free_accuracy : float
        Share of the truly occupied and of the truly free known cells that the map calls occupied and free.
    coverage : float
        Share of the surface observed by the team in the whole run that the map calls occupied.
    world_coverage : float
        Share of all surface that the map calls occupied.
    calibration_error, calibration_error_occupied : float
        Expected calibration error, over known cells and over those that are occupied in the map or in truth.
    """

    iou: tuple[float, ...]
    mean_iou: float
    mean_iou_known: float
    occupied_accuracy: float
    free_accuracy: float
    coverage: float
    world_coverage: float
    calibration_error: float
    calibration_error_occupied: float


@dataclass(frozen=True)
class MapScores:
    """Scores of one robot's map, or of the centralised one, at one stored tick.

    ``agreement`` and ``agreement_occupied`` are with the reference map (docs/metrics.md), NaN without one. ``truth`` is
    None where the evaluation has no truth.
    """

    robot_id: str
    is_active: bool
    num_cells: int
    entropy_bits: float
    agreement: float
    agreement_occupied: float
    truth: TruthScores | None

    def score(self, name: str) -> float:
        """Return the score called ``name``, one of ``SCORES``; NaN for a score against the truth without a truth."""
        record = self if name in MAP_SCORES else self.truth
        value: float = math.nan if record is None else getattr(record, name)
        return value


MAP_SCORES = ("num_cells", "entropy_bits", "agreement", "agreement_occupied")
"""Scores of a map that need no truth: fields of MapScores."""

SCORES = (*MAP_SCORES, *(item.name for item in dataclasses.fields(TruthScores) if item.name != "iou"))
"""All scores of a map that are one number."""
_TICK_COLUMNS = ("tick", "seconds", "label_disagreement")


@dataclass(frozen=True)
class EvaluatedTick(PairTotals):
    """Scores of all maps at one stored tick.

    ``seconds`` counts from the run's start. ``label_disagreement`` is between the robots, NaN where all maps are empty.
    ``pairs`` compare the robots' evidence, and are empty where the tick's evidence is not stored.
    """

    tick: int
    seconds: float
    label_disagreement: float
    maps: tuple[MapScores, ...]
    pairs: tuple[PairMetrics, ...] = ()

    @property
    def robots(self) -> tuple[MapScores, ...]:
        """Scores of the active robots' maps; of all robots' maps where no robot is active."""
        robots = tuple(scores for scores in self.maps if scores.robot_id != CENTRAL)
        return tuple(scores for scores in robots if scores.is_active) or robots

    @property
    def central(self) -> MapScores | None:
        """Scores of the centralised map, None where the result does not hold it."""
        return next((scores for scores in self.maps if scores.robot_id == CENTRAL), None)

    def mean(self, name: str) -> float:
        """Mean of one score over the robots; NaN where it is NaN for a robot."""
        values = [scores.score(name) for scores in self.robots]
        return sum(values) / len(values) if values else math.nan

    def least(self, name: str) -> float:
        """Smallest value of one score over the robots; NaN where it is NaN for a robot."""
        values = [scores.score(name) for scores in self.robots]
        return float(min(values)) if values and not any(map(math.isnan, values)) else math.nan


@dataclass(frozen=True)
class Evaluation:
    """Scores of a result's maps over time; the last of ``ticks`` is the end. ``class_names`` (C,) without free.

    ``map_kind`` is the form of the maps that was scored: 'posterior' or 'mean'. ``warnings`` are sentences on the
    robots' frames (docs/metrics.md).
    """

    result: str
    truth: str | None
    against: str
    map_kind: str
    class_names: tuple[str, ...]
    ticks: tuple[EvaluatedTick, ...]
    warnings: tuple[str, ...] = ()

    @property
    def final(self) -> EvaluatedTick:
        """Scores at the end of the run."""
        return self.ticks[-1]

    def as_table(self) -> Table:
        """Return the scores of all maps as a table: one row per stored tick and map, 'central' included.

        The columns are tick, seconds, label_disagreement of the team, robot_id, is_active, all scores (NaN without a
        truth), and ``iou.<class>`` for each class.
        """
        rows = [(tick, scores) for tick in self.ticks for scores in tick.maps]
        first = {name: np.array([getattr(tick, name) for tick, _ in rows]) for name in _TICK_COLUMNS}
        maps = Table.from_records(MapScores, [scores for _, scores in rows], first).columns
        against_truth = {
            name: np.array([scores.score(name) for _, scores in rows]) for name in SCORES if name not in MAP_SCORES
        }
        iou = np.array([self.iou(scores) for _, scores in rows]).reshape(len(rows), len(self.class_names))
        classes = {f"iou.{name}": values for name, values in zip(self.class_names, iou.T, strict=True)}
        return Table({**maps, **against_truth, **classes})

    def iou(self, scores: MapScores) -> tuple[float, ...]:
        """Return the intersection over union (C,) of each class in one of the maps; NaN without a truth."""
        return (math.nan,) * len(self.class_names) if scores.truth is None else scores.truth.iou
