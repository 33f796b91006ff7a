"""Figures of the links: bytes and losses of each directed link of a run, and of the teams of several runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.errors import InputError
from octoreplay.records import Float64Array
from octoreplay.report.figures import (
    BLUE,
    COLORS,
    LINES,
    MARKERS,
    FigureStyle,
    label_in_bytes,
    mark_isolated,
    over_log_time,
    plain,
    style,
)
from octoreplay.report.log_time import PlottedRun
from octoreplay.report.zoom import zoom_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_NAMED = 12
"""Largest number of links with a name each; with more of them, the links of a sender share one."""
_MAX_ROWS = 60.0
_LOST = ("num_lost", "num_dropped", "num_damaged")
"""Numbers of packets that did not arrive, or could not be used."""


def links_figure(runs: Sequence[PlottedRun], look: FigureStyle) -> tuple[Figure, list[Axes]]:
    """Return the figure and its axes over log time.

    Of one run a row for each directed link: bytes delivered in a tick as shades of grey, and a cross where packets were
    lost; below it the bytes of the team. Of several runs, links, bytes and losses of each team. Raises InputError for a
    run without links.
    """
    for run in runs:
        if not any(tick.links for tick in run.metrics):
            raise InputError(f"{run.source}: the result has no links, since no robot could send to another one")
    return _of_run(runs[0], look) if len(runs) == 1 else _of_runs(runs, look)


def _of_run(run: PlottedRun, look: FigureStyle) -> tuple[Figure, list[Axes]]:
    """Figure of one run."""
    order = {robot.robot_id: index for index, robot in enumerate(run.metrics[0].robots)}
    found = {(link.sender, link.receiver) for tick in run.metrics for link in tick.links}
    ends = sorted(found, key=lambda pair: [order.get(robot_id, 0) for robot_id in pair])
    rows = {pair: index for index, pair in enumerate(ends)}
    sent, lost = (np.full((len(ends), len(run.metrics)), value) for value in (np.nan, 0.0))
    for column, tick in enumerate(run.metrics):
        for link in tick.links:
            row = rows[link.sender, link.receiver]
            sent[row, column] = link.delivered_bytes
            lost[row, column] = sum(getattr(link, name) for name in _LOST)
    height = look.row_height * (1.6 + 0.04 * min(len(ends), _MAX_ROWS)) + look.row_height
    figure = look.figure(height)
    upper, lower = figure.subplots(2, sharex=True, height_ratios=[height - 1.6 * look.row_height, look.row_height])
    style(upper, "" if look.is_print else "Bytes delivered over the links", y_label="link, grouped by sender")
    upper.grid(visible=False)
    _draw_rows(figure, upper, run, sent, lost)
    _name_rows(upper, ends)
    style(lower, x_label="log time [s]", y_label="team\n[B / tick]")
    total = np.nansum(sent, axis=0)
    total = np.where(total > 0, total, np.nan)
    lower.plot(run.times, total, color=BLUE)
    mark_isolated(lower, run.times, total, color=BLUE)
    if (total > 0).any():
        lower.set_yscale("log")
        label_in_bytes(lower)
    return figure, [lower]


def _draw_rows(figure: Figure, axes: Axes, run: PlottedRun, sent: Float64Array, lost: Float64Array) -> None:
    """Draw the bytes (links, ticks) as shades, and crosses at losses; white where there is no link."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import EngFormatter

    positive = sent[sent > 0]
    low, high = (float(positive.min()), float(positive.max())) if positive.size else (1.0, 10.0)
    middles = (run.times[1:] + run.times[:-1]) / 2
    first = run.times[0] - (middles[0] - run.times[0] if middles.size else 0.5)
    last = run.times[-1] + (run.times[-1] - middles[-1] if middles.size else 0.5)
    edges = np.concatenate([[first], middles, [last]])
    shades: Any = np.where(sent > 0, sent, np.where(np.isnan(sent), np.nan, low))
    image = axes.pcolormesh(
        edges, np.arange(len(sent) + 1) - 0.5, shades, cmap="Blues", norm=LogNorm(low / 3, max(high, 2 * low)),
        rasterized=True,
    )  # fmt: skip
    row, column = np.nonzero(lost)
    if row.size:
        axes.plot(run.times[column], row, "x", color=COLORS[1], markersize=3, markeredgewidth=0.9, label="packets lost")
    axes.invert_yaxis()
    bar = figure.colorbar(image, ax=axes, pad=0.01, aspect=30, format=EngFormatter(unit="B"))
    bar.ax.tick_params(labelsize="small")
    bar.outline.set_visible(False)


def _name_rows(axes: Axes, ends: Sequence[tuple[str, str]]) -> None:
    """Label the rows with the links, or with the sender at the first of its links."""
    senders = [sender for sender, _ in ends]
    if len(ends) <= MAX_NAMED:
        axes.set_yticks(range(len(ends)), [f"{plain(sender)} \u2192 {plain(receiver)}" for sender, receiver in ends])
        return
    starts = [index for index, sender in enumerate(senders) if senders.index(sender) == index]
    axes.set_yticks(
        [start - 0.5 for start in starts], [f"{plain(senders[start])} \u2192" for start in starts], va="top"
    )
    for start in starts[1:]:
        axes.axhline(start - 0.5, color="white", linewidth=1.2)


def _of_runs(runs: Sequence[PlottedRun], look: FigureStyle) -> tuple[Figure, list[Axes]]:
    """Figure of several runs."""
    figure, stack = over_log_time("Links of the team", ["bytes sent\nin a tick", "links", "packets\nlost [%]"], look)
    for index, run in enumerate(runs):
        links = [tick.links for tick in run.metrics]
        num_sent = np.array([sum(link.num_sent for link in row) for row in links], np.float64)
        lost = np.array([sum(getattr(link, name) for link in row for name in _LOST) for row in links], np.float64)
        sent = np.array([sum(link.sent_bytes for link in row) for row in links], np.float64)
        share = np.divide(100 * lost, num_sent, out=np.full(len(links), np.nan), where=num_sent > 0)
        step = max(len(links) // 8, 1)
        for axes, values in zip(
            stack, (np.where(sent > 0, sent, np.nan), [len(row) for row in links], share), strict=True
        ):
            axes.plot(
                run.times, values, color=COLORS[index % len(COLORS)], linestyle=LINES[index % len(LINES)],
                marker=MARKERS[index % len(MARKERS)], markevery=(index * step // len(MARKERS), step),
                label=run.label if axes is stack[0] else None,
            )  # fmt: skip
            mark_isolated(
                axes, run.times, values, color=COLORS[index % len(COLORS)], marker=MARKERS[index % len(MARKERS)]
            )
    if any((np.asarray(line.get_ydata(), np.float64) > 0).any() for line in stack[0].get_lines()):
        stack[0].set_yscale("log")
        label_in_bytes(stack[0])
    zoom_values(stack[1], [*(line.get_ydata() for line in stack[1].get_lines()), [0.0]])
    zoom_values(stack[2], [*(line.get_ydata() for line in stack[2].get_lines()), [0.0, 1.0]])
    return figure, stack
