"""Tables of evaluations for the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from octoreplay.evaluate.records import EvaluatedTick, Evaluation, MapScores
from octoreplay.records import CENTRAL
from octoreplay.report.evaluation_files import OVER_ROBOTS
from octoreplay.report.tables import number, share, styled_table

MAX_ROBOT_COLUMNS = 6
"""A table of classes has a column for each robot of a team of at most so many."""

MAX_TIMES = 12
"""A table over time has at most so many rows."""

_TRUTH_COLUMNS = {
    "mean IoU": "mean_iou", "of known": "mean_iou_known", "occupied\nfound": "occupied_accuracy",
    "free\nfound": "free_accuracy", "coverage": "coverage", "of the\nworld": "world_coverage",
}  # fmt: skip
_CALIBRATION_COLUMNS = {
    "ECE of h\nall": "calibration_error", "\noccupied": "calibration_error_occupied",
    "of N h\nall": "team_calibration_error", " \noccupied": "team_calibration_error_occupied",
}  # fmt: skip


def evaluation_tables(evaluation: Evaluation) -> RenderableType:
    """An evaluation as tables: the maps at the end, its classes, and how it came about."""
    final = evaluation.final
    # Titles stand above the tables: within one they would be folded to its width.
    parts: list[RenderableType] = [
        _title(f"Maps {final.seconds:.1f} s after the start, agreement with {_reference(evaluation)}"),
        _maps_table(final),
        f"cells whose label differs between robots: {share(final.label_disagreement)}",
    ]
    if evaluation.truth is not None:
        parts += ["", _title(f"Against {evaluation.truth}"), _truth_table(final)]
        parts += ["h: the map itself; N h: h_0 + N (h - h_0), the team's posterior (docs/evaluation.md)"]
        parts += ["", _title("IoU of the classes"), _classes_table(evaluation.class_names, final)]
    if len(evaluation.ticks) > 1:
        parts += ["", _title("Over time, mean over the robots"), _times_table(evaluation)]
    return Group(*parts)


def _title(text: str) -> Text:
    """A line above a table."""
    return Text(text, style="bold")


def _maps_table(final: EvaluatedTick) -> Table:
    """One row for each map at the end: what can be said without the truth."""
    table = styled_table("")
    table.add_column("map", no_wrap=True)
    for heading in ("known cells", "entropy", "agreement\nall cells", "\noccupied"):
        table.add_column(heading, justify="right", no_wrap=True)

    def add(name: str, value: Callable[[str], float]) -> None:
        table.add_row(
            name, number(value("num_cells")), f"{value('entropy_bits'):.3f} bit", share(value("agreement")),
            share(value("agreement_occupied")),
        )  # fmt: skip

    _add_maps(final, add)
    return table


def _truth_table(final: EvaluatedTick) -> Table:
    """One row for each map at the end: its scores against the truth."""
    table = styled_table("")
    columns = {**_TRUTH_COLUMNS, **_CALIBRATION_COLUMNS}
    table.add_column("map", no_wrap=True)
    for heading in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    _add_maps(final, lambda name, value: table.add_row(name, *(_ratio(value(f)) for f in columns.values())))
    return table


def _classes_table(class_names: Sequence[str], final: EvaluatedTick) -> Table:
    """One row for each class: the IoU in each map, or in the mean, least and largest where the team is large."""
    table = styled_table("")
    table.add_column("class", no_wrap=True)
    robots = final.robots
    is_large = len(robots) > MAX_ROBOT_COLUMNS
    columns: dict[str, Sequence[float]] = {} if is_large else {scores.robot_id: scores.iou for scores in robots}
    for kind, over_robots in OVER_ROBOTS.items():
        if kind == "mean" or is_large:
            columns[kind] = [over_robots(values) for values in zip(*(scores.iou for scores in robots), strict=True)]
    if final.central is not None:
        columns[CENTRAL] = final.central.iou
    for heading in columns:
        table.add_column(heading, justify="right", overflow="fold")
    for name, *values in zip(class_names, *columns.values(), strict=True):
        table.add_row(name, *map(_ratio, values))
    return table


def _times_table(evaluation: Evaluation) -> Table:
    """One row for each of some stored ticks: means over the robots, and the centralised map."""
    table = styled_table("")
    columns = {"agreement\nall cells": "agreement", "\noccupied": "agreement_occupied"}
    if evaluation.truth is not None:
        columns |= {"mean IoU": "mean_iou", "coverage": "coverage", "ECE of h": "calibration_error",
                    "of N h": "team_calibration_error"}  # fmt: skip
    for heading in ("time", "different\nlabels", *columns):
        table.add_column(heading, justify="right", no_wrap=True)
    if evaluation.truth is not None:
        table.add_column("central:\nmean IoU", justify="right", no_wrap=True)
    for tick in _chosen(evaluation.ticks):
        shares = (tick.label_disagreement, tick.mean("agreement"), tick.mean("agreement_occupied"))
        ratios = [tick.mean(name) for name in list(columns.values())[2:]]
        if evaluation.truth is not None:
            ratios.append(math.nan if tick.central is None else tick.central.mean_iou)
        table.add_row(f"{tick.seconds:.1f} s", *map(share, shares), *map(_ratio, ratios))
    return table


def _chosen(ticks: Sequence[EvaluatedTick]) -> list[EvaluatedTick]:
    """At most MAX_TIMES ticks, evenly over the run, the last one among them."""
    count = min(MAX_TIMES, len(ticks))
    return [ticks[-1 - (len(ticks) - 1) * index // max(count - 1, 1)] for index in reversed(range(count))]


def _add_maps(final: EvaluatedTick, add: Callable[[str, Callable[[str], float]], object]) -> None:
    """One row for each robot's map, for their mean and for the centralised map."""

    def of(scores: MapScores) -> Callable[[str], float]:
        return lambda name: float(getattr(scores, name))

    for scores in final.maps:
        if scores.robot_id != CENTRAL:
            add(scores.robot_id + ("" if scores.is_active else " (off)"), of(scores))
    add("mean", final.mean)
    if final.central is not None:
        add(CENTRAL, of(final.central))


def _reference(evaluation: Evaluation) -> str:
    """What agreement is with."""
    own = evaluation.against == CENTRAL
    return "the centralised map" if own else f"the centralised map of {evaluation.against}"


def _ratio(value: float) -> str:
    """A share 0..1 with three digits."""
    return f"{value:.3f}" if math.isfinite(value) else "-"
