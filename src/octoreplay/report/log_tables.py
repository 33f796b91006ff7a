"""Tables for the terminal: contents of logs, and the inputs and classes of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from octoreplay.config.resolved import MapFrame, ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import printable
from octoreplay.io.robots.label_counts import RawLabel
from octoreplay.io.robots.team_clocks import instant
from octoreplay.records import ClassTable
from octoreplay.report.tables import seconds, spaced, styled_table

if TYPE_CHECKING:
    from octoreplay.io.robots.describe import LogDescription, LogSummary


def chosen_inputs(config: ResolvedRun) -> Table:
    """Return a table of the robots, logs and topics of a run."""
    table = styled_table("Robots and topics")
    table.add_column("robot", no_wrap=True)
    table.add_column("log", overflow="fold")
    table.add_column("topics and frames", overflow="fold")
    for robot in config.robots:
        logs = "\n".join(log.name or str(log) for log in robot.logs)
        table.add_row(robot.robot_id, logs, "\n".join(_choices(robot, robot.frame)))
    return table


def class_list(class_table: ClassTable) -> RenderableType:
    """Return a list of the classes with their colours."""
    items = [
        Text.assemble(("\u25a0 ", "rgb({},{},{})".format(*entry.color)), printable(entry.name))
        for entry in class_table.classes
    ]
    return Group(Text("Classes", style="bold"), Columns(items, padding=(0, 2)))


def description(logs: LogDescription) -> RenderableType:
    """Return a description of logs as tables: topics, robots, classes and missing inputs."""
    parts: list[RenderableType] = [_log_table(log) for log in logs.logs if log.error is None]
    if logs.robots:
        parts.append(_robot_spans(logs))
    if logs.labels:
        parts.append(_label_table(logs))
    parts.append(_readiness(logs))
    return spaced(parts)


def _log_table(log: LogSummary) -> RenderableType:
    """Time span of a log, and a table of its topics."""
    span = "empty"
    if log.start_ns is not None and log.end_ns is not None:
        span = f"{instant(log.start_ns)}, {seconds((log.end_ns - log.start_ns) / 1e9)}"
    title = Text.assemble((printable(str(log.path)), "bold"), f"\n{span}, {log.num_messages:,} messages")
    table = styled_table("")
    longest = max((len(topic.name) for topic in log.topics), default=0)
    table.add_column("topic", overflow="fold", min_width=min(longest, 24))
    table.add_column("type", no_wrap=True)
    table.add_column("count", justify="right", no_wrap=True)
    table.add_column("rate", justify="right", no_wrap=True)
    table.add_column("content", overflow="fold", min_width=len("content"))
    for topic in log.topics:
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.3g} Hz"
        kind = topic.type_name.replace("/msg/", "/")
        kind = kind if topic.encoding in ("", "cdr", "ros1") else f"{kind} ({topic.encoding})"
        table.add_row(topic.name, kind, f"{topic.num_messages:,}", rate, topic.detail)
    damage = [Text(printable(f"damaged: {log.damage}"), style="yellow")] if log.damage else []
    return Group(title, *damage, table)


def _robot_spans(logs: LogDescription) -> Table:
    """Table of the robots found in logs: topics, frames and time span."""
    table = styled_table("Robots")
    table.add_column("robot", no_wrap=True)
    table.add_column("topics and frames", overflow="fold")
    table.add_column("start", justify="right", no_wrap=True)
    table.add_column("length", justify="right", no_wrap=True)
    first = min((robot.span_ns[0] for robot in logs.robots if robot.span_ns is not None), default=0)
    for robot in logs.robots:
        begin, length = "-", "-"
        if robot.span_ns is not None:
            start, end = robot.span_ns
            begin, length = f"+{(start - first) / 1e9:.1f} s", seconds((end - start) / 1e9)
        table.add_row(robot.robot.robot_id, "\n".join(_choices(robot.robot, robot.frame)), begin, length)
    return table


_MAX_LABELS = 12
"""Largest number of raw labels of a topic that the table shows."""


def _label_table(logs: LogDescription) -> Table:
    """Table of the most frequent raw labels of each topic."""
    table = styled_table("Raw labels")
    table.add_column("topic", overflow="fold")
    for name in ("label", "class", "share"):
        table.add_column(name, justify="right" if name != "class" else "left", no_wrap=True)
    for counts in logs.labels:
        total = sum(label.number for label in counts.labels) or 1
        head = f"{counts.topic}\n{counts.num_read} of {counts.num_messages:,} messages"
        rows = counts.labels[:_MAX_LABELS]
        cells = [
            "\n".join(label.raw for label in rows),
            "\n".join(_class_cell(label, has_table=counts.has_table) for label in rows),
            "\n".join(f"{label.number / total:.2%}" for label in rows),
        ]
        num_more = len(counts.labels) - len(rows)
        table.add_row(head, *cells)
        if num_more:
            rest = sum(label.number for label in counts.labels[_MAX_LABELS:])
            table.add_row("", f"{num_more:,} more", "", f"{rest / total:.2%}")
    return table


def _class_cell(label: RawLabel, *, has_table: bool) -> str:
    """Class of a raw label as shown in the table."""
    if label.class_name is None:
        return "unknown" if has_table else "-"
    return label.class_name or "(ignored)"


def _readiness(logs: LogDescription) -> RenderableType:
    """Common time of the robots, classes, and missing inputs."""
    lines: list[RenderableType] = []
    if len(logs.robots) > 1:
        lines.append(Text(printable(f"common time of all robots: {_common_time(logs)}")))
    if logs.class_table is not None:
        lines.append(class_list(logs.class_table))
    missing = [f"{robot.robot.robot_id}: {item}" for robot in logs.robots for item in robot.missing]
    missing += logs.missing
    if not missing:
        lines.append(Text("nothing is missing for a run", style="green"))
    lines += [Text(printable(f"missing for a run: {item}"), style="yellow") for item in missing]
    return Group(*lines)


def _common_time(logs: LogDescription) -> str:
    """Length of the time that all robots share, or the robots that share none."""
    if logs.overlap_ns is not None:
        return seconds((logs.overlap_ns[1] - logs.overlap_ns[0]) / 1e9)
    spans = {robot.robot.robot_id: robot.span_ns for robot in logs.robots if robot.span_ns is not None}
    if not spans:
        return "none"
    first, last = min(spans, key=lambda name: spans[name][1]), max(spans, key=lambda name: spans[name][0])
    gap = (spans[last][0] - spans[first][1]) / 1e9
    return f"none: the log of {first} ends {seconds(gap)} before that of {last} begins"


def _choices(robot: RobotConfig, frame: MapFrame | None) -> list[str]:
    """Lines with the topics and frames of a robot's configuration, and how its poses reach the map frame."""
    of_sensor = {
        "depth_topic": "depth", "cloud_topic": "cloud", "label_topic": "labels", "camera_info_topic": "camera"
    }  # fmt: skip
    of_robot = {
        "pose_topic": "pose", "label_info_topic": "names", "fix_topic": "fixes", "tags_topic": "tags",
        "map_frame": "map frame", "sensor_frame": "sensor frame",
    }  # fmt: skip
    width = max(len(name) for name in of_robot.values())
    values = {name: value for field, name in {**of_sensor, **of_robot}.items() if (value := getattr(robot, field))}
    for number, sensor in enumerate(robot.sensors, start=1):
        found = [value for field in (*of_sensor, "sensor_frame") if (value := getattr(sensor, field))]
        values[f"sensor {number}"] = ", ".join(found)
    if robot.pose is not None:
        values["pose"] = "stands still at " + " ".join(f"{number:g}" for number in robot.pose)
    if frame is not None and frame.origin:
        values["map frame"] += f" ({frame.origin})"
    if isinstance(robot, ResolvedRobot) and robot.frame_origin:
        values["team frame"] = robot.frame_origin
    return [f"{name:<{width}}  {value}" for name, value in values.items()]
