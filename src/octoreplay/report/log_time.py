"""Runs as figures over log time show them: times, values over robots, and the mark of settling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.records import BoolArray, Float64Array
from octoreplay.report.figures import GREY
from octoreplay.run_metrics import RobotMetrics, TickMetrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class PlottedRun:
    """Run in a figure: its label, the metrics of its ticks, and the name of its result in errors."""

    def __init__(self, label: str, metrics: Sequence[TickMetrics], source: str | None = None) -> None:
        self.label = label
        self.metrics = metrics
        self.source = source or label

    @cached_property
    def times(self) -> Float64Array:
        """Log time (n,) of each tick in seconds since the first one."""
        return log_seconds(self.metrics)

    @cached_property
    def settling(self) -> BoolArray:
        """True (n,) for settling ticks."""
        return np.array([tick.settling for tick in self.metrics], np.bool_)

    @property
    def end_of_logs(self) -> float | None:
        """Log time at which settling begins [s], None for a run without it."""
        first = int(np.argmax(self.settling))
        return float(self.times[max(first - 1, 0)]) if self.settling.any() else None


def log_seconds(metrics: Sequence[TickMetrics]) -> Float64Array:
    """Return the time (n,) of each tick in seconds since the first one."""
    return np.array([tick.stamp_ns - metrics[0].stamp_ns for tick in metrics]) / 1e9


def over_robots(
    metrics: Sequence[TickMetrics], name: str, is_counted: Callable[[RobotMetrics], bool]
) -> tuple[Any, Any]:
    """Return mean and standard deviation (n,) per tick of a metric over the counted robots; NaN where none counts."""
    means, deviations = [], []
    for tick in metrics:
        values = [getattr(robot, name) for robot in tick.robots if is_counted(robot)]
        means.append(np.mean(values) if values else np.nan)
        deviations.append(np.std(values) if values else np.nan)
    return np.array(means), np.array(deviations)


def has_published(robot: RobotMetrics) -> bool:
    """Return True for a robot that published its map in the tick."""
    return robot.grid_bytes > 0


def mark_settling(stack: Sequence[Axes], runs: Sequence[PlottedRun]) -> None:
    """Draw a light band from the end of the logs to the end of settling; runs that end alike share one."""
    spans = {
        (round(start, 3), round(float(run.times[-1]), 3)) for run in runs if (start := run.end_of_logs) is not None
    }
    starts = {start for start, _ in spans}
    label = "settling, no new scans"
    for start in sorted(starts):
        end = max(stop for first, stop in spans if first == start)
        for axes in stack:
            axes.axvspan(start, end, color=GREY, alpha=0.18, linewidth=0, zorder=0, label=label)
        label = ""
