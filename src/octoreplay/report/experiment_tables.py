"""Results of the experiments as tables: Markdown from the rows of sweeps, and the paper's numbers for the terminal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rich.table import Table

from octoreplay.config.rules import RULES
from octoreplay.report import tables

Row = Mapping[str, Any]
Tables = Mapping[str, Sequence[Row]]
"""Rows of an experiment's sweeps, by the name of the plan."""

Key = tuple[Any, ...]

_IOUS = ("mean_iou", "central_mean_iou")
_SCHEDULES = {("0.5", "0"): "γ 0.5", ("1", "0"): "γ 1", ("1", "1"): "γ 1/k"}


class Column(NamedTuple):
    """Column of a table: heading, and function from a group of rows to text."""

    heading: str
    text: Callable[[Sequence[Row]], str]


def answer_tables(name: str, found: Tables) -> str:
    """Return the results of an experiment as Markdown tables."""
    makers = {"rules": _rules, "steps": _steps, "scale": _scale, "noise": _noise, "choose": _choose}
    return "\n".join(makers[name](found)) + "\n"


def paper_table(moments: Sequence[Row]) -> Table:
    """Table of the paper's experiment: one column per moment, given by the fields of ``study.paper.Moment``."""
    table = tables.styled_table("The paper's experiment")
    table.add_column("")
    for moment in moments:
        table.add_column(f"{moment['seconds']:.0f} s", justify="right")
    rows: tuple[tuple[str, str, Callable[[float], str]], ...] = (
        ("total distance Φ", "total_distance", tables.number),
        ("Φ per pair / squared norm of a map", "relative_distance", tables.share),
        ("known cells", "num_known_cells", "{:,}".format),
        ("cells with different labels", "label_disagreement", tables.share),
        ("agreement, worst robot, all cells", "agreement", tables.share),
        ("agreement, worst robot, occupied cells", "agreement_occupied", tables.share),
        ("map as uniform grid", "grid_bytes", tables.size),
        ("map as octree", "octree_bytes", tables.size),
        ("uniform grid / octree", "ratio", "{:.2f}".format),
    )
    for heading, name, text in rows:
        table.add_row(heading, *(text(moment[name]) for moment in moments))
    return table


def groups(rows: Sequence[Row], *names: str) -> dict[Key, list[Row]]:
    """Group rows with equal values in some columns, in the order of first occurrence."""
    found: dict[Key, list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in names), []).append(row)
    return found


def mean(rows: Sequence[Row], name: str) -> float:
    """Mean of a column over the rows that have a number in it; NaN without any."""
    values = [float(row[name]) for row in rows if row.get(name) is not None and not math.isnan(float(row[name]))]
    return sum(values) / len(values) if values else math.nan


SITUATIONS = ("good_radio", "poor_radio", "many_robots")
"""Plans of the experiment ``choose``, in order."""

NOISES = ("label_noise", "pose_noise", "depth_noise")
"""Kinds of noise; the experiment varies one at a time."""


def of_noise(rows: Sequence[Row], kind: str) -> list[Row]:
    """Rows in which only this kind of noise is varied, in ascending order."""
    usual = {name: Counter(row[name] for row in rows).most_common(1)[0][0] for name in NOISES if name != kind}
    found = [row for row in rows if all(row[name] == value for name, value in usual.items())]
    return sorted(found, key=lambda row: float(row[kind]))


def variant(row: Row) -> str:
    """Name of a rule, with its evidence and gamma where it has a gradient step."""
    if not RULES[row["rule"]].has_gamma:
        return str(row["rule"])
    return f"{row['rule']}, {row['evidence']}, {_SCHEDULES[row['gamma'], row['gamma_power']]}"


def _rules(found: Tables) -> Iterator[str]:
    """Yield the tables of the experiment ``rules``, one per graph."""
    for (topology,), rows in groups(found["rules"], "topology").items():
        yield f"**{topology}**\n"
        columns = (
            Column("Φ over all pairs, end of the logs", _number("total_distance_all_log_end")),
            Column("Φ, settled", _number("total_distance_all")),
            Column(
                "agreement over the logs, all / occupied",
                _pair("agreement_mean", "agreement_occupied_mean"),
            ),
            Column("agreement, settled", _pair("agreement", "agreement_occupied")),
            Column("mean IoU", _share("mean_iou", 3)),
            Column("mean IoU of the oracle", _share("central_mean_iou", 3)),
            Column("kB per robot and second", _kilobytes("sent_bytes_per_second")),
            Column("ticks to consensus", _ticks),
        )
        yield from _table(
            "rule, evidence, steps",
            columns,
            {(variant(r[0]),): r for r in _by_variant(rows)} | {("central, the oracle",): _oracle(rows)},
        )


def _oracle(rows: Sequence[Row]) -> list[Row]:
    """Rows of a rule that gives every robot the centralised map of summed evidence."""
    same = {"total_distance_all_log_end": 0.0, "total_distance_all": 0.0, "ticks_to_consensus": 0.0}
    agreements = ("agreement_mean", "agreement_occupied_mean", "agreement", "agreement_occupied")
    return [
        {**same, **dict.fromkeys(agreements, 1.0), **dict.fromkeys(_IOUS, row["central_mean_iou"])}
        for row in with_summed_evidence(rows)
    ]


def with_summed_evidence(rows: Sequence[Row]) -> list[Row]:
    """Rows of runs with summed evidence, whose centralised map is the oracle."""
    return [row for row in rows if row["evidence"] in ("sum", "-")]


