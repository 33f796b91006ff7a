"""Main columns of a sweep's table as figures over the varied settings."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octoreplay.io.output_file import writing
from octoreplay.report.figures import COLORS, LINES, MARKERS, new_figure, plain, save_figures, style
from octoreplay.report.zoom import zoom_shares, zoom_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Axis = tuple[str, ...]
"""Columns of settings that are varied together."""

_TITLES = {
    "total_distance_all_log_end": ("\u03a6 over all pairs at the end of the logs", "\u03a6"),
    "total_distance_all": ("\u03a6 over all pairs at the end", "\u03a6"),
    "contraction": ("Factor of \u03a6 per settling tick", "factor"),
    "label_disagreement_log_end": ("Cells with different labels at the end of the logs", "share of known cells"),
    "label_disagreement": ("Cells with different labels at the end", "share of known cells"),
    "ticks_to_consensus": ("Settling ticks until consensus", "ticks"),
    "agreement": ("Agreement with the centralised map, worst robot at the end", "share of known cells"),
    "agreement_occupied": ("Agreement on occupied cells, worst robot at the end", "share of occupied cells"),
    "packet_bytes": ("Size of a packet", "bytes"),
    "sent_bytes_per_second": ("Bytes sent by a robot during the logs", "bytes per second"),
    "mean_iou": ("Mean IoU, mean over the robots", "mean IoU"),
    "coverage": ("Share of the observed surface in the map, mean over the robots", "share"),
    "calibration_error": ("Expected calibration error, mean over the robots", "error"),
}
"""Title and label of the y axis of each drawn column."""

_LOGARITHMIC = ("total_distance_all_log_end", "total_distance_all", "packet_bytes", "sent_bytes_per_second")
_SHARES = ("agreement", "agreement_occupied", "mean_iou", "coverage")
"""Columns of shares with 1 as the best value."""
_HATCHES = ("", "///", "...", "xxx")
_CROWDED = 0.25
"""Part of the largest value in which all values lie where bars from 0 would look alike."""


def write_sweep_figures(rows: Sequence[Mapping[str, Any]], varied: Sequence[Axis], folder: Path) -> list[Path]:
    """Write a figure ``<column>.png`` of every main column into a folder, made if missing, and return the paths.

    ``rows`` are the rows of a sweep and ``varied`` its varied columns: the first is the x axis, the second gives the
    colours, and every combination of the others has a panel. Values are means over the seeds, with their range. A
    column without numbers has no figure; a figure of an earlier sweep is removed. Raises OutputError.
    """
    good = [row for row in rows if row["status"] != "failed"]
    axes = _axes_of(good, varied)
    drawn = {
        f"{column}.png": _figure(good, axes, column)
        for column in _TITLES
        if any(math.isfinite(row.get(column, math.nan)) for row in good)
    }
    with writing(folder):
        for column in _TITLES:
            if f"{column}.png" not in drawn:
                (folder / f"{column}.png").unlink(missing_ok=True)
        if not drawn and folder.exists():
            folder.rmdir()
    return save_figures(drawn, folder) if drawn else []


@dataclass(frozen=True)
class _Spread:
    """Mean, least and largest value over seeds; ``note`` describes values that have no visible bar."""

    mean: float
    least: float
    largest: float
    note: str


@dataclass(frozen=True)
class _Layout:
    """Columns of a sweep on the x axis, as colours and as panels."""

    along: Axis
    series: Axis
    panels: tuple[Axis, ...]


def _axes_of(rows: Sequence[Mapping[str, Any]], varied: Sequence[Axis]) -> _Layout:
    """Assign the varied columns; the seeds are the x axis where nothing else was varied."""
    has_teams = len({row["team"] for row in rows}) > 1
    axes = [*varied, *([("team",)] if has_teams else [])] or [("seed",)]
    return _Layout(axes[0], axes[1] if len(axes) > 1 else (), tuple(axes[2:]))


def _label(row: Mapping[str, Any], axis: Axis) -> str:
    """Values of a row in columns that are varied together."""
    return " ".join(str(row[name]) for name in axis)


def _labels(rows: Sequence[Mapping[str, Any]], axis: Axis) -> list[str]:
    """Distinct labels in the rows' order."""
    return list(dict.fromkeys(_label(row, axis) for row in rows))


