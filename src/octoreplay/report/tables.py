"""Tables for the terminal: results of a run, its inputs, answers to queries and descriptions of logs."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from rich import box
from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from octoreplay.config.resolved import MapFrame, ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.io.robots.team_clocks import instant
from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.mapping.contradiction import contradicting_pairs
from octoreplay.records import ClassTable, FrameCounts, LeafTable
from octoreplay.run_metrics import (
    MIN_COMPARED_CELLS,
    PAIR_SHARES,
    LinkMetrics,
    PairMetrics,
    RunSummary,
    TickMetrics,
    ranked_pairs,
)

if TYPE_CHECKING:
    from octoreplay.io.robots.describe import LogDescription, LogSummary
    from octoreplay.result import PointQuery

_CAUSES = {
    "no_label": "no label", "no_pose": "no pose", "late": "late",
    "undecodable": "unreadable",
}  # fmt: skip
"""Causes of frames that were not mapped: fields of FrameCounts and their headings."""

MAX_PAIRS = 8
"""Largest number of rows of the table of pairs."""


def number(value: float) -> str:
    """Format a number with about three significant digits and separated thousands; a dash if not finite."""
    if not math.isfinite(value):
        return "-"
    if value == 0 or 999.5 <= abs(value) < 1e9:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def size(num_bytes: float) -> str:
    """Format a number of bytes in B, kB, MB or GB (powers of 1000); a dash if not finite."""
    if not math.isfinite(num_bytes):
        return "-"
    for unit in ("B", "kB", "MB"):
        if abs(num_bytes) < 999.5:
            return f"{num_bytes:.0f} {unit}" if unit == "B" else f"{num_bytes:.3g} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:,.3g} GB"


def share(value: float) -> str:
    """Format a share 0..1 in per cent; a dash if not finite."""
    return f"{100 * value:.2f} %" if math.isfinite(value) else "-"


def seconds(value: float) -> str:
    """Format a duration in seconds below two minutes, else in minutes and seconds."""
    if value < 119.95:
        return f"{value:.1f} s"
    whole = round(value)
    return f"{whole // 60} min {whole % 60:02d} s"


def results(summary: RunSummary) -> RenderableType:
    """Return the results of a run as tables: team, robots, contradicting pairs, lossy links, frames not mapped."""
    parts: list[RenderableType] = [_team_table(summary), _robots_table(summary.last)]
    if contradicting_pairs(summary.last.pairs):
        parts.append(pairs_table(summary.last.pairs))
    if any(getattr(link, f"num_{fate}") for link in summary.links for fate in _FATES):
        parts.append(_links_table(summary.links))
    if any(counts.skipped for counts in summary.frame_counts.values()):
        parts.append(_frames_table(summary.frame_counts))
    return _spaced(parts)


def worst_pair(pairs: Sequence[PairMetrics], name: str) -> str:
    """Return the largest share ``name`` of a pair with its number of cells; a dash without a pair that counts."""
    ranked = ranked_pairs(pairs, name)
    if not ranked:
        return f"- (no pair shares {MIN_COMPARED_CELLS} occupied cells)" if pairs else "-"
    pair = ranked[0]
    num_cells = getattr(pair, PAIR_SHARES[name])
    return f"{share(getattr(pair, name))} of {num_cells:,} occupied cells, {pair.first} and {pair.second}"


def pairs_table(pairs: Sequence[PairMetrics]) -> Table:
    """Return a table of the pairs that contradict each other most, and of how many pairs they are."""
    ranked = ranked_pairs(pairs, "clear_contradiction")
    rows = ranked[:MAX_PAIRS]
    table = styled_table(f"Contradiction of evidence, {len(rows)} of {len(ranked)} pairs")
    table.add_column("pair", overflow="fold")
    for name in ("shared\ncells", "of these\noccupied", "contra-\ndiction", "clear", "labels"):
        table.add_column(name, justify="right", no_wrap=True)
    for pair in rows:
        table.add_row(
            f"{pair.first}, {pair.second}", f"{pair.overlap_cells:,}", f"{pair.occupied_cells:,}",
            *(share(getattr(pair, name)) for name in PAIR_SHARES),
        )  # fmt: skip
    return table


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
        Text.assemble(("\u25a0 ", "rgb({},{},{})".format(*entry.color)), entry.name) for entry in class_table.classes
    ]
    return Group(Text("Classes", style="bold"), Columns(items, padding=(0, 2)))


def point_answers(names: Sequence[str], points: Sequence[tuple[float, float, float]], answer: PointQuery) -> Table:
    """Return a table of the most probable classes at points; ``names`` are free, then the classes."""
    table = styled_table("")
    table.add_column("x, y, z [m]", no_wrap=True)
    table.add_column("label", no_wrap=True)
    table.add_column("probability", justify="right", no_wrap=True)
    table.add_column("next")
    table.add_column("leaf", justify="right", no_wrap=True)
    for index, point in enumerate(points):
        where = ", ".join(f"{value:g}" for value in point)
        if not answer.known[index]:
            table.add_row(where, "unknown", "", "", "")
            continue
        row = answer.probabilities[index]
        order = sorted(range(len(names)), key=lambda k: (-row[k], k))
        rest = ", ".join(f"{names[k]} {share(row[k])}" for k in order[1:3])
        table.add_row(where, names[order[0]], share(row[order[0]]), rest, f"{answer.sizes[index]:g} m")
    return table


def box_answer(names: Sequence[str], leaves: LeafTable) -> Table:
    """Return a table of the volume of each class in some leaves; ``names`` are free, then the classes."""
    labels, volumes = best_labels(leaves.log_odds), leaves.sizes**3
    probabilities = label_probabilities(leaves.log_odds)
    table = styled_table("")
    table.add_column("label", no_wrap=True)
    for heading in ("leaves", "volume", "mean probability"):
        table.add_column(heading, justify="right", no_wrap=True)
    for class_id, name in enumerate(names):
        chosen = labels == class_id
        if chosen.any():
            mean = np.average(probabilities[chosen], weights=volumes[chosen])
            table.add_row(name, f"{chosen.sum():,}", f"{number(volumes[chosen].sum())} m\u00b3", share(mean))
    if not len(leaves):
        table.add_row("unknown", "", "", "")
    return table


def made_files(files: Mapping[Path, str]) -> Table:
    """Return a table of written files or folders and their content."""
    table = styled_table("Written")
    table.show_header = False
    table.add_column(overflow="fold")
    table.add_column()
    for path, content in files.items():
        table.add_row(str(path), content)
    return table


def description(logs: LogDescription) -> RenderableType:
    """Return a description of logs as tables: topics, robots, classes and missing inputs."""
    parts: list[RenderableType] = [_log_table(log) for log in logs.logs if log.error is None]
    if logs.robots:
        parts.append(_robot_spans(logs))
    parts.append(_readiness(logs))
    return _spaced(parts)


def terminal(*, stderr: bool = False, file: IO[str] | None = None, width: int | None = None) -> Console:
    """Return a console of at most 100 columns, 160 in a pipe, without markup and emoji codes."""
    console = Console(stderr=stderr, file=file, width=width, markup=False, emoji=False, highlight=False)
    # A pipe has no width, and text for programs should not be cut.
    console.width = min(console.width, 100) if console.is_terminal or width or "COLUMNS" in os.environ else 160
    return console


def show(console: Console, *parts: RenderableType) -> None:
    """Print tables and texts with an empty line after each."""
    for part in parts:
        console.print(part)
        console.print()


def styled_table(title: str) -> Table:
    """Return an empty table in the common style of all tables."""
    return Table(
        title=title or None,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        header_style="bold",
        show_edge=False,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )


def _spaced(parts: Sequence[RenderableType]) -> Group:
    """Parts with an empty line between them."""
    lines: list[RenderableType] = []
    for part in parts:
        lines += [*([""] if lines else []), part]
    return Group(*lines)


def _team_table(summary: RunSummary) -> Table:
    """Table of the whole team: rows of description and value."""
    last, table = summary.last, styled_table("Team")
    table.show_header = False
    table.add_column(no_wrap=True)
    table.add_column()
    table.add_row("log time", seconds(summary.log_seconds))
    if math.isfinite(summary.wall_seconds) and summary.wall_seconds > 0:
        speed = summary.log_seconds / summary.wall_seconds
        table.add_row("wall time", f"{seconds(summary.wall_seconds)} ({speed:.1f} times real time)")
    settling = f", and {summary.num_settling_ticks} settling" if summary.num_settling_ticks else ""
    table.add_row("ticks", f"{summary.num_ticks - summary.num_settling_ticks}{settling}")
    table.add_row("stopped", summary.stop_reason)
    table.add_row("known cells", f"{last.num_known_cells:,}")
    table.add_row(
        "disagreement \u03a6",
        f"{number(last.total_distance)} at the end, {number(summary.peak_total_distance)} at most",
    )
    table.add_row(
        "\u03a6 over all pairs",
        f"{number(last.total_distance_all)} at the end, {number(summary.peak_total_distance_all)} at most",
    )
    table.add_row("cells with different labels", share(last.label_disagreement))
    robots = last.counted_robots
    worst = [min((getattr(robot, name) for robot in robots), default=math.nan) for name in _AGREEMENTS]
    table.add_row("agreement, worst robot", f"{share(worst[0])} of all cells, {share(worst[1])} of occupied cells")
    if len(last.robots) > 1:
        table.add_row("contradiction, worst pair", worst_pair(last.pairs, "contradiction"))
        table.add_row("clear contradiction", worst_pair(last.pairs, "clear_contradiction"))
        table.add_row("label contradiction", worst_pair(last.pairs, "label_contradiction"))
        if summary.frame_origins:
            table.add_row("frames", _frame_origins(summary.frame_origins))
        if last.places:
            table.add_row("components", _joined(summary))
    table.add_row("map packet, mean", f"{size(summary.mean_packet_bytes)} as sent")
    table.add_row("", f"{size(summary.mean_octree_bytes)} as octree, uncompressed")
    grid = f"{size(summary.mean_grid_bytes)} as uniform grid"
    if summary.mean_grid_bytes > 0:
        grid += f" (sent: {share(summary.mean_packet_bytes / summary.mean_grid_bytes)} of it)"
    table.add_row("", grid)
    table.add_row("sent in total", size(summary.total_sent_bytes))
    num_sent = sum(link.num_sent for link in summary.links)
    if num_sent:
        delivered = sum(link.num_delivered for link in summary.links) / num_sent
        table.add_row("packets", f"{num_sent:,} over {len(summary.links)} links, {share(delivered)} delivered")
    return table


def _frame_origins(origins: Mapping[str, str]) -> str:
    """Lines on the origins of the robots' frames: one for all robots, or one each."""
    if len(set(origins.values())) == 1:
        return next(iter(origins.values()))
    return "\n".join(f"{robot_id}: {origin}" for robot_id, origin in origins.items())


