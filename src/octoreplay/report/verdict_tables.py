"""Tables and verdicts for the terminal: checks of a result, and the comparison of two results."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from octoreplay.errors import counted, printable
from octoreplay.evaluate.checks import CheckRow
from octoreplay.evaluate.comparison import MapDifference, Point, ResultComparison, SettingDifference
from octoreplay.report.tables import styled_table

_MOST_CHANGES = 12
"""Number of pairs of labels with a row of their own; one row sums up the others."""


def check_rows(rows: Sequence[CheckRow]) -> Table:
    """Return a table with one row per check, in their order."""
    table = styled_table("")
    table.add_column("", no_wrap=True)
    table.add_column("check", overflow="fold")
    table.add_column("limit", justify="right", no_wrap=True)
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("where", overflow="fold")
    for row in rows:
        verdict = Text("passed", style="green") if row.passed else Text("FAILED", style="bold red")
        table.add_row(verdict, row.name.replace("_", " "), *_values(row), _where(row))
    return table


def check_verdict(rows: Sequence[CheckRow]) -> str:
    """Return one sentence that names the failed checks."""
    failed = [row.name.replace("_", " ") for row in rows if not row.passed]
    if not failed:
        return f"passed: {'all ' if len(rows) > 1 else ''}{counted(len(rows), 'check')}"
    return f"failed: {len(failed)} of {counted(len(rows), 'check')}: {', '.join(failed)}"


def comparison(found: ResultComparison, *, is_verbose: bool = False) -> Iterator[RenderableType]:
    """Yield the tables of a comparison: files, maps, differing boxes, labels and settings.

    Of many pairs of labels the most frequent are shown, unless ``is_verbose``.
    """
    yield _files(found)
    if found.maps:
        yield _maps(found)
    differing = [one for one in found.maps if one.num_differing]
    if differing:
        yield _places(differing)
    if any(one.label_changes for one in found.maps):
        yield _label_changes(found.maps, None if is_verbose else _MOST_CHANGES)
    if found.settings:
        yield _settings(found.settings)


def comparison_verdict(found: ResultComparison) -> str:
    """Return one sentence: whether the maps are the same, and the largest difference otherwise."""
    within = f" within {found.tolerance:g}" if found.tolerance else ""
    num_maps = len(found.maps)
    if found.is_same:
        num_relabelled = sum(one.num_relabelled for one in found.maps)
        labels = f"; labels differ in {counted(num_relabelled, 'cell')}" if num_relabelled else ""
        return f"the same{within}: all cells of {counted(num_maps, 'map')}{labels}"
    parts = []
    differing = [one for one in found.maps if one.num_differing]
    if differing:
        worst = max(differing, key=lambda one: one.largest_difference)
        most = max(one.num_differing for one in differing)
        parts.append(
            f"{len(differing)} of {counted(num_maps, 'map')}, in up to {counted(most, 'cell')},"
            f" by up to {six_digits(worst.largest_difference)} ({_place(worst)})"
        )
    parts += [f"only {result} has a map of {', '.join(names)}"
              for result, names in (("A", found.only_a), ("B", found.only_b)) if names]  # fmt: skip
    return f"different{within}: {'; '.join(parts)}"


def six_digits(value: float) -> str:
    """Format a number with six significant digits and separated thousands; a dash for NaN."""
    if math.isnan(value):
        return "-"
    if math.isfinite(value) and value == round(value) and abs(value) < 1e15:
        return f"{value:,.0f}"
    return f"{value:.6g}"


def _values(row: CheckRow) -> tuple[str, str]:
    """Limit and measured value as texts, which differ wherever the numbers do."""
    if row.is_flag:
        return "yes", "yes" if row.measured else "no"
    limit, measured = six_digits(row.limit), six_digits(row.measured)
    if limit == measured and row.limit != row.measured:
        limit, measured = repr(row.limit), repr(row.measured)
    return f"{'at most' if row.is_upper else 'at least'} {limit}", measured


def _where(row: CheckRow) -> str:
    """Robot, link or pair, and time of a value, and the explanation."""
    at = "" if row.seconds is None else f"at {row.seconds:.1f} s"
    place = " ".join(part for part in (row.robot, row.link, row.pair, at) if part)
    return "; ".join(part for part in (place, row.detail) if part)


def _files(found: ResultComparison) -> Group:
    """Paths of the two results, and whether their logs are the same."""
    files = (("A", found.a, found.is_complete_a), ("B", found.b, found.is_complete_b))
    lines = [
        Text(printable(f"{name}: {path}{'' if is_complete else ' (interrupted run)'}"), overflow="fold")
        for name, path, is_complete in files
    ]
    verdicts = {True: "the same", False: "different", None: "not comparable, since their fingerprint methods differ"}
    return Group(*lines, Text(f"logs: {verdicts[found.same_inputs]}"))


def _maps(found: ResultComparison) -> Table:
    """Table of the maps that both results have."""
    table = styled_table("Maps, in finest cells")
    table.add_column("map", overflow="fold")
    for name in ("time A", "time B", "in both", "only A", "only B", "other\nlabel", "largest\ndifference"):
        table.add_column(name, justify="right", overflow="fold")
    table.add_column(f"over\n{found.tolerance:g}", justify="right", overflow="fold")
    for one in found.maps:
        table.add_row(
            one.robot_id, f"{one.seconds_a:.1f} s", f"{one.seconds_b:.1f} s", f"{one.num_cells_both:,}",
            f"{one.num_cells_a_only:,}", f"{one.num_cells_b_only:,}", f"{one.num_relabelled:,}",
            six_digits(one.largest_difference), f"{one.num_over_tolerance:,}",
        )  # fmt: skip
    return table


def _places(differing: Sequence[MapDifference]) -> Table:
    """Table of the boxes around the differing cells, and of the cells with the largest difference."""
    table = styled_table("Places of the differences [m]")
    table.add_column("map", no_wrap=True)
    table.add_column("cells", justify="right", no_wrap=True)
    for name in ("from", "to", "largest difference at"):
        table.add_column(name, no_wrap=True)
    for one in differing:
        table.add_row(one.robot_id, f"{one.num_differing:,}", *map(_point, (one.lower, one.upper, one.largest_at)))
    return table


def _label_changes(maps: Sequence[MapDifference], num_rows: int | None) -> Table:
    """Table of the pairs of different labels, summed over all maps."""
    counts: Counter[tuple[str, str]] = Counter()
    for one in maps:
        counts.update({(change.label_a, change.label_b): change.num_cells for change in one.label_changes})
    table = styled_table("Different labels")
    table.add_column("in A", no_wrap=True)
    table.add_column("in B", no_wrap=True)
    table.add_column("cells, in all maps", justify="right", no_wrap=True)
    pairs = counts.most_common()
    for (label_a, label_b), num_cells in pairs[:num_rows]:
        table.add_row(label_a, label_b, f"{num_cells:,}")
    if rest := pairs[len(pairs) if num_rows is None else num_rows :]:
        table.add_row(f"{len(rest)} others", "", f"{sum(num_cells for _, num_cells in rest):,}")
    return table


def _settings(settings: Sequence[SettingDifference]) -> Table:
    """Table of the settings with different values."""
    table = styled_table("Different settings")
    table.add_column("setting", overflow="fold")
    table.add_column("in A", overflow="fold")
    table.add_column("in B", overflow="fold")
    for one in settings:
        table.add_row(one.name, _setting(one.value_a), _setting(one.value_b))
    return table


def _setting(value: object) -> str:
    """Value of a setting as text; None is a default that follows from other settings."""
    return "(default)" if value is None else "(none)" if value == () else str(value)


def _place(one: MapDifference) -> str:
    """Name of a map and the centre of the cell with the largest difference."""
    return one.robot_id if one.largest_at is None else f"{one.robot_id} at {_point(one.largest_at)}"


def _point(point: Point | None) -> str:
    """Coordinates as text."""
    return "" if point is None else ", ".join(f"{value:g}" for value in point)
