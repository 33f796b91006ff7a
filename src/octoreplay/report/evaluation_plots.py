"""Figures of evaluations: agreement, IoU, coverage and calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.evaluate.records import EvaluatedTick, Evaluation
from octoreplay.report.figures import (
    BLUE,
    GREEN,
    ORANGE,
    legend_below,
    new_figure,
    over_log_time,
    plain,
    save_figures,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def write_evaluation_figures(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write the figures of an evaluation into a folder and return their paths. Raises OutputError.

    The files are ``agreement.png``, and with a truth ``iou.png``, ``class_iou.png``, ``coverage.png`` and
    ``calibration.png``. The folder is made if it does not exist.
    """
    figures = {"agreement.png": _agreement_figure(evaluation.ticks)}
    if evaluation.truth is not None:
        figures["iou.png"] = _curves("Mean IoU with the truth", "mean IoU", evaluation.ticks, "mean_iou")
        figures["class_iou.png"] = _classes_figure(evaluation)
        figures["coverage.png"] = _curves(
            "Coverage of the surface observed by the team", "coverage", evaluation.ticks, "coverage"
        )
        figures["calibration.png"] = _calibration_figure(evaluation)
    return save_figures(figures, folder)


def _agreement_figure(ticks: Sequence[EvaluatedTick]) -> Figure:
    """Figure of the agreement with the reference and of the label disagreement."""
    figure, [axes] = over_log_time("Agreement of the robots (mean, least and largest)", ["share of cells"])
    _draw_robots(axes, ticks, "agreement", BLUE, "agreement, all cells")
    _draw_robots(axes, ticks, "agreement_occupied", GREEN, "agreement, occupied")
    axes.plot(
        _times(ticks), [tick.label_disagreement for tick in ticks], color=ORANGE, linewidth=1.6, marker=_marker(ticks),
        label="different labels",
    )  # fmt: skip
    return _finished(figure, axes)


def _curves(title: str, y_label: str, ticks: Sequence[EvaluatedTick], name: str) -> Figure:
    """Figure of one score of the robots and of the centralised map over time."""
    figure, [axes] = over_log_time(title, [y_label])
    _draw_robots(axes, ticks, name, BLUE, "robots: mean, least and largest")
    _draw_central(axes, ticks, name, ORANGE, "centralised map")
    return _finished(figure, axes)


def _calibration_figure(evaluation: Evaluation) -> Figure:
    """Figure of the expected calibration error of the robots' maps and of the centralised map."""
    ticks = evaluation.ticks
    figure, [axes] = over_log_time("Expected calibration error", ["error"])
    _draw_robots(axes, ticks, "calibration_error", BLUE, f"robots' maps, {evaluation.map_kind}")
    _draw_central(axes, ticks, "calibration_error", ORANGE, "centralised map")
    return _finished(figure, axes)


def _classes_figure(evaluation: Evaluation) -> Figure:
    """Figure of the IoU of each class at the end: mean over the robots, and centralised map."""
    figure = new_figure()
    axes = style(figure.add_subplot(), "IoU of the classes at the end", "", "IoU")
    final, places = evaluation.final, np.arange(len(evaluation.class_names))
    axes.bar(places - 0.2, _robots_iou(evaluation).mean(axis=0), 0.4, color=BLUE, label="robots, mean")
    if final.central is not None:
        axes.bar(places + 0.2, evaluation.iou(final.central), 0.4, color=ORANGE, label="centralised map")
    names = [plain(name) for name in evaluation.class_names]
    axes.set_xticks(places, names, rotation=45 if len(places) > 6 else 0, ha="right", fontsize=8)
    return _finished(figure, axes)


def _robots_iou(evaluation: Evaluation) -> Any:
    """IoU (robots, C) at the end."""
    return np.array([evaluation.iou(scores) for scores in evaluation.final.robots])


def _draw_robots(axes: Axes, ticks: Sequence[EvaluatedTick], name: str, color: str, label: str) -> None:
    """Draw the mean of a score over the robots, and a band from the least to the largest."""
    values = [[scores.score(name) for scores in tick.robots] for tick in ticks]
    times = _times(ticks)
    axes.plot(times, [np.mean(row) for row in values], color=color, linewidth=1.6, marker=_marker(ticks), label=label)
    axes.fill_between(
        times, [np.min(row) for row in values], [np.max(row) for row in values], color=color, alpha=0.2, linewidth=0
    )


def _draw_central(axes: Axes, ticks: Sequence[EvaluatedTick], name: str, color: str, label: str) -> None:
    """Draw a score of the centralised map where it exists."""
    if any(tick.central is not None for tick in ticks):
        values = [math.nan if tick.central is None else tick.central.score(name) for tick in ticks]
        axes.plot(_times(ticks), values, "--", color=color, linewidth=1.4, marker=_marker(ticks), label=label)


def _times(ticks: Sequence[EvaluatedTick]) -> list[float]:
    """Times of ticks in seconds since the start."""
    return [tick.seconds for tick in ticks]


def _marker(ticks: Sequence[EvaluatedTick]) -> str | None:
    """Marker for a single point, which a line would not show."""
    return "o" if len(ticks) == 1 else None


def _finished(figure: Figure, axes: Axes) -> Figure:
    """Set the axes of a figure of shares and add its legend; a time axis includes settling."""
    if axes.get_xlabel():
        axes.set_xlabel("time since the start, settling included [s]")
    axes.set_ylim(0.0, 1.0)
    legend_below(figure)
    return figure
