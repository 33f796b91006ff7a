"""Metrics, poses and links of a result as arrays over its ticks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from octoreplay.errors import escaped
from octoreplay.records import CENTRAL, Float32Array, Float64Array, UInt32Array
from octoreplay.report.page.columns import Columns
from octoreplay.result import Result
from octoreplay.run_metrics import PAIR_SHARES, TickMetrics

_TEAM_CHARTS = (
    ("total_distance", "Disagreement Φ", "", "log", ("total_distance", "total_distance_all")),
    ("label_disagreement", "Cells with different labels", "%", "linear", ("label_disagreement",)),
    ("contradiction", "Contradiction of evidence, worst pair", "%", "linear", tuple(PAIR_SHARES)),
)
"""Charts of team metrics: id, title, unit, scale, and fields of TickMetrics."""
_ROBOT_CHARTS = (
    ("agreement", "Agreement with all evidence", "%", "linear"),
    ("agreement_occupied", "Agreement, occupied cells", "%", "linear"),
    ("sent_bytes", "Sent by each robot", "B/s", "linear"),
    ("observed_volume", "Observed volume", "m³", "linear"),
    ("entropy_bits", "Entropy", "bit", "linear"),
)
"""Charts with one line for each robot: field of RobotMetrics, title, unit and scale."""
_NAMES = {
    "total_distance": "over links", "total_distance_all": "over all pairs", "label_disagreement": "team",
    "contradiction": "contradiction", "clear_contradiction": "clear", "label_contradiction": "labels",
}  # fmt: skip


def times(result: Result) -> Float64Array:
    """Return the time of each tick since the run's start (T,) [s]."""
    return np.array([result.seconds(tick.stamp_ns) for tick in result.metrics])


def charts(result: Result, columns: Columns) -> list[dict[str, Any]]:
    """Return the charts: id, title, unit, scale, and lines with a name, robot index and values (T,) float64.

    Values are those of the metrics (docs/metrics.md): percentages are 100 times a share, and bytes per second those of
    a tick over the publish period. Missing values are NaN.
    """
    metrics = result.metrics
    found = []
    for chart, title, unit, scale, names in _TEAM_CHARTS:
        factor = 100.0 if unit == "%" else 1.0
        lines = []
        for name in names:
            values = factor * np.array([getattr(tick, name) for tick in metrics], dtype=np.float64)
            if np.isfinite(values).any():
                lines.append({"name": _NAMES[name], "column": name, "robot": -1, "values": columns.add(values)})
        found.append({"id": chart, "title": title, "unit": unit, "scale": scale, "lines": lines})
    period = result.config.network.publish_period
    for name, title, unit, scale in _ROBOT_CHARTS:
        factor = {"%": 100.0, "B/s": 1.0 / period}.get(unit, 1.0)
        lines = []
        for index, robot_id in enumerate(result.robots):
            values = factor * _of_robot(metrics, robot_id, name)
            line = {"name": escaped(robot_id), "column": f"{robot_id}.{name}", "robot": index}
            lines.append({**line, "values": columns.add(values)})
        found.append({"id": name, "title": title, "unit": unit, "scale": scale, "lines": lines})
    found.append(_links_chart(result, columns))
    return [chart for chart in found if chart["lines"]]


def links(result: Result, columns: Columns) -> dict[str, Any]:
    """Return the links: sender and receiver (K, 2) uint16, packets sent and delivered in each tick (K, T) uint32."""
    ends = _link_ends(result.metrics)
    index = {robot_id: position for position, robot_id in enumerate(result.robots)}
    pairs = np.array([(index[a], index[b]) for a, b in ends], dtype=np.uint16).reshape(-1, 2)
    return {
        "pairs": columns.add(pairs),
        "sent": columns.add(_of_links(result.metrics, ends, lambda link: link.num_sent)),
        "delivered": columns.add(_of_links(result.metrics, ends, lambda link: link.num_delivered)),
    }


def poses(result: Result, columns: Columns) -> list[dict[str, Any]]:
    """Return each robot's sensor poses at all ticks, (T, 7) float32 x, y, z, qx, qy, qz, qw; NaN without a pose."""
    stamps = {tick.stamp_ns: row for row, tick in enumerate(result.metrics)}
    found = []
    for robot_id in result.robots:
        table: Float32Array = np.full((len(stamps), 7), np.nan, dtype=np.float32)
        pose_stamps, rows = result.poses(robot_id)
        for stamp_ns, row in zip(pose_stamps, rows, strict=True):
            if stamp_ns in stamps:
                table[stamps[stamp_ns]] = row
        found.append({"poses": columns.add(table)})
    return found


def frames(result: Result, columns: Columns) -> dict[str, Any]:
    """Return the frame of each robot's map and pose at each tick (N, T) uint16, and that of the team's map (T,).

    Equal numbers are equal frames. The team's map is that of the largest group of robots with a common frame.
    """
    names: dict[str, int] = {}
    of_robots = np.zeros((len(result.robots), len(result.metrics)), dtype=np.uint16)
    of_team = np.zeros(len(result.metrics), dtype=np.uint16)
    for column, tick in enumerate(result.metrics):
        for row, robot_id in enumerate(result.robots):
            of_robots[row, column] = names.setdefault(tick.frame_of(robot_id), len(names))
        of_team[column] = names.setdefault(tick.frame_of(CENTRAL), len(names))
    return {"robots": columns.add(of_robots), "team": columns.add(of_team)}


def _links_chart(result: Result, columns: Columns) -> dict[str, Any]:
    """Chart of the bytes sent over each directed link in a second."""
    ends = _link_ends(result.metrics)
    sent = _of_links(result.metrics, ends, lambda link: link.sent_bytes) / result.config.network.publish_period
    lines = [
        {"name": escaped(f"{a} → {b}"), "column": f"{a}>{b}.sent_bytes", "robot": result.robots.index(a),
         "values": columns.add(values)}
        for (a, b), values in zip(ends, sent, strict=True)
    ]  # fmt: skip
    return {"id": "link_bytes", "title": "Sent over each link", "unit": "B/s", "scale": "linear", "lines": lines}


def _link_ends(metrics: Sequence[TickMetrics]) -> list[tuple[str, str]]:
    """Directed links in the order in which they occur."""
    return list(dict.fromkeys((link.sender, link.receiver) for tick in metrics for link in tick.links))


def _of_links(
    metrics: Sequence[TickMetrics], ends: Sequence[tuple[str, str]], value: Callable[[Any], int]
) -> UInt32Array:
    """Values (K, T) of the links in each tick, 0 in ticks without the link."""
    rows = {pair: row for row, pair in enumerate(ends)}
    table = np.zeros((len(ends), len(metrics)), dtype=np.uint32)
    for column, tick in enumerate(metrics):
        for link in tick.links:
            table[rows[link.sender, link.receiver], column] = value(link)
    return table


def _of_robot(metrics: Sequence[TickMetrics], robot_id: str, name: str) -> Float64Array:
    """Values (T,) of one robot's metric; NaN in ticks without the robot."""
    found = ({robot.robot_id: robot for robot in tick.robots}.get(robot_id) for tick in metrics)
    return np.array([math.nan if robot is None else getattr(robot, name) for robot in found], dtype=np.float64)
