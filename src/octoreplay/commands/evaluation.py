"""Command that evaluates the maps of a result: evaluate."""

from __future__ import annotations

from pathlib import Path

import click

from octoreplay.commands.options import check_folder, check_output, existing_path, map_option
from octoreplay.commands.progress import progress_bar, warn
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
@click.option("--json", type=existing_path, metavar="FILE.json", help="write the same scores as JSON")
@click.option("--plot", type=existing_path, metavar="DIR",
              help="write figures of IoU, coverage, calibration and agreement into this folder")  # fmt: skip
@click.option("--last", is_flag=True, help="evaluate only the last stored maps, which is faster")
def evaluate(
    result: Path, truth: Path | None, against: str, map_kind: str, csv: Path | None, json: Path | None,
    plot: Path | None, last: bool,
) -> int:  # fmt: skip
    """Evaluate the maps of a result, over time and at the end.

    With --truth: IoU per class, occupied and free cells found, coverage of the surface, calibration of the
    probabilities. Without it only scores that need no ground truth: entropy, agreement with the centralised map,
    disputed labels, contradiction of the robots' evidence.
    """
    from octoreplay.evaluate.evaluation import evaluate_result, truth_beside_logs
    from octoreplay.report import tables
    from octoreplay.report.evaluation_files import write_evaluation
    from octoreplay.report.evaluation_plots import write_evaluation_figures
    from octoreplay.report.evaluation_tables import evaluation_tables
    from octoreplay.result import open_result

    inputs = [result, *([truth] if truth is not None else []), Path(against)]
    for path, suffix in ((csv, ".csv"), (json, ".json")):
        if path is not None:
            check_output(path, suffix, inputs)
    if plot is not None:
        check_folder(plot)
    out, err = tables.terminal(), tables.terminal(stderr=True)
    with open_result(result) as opened:
        if not opened.is_complete:
            warn(err, f"{result}: the run was interrupted; only the maps stored before are evaluated")
    with progress_bar("evaluate") as update:
        evaluation = evaluate_result(
            result, truth=truth, against=against, map_kind=map_kind, over_time=not last,
            progress=lambda share: update(share, None, ""),
        )  # fmt: skip
    tables.show(out, evaluation_tables(evaluation))
    for sentence in evaluation.warnings:
        warn(err, sentence)
    if truth is None:
        beside = truth_beside_logs(result)
        found = "" if beside is None else f"; found beside the logs: {beside}"
        err.print(f"IoU, coverage and calibration need the ground truth: --truth WORLD{found}", soft_wrap=True)
    write_evaluation(evaluation, csv_path=csv, json_path=json)
    written = [path for path in (csv, json) if path is not None]
    if plot is not None:
        written += write_evaluation_figures(evaluation, plot)
    for path in written:
        click.echo(f"wrote {path}")
    return 0
