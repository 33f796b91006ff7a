"""Command that runs combinations of settings: sweep."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST, EXIT_ERROR
from octoreplay.commands.options import SectionedCommand, existing_path, lock_folder, preset_option, with_parameters
from octoreplay.commands.progress import progress_bar

if TYPE_CHECKING:
    from octoreplay.study.sweep import Sweep, SweepProgress


@with_parameters()
@click.command(cls=SectionedCommand, short_help="Run every combination of settings and write one table.")
@click.argument("teams", nargs=-1, required=True, type=existing_path, metavar="TEAM.yaml...")
@click.option(
    "-o", "--output", type=existing_path, required=True, metavar="DIR", help="folder for the table and figures"
)
@click.option("--vary", multiple=True, metavar="NAME=V1,V2,...",
              help="parameter and its values, or NAME+NAME=V1+V1,V2+V2,... to vary several together; may be"
                   " repeated")  # fmt: skip
@click.option("--seeds", type=int, metavar="N", help="run every combination with network_seed 0 to N - 1")
@click.option("--truth", type=existing_path, metavar="FILE",
              help="evaluate against this ground truth, relative to each team file or the working folder")  # fmt: skip
@click.option("--keep", is_flag=True, help="keep the result of every run in DIR/runs")
@click.option("--jobs", type=int, metavar="N",
              help="number of parallel runs on this machine  [default: processors / threads]")  # fmt: skip
@click.option("--threads", type=int, default=1, show_default=True, metavar="N", help="number of threads of each run")
@click.option("--scheduler", metavar="tcp://HOST:PORT",
              help="address of a dask scheduler; runs are executed on its workers instead of this machine")  # fmt: skip
@preset_option
@prints
def sweep(
    teams: tuple[Path, ...], output: Path, vary: tuple[str, ...], seeds: int | None, truth: Path | None, keep: bool,
    jobs: int | None, threads: int, scheduler: str | None, preset: str | None, **parameters: Any,
) -> int:  # fmt: skip
    """Run every combination of teams and settings, and write one table and figures into DIR.

    Runs that are already finished in DIR are not repeated, so the same command continues after an interruption. A
    failed run does not stop the others.
    """
    lock_folder(output)

    from octoreplay.study.sweep import run_sweep

    with progress_bar("sweep") as update:

        def show(progress: SweepProgress) -> None:
            update(progress.num_finished / progress.num_runs, None, _stage(progress))

        done = run_sweep(
            teams, vary, output, settings={**parameters, "preset": preset}, num_seeds=seeds, truth=truth, keep=keep,
            num_jobs=jobs, num_threads=threads, scheduler=scheduler, progress=show,
        )  # fmt: skip
    here = terminal()
    earlier = f", {done.num_earlier} of them before" if done.num_earlier else ""
    for sentence in done.warnings:
        here.warn(sentence)
    here.line(f"wrote {done.table} ({len(done.rows)} runs{earlier}), figures in {output / 'figures'}")
    here.give(table=done.table, num_runs=len(done.rows), num_failed=len(done.failed), lost_data=done.lost_data,
              runs=done.rows)  # fmt: skip
    return _end(done)


def _stage(progress: SweepProgress) -> str:
    """Text of a sweep's progress."""
    from octoreplay.report.tables import seconds

    left = progress.num_runs - progress.num_finished
    failed = f", {progress.num_failed} failed" if progress.num_failed else ""
    time = f", about {seconds(progress.seconds_left)}" if left and math.isfinite(progress.seconds_left) else ""
    return f"{progress.num_finished} of {progress.num_runs} runs{failed}, {left} left{time}"


def _end(done: Sweep) -> int:
    """Report the failed runs and return the exit code."""
    names = ("team", *done.names, "seed")
    for row in done.failed:
        terminal().warn(f"failed: {', '.join(f'{name}={row[name]}' for name in names)}: {row['error']}")
    if done.failed:
        return EXIT_ERROR
    return EXIT_DATA_LOST if done.lost_data else 0
