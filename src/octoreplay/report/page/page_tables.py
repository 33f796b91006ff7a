"""Tables of the page: results, settings, inputs, frames and warnings."""

from __future__ import annotations

from html import escape

from octoreplay.config.parameters import PARAMETERS, SECTIONS
from octoreplay.errors import counted, escaped
from octoreplay.evaluate.verdict import run_verdict
from octoreplay.report import tables as terminal_tables
from octoreplay.report.alignment_tables import FrameRow, frames_table
from octoreplay.report.page.html_tables import html_of, html_table
from octoreplay.result import Result
from octoreplay.transforms import transform_of


def verdict(result: Result) -> str:
    """Return the verdict on a run as an HTML description list, with the end of an incomplete run."""
    summary = result.summary
    robots = counted(len(result.robots), "robot")
    rows = [("logs", f"{robots}, {terminal_tables.seconds(summary.log_seconds)}")]
    if not result.is_complete:
        rows.append(("incomplete", result.extent))
    rows += terminal_tables.verdict_rows(run_verdict(summary))
    items = (f"<div><dt>{name}</dt><dd>{escape(escaped(text))}</dd></div>" for name, text in rows)
    return f"<dl>{''.join(items)}</dl>".replace("\n", "; ")


def tables(result: Result) -> str:
    """Return all tables as HTML."""
    summary = result.summary
    results = terminal_tables.results(summary, num_warnings=len(summary.warnings))
    return "".join(
        [
            _section("Warnings", _warnings(summary.warnings), is_open=True) if summary.warnings else "",
            _section("Results", html_of(results), is_open=True),
            _section("Frames", _frames(result)),
            _section("Contradiction of evidence", html_of(terminal_tables.pairs_table(summary.last.pairs)))
            if summary.last.pairs else "",
            _section("Settings", _settings(result)),
            _section("Inputs", _inputs(result)),
        ]
    )  # fmt: skip


def _section(title: str, content: str, *, is_open: bool = False) -> str:
    """Section that can be folded."""
    return f"<details{' open' if is_open else ''}><summary>{escape(title)}</summary>{content}</details>"


def _warnings(warnings: tuple[str, ...]) -> str:
    """List of warnings."""
    return f"<ul>{''.join(f'<li>{escape(escaped(warning))}</li>' for warning in warnings)}</ul>"


def _frames(result: Result) -> str:
    """Tables of the robots' frames, with the evidence for those that were found, and of joins during the run."""
    robots = {robot.robot_id: robot for robot in result.config.robots}
    origins = result.summary.frame_origins
    rows = [
        FrameRow(
            name, transform_of(place.T_frame_map), robots[name].T_team_map_sigma, origins.get(name, place.frame_id)
        )
        for name, place in result.places.items()
    ]
    found = html_of(frames_table(rows, ""))
    if result.summary.joins:
        joins = [
            (f"{join.seconds:g} s", f"{join.first}, {join.second}", ", ".join(join.moved), f"{join.score:.0f}")
            for join in result.summary.joins
        ]
        found += html_table("Joins during the run", ("time", "found between", "moved", "L"), joins)
    return found


def _settings(result: Result) -> str:
    """Table of all parameters; those that differ from the defaults are first."""
    rows = []
    for name, parameter in PARAMETERS.items():
        value = getattr(getattr(result.config, parameter.section), name)
        is_default = value == parameter.default
        rows.append((is_default, (name, _text(value), parameter.unit, "" if is_default else _text(parameter.default),
                                  SECTIONS[parameter.section].title)))  # fmt: skip
    rows.sort(key=lambda row: row[0])
    titles = ("parameter", "value", "unit", "default, where it differs", "section")
    return html_table("", titles, [cells for _, cells in rows])


def _inputs(result: Result) -> str:
    """Table of the input files."""
    rows = [
        (escaped(name), terminal_tables.size(size), f"{method} {value}")
        for name, (size, method, value) in result.inputs.items()
    ]
    return html_table("", ("file", "size", "fingerprint"), rows)


def _text(value: object) -> str:
    """Value of a parameter."""
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    return "-" if value is None else escaped(f"{value:g}" if isinstance(value, float) else str(value))
