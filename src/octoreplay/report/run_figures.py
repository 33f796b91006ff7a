"""Figures of one run or of several: each is defined here once, for the command line, folders of figures and Python.

Curves of several robots are drawn as in the paper: mean solid, standard deviation as a band. Several runs differ in
colour, line style and markers, so that they can be told apart in grey.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from octoreplay.errors import InputError
from octoreplay.report.contradiction_plots import contradiction_figure
from octoreplay.report.figures import (
    BLUE,
    COLORS,
    GREEN,
    GREY,
    LINES,
    MARKERS,
    ORANGE,
    SCREEN,
    FigureStyle,
    label_in_bytes,
    legend_below,
    mark_isolated,
    over_log_time,
)
from octoreplay.report.link_figures import links_figure
from octoreplay.report.log_time import PlottedRun, has_published, mark_settling, over_robots
from octoreplay.report.zoom import finite, zoom_rests, zoom_shares, zoom_values
from octoreplay.run_metrics import RobotMetrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NARROW = 0.02
"""Relative standard deviation below which a band is too narrow to be seen, and the legend gives its width."""
_ROUNDING = 1e-6
"""Relative standard deviation up to which values are equal but for rounding."""
_DECADES_BELOW = 100.0
"""Factor from the values during the logs to the lower end of the axis of Phi."""


class _Look(NamedTuple):
    """Colour, line style and marker of a curve."""

    color: str
    line: Any
    marker: str | None = None


def run_figure(what: str, runs: Sequence[PlottedRun], look: FigureStyle = SCREEN) -> Figure:
    """Return a figure over log time of runs with different labels; ``what`` is a key of ``FIGURES``.

    Raises InputError for a run without a tick, or without what the figure shows.
    """
    for run in runs:
        if not run.metrics:
            raise InputError(f"{run.source}: has no tick to draw, since the run was interrupted before its first one")
    with look.applied():
        return FIGURES[what](runs, look)


def _phi_figure(runs: Sequence[PlottedRun], look: FigureStyle) -> Figure:
    """Phi over time: of one run over the links and all pairs, of several runs over all pairs."""
    is_single = len(runs) == 1
    title = "Disagreement of the team" if is_single else "Disagreement of the team, all pairs of robots"
    figure, [axes] = over_log_time(title, ["\u03a6"], look)
    drawn = []
    for index, run in enumerate(runs):
        of_links, of_pairs = _values(run, "total_distance"), _values(run, "total_distance_all")
        if is_single:
            published = _values(run, "total_distance_published")
            drawn.append((run, published, "\u03a6 over the links, before the iterations", _Look(GREY, ":")))
            drawn.append((run, of_links, "\u03a6 over the links", _Look(BLUE, "-")))
        # On a complete graph the two curves are equal except for rounding.
        if not is_single or not np.allclose(of_links, of_pairs, rtol=1e-3):
            name, shown = ("\u03a6 over all pairs", _Look(ORANGE, "--")) if is_single else (run.label, _run_look(index))
            drawn.append((run, of_pairs, name, shown))
    bottom = _log_scale(axes, [(run, values) for run, values, _, _ in drawn])
    for run, values, label, shown in drawn:
        if values[-1] < bottom:
            label = f"{label} ({values[-1]:.2g} at the end)"
        # Equal maps have no place on a logarithmic axis.
        _draw(axes, run.times, np.where(values > 0, values, np.nan) if bottom else values, label, shown)
    return _finished(figure, [axes], runs, look)


def _log_scale(axes: Axes, curves: Sequence[tuple[PlottedRun, Any]]) -> float:
    """Make the y axis of Phi logarithmic; return its lower end, or 0 for a linear axis where no value is positive.

    The values during the logs set the range, so that the fall of settling, which leaves it, does not compress them.
    """
    positive = [values[(values > 0) & ~run.settling] for run, values in curves]
    numbers = finite(positive if any(part.size for part in positive) else [v[v > 0] for _, v in curves])
    if not numbers.size:
        # Curves at 0 stay visible.
        axes.set_ylim(-0.05, 1.0)
        return 0.0
    largest = float(finite([values for _, values in curves]).max())
    bottom = max(float(np.percentile(numbers, 2)) / _DECADES_BELOW, 1e-9 * largest)
    axes.set_yscale("log")
    axes.set_ylim(bottom, 3 * largest)
    return bottom


def _agreement_figure(runs: Sequence[PlottedRun], look: FigureStyle) -> Figure:
    """Agreement with the centralised map, all and occupied cells, and share of cells with different labels."""
    names = {"agreement": "all cells", "agreement_occupied": "occupied cells"}
    y_labels = [*(f"agreement,\n{text}" for text in names.values()), "different\nlabels"]
    figure, stack = over_log_time("Agreement with the centralised map (mean and deviation over robots)", y_labels, look)
    for axes, name in zip(stack, names, strict=False):
        shown = []
        for index, run in enumerate(runs):
            mean, deviation = over_robots(run.metrics, name, _is_active)
            worst = np.array([
                min((getattr(robot, name) for robot in tick.robots if robot.active), default=np.nan)
                for tick in run.metrics
            ])  # fmt: skip
            curve = _single_look(BLUE) if len(runs) == 1 else _run_look(index)
            upper = np.minimum(mean + deviation, 1.0)
            is_first = axes is stack[0]
            _draw_band(axes, run, mean, (mean - deviation, upper), _name(run, runs, "mean") if is_first else "", curve)
            if len(runs) == 1:
                axes.plot(run.times, worst, "--", color=ORANGE, label="worst robot" if is_first else None)
            shown += [mean, upper, worst if len(runs) == 1 else mean - deviation]
        zoom_shares(axes, shown)
    lower = stack[-1]
    for index, run in enumerate(runs):
        curve = _single_look(GREEN) if len(runs) == 1 else _run_look(index)
        _draw(lower, run.times, _values(run, "label_disagreement"), "", curve)
    zoom_rests(lower, [_values(run, "label_disagreement") for run in runs])
    return _finished(figure, stack, runs, look)


def _coverage_figure(runs: Sequence[PlottedRun], look: FigureStyle) -> Figure:
    """Observed volume of the robots' maps, and their share of the cells that any robot knows."""
    y_labels = ["volume of a\nmap [m\u00b3]", "share of the\nteam's cells"]
    figure, stack = over_log_time("Known space of the robots' maps (mean and deviation over robots)", y_labels, look)
    shares = []
    for index, run in enumerate(runs):
        curve = _single_look(BLUE) if len(runs) == 1 else _run_look(index)
        volume, deviation = over_robots(run.metrics, "observed_volume", _is_any)
        band = (np.maximum(volume - deviation, 0.0), volume + deviation)
        _draw_band(stack[0], run, volume, band, _name(run, runs, "robots' maps"), curve)
        cells, spread = over_robots(run.metrics, "num_cells", _is_any)
        known = np.array([tick.num_known_cells or np.nan for tick in run.metrics])
        mean, spread = cells / known, spread / known
        band = (mean - spread, np.minimum(mean + spread, 1.0))
        _draw_band(stack[1], run, mean, band, "", curve)
        shares += [*band, mean]
    stack[0].set_ylim(bottom=0.0)
    zoom_shares(stack[1], shares)
    return _finished(figure, stack, runs, look)


