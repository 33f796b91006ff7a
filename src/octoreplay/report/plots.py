"""Metrics as CSV and as figures over time: disagreement, packet sizes, contradiction of evidence."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.errors import InputError
from octoreplay.io.text_files import write_whole
from octoreplay.report.contradiction_plots import contradiction_figure
from octoreplay.report.figures import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    label_in_bytes,
    legend_below,
    over_log_time,
    save_figures,
)
from octoreplay.run_metrics import PAIR_SHARES, TickMetrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TEAM_COLUMNS = (
    "tick", "stamp_ns", "settling", "total_distance_published", "total_distance", "total_distance_all",
    "distance_per_leaf",
    "distance_per_cell_and_link", "num_known_cells", "label_disagreement", "max_change",
    *PAIR_SHARES, "num_components",
)  # fmt: skip
_ROBOT_COLUMNS = (
    "active", "num_scans", "num_iterations", "agreement", "agreement_occupied", "num_leaves", "num_cells",
    "observed_volume", "entropy_bits", "memory_bytes", "sent_bytes", "packet_bytes", "octree_bytes", "grid_bytes",
    "unpruned_bytes", "unpruned_compressed_bytes",
)  # fmt: skip
_LINK_COLUMNS = (
    "num_sent", "sent_bytes", "num_delivered", "delivered_bytes", "num_lost", "num_dropped", "num_late", "num_stale",
    "num_gaps", "num_damaged", "bytes_per_second",
)  # fmt: skip
_PAIR_COLUMNS = (
    "overlap_cells", "occupied_cells", "contradiction", "clear_contradiction", "contradiction_of_first",
    "contradiction_of_second",
    "both_occupied_cells", "label_contradiction",
)  # fmt: skip


def metrics_csv(metrics: Sequence[TickMetrics]) -> str:
    """Return all metrics as CSV text, one row per tick: of the team, then of each robot, each link and each pair.

    Columns have the names of the metrics' fields, with the prefix ``<robot>.`` for a robot, ``<sender>><receiver>.``
    for a link and ``<first>&<second>.`` for a pair. Numbers have full precision; values that a tick does not have are
    empty.
    """
    robots = list(dict.fromkeys(robot.robot_id for tick in metrics for robot in tick.robots))
    # Frames are columns only where robots find them during the run.
    framed = robots if any(tick.places for tick in metrics) else []
    links = list(dict.fromkeys((link.sender, link.receiver) for tick in metrics for link in tick.links))
    pairs = list(dict.fromkeys((pair.first, pair.second) for tick in metrics for pair in tick.pairs))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [*_TEAM_COLUMNS, *(f"{robot}.frame" for robot in framed),
         *(f"{robot}.{name}" for robot in robots for name in _ROBOT_COLUMNS),
         *(f"{a}>{b}.{name}" for a, b in links for name in _LINK_COLUMNS),
         *(f"{a}&{b}.{name}" for a, b in pairs for name in _PAIR_COLUMNS)]
    )  # fmt: skip
    for tick in metrics:
        of_robot: dict[Any, Any] = {robot.robot_id: robot for robot in tick.robots}
        of_link: dict[Any, Any] = {(link.sender, link.receiver): link for link in tick.links}
        of_pair: dict[Any, Any] = {(pair.first, pair.second): pair for pair in tick.pairs}
        writer.writerow(
            [*_cells(tick, _TEAM_COLUMNS), *(tick.frame_of(robot) for robot in framed),
             *(v for r in robots for v in _cells(of_robot.get(r), _ROBOT_COLUMNS)),
             *(v for key in links for v in _cells(of_link.get(key), _LINK_COLUMNS)),
             *(v for key in pairs for v in _cells(of_pair.get(key), _PAIR_COLUMNS))]
        )  # fmt: skip
    return text.getvalue()


def write_metrics_csv(metrics: Sequence[TickMetrics], path: Path) -> None:
    """Write ``metrics_csv`` to a file. Raises OutputError."""
    write_whole(path, metrics_csv(metrics))


def write_figures(metrics: Sequence[TickMetrics], folder: Path) -> list[Path]:
    """Write ``disagreement.png``, ``packet_size.png`` and, where robots share known space, ``contradiction.png``.

    The folder is made if missing. Returns the paths. Raises OutputError, and InputError without any tick.
    """
    if not metrics:
        raise InputError("the result has no tick to draw, since the run was interrupted before its first one")
    figures = {"disagreement.png": _disagreement_figure(metrics), "packet_size.png": _packet_figure(metrics)}
    if any(tick.pairs for tick in metrics):
        figures["contradiction.png"] = contradiction_figure(metrics, log_seconds(metrics))
    return save_figures(figures, folder)


def _cells(record: Any, names: Sequence[str]) -> list[str]:
    """Values of one record as text, empty for None."""
    if record is None:
        return [""] * len(names)
    return [_cell(getattr(record, name)) for name in names]


def _cell(value: Any) -> str:
    """Value as text, empty for NaN; truth values are 0 and 1."""
    if value != value:
        return ""
    return str(int(value)) if isinstance(value, bool | np.bool_) else str(value)


def log_seconds(metrics: Sequence[TickMetrics]) -> Any:
    """Return the time of each tick in seconds since the first one."""
    return np.array([tick.stamp_ns - metrics[0].stamp_ns for tick in metrics]) / 1e9


def _mark_settling(axes: Axes, metrics: Sequence[TickMetrics], times: Any) -> None:
    """Draw a grey band over the settling ticks."""
    first = next((index for index, tick in enumerate(metrics) if tick.settling), None)
    if first is not None:
        start = times[first - 1] if first else times[0]
        axes.axvspan(start, times[-1], color=GREY, alpha=0.15, linewidth=0, label="settling, no new scans")


def _disagreement_figure(metrics: Sequence[TickMetrics]) -> Figure:
    """Figure of Phi over time, on a logarithmic axis."""
    figure, [axes] = over_log_time("Disagreement of the team", ["\u03a6"])
    times = log_seconds(metrics)
    links = np.array([tick.total_distance for tick in metrics])
    pairs = np.array([tick.total_distance_all for tick in metrics])
    published = np.array([tick.total_distance_published for tick in metrics])
    axes.plot(
        times, np.where(published > 0, published, np.nan), ":", color=GREY, linewidth=1.4,
        label="\u03a6 over the links, before the iterations",
    )  # fmt: skip
    axes.plot(times, np.where(links > 0, links, np.nan), color=BLUE, linewidth=1.6, label="\u03a6 over the links")
    # On a complete graph the two lines are equal except for rounding.
    if not np.allclose(links, pairs, rtol=1e-3):
        axes.plot(
            times, np.where(pairs > 0, pairs, np.nan), "--", color=ORANGE, linewidth=1.4, label="\u03a6 over all pairs"
        )
    if (pairs > 0).any():
        axes.set_yscale("log")
        # Values below this are consensus; the axis shows the rise and the fall.
        axes.set_ylim(bottom=pairs.max() * 1e-9)
    _mark_settling(axes, metrics, times)
    legend_below(figure)
    return figure


def _packet_figure(metrics: Sequence[TickMetrics]) -> Figure:
    """Figure of the bytes of a published map: as sent, as octree and as uniform grid."""
    figure, [axes] = over_log_time("Size of a published map (mean and standard deviation over robots)", ["bytes"])
    times = log_seconds(metrics)
    least = np.inf
    for name, label, color in (
        ("grid_bytes", "uniform grid", ORANGE),
        ("octree_bytes", "octree", BLUE),
        ("packet_bytes", "octree, as sent", GREEN),
    ):
        mean, deviation = over_robots(metrics, name)
        axes.plot(times, mean, color=color, linewidth=1.6, label=label)
        axes.fill_between(times, np.maximum(mean - deviation, 1), mean + deviation, color=color, alpha=0.2, linewidth=0)
        least = min([least, *mean[mean > 0]])
    if np.isfinite(least):
        # On a linear axis both octree curves would lie on the x axis.
        axes.set_yscale("log")
        axes.set_ylim(bottom=least / 2)
        label_in_bytes(axes)
    _mark_settling(axes, metrics, times)
    legend_below(figure)
    return figure


def over_robots(metrics: Sequence[TickMetrics], name: str) -> tuple[Any, Any]:
    """Return mean and standard deviation per tick over the robots that published; NaN where none did."""
    means, deviations = [], []
    for tick in metrics:
        values = [getattr(robot, name) for robot in tick.robots if robot.grid_bytes > 0]
        means.append(np.mean(values) if values else np.nan)
        deviations.append(np.std(values) if values else np.nan)
    return np.array(means), np.array(deviations)
