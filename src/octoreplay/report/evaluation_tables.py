"""Tables of evaluations for the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from octoreplay.evaluate.records import EvaluatedTick, Evaluation
from octoreplay.mapping.contradiction import contradicting_pairs
from octoreplay.records import CENTRAL, MEAN, POSTERIOR
from octoreplay.report.evaluation_files import OVER_ROBOTS
from octoreplay.report.tables import (
    are_equal,
    caption_equal,
    number,
    pairs_table,
    share,
    size,
    styled_table,
    worst_pair,
)

_KINDS = {POSTERIOR: "posterior of the team", MEAN: "mean of the team"}
"""Phrase for each form of the maps."""

MAX_ROBOT_COLUMNS = 6
"""Largest team with one column per robot in the table of classes."""

MAX_TIMES = 12
"""Largest number of rows of a table over time."""

_TRUTH_COLUMNS = {
    "mean IoU": "mean_iou", "of known": "mean_iou_known", "occupied\nfound": "occupied_accuracy",
    "free\nfound": "free_accuracy", "coverage": "coverage", "of the\nworld": "world_coverage",
}  # fmt: skip
_CALIBRATION_COLUMNS = {
    "ECE\nall": "calibration_error", "\noccupied": "calibration_error_occupied",
}  # fmt: skip


def evaluation_tables(evaluation: Evaluation, *, is_verbose: bool = False) -> RenderableType:
    """Return an evaluation as tables: the maps at the end, the classes, and the scores over time.

    Robots with equal scores, at the precision shown, are one row or column unless ``is_verbose``.
    """
    final = evaluation.final
    # Titles are lines of their own, since a table folds its title to its width.
    parts: list[RenderableType] = [
        _title(
            f"Maps {final.seconds:.1f} s after the start ({_KINDS[evaluation.map_kind]}), agreement with"
            f" {_reference(evaluation)}"
        ),
        _maps_table(final, is_verbose=is_verbose),
        f"cells with different labels: {share(final.label_disagreement)}, without the run's tolerance for flows",
        f"contradiction of evidence, worst pair: {worst_pair(final.pairs, 'contradiction')}",
        f"clear contradiction: {worst_pair(final.pairs, 'clear_contradiction')}",
        f"label contradiction: {worst_pair(final.pairs, 'label_contradiction')}",
    ]
    if contradicting_pairs(final.pairs):
        parts += ["", pairs_table(final.pairs)]
    if evaluation.truth is not None:
        parts += ["", _title(f"Against {evaluation.truth}"), _truth_table(final, is_verbose=is_verbose)]
        parts += ["", _title("IoU of the classes"), _classes_table(evaluation, is_verbose=is_verbose)]
    if len(evaluation.ticks) > 1:
        parts += ["", _title("Over time, mean over the robots"), _times_table(evaluation)]
    return Group(*parts)


def rules_table(rows: Mapping[str, tuple[EvaluatedTick, float]]) -> Table:
    """Return a table of the last maps of several rules on the same logs, and what their exchange costs.

    ``rows`` are the scores at the end, and the bytes that a robot sent in a second while the logs lasted, by the rule's
    title.
    Scores are means over the robots.
    """
    table = styled_table("Rules on the same logs, mean over the robots")
    table.add_column("rule")
    for heading in (
        "sent, each\nrobot",
        "agreement with\nall evidence",
        "\noccupied",
        "surface\nfound",
        "mean IoU\nof all",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for title, (final, rate) in rows.items():
        table.add_row(
            title, f"{size(rate)}/s", share(final.mean("agreement")), share(final.mean("agreement_occupied")),
            share(final.mean("coverage")), _ratio(final.mean("mean_iou")),
        )  # fmt: skip
        central = final.central
    if rows and central is not None:
        table.add_row(
            "all evidence in one map", "-", share(1.0), share(1.0), share(central.score("coverage")),
            _ratio(central.score("mean_iou")),
        )  # fmt: skip
    return table


def _title(text: str) -> Text:
    """Title of a table, as a line above it."""
    return Text(text, style="bold")


def _maps_table(final: EvaluatedTick, *, is_verbose: bool) -> Table:
    """Table of the maps at the end: scores that need no truth."""
    table = styled_table("")
    table.add_column("map", no_wrap=True)
    for heading in ("known cells", "entropy", "agreement\nall cells", "\noccupied"):
        table.add_column(heading, justify="right", no_wrap=True)

    def row(value: Callable[[str], float]) -> list[str]:
        entropy = f"{value('entropy_bits'):.3f} bit"
        return [number(value("num_cells")), entropy, share(value("agreement")), share(value("agreement_occupied"))]

    _add_maps(table, final, row, is_verbose=is_verbose)
    return table


def _truth_table(final: EvaluatedTick, *, is_verbose: bool) -> Table:
    """Table of the maps at the end: scores against the truth."""
    table = styled_table("")
    columns = {**_TRUTH_COLUMNS, **_CALIBRATION_COLUMNS}
    table.add_column("map", no_wrap=True)
    for heading in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    _add_maps(table, final, lambda value: [_ratio(value(name)) for name in columns.values()], is_verbose=is_verbose)
    return table


def _classes_table(evaluation: Evaluation, *, is_verbose: bool) -> Table:
    """Table of the classes: IoU in each map, or its mean, least and largest over the robots of a large team.

    Robots with equal maps are one column unless ``is_verbose``.
    """
    table = styled_table("")
    table.add_column("class", no_wrap=True)
    final = evaluation.final
    robots = final.robots
    is_large = len(robots) > MAX_ROBOT_COLUMNS
    columns: dict[str, Sequence[float]] = (
        {} if is_large else {scores.robot_id: evaluation.iou(scores) for scores in robots}
    )
    is_one = not is_verbose and are_equal([list(map(_ratio, evaluation.iou(scores))) for scores in robots])
    if is_one:
        columns = {caption_equal(table, len(robots)): evaluation.iou(robots[0])}
    for kind, over_robots in OVER_ROBOTS.items():
        if not is_one and (kind == "mean" or is_large):
            columns[kind] = [over_robots(values) for values in zip(*map(evaluation.iou, robots), strict=True)]
    if final.central is not None:
        columns[CENTRAL] = evaluation.iou(final.central)
    for heading in columns:
        table.add_column(heading, justify="right", overflow="fold")
    for name, *values in zip(evaluation.class_names, *columns.values(), strict=True):
        table.add_row(name, *map(_ratio, values))
    return table


def _times_table(evaluation: Evaluation) -> Table:
    """Table over time: means over the robots, and the centralised map, at some of the stored ticks."""
    table = styled_table("")
    columns = {"agreement\nall cells": "agreement", "\noccupied": "agreement_occupied"}
    if evaluation.truth is not None:
        columns |= {"mean IoU": "mean_iou", "coverage": "coverage", "ECE": "calibration_error"}
    for heading in ("time", "different\nlabels", *columns):
        table.add_column(heading, justify="right", no_wrap=True)
    if evaluation.truth is not None:
        table.add_column("central:\nmean IoU", justify="right", no_wrap=True)
    for tick in _shown_ticks(evaluation.ticks):
        shares = (tick.label_disagreement, tick.mean("agreement"), tick.mean("agreement_occupied"))
        ratios = [tick.mean(name) for name in list(columns.values())[2:]]
        if evaluation.truth is not None:
            ratios.append(math.nan if tick.central is None else tick.central.score("mean_iou"))
        table.add_row(f"{tick.seconds:.1f} s", *map(share, shares), *map(_ratio, ratios))
    return table


def _shown_ticks(ticks: Sequence[EvaluatedTick]) -> list[EvaluatedTick]:
    """At most MAX_TIMES ticks, evenly over the run, including the last one."""
    count = min(MAX_TIMES, len(ticks))
    return [ticks[-1 - (len(ticks) - 1) * index // max(count - 1, 1)] for index in reversed(range(count))]


def _add_maps(
    table: Table, final: EvaluatedTick, row: Callable[[Callable[[str], float]], list[str]], *, is_verbose: bool
) -> None:
    """Add one row for each robot's map, one for their mean and one for the centralised map.

    The rows of robots and mean are one row where they are equal and all robots are active, unless ``is_verbose``.
    """
    robots = [scores for scores in final.maps if scores.robot_id != CENTRAL]
    rows = [row(scores.score) for scores in robots]
    if not is_verbose and are_equal(rows) and all(scores.is_active for scores in robots):
        table.add_row(caption_equal(table, len(rows)), *rows[0])
    else:
        for scores, texts in zip(robots, rows, strict=True):
            table.add_row(scores.robot_id + ("" if scores.is_active else " (off)"), *texts)
        table.add_row("mean", *row(final.mean))
    if final.central is not None:
        table.add_row(CENTRAL, *row(final.central.score))


def _reference(evaluation: Evaluation) -> str:
    """Name of the reference of the agreement."""
    own = evaluation.against == CENTRAL
    return "the centralised map" if own else f"the centralised map of {evaluation.against}"


def _ratio(value: float) -> str:
    """Share 0..1 with three digits, a dash for NaN."""
    return f"{value:.3f}" if math.isfinite(value) else "-"
