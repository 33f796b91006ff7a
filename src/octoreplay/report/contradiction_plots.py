"""Figure of the contradiction of evidence: each pair of robots over time, and all pairs at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.mapping.contradiction import CLEAR_LIMIT, LABEL_LIMIT
from octoreplay.report.figures import COLORS, GREY, new_figure, style
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
MAX_NUMBERS = 8
"""Largest team with a number in each square of the matrix."""


def contradiction_figure(metrics: Sequence[TickMetrics], times: Any) -> Figure:
    """Return the figure: the shares of the pairs over ``times`` (n,) [s], and a matrix of the pairs.

    Only pairs with enough cells in a tick have a value there. The pairs with the largest values at the end have
    colours. The matrix shows the contradiction at the end; row i and column j is the share of the cells that robot i
    calls occupied and robot j calls free.
    """
    figure = new_figure(width=11.0, height=6.0)
    panels: Any = figure.subfigures(1, 2, width_ratios=[3, 2])
    left, right = panels
    axes = left.subplots(len(_PANELS), 1, sharex=True).tolist()
    curves = {name: _curves(metrics, name) for name in _PANELS}
    of_all = curves["contradiction"]
    worst = sorted(of_all, key=lambda pair: -_last(of_all[pair]))[:MAX_COLORED]
    for panel, (name, (y_label, limit)) in zip(axes, _PANELS.items(), strict=True):
        style(panel, y_label=y_label)
        _draw(panel, times, curves[name], worst)
        if limit is not None:
            # The limit may lie above all values.
            top = panel.get_ylim()[1]
            panel.axhline(100 * limit, color="#222222", linewidth=0.8, linestyle="--")
            panel.set_ylim(0, top)
            panel.set_title(f"warning above {100 * limit:g} % (dashed)", loc="right", fontsize=8)
    axes[0].set_title("Contradiction of evidence, share of the cells [%]", loc="left", fontsize=11)
    axes[-1].set_xlabel("log time [s]")
    handles = {
        label: handle for panel in axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    left.legend(handles.values(), handles.keys(), frameon=False, fontsize=8, loc="outside lower center", ncols=2)
    _draw_matrix(right, metrics[-1])
    return figure


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
    for pair, color in reversed(list(zip(worst, COLORS, strict=False))):
        if pair in curves:
            axes.plot(times, curves[pair], color=color, linewidth=1.6, label=f"{pair[0]}, {pair[1]}")
    axes.set_ylim(bottom=0)


def _draw_matrix(figure: Any, last: TickMetrics) -> None:
    """Draw the contradiction of every pair at the end, in both directions; grey where a pair does not count."""
    ids = [robot.robot_id for robot in last.robots]
    shares = np.full((len(ids), len(ids)), np.nan)
    for pair in ranked_pairs(last.pairs, "contradiction"):
        i, j = ids.index(pair.first), ids.index(pair.second)
        shares[i, j], shares[j, i] = 100 * pair.contradiction_of_first, 100 * pair.contradiction_of_second
    axes = figure.subplots()
    axes.set_title("At the end: row occupied, column free", loc="left", fontsize=9)
    axes.set_facecolor("#e5e5e5")
    image = axes.imshow(shares, cmap="magma_r", vmin=0, vmax=100)
    small = {"fontsize": 8 if len(ids) <= MAX_NUMBERS else 6}
    axes.set_xticks(range(len(ids)), ids, rotation=90, **small)
    axes.set_yticks(range(len(ids)), ids, **small)
    if len(ids) <= MAX_NUMBERS:
        for i, j in np.argwhere(np.isfinite(shares)).tolist():
            color = "white" if shares[i, j] > 50 else "black"
            axes.text(j, i, f"{shares[i, j]:.0f}", ha="center", va="center", color=color, fontsize=8)
    figure.colorbar(image, ax=axes, shrink=0.7, label="contradiction [%]")
