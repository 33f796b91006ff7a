"""Commands with a verdict as exit code: check, compare."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_ERROR
from octoreplay.commands.options import existing_path, map_option
from octoreplay.evaluate.checks import LIMITS, check_result


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
@prints
def check(result: Path, settled: bool, truth: Path | None, map_kind: str, **options: float | None) -> int:
    """Check a result against limits, for continuous integration.

    Exit code 0 if all limits hold, 1 if one is violated. The result of an interrupted run fails.
    """
    from octoreplay.report import verdict_tables

    limits = {name: limit for name, limit in options.items() if limit is not None}
    rows = check_result(result, limits, settled=settled, truth=truth, map_kind=map_kind)
    passed = all(row.passed for row in rows)
    here = terminal()
    here.show(verdict_tables.check_rows(rows))
    here.line(verdict_tables.check_verdict(rows))
    here.give(result=result, passed=passed, rows=rows)
    return 0 if passed else EXIT_ERROR


@click.command(short_help="Compare the maps of two results; exit code 1 if they differ.")
@click.argument("a", type=existing_path, metavar="A.mcap")
@click.argument("b", type=existing_path, metavar="B.mcap")
@click.option("--robot", default=None, metavar="ID", help="robot id, or 'central'  [default: all maps]")
@click.option("--at", type=float, default=None, metavar="SECONDS",
              help="time of the maps since each run's start [s]  [default: the end]")  # fmt: skip
@click.option("--tolerance", type=float, default=0.0, show_default=True,
              help="largest difference of log-odds that counts as equal")  # fmt: skip
@prints
def compare(a: Path, b: Path, **options: Any) -> int:
    """Compare the maps of two results and show where and by how much they differ.

    Exit code 0 if all maps are equal, 1 otherwise.
    """
    from octoreplay.evaluate.comparison import compare_results
    from octoreplay.report import verdict_tables

    comparison = compare_results(a, b, **options)
    here = terminal()
    here.show(*verdict_tables.comparison(comparison, is_verbose=here.is_verbose))
    here.line(verdict_tables.comparison_verdict(comparison))
    here.give(**vars(comparison))
    return 0 if comparison.is_same else EXIT_ERROR
