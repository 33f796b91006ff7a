"""Command that shows the whole way from logs to a map: demo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from octoreplay.commands.aligning import align_with_bar, evidence_with_bar
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import existing_path
from octoreplay.commands.progress import replay_with_bar, show_warnings, simulate_with_bar, warn
from octoreplay.commands.team_options import save_team_file

if TYPE_CHECKING:
    from rich.console import Console

    from octoreplay.config.resolved import ResolvedRun
    from octoreplay.replay.alignment import Alignment
    from octoreplay.run_metrics import PairMetrics


@click.command(short_help="Simulate a team, find its frames, replay it and export its map.")
@click.argument("folder", type=existing_path, metavar="[DIR]", default=Path("octoreplay-demo"), required=False)
@click.option("--robots", type=click.IntRange(min=2), default=6, show_default=True, help="number of robots in the team")
@click.option("--duration", type=float, default=60.0, show_default=True, help="length of the logs [s]")
@click.option("--seed", type=int, default=0, show_default=True, help="seed of the village and of all noise")
def demo(folder: Path, robots: int, duration: float, seed: int) -> int:
    """Simulate a team, find its frames, replay it, and export its map and figures into DIR (default: octoreplay-demo).

    The robots' logs are in frames of their own, as those of real robots. Takes about two minutes. Lists the files
    written and the programs that open them.
    """
    from octoreplay.report import export, plots, tables
    from octoreplay.report.alignment_plots import team_figure
    from octoreplay.report.alignment_tables import contradiction_table
    from octoreplay.report.figures import save_figures
    from octoreplay.result import open_result

    out, err = tables.terminal(), tables.terminal(stderr=True)
    result_path, ply, csv, figures = (folder / n for n in ("result.mcap", "map.ply", "metrics.csv", "figures"))
    options = {"num_robots": robots, "duration": duration, "seed": seed, "own_frames": True}
    team_file = simulate_with_bar(folder / "logs", options)
    config, alignment, before = _aligned(team_file, folder, out)
    summary = replay_with_bar(config, result_path)
    with open_result(result_path) as result:
        plots.write_metrics_csv(result.metrics, csv)
        plots.write_figures(result.metrics, figures)
    after = summary.last.pairs
    titles = [f"{name}: {_clear(pairs)}" for name, pairs in (("before", before), ("after", after))]
    save_figures({"frames.png": team_figure(alignment, before=titles[0], after=titles[1])}, figures)
    export.export_ply(result_path, ply, what="voxels")
    tables.show(out, tables.results(summary))
    tables.show(out, contradiction_table({"as in the logs": before, "found": after}))
    show_warnings(err, summary)
    for sentence in alignment.warnings:
        warn(err, sentence)
    first = summary.last.robots[0].robot_id
    tables.show(
        out,
        tables.made_files(
            {
                folder / "logs": f"logs of {robots} robots, team file and the village as a mesh (world.ply)",
                folder / "aligned.yaml": "team file with the frames that were found",
                result_path: f"result; open it in Foxglove: 3D panel, frame 'team', topic /{first}/map",
                ply: "final map as cubes; open it in CloudCompare, MeshLab or Open3D",
                figures: "figures of the frames before and after, disagreement, contradiction and packet sizes",
                csv: "all metrics of every tick",
            }
        ),
    )
    out.print(f"more: octoreplay metrics {result_path}", soft_wrap=True)
    out.print(f"the paper's rule gradient in place of {config.consensus.rule}: octoreplay run {folder / 'aligned.yaml'}"
              f" -o {folder / 'gradient.mcap'} --rule gradient", soft_wrap=True)  # fmt: skip
    return EXIT_DATA_LOST if summary.lost_data or not alignment.is_whole else 0


def _aligned(team_file: Path, folder: Path, out: Console) -> tuple[ResolvedRun, Alignment, tuple[PairMetrics, ...]]:
    """The aligned team, its alignment, and the contradiction of the evidence before it; writes aligned.yaml."""
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.robots import discover
    from octoreplay.replay.alignment import aligned_config, check_aligned
    from octoreplay.replay.own_maps import overlaid_contradiction
    from octoreplay.report import tables
    from octoreplay.report.alignment_tables import alignment_tables

    team = load_team_file(team_file)
    resolved = discover.resolve(team)
    evidence = evidence_with_bar(resolved)
    alignment = align_with_bar(team, evidence)
    tables.show(out, alignment_tables(alignment))
    check_aligned(alignment)
    aligned = aligned_config(team, alignment.teams[0])
    save_team_file(aligned, folder / "aligned.yaml")
    return discover.resolve(aligned), alignment, overlaid_contradiction(resolved, evidence)


def _clear(pairs: tuple[PairMetrics, ...]) -> str:
    """Clear contradiction of the worst pair as a title."""
    from octoreplay.report.tables import share
    from octoreplay.run_metrics import ranked_pairs

    ranked = ranked_pairs(pairs, "clear_contradiction")
    return f"{share(ranked[0].clear_contradiction)} clear contradiction, worst pair" if ranked else "no common space"
