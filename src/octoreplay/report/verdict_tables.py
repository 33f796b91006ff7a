"""Tables and sentences for the terminal: what a check found, and how two results differ."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from octoreplay.evaluate.checks import CheckRow
from octoreplay.evaluate.comparison import MapDifference, Point, ResultComparison, SettingDifference
from octoreplay.report.tables import styled_table

_MOST_CHANGES = 12
"""Pairs of labels that the table shows; the others are in one row."""


def check_rows(rows: Sequence[CheckRow]) -> Table:
    """One row per limit, in their order."""
    table = styled_table("")
    table.add_column("", no_wrap=True)
    table.add_column("what", overflow="fold")
    table.add_column("limit", justify="right", no_wrap=True)
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("where", overflow="fold")
    for row in rows:
        verdict = Text("passed", style="green") if row.passed else Text("FAILED", style="bold red")
        table.add_row(verdict, row.name.replace("_", " "), *_values(row), _where(row))
    return table


def check_verdict(rows: Sequence[CheckRow]) -> str:
    """One sentence that says what failed."""
    failed = [row.name.replace("_", " ") for row in rows if not row.passed]
    if not failed:
        return f"passed: {'all ' if len(rows) > 1 else ''}{_count(len(rows), 'check')}"
    return f"failed: {len(failed)} of {_count(len(rows), 'check')}: {', '.join(failed)}"


def comparison(found: ResultComparison) -> Iterator[RenderableType]:
    """Two results side by side: their files, their maps, the labels, the settings."""
    yield _files(found)
    if found.maps:
        yield _maps(found)
    differing = [one for one in found.maps if one.num_differing]
    if differing:
        yield _places(differing)
    if any(one.label_changes for one in found.maps):
        yield _label_changes(found.maps)
    if found.settings:
        yield _settings(found.settings)


def comparison_verdict(found: ResultComparison) -> str:
    """One sentence: the same, or how different."""
    within = f" within {found.tolerance:g}" if found.tolerance else ""
    num_maps = len(found.maps)
    if found.is_same:
        num_relabelled = sum(one.num_relabelled for one in found.maps)
        but = f"; labels differ in {_count(num_relabelled, 'cell')}" if num_relabelled else ""
        return f"the same{within}: {_count(num_maps, 'map')}, every cell{but}"
    parts = []
    differing = [one for one in found.maps if one.num_differing]
    if differing:
        worst = max(differing, key=lambda one: one.largest_difference)
        most = max(one.num_differing for one in differing)
        parts.append(
            f"{len(differing)} of {_count(num_maps, 'map')}, in up to {_count(most, 'cell')},"
            f" by up to {number(worst.largest_difference)} ({_place(worst)})"
        )
    parts += [f"only {which} has a map of {', '.join(names)}"
              for which, names in (("A", found.only_a), ("B", found.only_b)) if names]  # fmt: skip
    return f"different{within}: {'; '.join(parts)}"


def number(value: float) -> str:
    """A number to be compared by eye: six significant digits, thousands separated; a dash for NaN."""
    if math.isnan(value):
        return "-"
    if math.isfinite(value) and value == round(value) and abs(value) < 1e15:
        return f"{value:,.0f}"
    return f"{value:.6g}"


def _values(row: CheckRow) -> tuple[str, str]:
    """Limit and measured value, which look different where one is past the other."""
    if row.is_flag:
        return "yes", "yes" if row.measured else "no"
    limit, measured = number(row.limit), number(row.measured)
    if limit == measured and row.limit != row.measured:
        limit, measured = repr(row.limit), repr(row.measured)
    return f"{'at most' if row.is_upper else 'at least'} {limit}", measured


def _where(row: CheckRow) -> str:
    """Whose value it is, when it was, and what else is to be said."""
    at = "" if row.seconds is None else f"at {row.seconds:.1f} s"
    whose = " ".join(part for part in (row.robot, row.link, at) if part)
    return "; ".join(part for part in (whose, row.detail) if part)


def _files(found: ResultComparison) -> Group:
    """The two files, and whether they were made from the same logs."""
    files = (("A", found.a, found.is_complete_a), ("B", found.b, found.is_complete_b))
    lines = [
        Text(f"{name}: {path}{'' if is_complete else ' (of an interrupted run)'}", overflow="fold")
        for name, path, is_complete in files
    ]
    said = {True: "the same", False: "different", None: "not comparable: their fingerprints were taken in two ways"}
    return Group(*lines, Text(f"logs: {said[found.same_inputs]}"))


def _maps(found: ResultComparison) -> Table:
    """One row per map that both results have."""
    table = styled_table("Maps, in finest cells")
    table.add_column("map", no_wrap=True)
    for name in ("time A", "time B", "in both", "only A", "only B", "other label", "largest\ndifference"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column(f"over\n{found.tolerance:g}", justify="right", no_wrap=True)
    for one in found.maps:
        table.add_row(
            one.robot_id, f"{one.seconds_a:.1f} s", f"{one.seconds_b:.1f} s", f"{one.num_cells_both:,}",
            f"{one.num_cells_a_only:,}", f"{one.num_cells_b_only:,}", f"{one.num_relabelled:,}",
            number(one.largest_difference), f"{one.num_over_tolerance:,}",
        )  # fmt: skip
    return table


def _places(differing: Sequence[MapDifference]) -> Table:
    """Where maps differ: the box that holds every differing cell, and the worst cell."""
    table = styled_table("Where they differ [m]")
    table.add_column("map", no_wrap=True)
    table.add_column("cells", justify="right", no_wrap=True)
    for name in ("from", "to", "largest difference at"):
        table.add_column(name, no_wrap=True)
    for one in differing:
        table.add_row(one.robot_id, f"{one.num_differing:,}", *map(_point, (one.lower, one.upper, one.largest_at)))
    return table


def _label_changes(maps: Sequence[MapDifference]) -> Table:
    """The pairs of different labels, of all maps together."""
    counts: Counter[tuple[str, str]] = Counter()
    for one in maps:
        counts.update({(change.label_a, change.label_b): change.num_cells for change in one.label_changes})
    table = styled_table("Labels that differ")
    table.add_column("in A", no_wrap=True)
    table.add_column("in B", no_wrap=True)
    table.add_column("cells, in all maps", justify="right", no_wrap=True)
    pairs = counts.most_common()
    for (label_a, label_b), num_cells in pairs[:_MOST_CHANGES]:
        table.add_row(label_a, label_b, f"{num_cells:,}")
    if rest := pairs[_MOST_CHANGES:]:
        table.add_row(f"{len(rest)} others", "", f"{sum(num_cells for _, num_cells in rest):,}")
    return table


def _settings(settings: Sequence[SettingDifference]) -> Table:
    """The settings that are not the same."""
    table = styled_table("Settings that differ")
    table.add_column("setting", overflow="fold")
    table.add_column("in A", overflow="fold")
    table.add_column("in B", overflow="fold")
    for one in settings:
        table.add_row(one.name, _setting(one.value_a), _setting(one.value_b))
    return table


def _setting(value: object) -> str:
    """A setting's value; what is not set follows from others."""
    return "(default)" if value is None else "(none)" if value == () else str(value)


def _place(one: MapDifference) -> str:
    """Whose map, and the cell with the largest difference."""
    return one.robot_id if one.largest_at is None else f"{one.robot_id} at {_point(one.largest_at)}"


def _point(point: Point | None) -> str:
    """Three coordinates."""
    return "" if point is None else ", ".join(f"{value:g}" for value in point)


def _count(number_of: int, noun: str) -> str:
    """A number of things."""
    return f"{number_of:,} {noun}{'' if number_of == 1 else 's'}"
