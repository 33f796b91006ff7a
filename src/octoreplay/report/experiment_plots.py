"""Figures of experiments: dots with intervals, curves with bands, contrasts, and squares (docs/experiments.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.report.comparisons import Comparison, Label, Measure, Row, Tables, mean_over_teams
from octoreplay.report.figures import COLORS, MARKERS, label_plainly, legend_below, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Theory = Callable[[str], tuple[Float64Array, Float64Array]]
"""Function that gives x (n,) and y (n,) of a theoretical curve by the label of a curve."""

_SPREAD = 0.7
"""Share of the distance of two labels over which the markers of one label are spread."""

_NUM_STEPS = 5
"""Largest number of steps between the numbers of an axis, which keeps them apart in narrow panels."""


class Drawing(Protocol):
    """Figure of an experiment."""

    def draw(self, found: Tables) -> Figure:
        """Return the figure of an experiment's runs."""


@dataclass(frozen=True)
class Dots:
    """One panel for each measure of a comparison, one line for each label, one colour for each section.

    Labels in ``without`` are left out, such as one that is so far from the others that these would not differ.
    """

    comparison: Comparison
    width: float = 13.0
    without: tuple[str, ...] = ()

    def draw(self, found: Tables) -> Figure:
        """Return the figure: means over the teams with their intervals."""
        sections = {
            section: {label: rows for label, rows in parts.items() if label not in self.without}
            for section, parts in self.comparison.sections(found).items()
        }
        labels = list(dict.fromkeys(label for parts in sections.values() for label in parts))
        figure = new_figure(self.width, 1.4 + 0.16 * len(labels) * (1 + len(sections)))
        panels = figure.subplots(1, len(self.comparison.measures), sharey=True, squeeze=False)[0]
        for axes, measure in zip(panels, self.comparison.measures, strict=True):
            style(axes, measure.heading)
            for index, (section, parts) in enumerate(sections.items()):
                offset = _SPREAD * ((index + 0.5) / len(sections) - 0.5)
                means = [mean_over_teams(rows, measure) for rows in parts.values()]
                axes.errorbar(
                    [mean.mean for mean in means], [labels.index(label) + offset for label in parts],
                    xerr=_bars(means), fmt=MARKERS[index % len(MARKERS)], color=COLORS[index % len(COLORS)],
                    markersize=4, elinewidth=1.0, capsize=2, label=section,
                )  # fmt: skip
            if measure.is_ratio:
                axes.set_xscale("log")
                label_plainly(axes.xaxis)
            else:
                axes.locator_params(axis="x", nbins=_NUM_STEPS)
                axes.ticklabel_format(axis="x", useOffset=False)
        panels[0].set_yticks(range(len(labels)), labels, fontsize=9)
        panels[0].invert_yaxis()
        if len(sections) > 1:
            legend_below(figure, panels[0])
        return figure


@dataclass(frozen=True)
class Curves:
    """One panel for each measure and section, one curve for each label over a column with numbers.

    ``theory`` draws a line for each label.
    """

    plan: str
    x: str
    x_label: str
    measures: tuple[Measure, ...]
    label: Label
    section: str | None = None
    theory: Theory | None = None
    is_log: bool = False

    def draw(self, found: Tables) -> Figure:
        """Return the figure: means over the teams with bands of their intervals, and theory as lines."""
        parts = _by(found[self.plan], lambda row: "" if self.section is None else str(row[self.section]))
        figure = new_figure(1.5 + 3.8 * len(self.measures), 0.8 + 3.0 * len(parts))
        panels = figure.subplots(len(parts), len(self.measures), sharex=True, squeeze=False)
        for line, (section, rows) in zip(panels, parts.items(), strict=True):
            for axes, measure in zip(line, self.measures, strict=True):
                style(axes, f"{section}: {measure.heading}" if section else measure.heading)
                self._panel(axes, rows, measure)
        for axes in panels[-1]:
            axes.set_xlabel(self.x_label)
        legend_below(figure, panels[0][0])
        return figure

    def _panel(self, axes: Axes, rows: Sequence[Row], measure: Measure) -> None:
        """Draw the curves of one measure."""
        for index, (label, part) in enumerate(_by(rows, self.label).items()):
            _draw_curve(axes, part, self.x, measure, label, index, "" if self.theory else "-")
            if self.theory is not None:
                axes.plot(*self.theory(label), "-", color=COLORS[index % len(COLORS)], linewidth=1.0)
        if self.is_log:
            _make_logarithmic(axes, rows, self.x)
        if measure.is_ratio:
            axes.set_yscale("log")
            label_plainly(axes.yaxis)


