"""Evaluations as CSV and JSON (docs/evaluation.md)."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from octoreplay.evaluate.records import EvaluatedTick, Evaluation, MapScores
from octoreplay.io.text_files import json_text, write_whole
from octoreplay.records import CENTRAL

SCORES = tuple(item.name for item in dataclasses.fields(MapScores) if item.name not in ("robot_id", "is_active", "iou"))
"""The numbers of MapScores, but for those of single classes."""

OVER_ROBOTS: dict[str, Callable[[Sequence[float]], float]] = {
    "mean": lambda values: sum(values) / len(values),
    "least": lambda values: math.nan if any(map(math.isnan, values)) else min(values),
    "largest": lambda values: math.nan if any(map(math.isnan, values)) else max(values),
}
"""What is said of a score of all robots; NaN where it is NaN for one."""


def evaluation_csv(evaluation: Evaluation) -> str:
    """An evaluation as CSV text: one row for each map and stored tick, and three for the team.

    ``kind`` is ``robot`` or ``central``, or for the team ``mean``, ``least`` or ``largest`` over the robots; the other
    columns are named as the fields of the records, with ``iou.<class>`` for each class. Numbers are exact; what there
    is not is empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    classes = (f"iou.{name}" for name in evaluation.class_names)
    writer.writerow(["tick", "seconds", "label_disagreement", "kind", "robot_id", "is_active", *SCORES, *classes])
    for tick in evaluation.ticks:
        for kind, robot_id, is_active, numbers, iou in _rows(tick):
            cells = (tick.seconds, tick.label_disagreement, kind, robot_id, is_active, *numbers, *iou)
            writer.writerow([tick.tick, *map(_cell, cells)])
    return text.getvalue()


def evaluation_json(evaluation: Evaluation) -> str:
    """An evaluation as JSON: the fields of its records, null where there is no number.

    Each tick has ``mean``, ``least`` and ``largest`` over the robots beside its ``maps``.
    """
    content: dict[str, Any] = dict(vars(evaluation))
    content["ticks"] = [
        {
            **vars(tick),
            **{
                kind: {**dict(zip(SCORES, numbers, strict=True)), "iou": iou} for kind, numbers, iou in _team_rows(tick)
            },
        }
        for tick in evaluation.ticks
    ]
    return json_text(content)


def write_evaluation(evaluation: Evaluation, *, csv_path: Path | None = None, json_path: Path | None = None) -> None:
    """Write ``evaluation_csv`` and ``evaluation_json`` where paths are given. Raises OutputError."""
    if csv_path is not None:
        write_whole(csv_path, evaluation_csv(evaluation))
    if json_path is not None:
        write_whole(json_path, evaluation_json(evaluation))


def _rows(tick: EvaluatedTick) -> Iterator[tuple[str, str, int | None, Sequence[float], Sequence[float]]]:
    """Kind, robot_id, whether it is active, numbers and IoUs of each map, then of the team."""
    for scores in tick.maps:
        kind = CENTRAL if scores.robot_id == CENTRAL else "robot"
        yield kind, scores.robot_id, int(scores.is_active), _numbers(scores), scores.iou
    for kind, numbers, iou in _team_rows(tick):
        yield kind, "", None, numbers, iou


def _team_rows(tick: EvaluatedTick) -> Iterator[tuple[str, list[float], list[float]]]:
    """Kind, numbers and IoUs over the robots."""
    numbers = list(zip(*map(_numbers, tick.robots), strict=True))
    iou = list(zip(*(scores.iou for scores in tick.robots), strict=True))
    for kind, over_robots in OVER_ROBOTS.items():
        yield kind, list(map(over_robots, numbers)), list(map(over_robots, iou))


def _numbers(scores: MapScores) -> tuple[float, ...]:
    """The values of SCORES."""
    return tuple(getattr(scores, name) for name in SCORES)


def _cell(value: Any) -> str:
    """A value as text; empty where there is none."""
    return "" if value is None or value != value else str(value)
