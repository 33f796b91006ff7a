"""Comparisons of settings over teams: means, paired differences with intervals, and their tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from octoreplay.report.intervals import CONFIDENCE, MIN_TEAMS, NUM_RESAMPLES, Interval, interval

Row = Mapping[str, Any]
Tables = Mapping[str, Sequence[Row]]
"""Rows of an experiment's runs, by the name of the plan."""
Label = Callable[[Row], str]
"""Function that gives the name of a run's settings."""

TEAM = "village"
"""Column of the number that names a run's team; runs of equal numbers are paired."""


def short(value: float) -> str:
    """Number with three digits, as a power of ten where it is very small or large; a dash for NaN."""
    if math.isnan(value):
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:,.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.3g}"
    return f"{value:.1e}"


class Measure(NamedTuple):
    """Number of a run that is compared.

    Attributes
    ----------
    heading : str
        Heading of its column.
    column : str
        Column of the runs' tables.
    digits : int or None
        Number of decimals; None for three significant digits.
    factor : float
        Factor from the column's unit to that of the heading.
    is_ratio : bool
        True to compare by quotients in place of differences.
    """

    heading: str
    column: str
    digits: int | None = 4
    factor: float = 1.0
    is_ratio: bool = False

    def text(self, value: float) -> str:
        """Return a value in the unit of the heading as text; a dash for NaN."""
        if self.digits is None or math.isnan(value):
            return short(value)
        return f"{value:.{self.digits}f}"

    def change_text(self, change: Interval) -> str:
        """Return a difference or quotient with its interval as text; a star where it is no accident."""
        if math.isnan(change.mean):
            return "-"
        texts = [self._one_change(value) for value in change]
        if math.isnan(change.low):
            return texts[0]
        star = " \\*" if change.excludes(1.0 if self.is_ratio else 0.0) else ""
        return f"{texts[0]} [{texts[1]}, {texts[2]}]{star}"

    def _one_change(self, value: float) -> str:
        """One difference or quotient as text."""
        if self.is_ratio:
            return f"{value:.3g}"
        if self.digits is None:
            return f"{'+' if value > 0 else ''}{short(value)}"
        return f"{value:+.{self.digits}f}"


KILOBYTES = Measure("kB per robot and second", "sent_bytes_per_second", None, 1e-3, is_ratio=True)


@dataclass(frozen=True)
class Comparison:
    """Comparison of the runs of one plan.

    Attributes
    ----------
    plan : str
        Name of the plan.
    heading : str
        Meaning of the labels.
    label : function
        Name of a run's settings.
    measures : tuple of Measure
        Numbers that are compared.
    baseline : str or None
        Label that the others are compared with; None for means alone.
    section : str or None
        Column by whose values the runs are divided into tables; comparisons stay within a table.
    unit : str
        Noun for what the column TEAM numbers.
    title : str
        Title of the tables, which tells them from those of the question's other comparisons.
    """

    plan: str
    heading: str
    label: Label
    measures: tuple[Measure, ...]
    baseline: str | None = None
    section: str | None = None
    unit: str = "village"
    title: str = ""

    def sections(self, found: Tables) -> dict[str, dict[str, list[Row]]]:
        """Return the rows of each section by label, in the order of first occurrence."""
        parts: dict[str, dict[str, list[Row]]] = {}
        for row in found[self.plan]:
            section = "" if self.section is None else str(row[self.section])
            parts.setdefault(section, {}).setdefault(self.label(row), []).append(row)
        return parts

    def change(self, measure: Measure, rows: Sequence[Row], others: Sequence[Row]) -> Interval:
        """Return the mean difference, or quotient, of ``rows`` to ``others`` of the same teams, with its interval."""
        values, baselines = by_team(rows, measure.column), by_team(others, measure.column)
        pairs = [(value, baselines[team]) for team, value in values.items() if team in baselines]
        if measure.is_ratio:
            return interval([value / base if base else math.nan for value, base in pairs])
        return interval([(value - base) * measure.factor for value, base in pairs])


def by_team(rows: Sequence[Row], column: str) -> dict[str, float]:
    """Mean of a column over the runs of each team; runs without a number are left out."""
    values: dict[str, list[float]] = {}
    for row in rows:
        if row.get(column) not in (None, "") and not math.isnan(float(row[column])):
            values.setdefault(str(row[TEAM]), []).append(float(row[column]))
    return {team: sum(found) / len(found) for team, found in values.items()}