@dataclass(frozen=True)
class Contrasts:
    """One panel for each group of measures and section, one curve for each measure over a column with numbers.

    ``panels`` are the measures by the label of their curve, by the heading of the panel. ``limits`` are lines across
    panels, by heading. ``is_log`` is for numbers from 0 on.
    """

    plan: str
    x: str
    x_label: str
    panels: Mapping[str, Mapping[str, Measure]]
    section: str | None = None
    limits: Mapping[str, float] = field(default_factory=dict)
    is_log: bool = False

    def draw(self, found: Tables) -> Figure:
        """Return the figure: means over the teams with bands of their intervals."""
        parts = _by(found[self.plan], lambda row: "" if self.section is None else str(row[self.section]))
        labels = list(dict.fromkeys(label for measures in self.panels.values() for label in measures))
        figure = new_figure(1.5 + 3.8 * len(self.panels), 0.8 + 3.0 * len(parts))
        panels = figure.subplots(len(parts), len(self.panels), sharex=True, sharey="col", squeeze=False)
        for line, (section, rows) in zip(panels, parts.items(), strict=True):
            for axes, (heading, measures) in zip(line, self.panels.items(), strict=True):
                style(axes, f"{section}\n{heading}" if section else heading)
                for label, measure in measures.items():
                    _draw_curve(axes, rows, self.x, measure, label, labels.index(label))
                if heading in self.limits:
                    axes.axhline(self.limits[heading], color="#222222", linestyle="--", linewidth=1.0)
                if self.is_log:
                    _make_logarithmic(axes, rows, self.x)
        for axes in panels[-1]:
            axes.set_xlabel(self.x_label)
        legend_below(figure, panels[0][0])
        return figure


@dataclass(frozen=True)
class Squares:
    """One panel for each measure and section: the mean over the teams for each pair of two columns' values."""

    plan: str
    x: str
    y: str
    measures: tuple[Measure, ...]
    section: str

    def draw(self, found: Tables) -> Figure:
        """Return the figure; a colour bar beside each panel."""
        parts = _by_column(found[self.plan], self.section)
        figure = new_figure(4.4 * len(self.measures), 3.4 * len(parts))
        panels = figure.subplots(len(parts), len(self.measures), squeeze=False)
        for line, (section, rows) in zip(panels, parts.items(), strict=True):
            for axes, measure in zip(line, self.measures, strict=True):
                self._panel(axes, rows, measure)
                axes.set_title(f"{section}: {measure.heading}", loc="left", fontsize=10)
        return figure

    def _panel(self, axes: Axes, rows: Sequence[Row], measure: Measure) -> None:
        """Draw the squares of one measure."""
        across, down = ([*_by_column(rows, name)] for name in (self.x, self.y))
        cells = _by(rows, lambda row: f"{row[self.x]} {row[self.y]}")
        values = np.array([[mean_over_teams(cells.get(f"{x} {y}", []), measure).mean for x in across] for y in down])
        norm = "log" if measure.is_ratio else "linear"
        image = axes.imshow(values, cmap="viridis", aspect="auto", norm=norm)
        axes.figure.colorbar(image, ax=axes)
        for (line, column), value in np.ndenumerate(values):
            color = "white" if np.asarray(image.norm(value)) < 0.5 else "black"
            axes.text(column, line, measure.text(value), ha="center", va="center", fontsize=7.5, color=color)
        axes.set_xticks(range(len(across)), across)
        axes.set_yticks(range(len(down)), down)
        axes.set_xlabel(self.x)
        axes.set_ylabel(self.y)


def _draw_curve(
    axes: Axes, rows: Sequence[Row], x: str, measure: Measure, label: str, index: int, line: str = "-"
) -> None:
    """Draw the means of a measure over a column with numbers, and the band of their intervals."""
    color, marker = COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)]
    points = sorted((float(value), mean_over_teams(part, measure)) for value, part in _by_column(rows, x).items())
    places = [place for place, _ in points]
    axes.plot(
        places, [mean.mean for _, mean in points], marker + line, color=color, markersize=5, linewidth=1.4, label=label
    )
    if not any(math.isnan(mean.low) for _, mean in points):
        lows, highs = [mean.low for _, mean in points], [mean.high for _, mean in points]
        axes.fill_between(places, lows, highs, color=color, alpha=0.25, linewidth=0)


def _make_logarithmic(axes: Axes, rows: Sequence[Row], x: str) -> None:
    """Make the axis of a column logarithmic, with its numbers as ticks; linear from 0 to the least positive number."""
    ticks = sorted({float(row[x]) for row in rows})
    if ticks[0] > 0:
        axes.set_xscale("log")
    else:
        axes.set_xscale("symlog", linthresh=ticks[1], linscale=0.5)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks], minor=False)
    axes.set_xticks([], minor=True)


def _by(rows: Sequence[Row], label: Label) -> dict[str, list[Row]]:
    """Rows by label, in the order of first occurrence."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(label(row), []).append(row)
    return found


def _by_column(rows: Sequence[Row], name: str) -> Mapping[str, list[Row]]:
    """Rows by the value of a column, in the order of first occurrence."""
    return _by(rows, lambda row: str(row[name]))


def _bars(means: Sequence[tuple[float, float, float]]) -> Float64Array:
    """Lengths (2, n) of the bars to both sides of means; 0 without an interval."""
    lengths: Float64Array = np.array([(mean - low, high - mean) for mean, low, high in means]).T
    return np.maximum(np.nan_to_num(lengths), np.float64(0.0))