def _packets_figure(runs: Sequence[PlottedRun], look: FigureStyle) -> Figure:
    """Bytes of a published map: of one run in three forms, of several runs as sent, and the sum that each team sent."""
    if len(runs) > 1:
        return _packets_of_runs(runs, look)
    [run] = runs
    title = "Size of a published map (mean and deviation over robots)"
    figure, [upper, lower] = over_log_time(title, ["bytes", "uniform grid /\noctree"], look)
    means, least = {}, np.inf
    for name, label, curve in (
        ("grid_bytes", "uniform grid", _Look(ORANGE, "--")),
        ("octree_bytes", "octree", _Look(BLUE, "-")),
        ("packet_bytes", "octree, as sent", _Look(GREEN, "-.")),
    ):
        mean, deviation = over_robots(run.metrics, name, has_published)
        _draw_band(upper, run, mean, (np.maximum(mean - deviation, 1), mean + deviation), label, curve)
        least = min([least, *mean[mean > 0]])
        means[name] = mean
    if np.isfinite(least):
        # On a linear axis both octree curves would lie on the x axis.
        upper.set_yscale("log")
        upper.set_ylim(bottom=least / 2)
        label_in_bytes(upper)
    ratio = means["grid_bytes"] / means["octree_bytes"]
    lower.plot(run.times, ratio, color=BLUE)
    zoom_values(lower, [ratio, [0.0]])
    return _finished(figure, [upper, lower], runs, look)