def mean_over_teams(rows: Sequence[Row], measure: Measure) -> Interval:
    """Mean of a measure over the teams, in the unit of its heading, with its interval."""
    return interval([value * measure.factor for value in by_team(rows, measure.column).values()])


class TextTable(NamedTuple):
    """Table of texts: a title, headings, lines with as many texts, and a caption."""

    title: str
    headings: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    caption: str


def tables_of(comparison: Comparison, found: Tables) -> Iterator[TextTable]:
    """Yield a table for each section of a comparison."""
    for section, parts in comparison.sections(found).items():
        baseline = parts.get(comparison.baseline or "")
        headings = [comparison.heading]
        for measure in comparison.measures:
            headings.append(measure.heading)
            if baseline is not None:
                headings.append(f"{'/' if measure.is_ratio else '-'} {comparison.baseline}")
        lines = []
        for label, rows in parts.items():
            line = [label]
            for measure in comparison.measures:
                mean = mean_over_teams(rows, measure)
                if baseline is None and not math.isnan(mean.low):
                    line.append(f"{measure.text(mean.mean)} [{measure.text(mean.low)}, {measure.text(mean.high)}]")
                else:
                    line.append(measure.text(mean.mean))
                if baseline is not None:
                    is_itself = label == comparison.baseline
                    line.append("" if is_itself else measure.change_text(comparison.change(measure, rows, baseline)))
            lines.append(tuple(line))
        every = [row for rows in parts.values() for row in rows]
        caption = _caption(every, comparison.unit, has_changes=baseline is not None)
        title = ", ".join(part for part in (comparison.title, section) if part)
        yield TextTable(title, tuple(headings), tuple(lines), caption)


def _caption(rows: Sequence[Row], unit: str, *, has_changes: bool) -> str:
    """Number of runs, their teams, and what the intervals are."""
    teams = sorted({int(row[TEAM]) for row in rows})
    listed = f"{teams[0]} to {teams[-1]}" if len(teams) > 1 else f"{teams[0]}"
    durations = sorted({round(float(row["log_seconds"])) for row in rows})
    span = f"{durations[0]} s" if len(durations) == 1 else f"{durations[0]} to {durations[-1]} s"
    noun = unit if len(teams) == 1 else f"{unit}s"
    text = f"{len(rows)} runs of {span}, {len(teams)} {noun} (seed {listed})."
    if len(teams) < MIN_TEAMS:
        return text
    what = f"differences and quotients within each {unit}" if has_changes else "means"
    text += f" In brackets: {CONFIDENCE:.0%} bootstrap intervals of {what} ({NUM_RESAMPLES:,} resamples)."
    return text + (" \\*: the interval excludes equality." if has_changes else "")


def markdown(table: TextTable) -> str:
    """Return a table as Markdown, with its title above and its caption below."""
    lines = [f"**{table.title}**\n"] if table.title else []
    lines.append(f"| {' | '.join(table.headings)} |")
    lines.append(f"|---{'|---:' * (len(table.headings) - 1)}|")
    lines.extend(f"| {' | '.join(line)} |" for line in table.lines)
    return "\n".join([*lines, "", f"*{table.caption}*", ""])


def latex(table: TextTable) -> str:
    """Return a table as LaTeX with the rules of the package booktabs."""
    caption = ". ".join(part for part in (table.title, table.caption) if part)
    rows = [" & ".join(map(_tex, line)) + r" \\" for line in (table.headings, *table.lines)]
    return "\n".join(
        (
            r"\begin{table}", rf"\caption{{{_tex(caption)}}}", r"\centering",
            rf"\begin{{tabular}}{{l{'r' * (len(table.headings) - 1)}}}", r"\toprule", rows[0], r"\midrule",
            *rows[1:], r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
        )
    )  # fmt: skip


_TEX = {
    "\\*": r"$^*$", "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "γ": r"$\gamma$", "ε": r"$\epsilon$",
    "Φ": r"$\Phi$", "φ": r"$\phi$", "ψ": r"$\psi$", "²": r"$^2$", "`": "",
}  # fmt: skip


def _tex(text: str) -> str:
    """Text with the characters that LaTeX treats in a special way, and Greek letters, escaped."""
    star = text.replace("\\*", "\0")
    return "".join(_TEX["\\*"] if letter == "\0" else _TEX.get(letter, letter) for letter in star)