def _joined(summary: RunSummary) -> str:
    """When the robots became one component, or the components at the end."""
    if summary.last.num_components == 1:
        return f"one from {summary.joins[-1].seconds:g} s on" if summary.joins else "one"
    names = "; ".join(", ".join(component) for component in summary.last.components)
    return f"{summary.last.num_components} at the end, in different frames: {names}"


_AGREEMENTS = ("agreement", "agreement_occupied")


def _robots_table(last: TickMetrics) -> Table:
    """Table of the robots after the last tick."""
    table = styled_table("Robots, after the last tick")
    table.add_column("robot", no_wrap=True)
    for name in ("scans", "agreement\nall cells", "\noccupied", "leaves", "volume", "entropy", "packet"):
        table.add_column(name, justify="right", no_wrap=True)
    for robot in last.robots:
        table.add_row(
            robot.robot_id, f"{robot.num_scans:,}", share(robot.agreement), share(robot.agreement_occupied),
            f"{robot.num_leaves:,}", f"{number(robot.observed_volume)} m\u00b3", f"{robot.entropy_bits:.3f} bit",
            size(robot.packet_bytes),
        )  # fmt: skip
    return table


_FATES = ("lost", "dropped", "late", "stale", "gaps", "damaged")
"""Fates of packets that were not delivered in time: fields of LinkMetrics without num_."""