def _figure(rows: Sequence[Mapping[str, Any]], layout: _Layout, column: str) -> Figure:
    """Figure of one column over the varied settings."""
    panels = list(itertools.product(*(_labels(rows, axis) for axis in layout.panels)))
    along, series = _labels(rows, layout.along), _labels(rows, layout.series)
    num_columns = 1 if len(panels) == 1 else 2
    num_rows = math.ceil(len(panels) / num_columns)
    numeric = _numbers(along) if len(layout.along) == 1 else None
    width = 7.0 if numeric else max(7.0, 0.16 * len(along) * len(series) + 1.5)
    figure = new_figure(width * num_columns, 3.6 * num_rows)
    title, y_label = _TITLES[column]
    figure.suptitle(title, x=0.02, ha="left", fontsize=11)
    grid = figure.subplots(num_rows, num_columns, squeeze=False, sharey=True)
    for axes in grid[:, 0]:
        axes.set_ylabel(y_label)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    scale = _scale(rows, column)
    is_crowded = scale == "linear" and _is_crowded(rows, column)
    for axes, panel in zip(grid.flat, panels, strict=False):
        of_panel = [row for row in rows if tuple(_label(row, axis) for axis in layout.panels) == panel]
        names = ", ".join(f"{'+'.join(axis)} {label}" for axis, label in zip(layout.panels, panel, strict=True))
        style(axes, names, "+".join(layout.along), axes.get_ylabel())
        if not numeric:
            axes.grid(visible=False, axis="x")
        spreads = _spreads(of_panel, layout, column)
        if numeric:
            _draw_lines(axes, numeric, along, series, spreads)
        else:
            _draw_groups(axes, along, series, spreads, is_zoomed=is_crowded)
        axes.set_yscale(scale)
    if scale == "linear" and (is_crowded or numeric):
        (zoom_shares if column in _SHARES else zoom_values)(grid.flat[0], [[row[column] for row in rows]])
    _leave_room(grid.flat[0], rows, column, scale)
    if layout.series:
        handles, names_of = grid.flat[0].get_legend_handles_labels()
        figure.legend(
            handles, names_of, title="+".join(layout.series), frameon=False, fontsize=9, title_fontsize=9,
            loc="outside right upper", ncols=1 + len(series) // 16,
        )  # fmt: skip
    return figure


def _numbers(labels: Sequence[str]) -> list[float] | None:
    """Labels as numbers, None unless all are finite numbers."""
    try:
        numbers = [float(label) for label in labels]
    except ValueError:
        return None
    return numbers if len(numbers) > 1 and all(map(math.isfinite, numbers)) else None


def _spreads(rows: Sequence[Mapping[str, Any]], layout: _Layout, column: str) -> dict[tuple[str, str], _Spread]:
    """Spreads of a column by label on the x axis and label of the series."""
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        found.setdefault((_label(row, layout.along), _label(row, layout.series)), []).append(row[column])
    return {key: _spread(values) for key, values in found.items()}


def _spread(values: Sequence[float]) -> _Spread:
    """Mean and range of the finite values."""
    there = [value for value in values if math.isfinite(value)]
    missing = len(values) - len(there)
    if not there:
        return _Spread(math.nan, math.nan, math.nan, "none")
    note = f"none in {missing} of {len(values)}" if missing else "0" if not any(there) else ""
    return _Spread(math.fsum(there) / len(there), min(there), max(there), note)


def _scale(rows: Sequence[Mapping[str, Any]], column: str) -> str:
    """Scale of the y axis, logarithmic where the values span much more than a decade."""
    values = [row[column] for row in rows if row[column] > 0 and math.isfinite(row[column])]
    return "log" if column in _LOGARITHMIC and values and max(values) > 20 * min(values) else "linear"


def _is_crowded(rows: Sequence[Mapping[str, Any]], column: str) -> bool:
    """True where all values are so close together that bars from 0 would look alike."""
    values = [row[column] for row in rows if math.isfinite(row[column])]
    return len(set(values)) > 1 and max(values) - min(values) < _CROWDED * max(values)


