"""Tables for the terminal: results of a run, and written files."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, NamedTuple

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table

from octoreplay.evaluate.verdict import RunVerdict, run_verdict
from octoreplay.mapping.contradiction import contradicting_pairs
from octoreplay.records import FrameCounts
from octoreplay.report.console import EscapingConsole
from octoreplay.run_metrics import (
    MIN_COMPARED_CELLS,
    PAIR_SHARES,
    LinkMetrics,
    PairMetrics,
    RobotMetrics,
    RunSummary,
    TickMetrics,
    ranked_pairs,
)

_OUTCOMES = {
    "used": "used", "no_label": "no label", "no_pose": "no pose", "late": "late", "duplicate": "same stamp",
    "undecodable": "unreadable", "unusable": "no pose in it", "unpaired": "no image", "unmapped": "image not mapped",
    "superseded": "older path", "off": "robot off", "not_selected": "not selected", "not_read": "not read",
}  # fmt: skip
"""Outcomes of messages (docs/logs.md) and their headings."""

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


def results(summary: RunSummary, *, num_warnings: int = 0, is_verbose: bool = False) -> RenderableType:
    """Return the results of a run as tables: verdict, team, robots, contradicting pairs, lossy links, unused messages.

    Robots with equal maps are one row, and of many pairs MAX_PAIRS are shown, unless ``is_verbose``.
    """
    parts: list[RenderableType] = [
        verdict_table(run_verdict(summary), num_warnings),
        _team_table(summary),
        _robots_table(summary.last, is_verbose=is_verbose),
    ]
    if contradicting_pairs(summary.last.pairs):
        parts.append(pairs_table(summary.last.pairs, None if is_verbose else MAX_PAIRS))
    if any(getattr(link, f"num_{fate}") for link in summary.links for fate in _FATES):
        parts.append(_links_table(summary.links))
    parts += _messages_tables(summary.frame_counts)
    return spaced(parts)


def worst_pair(pairs: Sequence[PairMetrics], name: str) -> str:
    """Return the largest share ``name`` of a pair with its number of cells; a dash without a pair that counts."""
    ranked = ranked_pairs(pairs, name)
    if not ranked:
        return f"- (no pair shares {MIN_COMPARED_CELLS} occupied cells)" if pairs else "-"
    pair = ranked[0]
    num_cells = getattr(pair, PAIR_SHARES[name])
    return f"{share(getattr(pair, name))} of {num_cells:,} occupied cells, {pair.first} and {pair.second}"


def verdict_table(verdict: RunVerdict, num_warnings: int) -> Table:
    """Return what matters most about a run: agreement, correctness, cost, and the number of its warnings."""
    table = styled_table("Verdict")
    table.show_header = False
    table.add_column(no_wrap=True)
    table.add_column()
    for name, sentences in verdict_rows(verdict):
        table.add_row(name, sentences)
    table.add_row("warnings", f"{num_warnings}, at the end, with remedies" if num_warnings else "none")
    return table


def verdict_rows(verdict: RunVerdict) -> list[tuple[str, str]]:
    """Return names and sentences of the verdict on a run: agreed, correct, cost."""
    per_second = "-" if math.isnan(verdict.sent_bytes_per_second) else f"{size(verdict.sent_bytes_per_second)}/s"
    cost = f"{per_second} sent by each robot, mean; {size(verdict.total_sent_bytes)} in total"
    return [("agreed", _agreed(verdict)), ("correct", _correct(verdict)), ("cost", cost)]


def _agreed(verdict: RunVerdict) -> str:
    """Sentence on the agreement of the team."""
    if verdict.has_agreed is None:
        return "one robot: nothing to compare" if verdict.num_robots == 1 else "the maps are empty: nothing to compare"
    if verdict.num_frames > 1:
        return f"no: the robots are in {verdict.num_frames} frames"
    answer = "yes" if verdict.has_agreed else "no"
    return f"{answer}: {share(verdict.label_disagreement)} of the known cells have different labels"


def _correct(verdict: RunVerdict) -> str:
    """Sentences on what the evidence says about the maps."""
    agreement = f"{share(verdict.agreement)} of the cells have the label of all evidence, worst robot"
    if verdict.num_robots == 1:
        return agreement
    if verdict.is_consistent is None or verdict.worst_pair is None:
        return f"not known: no two robots share {MIN_COMPARED_CELLS} occupied cells\n{agreement}"
    answer = "plausible" if verdict.is_consistent else "doubtful"
    clear = f"{share(verdict.clear_contradiction)} clear contradiction"
    return f"{answer}: {clear}, worst pair {' and '.join(verdict.worst_pair)}\n{agreement}"


def pairs_table(pairs: Sequence[PairMetrics], num_rows: int | None = MAX_PAIRS) -> Table:
    """Return a table of the ``num_rows`` pairs that contradict each other most (None: all), and of their number."""
    ranked = ranked_pairs(pairs, "clear_contradiction")
    rows = ranked[:num_rows]
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


def are_equal(rows: Sequence[Sequence[str]]) -> bool:
    """Return True for several robots with the same texts, which a table shows as one."""
    return len(rows) > 1 and len(set(map(tuple, rows))) == 1


def caption_equal(table: Table, num_robots: int) -> str:
    """Add the caption of a table in which equal robots are one row or column; return the heading of that row."""
    table.caption, table.caption_justify = "The robots' maps agree; -v shows each robot.", "left"
    return f"all {num_robots}"


def made_files(files: Mapping[Path, str]) -> Table:
    """Return a table of written files or folders and their content."""
    table = styled_table("Written")
    table.show_header = False
    table.add_column(overflow="fold")
    table.add_column()
    for path, content in files.items():
        table.add_row(str(path), content)
    return table


def terminal(*, stderr: bool = False, file: IO[str] | None = None, width: int | None = None) -> Console:
    """Return a console of at most 100 columns, 160 in a pipe, without markup and emoji codes.

    It escapes all text, so that names in logs and results cannot control the terminal.
    """
    console = EscapingConsole(stderr=stderr, file=file, width=width, markup=False, emoji=False, highlight=False)
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


def spaced(parts: Sequence[RenderableType]) -> Group:
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
    totals: Counter[str] = Counter()
    for counts in summary.frame_counts.values():
        for outcomes in counts.outcomes.values():
            totals.update(outcomes)
    if totals:
        parts = [f"{totals[name]:,} {heading}" for name, heading in _OUTCOMES.items() if totals[name]]
        table.add_row("messages", f"{totals.total():,} in the logs: {', '.join(parts)}")
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
        table.add_row("clear contradiction", worst_pair(last.pairs, "clear_contradiction"))
        table.add_row("any contradiction", worst_pair(last.pairs, "contradiction"))
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
    """Time at which the robots became one component, or the components at the end."""
    if summary.last.num_components == 1:
        return f"one from {summary.joins[-1].seconds:g} s on" if summary.joins else "one"
    names = "; ".join(", ".join(component) for component in summary.last.components)
    return f"{summary.last.num_components} at the end, in different frames: {names}"


_AGREEMENTS = ("agreement", "agreement_occupied")


class _Column(NamedTuple):
    """Column of the table of robots: field of RobotMetrics, and whether it describes the contents of the map."""

    heading: str
    name: str
    text: Callable[[float], str]
    is_content: bool


_ROBOT_COLUMNS = (
    _Column("scans", "num_scans", "{:,}".format, False),
    _Column("agreement\nall cells", "agreement", share, True),
    _Column("\noccupied", "agreement_occupied", share, True),
    _Column("leaves", "num_leaves", "{:,}".format, False),
    _Column("volume", "observed_volume", lambda value: f"{number(value)} m\u00b3", True),
    _Column("entropy", "entropy_bits", "{:.3f} bit".format, True),
    _Column("packet", "packet_bytes", size, False),
)


def _robots_table(last: TickMetrics, *, is_verbose: bool) -> Table:
    """Table of the robots after the last tick; one row for robots with equal maps unless ``is_verbose``."""
    table = styled_table("Robots, after the last tick")
    table.add_column("robot", no_wrap=True)
    for column in _ROBOT_COLUMNS:
        table.add_column(column.heading, justify="right", no_wrap=True)
    contents = [
        tuple(column.text(getattr(robot, column.name)) for column in _ROBOT_COLUMNS if column.is_content)
        for robot in last.robots
    ]
    groups = [(robot.robot_id, [robot]) for robot in last.robots]
    if not is_verbose and are_equal(contents):
        groups = [(caption_equal(table, len(last.robots)), list(last.robots))]
    for name, robots in groups:
        table.add_row(name, *(_range(column, robots) for column in _ROBOT_COLUMNS))
    return table


def _range(column: _Column, robots: Sequence[RobotMetrics]) -> str:
    """Smallest and largest value of a column; one value where their texts are equal."""
    values = [getattr(robot, column.name) for robot in robots]
    ends = dict.fromkeys(column.text(value) for value in (min(values), max(values)))
    return " -\n".join(ends)


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


def _messages_tables(counts_by_robot: Mapping[str, FrameCounts]) -> list[Table]:
    """Table of messages by robot, topic and outcome, of the topics with unused ones; empty without such topics."""
    rows = {
        (robot_id, topic): outcomes
        for robot_id, counts in counts_by_robot.items()
        for topic, outcomes in counts.outcomes.items()
        if set(outcomes) - {"used", "not_read"}
    }
    if not rows:
        return []
    table = styled_table("Messages")
    shown = [name for name in _OUTCOMES if any(name in outcomes for outcomes in rows.values())]
    for name in ("robot", "topic"):
        table.add_column(name, overflow="fold")
    for name in ("in log", *(_OUTCOMES[name] for name in shown)):
        table.add_column(name, justify="right")
    for (robot_id, topic), outcomes in rows.items():
        table.add_row(robot_id, topic, f"{sum(outcomes.values()):,}", *(f"{outcomes.get(n, 0):,}" for n in shown))
    return [table]
