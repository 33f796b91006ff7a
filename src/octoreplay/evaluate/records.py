"""What an evaluation says of maps: one record for each map and stored tick (docs/evaluation.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from octoreplay.records import CENTRAL


@dataclass(frozen=True)
class MapScores:
    """One robot's map, or the centralised one, at one stored tick.

    ``agreement`` and ``agreement_occupied`` are with the reference map (docs/metrics.md); NaN where there is none.
    What needs the truth is NaN without it: ``iou`` (C,) of each class over the cells that the team's evidence covers
    (NaN where a class occurs neither in the truth nor in the map) and ``mean_iou``, their mean over the classes that
    the truth has there; ``mean_iou_known``, the same over the cells that this map knows; ``occupied_accuracy`` and
    ``free_accuracy``, the share of truly occupied and of truly free known cells that the map calls so; ``coverage``,
    the share of the surface observed by the team in the whole run that the map calls occupied; ``world_coverage``, the
    same of all surface; ``calibration_error``, the
    expected calibration error over known cells, and over those that are occupied in map or truth, of h; ``team_`` the
    same of h_0 + N (h - h_0).
    """

    robot_id: str
    is_active: bool
    num_cells: int
    entropy_bits: float
    agreement: float
    agreement_occupied: float
    iou: tuple[float, ...]
    mean_iou: float
    mean_iou_known: float
    occupied_accuracy: float
    free_accuracy: float
    coverage: float
    world_coverage: float
    calibration_error: float
    calibration_error_occupied: float
    team_calibration_error: float
    team_calibration_error_occupied: float


@dataclass(frozen=True)
class EvaluatedTick:
    """All maps at one stored tick; ``seconds`` since the run's start, ``label_disagreement`` between the robots, NaN
    where no map holds anything.
    """

    tick: int
    seconds: float
    label_disagreement: float
    maps: tuple[MapScores, ...]

    @property
    def robots(self) -> tuple[MapScores, ...]:
        """The robots' maps, the centralised one left out; only the active robots' where there are any."""
        robots = tuple(scores for scores in self.maps if scores.robot_id != CENTRAL)
        return tuple(scores for scores in robots if scores.is_active) or robots

    @property
    def central(self) -> MapScores | None:
        """The centralised map's scores, where the result holds it."""
        return next((scores for scores in self.maps if scores.robot_id == CENTRAL), None)

    def mean(self, name: str) -> float:
        """The mean over the robots of one of the scores; NaN where it is NaN for a robot."""
        values = [float(getattr(scores, name)) for scores in self.robots]
        return sum(values) / len(values) if values else math.nan

    def least(self, name: str) -> float:
        """The smallest of one of the scores over the robots; NaN where it is NaN for a robot."""
        values = [float(getattr(scores, name)) for scores in self.robots]
        return min(values) if values and not any(map(math.isnan, values)) else math.nan


@dataclass(frozen=True)
class Evaluation:
    """A result's maps over time; the last of ``ticks`` is the end. ``class_names`` (C,) without free."""

    result: str
    truth: str | None
    against: str
    class_names: tuple[str, ...]
    ticks: tuple[EvaluatedTick, ...]

    @property
    def final(self) -> EvaluatedTick:
        """The maps at the end of the run."""
        return self.ticks[-1]
