"""Figures of evaluations: how good the maps are, in which classes, how sure, and how equal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.evaluate.records import EvaluatedTick, Evaluation
from octoreplay.report.figures import BLUE, GREEN, ORANGE, legend_below, new_figure, over_log_time, save_figures, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def write_evaluation_figures(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write ``agreement.png``, and with a truth ``iou.png``, ``class_iou.png``, ``coverage.png``, ``calibration.png``.

    Into a folder, made if need be; the files written. Raises OutputError.
    """
    figures = {"agreement.png": _agreement_figure(evaluation.ticks)}
    if evaluation.truth is not None:
        figures["iou.png"] = _curves("Mean IoU with the truth", "mean IoU", evaluation.ticks, "mean_iou")
        figures["class_iou.png"] = _classes_figure(evaluation)
        figures["coverage.png"] = _curves(
            "Coverage of the surface that the team observed", "coverage", evaluation.ticks, "coverage"
        )
        figures["calibration.png"] = _calibration_figure(evaluation.ticks)
    return save_figures(figures, folder)


def _agreement_figure(ticks: Sequence[EvaluatedTick]) -> Figure:
    """Agreement of the robots with the reference, and cells with different labels."""
    figure, [axes] = over_log_time("Agreement of the robots (mean, least and largest)", ["share of cells"])
    _draw_robots(axes, ticks, "agreement", BLUE, "agreement, all cells")
    _draw_robots(axes, ticks, "agreement_occupied", GREEN, "agreement, occupied")
    axes.plot(
        _times(ticks), [tick.label_disagreement for tick in ticks], color=ORANGE, linewidth=1.6, marker=_marker(ticks),
        label="different labels",
    )  # fmt: skip
    return _finished(figure, axes)


def _curves(title: str, y_label: str, ticks: Sequence[EvaluatedTick], name: str) -> Figure:
    """One score of the robots and of the centralised map over time."""
    figure, [axes] = over_log_time(title, [y_label])
    _draw_robots(axes, ticks, name, BLUE, "robots: mean, least and largest")
    _draw_central(axes, ticks, name, ORANGE, "centralised map")
    return _finished(figure, axes)


def _calibration_figure(ticks: Sequence[EvaluatedTick]) -> Figure:
    """The expected calibration error of h, of N h and of the centralised map."""
    figure, [axes] = over_log_time("Expected calibration error", ["error"])
    _draw_robots(axes, ticks, "calibration_error", BLUE, "robots' maps, h")
    _draw_robots(axes, ticks, "team_calibration_error", GREEN, "the team's posterior, N h")
    _draw_central(axes, ticks, "calibration_error", ORANGE, "centralised map")
    return _finished(figure, axes)


def _classes_figure(evaluation: Evaluation) -> Figure:
    """The IoU of each class at the end: the mean over the robots, and the centralised map."""
    figure = new_figure()
    axes = style(figure.add_subplot(), "IoU of the classes at the end", "", "IoU")
    final, places = evaluation.final, np.arange(len(evaluation.class_names))
    axes.bar(places - 0.2, _robots_iou(final).mean(axis=0), 0.4, color=BLUE, label="robots, mean")
    if final.central is not None:
        axes.bar(places + 0.2, final.central.iou, 0.4, color=ORANGE, label="centralised map")
    axes.set_xticks(places, evaluation.class_names, rotation=45 if len(places) > 6 else 0, ha="right", fontsize=8)
    return _finished(figure, axes)


def _robots_iou(tick: EvaluatedTick) -> Any:
    """IoUs (robots, C)."""
    return np.array([scores.iou for scores in tick.robots])


def _draw_robots(axes: Axes, ticks: Sequence[EvaluatedTick], name: str, color: str, label: str) -> None:
    """The mean of a score over the robots, in a band from the least to the largest."""
    values = [[getattr(scores, name) for scores in tick.robots] for tick in ticks]
    times = _times(ticks)
    axes.plot(times, [np.mean(row) for row in values], color=color, linewidth=1.6, marker=_marker(ticks), label=label)
    axes.fill_between(
        times, [np.min(row) for row in values], [np.max(row) for row in values], color=color, alpha=0.2, linewidth=0
    )


def _draw_central(axes: Axes, ticks: Sequence[EvaluatedTick], name: str, color: str, label: str) -> None:
    """A score of the centralised map, where there is one."""
    if any(tick.central is not None for tick in ticks):
        values = [math.nan if tick.central is None else getattr(tick.central, name) for tick in ticks]
        axes.plot(_times(ticks), values, "--", color=color, linewidth=1.4, marker=_marker(ticks), label=label)


def _times(ticks: Sequence[EvaluatedTick]) -> list[float]:
    """Seconds since the start."""
    return [tick.seconds for tick in ticks]


def _marker(ticks: Sequence[EvaluatedTick]) -> str | None:
    """A single point needs a mark to be seen."""
    return "o" if len(ticks) == 1 else None


def _finished(figure: Figure, axes: Axes) -> Figure:
    """A figure of shares with its legend; what is over time goes on while the team settles."""
    if axes.get_xlabel():
        axes.set_xlabel("time since the start, settling included [s]")
    axes.set_ylim(0.0, 1.0)
    legend_below(figure)
    return figure