def _links_table(links: Sequence[LinkMetrics]) -> Table:
    """Table of the directed links over the whole run."""
    table = styled_table("Links, over the whole run")
    table.add_column("link", no_wrap=True)
    for name in ("packets", "delivered", *_FATES, "bytes/s"):
        table.add_column(name, justify="right", no_wrap=True)
    for link in links:
        delivered = link.num_delivered / link.num_sent if link.num_sent else math.nan
        table.add_row(
            f"{link.sender} \u2192 {link.receiver}", f"{link.num_sent:,}", share(delivered),
            *(f"{getattr(link, f'num_{fate}'):,}" for fate in _FATES), size(link.bytes_per_second),
        )  # fmt: skip
    return table


def _log_table(log: LogSummary) -> RenderableType:
    """Time span of a log, and a table of its topics."""
    span = "empty"
    if log.start_ns is not None and log.end_ns is not None:
        span = f"{instant(log.start_ns)}, {seconds((log.end_ns - log.start_ns) / 1e9)}"
    title = Text.assemble((str(log.path), "bold"), f"\n{span}, {log.num_messages:,} messages")
    table = styled_table("")
    longest = max((len(topic.name) for topic in log.topics), default=0)
    table.add_column("topic", overflow="fold", min_width=min(longest, 32))
    table.add_column("type", no_wrap=True)
    table.add_column("count", justify="right", no_wrap=True)
    table.add_column("rate", justify="right", no_wrap=True)
    table.add_column("content", overflow="fold")
    for topic in log.topics:
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.3g} Hz"
        kind = topic.type_name.replace("/msg/", "/")
        kind = kind if topic.encoding in ("", "cdr", "ros1") else f"{kind} ({topic.encoding})"
        table.add_row(topic.name, kind, f"{topic.num_messages:,}", rate, topic.detail)
    damage = [Text(f"damaged: {log.damage}", style="yellow")] if log.damage else []
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