def _by_variant(rows: Sequence[Row]) -> list[list[Row]]:
    """Rows grouped by rule, evidence and gamma."""
    return list(groups(rows, "rule", "evidence", "gamma", "gamma_power").values())


def _steps(found: Tables) -> Iterator[str]:
    """Yield the table of the experiment ``steps``."""
    columns = (
        Column("epsilon / bound", _share("epsilon_share", 2)),
        Column("factor of Φ per tick", _share("contraction", 4)),
        Column("factor in theory", _share("contraction_theory", 4)),
        Column("ticks to consensus", _ticks),
    )
    yield from _table("graph, epsilon", columns, groups(found["bound"], "topology", "epsilon"))


def _scale(found: Tables) -> Iterator[str]:
    """Yield the tables of the experiment ``scale``."""
    columns = (
        Column("real-time factor", _number("realtime_factor")),
        Column("peak memory", _megabytes("peak_rss_bytes")),
        Column("largest memory of a robot", _megabytes("memory_bytes")),
        Column("kB per robot and second", _kilobytes("sent_bytes_per_second")),
        Column("leaves per map", _number("num_leaves")),
    )
    for plan, names in (
        ("robots", ("num_robots", "topology", "resolution")),
        ("resolution", ("resolution", "rule")),
        ("classes", ("num_classes", "rule")),
    ):
        yield from _table(", ".join(names), columns, groups(found[plan], *names))


def _noise(found: Tables) -> Iterator[str]:
    """Yield the tables of the experiment ``noise``, one per kind of noise."""
    columns = (
        Column("mean IoU", _share("mean_iou", 3)),
        Column("mean IoU of known cells", _share("mean_iou_known", 3)),
        Column("wrong before", _percent("wrong")),
        Column("corrected", _percent("repaired")),
        Column("made wrong", _percent("spread")),
        Column("calibration error", _share("calibration_error_occupied", 3)),
        Column("centralised mean IoU", _share("central_mean_iou", 3)),
    )
    for kind in NOISES:
        yield from _table(
            f"{kind.replace('_', ' ')}, rule", columns, groups(of_noise(found["noise"], kind), kind, "rule")
        )


def _choose(found: Tables) -> Iterator[str]:
    """Yield the tables of the experiment ``choose``, one per situation."""
    columns = (
        Column("agreement over the logs, all / occupied", _pair("agreement_mean", "agreement_occupied_mean")),
        Column("agreement, settled", _pair("agreement", "agreement_occupied")),
        Column("mean IoU", _share("mean_iou", 3)),
        Column("kB per robot and second", _kilobytes("sent_bytes_per_second")),
        Column("ticks to consensus", _ticks),
        Column("largest memory of a robot", _megabytes("memory_bytes")),
    )
    for plan in SITUATIONS:
        yield f"**{plan.replace('_', ' ')}**\n"
        yield from _table("rule, packets, content", columns, groups(found[plan], "rule", "packets", "content"))


def _table(title: str, columns: Sequence[Column], rows: Mapping[Key, Sequence[Row]]) -> Iterator[str]:
    """Yield the lines of a Markdown table with one line per group of rows."""
    yield f"| {' | '.join([title, *(column.heading for column in columns)])} |"
    yield f"|---{'|---:' * len(columns)}|"
    for key, group in rows.items():
        yield f"| {' | '.join([', '.join(map(_named, key)), *(column.text(group) for column in columns)])} |"
    yield ""


def _named(value: Any) -> str:
    """Part of a line's name, equal for a number and for its text."""
    try:
        return f"{float(value):g}"
    except ValueError:
        return str(value)


def _number(name: str) -> Callable[[Sequence[Row]], str]:
    """Text of the mean of a column."""
    return lambda rows: _short(mean(rows, name))


def _share(name: str, digits: int) -> Callable[[Sequence[Row]], str]:
    """Text of the mean of a column with fixed digits."""
    return lambda rows: _fixed(mean(rows, name), digits)


def _percent(name: str) -> Callable[[Sequence[Row]], str]:
    """Text of the mean of a share in per cent."""
    return lambda rows: "-" if math.isnan(value := mean(rows, name)) else f"{100 * value:.2f} %"


def _pair(first: str, second: str) -> Callable[[Sequence[Row]], str]:
    """Text of the means of two shares."""
    return lambda rows: f"{_fixed(mean(rows, first), 4)} / {_fixed(mean(rows, second), 4)}"


def _kilobytes(name: str) -> Callable[[Sequence[Row]], str]:
    """Text of the mean of a column of bytes, in kilobytes."""
    return lambda rows: _short(mean(rows, name) / 1e3)


def _megabytes(name: str) -> Callable[[Sequence[Row]], str]:
    """Text of the mean of a column of bytes, in megabytes."""
    return lambda rows: "-" if math.isnan(value := mean(rows, name)) else f"{value / 1e6:,.0f} MB"


def _ticks(rows: Sequence[Row]) -> str:
    """Mean number of ticks if all runs reached consensus, else the number of runs that did not."""
    never = sum(math.isnan(float(row["ticks_to_consensus"])) for row in rows)
    if never:
        return "never" if never == len(rows) else f"never in {never} of {len(rows)}"
    return _short(mean(rows, "ticks_to_consensus"))


def _fixed(value: float, digits: int) -> str:
    """Number with fixed digits, a dash for NaN."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _short(value: float) -> str:
    """Number with three digits, as a power of ten where it is very small or large."""
    if math.isnan(value):
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:,.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.3g}"
    return f"{value:.1e}"
