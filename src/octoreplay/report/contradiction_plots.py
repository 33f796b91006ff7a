"""Figure of the contradiction of evidence: each pair of robots over time, and all pairs at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.errors import InputError
from octoreplay.mapping.contradiction import CLEAR_LIMIT, LABEL_LIMIT
from octoreplay.report.figures import COLORS, GREY, LINES, MARKERS, FigureStyle, plain, style
from octoreplay.report.log_time import PlottedRun
from octoreplay.run_metrics import TickMetrics, ranked_pairs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_COLORED = 5
"""Number of pairs with a colour and a name of their own; the others are grey."""
_PANELS: Mapping[str, tuple[str, float | None]] = {
    "contradiction": ("occupied / free", None),
    "clear_contradiction": ("clearly", CLEAR_LIMIT),
    "label_contradiction": ("other label", LABEL_LIMIT),
}
"""Shares of the panels with their labels and limits."""
WIDE = 6.0
"""Width in inches from which the matrix is beside the curves, and not below them."""
MAX_NUMBERS = 8
"""Largest team with a number in each square of the matrix."""


def contradiction_figure(runs: Sequence[PlottedRun], look: FigureStyle) -> tuple[Figure, list[Axes]]:
    """Return the figure and its axes over log time: the shares of the pairs, and a matrix of the pairs of a single run.

    Only pairs with enough cells in a tick have a value there. Of one run the pairs with the largest clear contradiction
    at the end have colours, and the matrix shows the contradiction at the end; row i and column j is the share of the
    cells that robot i calls occupied and robot j calls free. Of several runs each has one curve, its largest share of a
    pair.
    Raises InputError for a run in which no two robots share known space.
    """
    for run in runs:
        if not any(tick.pairs for tick in run.metrics):
            raise InputError(
                f"{run.source}: no two robots share known cells, or the result was written before they were compared"
            )
    if len(runs) > 1:
        return _of_runs(runs, look)
    [run] = runs
    is_wide = look.width >= WIDE
    figure = look.figure((6.0 if is_wide else 11.0) * look.row_height / 1.8)
    figure.set_figwidth(look.width * (11.0 / 7.0 if is_wide and not look.is_print else 1.0))
    panels: Any = (
        figure.subfigures(1, 2, width_ratios=[3, 2]) if is_wide else figure.subfigures(2, 1, height_ratios=[3, 2])
    )
    left, right = panels
    axes = left.subplots(len(_PANELS), 1, sharex=True).tolist()
    curves = {name: _curves(run.metrics, name) for name in _PANELS}
    # The warning uses the clear contradiction, so its pairs are named.
    clear = curves["clear_contradiction"]
    worst = sorted(clear, key=lambda pair: -_last(clear[pair]))[:MAX_COLORED]
    for panel, name in zip(axes, _PANELS, strict=True):
        _draw(panel, run.times, curves[name], worst)
    _finish_panels(axes, look)
    handles = {
        label: handle for panel in axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    left.legend(handles.values(), handles.keys(), frameon=False, fontsize="small", loc="outside lower center", ncols=2)
    _draw_matrix(right, run.metrics[-1])
    return figure, axes


def _of_runs(runs: Sequence[PlottedRun], look: FigureStyle) -> tuple[Figure, list[Axes]]:
    """Figure of the largest share of a pair in each of several runs."""
    figure = look.figure(look.row_height * 4)
    axes = figure.subplots(len(_PANELS), 1, sharex=True).tolist()
    for index, run in enumerate(runs):
        step = max(len(run.times) // 8, 1)
        for panel, name in zip(axes, _PANELS, strict=True):
            values = [100 * getattr(tick, name) for tick in run.metrics]
            panel.plot(
                run.times, values, color=COLORS[index % len(COLORS)], linestyle=LINES[index % len(LINES)],
                marker=MARKERS[index % len(MARKERS)], markevery=(index * step // len(MARKERS), step),
                label=run.label if panel is axes[0] else None,
            )  # fmt: skip
    _finish_panels(axes, look)
    return figure, axes


def _finish_panels(axes: Sequence[Axes], look: FigureStyle) -> None:
    """Label the panels and draw the limits of the warnings."""
    for panel, (y_label, limit) in zip(axes, _PANELS.values(), strict=True):
        style(panel, y_label=y_label)
        panel.set_ylim(bottom=0)
        if limit is not None:
            # The limit may lie above all values.
            top = panel.get_ylim()[1]
            panel.axhline(100 * limit, color="#222222", linewidth=0.8, linestyle="--")
            panel.set_ylim(0, top)
            panel.set_title(f"warning above {100 * limit:g} % (dashed)", loc="right", fontsize="small")
    if not look.is_print:
        axes[0].set_title("Contradiction of evidence, share of the cells [%]", loc="left", fontsize="medium")
    axes[-1].set_xlabel("log time [s]")


def _curves(metrics: Sequence[TickMetrics], name: str) -> dict[tuple[str, str], Any]:
    """Value of a share for each pair in each tick [%], NaN where it does not count."""
    curves: dict[tuple[str, str], Any] = {}
    for index, tick in enumerate(metrics):
        for pair in ranked_pairs(tick.pairs, name):
            curve = curves.setdefault((pair.first, pair.second), np.full(len(metrics), np.nan))
            curve[index] = 100 * getattr(pair, name)
    return curves


def _last(curve: Any) -> float:
    """Last value of a curve that has at least one."""
    return float(curve[np.isfinite(curve)][-1])


def _draw(axes: Axes, times: Any, curves: dict[tuple[str, str], Any], worst: Sequence[tuple[str, str]]) -> None:
    """Draw the curves of all pairs, the worst ones in colour and on top."""
    others = [curve for pair, curve in curves.items() if pair not in worst]
    for index, curve in enumerate(others):
        axes.plot(times, curve, color=GREY, linewidth=0.7, alpha=0.6, label=None if index else "other pairs")
    for pair, color, line in reversed(list(zip(worst, COLORS, LINES, strict=False))):
        if pair in curves:
            axes.plot(times, curves[pair], color=color, linestyle=line, label=f"{pair[0]}, {pair[1]}")


def _draw_matrix(figure: Any, last: TickMetrics) -> None:
    """Draw the contradiction of every pair at the end, in both directions; grey where a pair does not count."""
    ids = [robot.robot_id for robot in last.robots]
    shares = np.full((len(ids), len(ids)), np.nan)
    for pair in ranked_pairs(last.pairs, "contradiction"):
        i, j = ids.index(pair.first), ids.index(pair.second)
        shares[i, j], shares[j, i] = 100 * pair.contradiction_of_first, 100 * pair.contradiction_of_second
    axes = figure.subplots()
    axes.set_title("At the end: row occupied, column free", loc="left", fontsize="small")
    axes.set_facecolor("#e5e5e5")
    image = axes.imshow(shares, cmap="magma_r", vmin=0, vmax=100)
    small = {"fontsize": "small" if len(ids) <= MAX_NUMBERS else "x-small"}
    names = [plain(robot_id) for robot_id in ids]
    axes.set_xticks(range(len(ids)), names, rotation=90, **small)
    axes.set_yticks(range(len(ids)), names, **small)
    if len(ids) <= MAX_NUMBERS:
        for i, j in np.argwhere(np.isfinite(shares)).tolist():
            color = "white" if shares[i, j] > 50 else "black"
            axes.text(j, i, f"{shares[i, j]:.0f}", ha="center", va="center", color=color, fontsize="small")
    figure.colorbar(image, ax=axes, shrink=0.7, label="contradiction [%]")