def _readiness(logs: LogDescription) -> RenderableType:
    """Common time of the robots, classes, and missing inputs."""
    lines: list[RenderableType] = []
    if len(logs.robots) > 1:
        shared = "none" if logs.overlap_ns is None else seconds((logs.overlap_ns[1] - logs.overlap_ns[0]) / 1e9)
        lines.append(Text(f"common time of all robots: {shared}"))
    if logs.class_table is not None:
        lines.append(class_list(logs.class_table))
    missing = [f"{robot.robot.robot_id}: {item}" for robot in logs.robots for item in robot.missing]
    missing += logs.missing
    if not missing:
        lines.append(Text("nothing is missing for a run", style="green"))
    lines += [Text(f"missing for a run: {item}", style="yellow") for item in missing]
    return Group(*lines)


def _frames_table(counts: Mapping[str, FrameCounts]) -> Table:
    """Table of frames per robot: mapped, and not mapped by cause."""
    table = styled_table("Frames")
    table.add_column("robot", no_wrap=True)
    table.add_column("mapped", justify="right")
    causes = [cause for cause in _CAUSES if any(getattr(count, cause) for count in counts.values())]
    for cause in causes:
        table.add_column(_CAUSES[cause], justify="right")
    for robot_id, count in counts.items():
        table.add_row(robot_id, f"{count.used:,}", *(f"{getattr(count, cause):,}" for cause in causes))
    return table


def _choices(robot: RobotConfig, frame: MapFrame | None) -> list[str]:
    """Lines with the topics and frames of a robot's configuration, and how its poses reach the map frame."""
    names = {
        "depth_topic": "depth", "cloud_topic": "cloud", "label_topic": "labels", "camera_info_topic": "camera",
        "pose_topic": "pose", "label_info_topic": "names", "fix_topic": "fixes", "tags_topic": "tags",
        "map_frame": "map frame", "sensor_frame": "sensor frame",
    }  # fmt: skip
    width = max(len(name) for name in names.values())
    values = {name: value for field, name in names.items() if (value := getattr(robot, field))}
    if frame is not None and frame.origin:
        values["map frame"] += f" ({frame.origin})"
    if isinstance(robot, ResolvedRobot) and robot.frame_origin:
        values["team frame"] = robot.frame_origin
    return [f"{name:<{width}}  {value}" for name, value in values.items()]
