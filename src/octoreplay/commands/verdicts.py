"""Commands with a verdict as exit code: check, compare."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from octoreplay.commands.exit_codes import EXIT_ERROR
from octoreplay.commands.options import check_output, existing_path, map_option
from octoreplay.evaluate.checks import LIMITS, check_result

_json_option = click.option("--json", "json_file", type=existing_path, metavar="FILE.json",
                            help="write the table as JSON")  # fmt: skip


def _with_limits(command: Callable[..., int]) -> Callable[..., int]:
    """Add an option for every limit to a command."""
    for name, quantity in reversed(LIMITS.items()):
        option = f"--{name.replace('_', '-')}"
        command = click.option(option, name, type=float, metavar="LIMIT", help=quantity.meaning)(command)
    return command


@click.command(short_help="Check a result against limits; exit code 1 if one is violated.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@_with_limits
@click.option("--settled", is_flag=True, help="the maps must have settled at the end")
@click.option("--truth", type=existing_path, metavar="WORLD",
              help="ground truth for limits that need it: world.npz, its folder, or a labelled PLY file")  # fmt: skip
@map_option
@_json_option
def check(
    result: Path, settled: bool, truth: Path | None, map_kind: str, json_file: Path | None, **options: float | None
) -> int:
    """Check a result against limits, for continuous integration.

    Exit code 0 if all limits hold, 1 if one is violated. The result of an interrupted run fails.
    """
    from octoreplay.io.text_files import json_text, write_whole
    from octoreplay.report import tables, verdict_tables

    limits = {name: limit for name, limit in options.items() if limit is not None}
    if json_file is not None:
        check_output(json_file, ".json", [result])
    rows = check_result(result, limits, settled=settled, truth=truth, map_kind=map_kind)
    passed = all(row.passed for row in rows)
    if json_file is not None:
        write_whole(json_file, json_text({"result": result, "passed": passed, "rows": rows}))
    out = tables.terminal()
    tables.show(out, verdict_tables.check_rows(rows))
    out.print(verdict_tables.check_verdict(rows), soft_wrap=True)
    return 0 if passed else EXIT_ERROR


@click.command(short_help="Compare the maps of two results; exit code 1 if they differ.")
@click.argument("a", type=existing_path, metavar="A.mcap")
@click.argument("b", type=existing_path, metavar="B.mcap")
@click.option("--robot", default=None, metavar="ID", help="robot id, or 'central'  [default: all maps]")
@click.option("--at", type=float, default=None, metavar="SECONDS",
              help="time of the maps since each run's start [s]  [default: the end]")  # fmt: skip
@click.option("--tolerance", type=float, default=0.0, show_default=True,
              help="largest difference of log-odds that counts as equal")  # fmt: skip
@_json_option
def compare(a: Path, b: Path, json_file: Path | None, **options: Any) -> int:
    """Compare the maps of two results and show where and by how much they differ.

    Exit code 0 if all maps are equal, 1 otherwise.
    """
    from octoreplay.evaluate.comparison import compare_results
    from octoreplay.io.text_files import json_text, write_whole
    from octoreplay.report import tables, verdict_tables

    if json_file is not None:
        check_output(json_file, ".json", [a, b])
    comparison = compare_results(a, b, **options)
    if json_file is not None:
        write_whole(json_file, json_text(comparison))
    out = tables.terminal()
    tables.show(out, *verdict_tables.comparison(comparison))
    out.print(verdict_tables.comparison_verdict(comparison), soft_wrap=True)
    return 0 if comparison.is_same else EXIT_ERROR