def _leave_room(axes: Any, rows: Sequence[Mapping[str, Any]], column: str, scale: str) -> None:
    """Set the limits of the y axis so that the least bar is visible, and 0..1 where all values are 0."""
    values = [row[column] for row in rows if math.isfinite(row[column])]
    if scale == "log":
        axes.set_ylim(bottom=min(value for value in values if value > 0) / 3, top=max(values) * 2)
    elif not any(values):
        axes.set_ylim(0.0, 1.0)


def _draw_lines(
    axes: Any, numbers: Sequence[float], along: Sequence[str], series: Sequence[str],
    spreads: Mapping[tuple[str, str], _Spread],
) -> None:  # fmt: skip
    """Draw one line per series over numbers."""
    order = sorted(range(len(along)), key=lambda index: numbers[index])
    for index, name in enumerate(series):
        points = [(numbers[n], spreads[along[n], name]) for n in order if (along[n], name) in spreads]
        for x, spread in points:
            _write_note(axes, x, spread, index)
        axes.errorbar(
            [x for x, _ in points], [spread.mean for _, spread in points], yerr=_ranges([s for _, s in points]),
            label=name, color=COLORS[index % len(COLORS)], linewidth=1.6, marker=MARKERS[index % len(MARKERS)],
            markersize=4, linestyle=LINES[index % len(LINES)], elinewidth=1, capsize=2,
        )  # fmt: skip
    if len(numbers) <= 8:
        axes.set_xticks(sorted(numbers))


def _draw_groups(
    axes: Any, along: Sequence[str], series: Sequence[str], spreads: Mapping[tuple[str, str], _Spread], *,
    is_zoomed: bool,
) -> None:  # fmt: skip
    """Draw a group per label with one bar per series, or one point where the axis does not begin at 0."""
    width = 0.8 / len(series)
    for index, name in enumerate(series):
        places = [(n, spreads[label, name]) for n, label in enumerate(along) if (label, name) in spreads]
        for n, spread in places:
            _write_note(axes, n + (index - (len(series) - 1) / 2) * width, spread, 0)
        x = [n + (index - (len(series) - 1) / 2) * width for n, _ in places]
        means, ranges = [spread.mean for _, spread in places], _ranges([spread for _, spread in places])
        color = COLORS[index % len(COLORS)]
        if is_zoomed:
            axes.errorbar(
                x, means, yerr=ranges, label=name, color=color, linestyle="", marker=MARKERS[index % len(MARKERS)],
                markersize=6, elinewidth=1, capsize=2,
            )  # fmt: skip
            continue
        axes.bar(
            x, means, 0.9 * width, label=name, color=color, hatch=_HATCHES[index % len(_HATCHES)], edgecolor="white",
            linewidth=0, yerr=ranges, error_kw={"elinewidth": 1, "capsize": 2, "ecolor": "#444444"},
        )  # fmt: skip
    is_long = sum(len(label) + 2 for label in along) > 90
    axes.set_xticks(
        range(len(along)), [plain(label) for label in along], **({"rotation": 30, "ha": "right"} if is_long else {})
    )
    axes.set_xlim(-0.6, len(along) - 0.4)


def _write_note(axes: Axes, x: float, spread: _Spread, line: int) -> None:
    """Write the note of a missing value or a value of 0 at the bottom of the axes."""
    if spread.note:
        axes.text(
            x, 0.02 + 0.06 * line, spread.note, transform=axes.get_xaxis_transform(), rotation=90, fontsize=7,
            ha="center", va="bottom", color=COLORS[line % len(COLORS)] if line else "#444444",
        )  # fmt: skip


def _ranges(spreads: Sequence[_Spread]) -> list[list[float]] | None:
    """Error bars: each mean minus the least, and the largest minus the mean; None where all are 0."""
    if all(spread.least == spread.largest or math.isnan(spread.mean) for spread in spreads):
        return None
    return [[max(s.mean - s.least, 0.0) for s in spreads], [max(s.largest - s.mean, 0.0) for s in spreads]]