def _packets_of_runs(runs: Sequence[PlottedRun], look: FigureStyle) -> Figure:
    """Bytes of a published map as sent, and all bytes that the team has sent, of several runs."""
    figure, stack = over_log_time("Published maps as sent", ["bytes of a map", "sent by the\nteam, total"], look)
    for index, run in enumerate(runs):
        mean, deviation = over_robots(run.metrics, "packet_bytes", has_published)
        # A map that is not sent has no place on a logarithmic axis.
        mean = np.where(mean > 0, mean, np.nan)
        band = (np.maximum(mean - deviation, 1), mean + deviation)
        _draw_band(stack[0], run, mean, band, run.label, _run_look(index))
        total = np.cumsum([sum(robot.sent_bytes for robot in tick.robots) for tick in run.metrics])
        _draw(stack[1], run.times, np.where(total > 0, total, np.nan), "", _run_look(index))
    for axes in stack:
        if finite(line.get_ydata() for line in axes.get_lines()).size:
            axes.set_yscale("log")
            label_in_bytes(axes)
    return _finished(figure, stack, runs, look)


def _contradiction(runs: Sequence[PlottedRun], look: FigureStyle) -> Figure:
    """Contradiction of evidence: of one run all pairs, of several runs the largest of each."""
    figure, stack = contradiction_figure(runs, look)
    return _finished(figure, stack, runs, look, has_legend=len(runs) > 1)


def _links(runs: Sequence[PlottedRun], look: FigureStyle) -> Figure:
    """Bytes and losses of the links."""
    figure, stack = links_figure(runs, look)
    return _finished(figure, stack, runs, look)


FIGURES: Mapping[str, Callable[[Sequence[PlottedRun], FigureStyle], Figure]] = {
    "phi": _phi_figure,
    "packets": _packets_figure,
    "agreement": _agreement_figure,
    "coverage": _coverage_figure,
    "links": _links,
    "contradiction": _contradiction,
}
"""Figures over log time by name."""


def _is_active(robot: RobotMetrics) -> bool:
    """True for a robot that takes part."""
    return robot.active


def _is_any(_: RobotMetrics) -> bool:
    """True for every robot."""
    return True


def _values(run: PlottedRun, name: str) -> Any:
    """Metric of the team (n,) per tick."""
    return np.array([getattr(tick, name) for tick in run.metrics], np.float64)


def _name(run: PlottedRun, runs: Sequence[PlottedRun], name: str) -> str:
    """Label of a curve: its name in a figure of one run, else the run's label."""
    return name if len(runs) == 1 else run.label


def _single_look(color: str) -> _Look:
    """Look of a curve of the only run."""
    return _Look(color, "-")


def _run_look(index: int) -> _Look:
    """Look of the curves of one of several runs."""
    return _Look(COLORS[index % len(COLORS)], LINES[index % len(LINES)], MARKERS[index % len(MARKERS)])


def _draw(axes: Axes, times: Any, values: Any, label: str, look: _Look) -> None:
    """Draw a curve; its markers are at about eight places and at isolated values."""
    step = max(len(times) // 8, 1)
    offset = MARKERS.index(look.marker) * step // len(MARKERS) if look.marker else 0
    axes.plot(
        times, values, color=look.color, linestyle=look.line, marker=look.marker,
        markevery=(offset, step), label=label or None,
    )  # fmt: skip
    mark_isolated(axes, times, values, color=look.color, marker=look.marker or "o")


def _draw_band(axes: Axes, run: PlottedRun, mean: Any, band: tuple[Any, Any], label: str, look: _Look) -> None:
    """Draw a mean and its band; the label gives the width of a band that is too narrow to be seen."""
    low, high = band
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = finite([(high - low) / 2 / np.abs(mean)])
    if label and shares.size and _ROUNDING < shares.max() < _NARROW:
        label = f"{label} (\u00b1 {100 * shares.max():.1g} % at most)"
    _draw(axes, run.times, mean, label, look)
    axes.fill_between(run.times, low, high, color=look.color, alpha=0.25, linewidth=0.4)


def _finished(
    figure: Figure, stack: Sequence[Axes], runs: Sequence[PlottedRun], look: FigureStyle, *, has_legend: bool = True
) -> Figure:
    """Mark settling, add the legend, and return the figure."""
    mark_settling(stack, runs)
    if has_legend:
        legend_below(figure, columns=look.columns)
    return figure
