"""Command that evaluates the maps of a result: evaluate."""

from __future__ import annotations

from pathlib import Path

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.options import (
    check_new_folder,
    check_output,
    existing_path,
    force_option,
    lock_folder,
    map_option,
)
from octoreplay.commands.progress import progress_bar
from octoreplay.records import CENTRAL


@click.command(short_help="Evaluate a result's maps: IoU, coverage, calibration, agreement.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("--truth", type=existing_path, metavar="WORLD",
              help="ground truth: world.npz, the folder of a simulated team, or a labelled PLY file")  # fmt: skip
@click.option("--against", default=CENTRAL, show_default=True, metavar="central|OTHER.mcap",
              help="centralised map to compare with: that of this result, or of another one")  # fmt: skip
@map_option
@click.option("--csv", type=existing_path, metavar="FILE.csv",
              help="write the scores of every map at every stored tick as CSV")  # fmt: skip
@click.option("--plot", type=existing_path, metavar="DIR",
              help="write figures of IoU, coverage, calibration and agreement into this folder")  # fmt: skip
@click.option("--last", is_flag=True, help="evaluate only the last stored maps, which is faster")
@force_option
@prints
def evaluate(
    result: Path, truth: Path | None, against: str, map_kind: str, csv: Path | None, plot: Path | None,
    last: bool,
) -> int:  # fmt: skip
    """Evaluate the maps of a result, over time and at the end.

    With --truth: IoU per class, occupied and free cells found, coverage of the surface, calibration of the
    probabilities. Without it only scores that need no ground truth: entropy, agreement with the centralised map,
    disputed labels, contradiction of the robots' evidence.
    """
    inputs = [result, *([truth] if truth is not None else []), Path(against)]
    if csv is not None:
        check_output(csv, ".csv", inputs)
    if plot is not None:
        check_new_folder(plot)
        lock_folder(plot)

    from octoreplay.evaluate.evaluation import evaluate_result, truth_beside_logs
    from octoreplay.report.evaluation_files import evaluation_content, write_evaluation
    from octoreplay.report.evaluation_plots import write_evaluation_figures
    from octoreplay.report.evaluation_tables import evaluation_tables

    here = terminal()
    with progress_bar("evaluate") as update:
        evaluation = evaluate_result(
            result, truth=truth, against=against, map_kind=map_kind, over_time=not last,
            progress=lambda share: update(share, None, ""),
        )  # fmt: skip
    here.show(evaluation_tables(evaluation, is_verbose=here.is_verbose))
    content = evaluation_content(evaluation)
    for sentence in content.pop("warnings"):
        here.warn(sentence)
    if truth is None:
        beside = truth_beside_logs(result)
        found = "" if beside is None else f"; found beside the logs: {beside}"
        here.note(f"IoU, coverage and calibration need the ground truth: --truth WORLD{found}")
    written: list[Path] = []
    if csv is not None:
        write_evaluation(evaluation, csv)
        written.append(csv)
    if plot is not None:
        written += write_evaluation_figures(evaluation, plot)
    for path in written:
        here.line(f"wrote {path}")
    here.give(**content, written=written)
    return 0
