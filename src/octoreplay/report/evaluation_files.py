"""Evaluations as CSV files, and for JSON (docs/evaluation.md)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from octoreplay.evaluate.records import MAP_SCORES, SCORES, EvaluatedTick, Evaluation, MapScores
from octoreplay.io.output_file import write_whole
from octoreplay.records import CENTRAL
from octoreplay.run_metrics import PAIR_SHARES

_TICK_COLUMNS = ("label_disagreement", *PAIR_SHARES)
"""Scores of the team in every row of the CSV."""

OVER_ROBOTS: dict[str, Callable[[Sequence[float]], float]] = {
    "mean": lambda values: sum(values) / len(values),
    "least": lambda values: math.nan if any(map(math.isnan, values)) else min(values),
    "largest": lambda values: math.nan if any(map(math.isnan, values)) else max(values),
}
"""Statistics of a score over the robots; NaN where the score is NaN for one of them."""


def evaluation_csv(evaluation: Evaluation) -> str:
    """Return an evaluation as CSV text: at each stored tick one row per map and three for the team.

    ``kind`` is ``robot`` or ``central``, or ``mean``, ``least`` or ``largest`` over the robots for the team.
    ``map_kind`` is the form of the maps that was scored. The other columns have the names of the records' fields, with
    ``iou.<class>`` for each class. Numbers have full precision; missing values are empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    classes = (f"iou.{name}" for name in evaluation.class_names)
    writer.writerow(["tick", "seconds", *_TICK_COLUMNS, "kind", "robot_id", "is_active", "map_kind", *SCORES, *classes])
    for tick in evaluation.ticks:
        for kind, robot_id, is_active, numbers, iou in _rows(evaluation, tick):
            cells = (
                tick.seconds,
                *(getattr(tick, name) for name in _TICK_COLUMNS),
                kind,
                robot_id,
                is_active,
                evaluation.map_kind,
                *numbers,
                *iou,
            )
            writer.writerow([tick.tick, *map(_cell, cells)])
    return text.getvalue()


def evaluation_content(evaluation: Evaluation) -> dict[str, Any]:
    """Return an evaluation for JSON: the fields of its records.

    Each tick has ``mean``, ``least`` and ``largest`` over the robots beside its ``maps``.
    """
    ticks = [
        {
            **vars(tick),
            **{name: getattr(tick, name) for name in PAIR_SHARES},
            "maps": [_map_fields(evaluation, scores) for scores in tick.maps],
            **{
                kind: {**dict(zip(SCORES, numbers, strict=True)), "iou": iou}
                for kind, numbers, iou in _team_rows(evaluation, tick)
            },
        }
        for tick in evaluation.ticks
    ]
    return {**vars(evaluation), "ticks": ticks}


def write_evaluation(evaluation: Evaluation, path: Path) -> None:
    """Write ``evaluation_csv`` to a file. Raises OutputError."""
    write_whole(path, evaluation_csv(evaluation))


def _map_fields(evaluation: Evaluation, scores: MapScores) -> dict[str, Any]:
    """Fields of one map's scores in JSON, those against the truth beside the others."""
    without_truth = {name: getattr(scores, name) for name in ("robot_id", "is_active", *MAP_SCORES)}
    numbers = {name: scores.score(name) for name in SCORES if name not in MAP_SCORES}
    return {**without_truth, "iou": evaluation.iou(scores), **numbers}


def _rows(
    evaluation: Evaluation, tick: EvaluatedTick
) -> Iterator[tuple[str, str, int | None, Sequence[float], Sequence[float]]]:
    """Yield kind, robot_id, activity, numbers and IoUs of each map and then of the team."""
    for scores in tick.maps:
        kind = CENTRAL if scores.robot_id == CENTRAL else "robot"
        yield kind, scores.robot_id, int(scores.is_active), _numbers(scores), evaluation.iou(scores)
    for kind, numbers, iou in _team_rows(evaluation, tick):
        yield kind, "", None, numbers, iou


def _team_rows(evaluation: Evaluation, tick: EvaluatedTick) -> Iterator[tuple[str, list[float], list[float]]]:
    """Yield kind, numbers and IoUs over the robots."""
    numbers = list(zip(*map(_numbers, tick.robots), strict=True))
    iou = list(zip(*map(evaluation.iou, tick.robots), strict=True))
    for kind, over_robots in OVER_ROBOTS.items():
        yield kind, list(map(over_robots, numbers)), list(map(over_robots, iou))


def _numbers(scores: MapScores) -> tuple[float, ...]:
    """Values of SCORES."""
    return tuple(map(scores.score, SCORES))


def _cell(value: Any) -> str:
    """Value as text, empty for None and NaN."""
    return "" if value is None or value != value else str(value)
