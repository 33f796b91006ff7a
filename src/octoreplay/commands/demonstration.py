"""Command that shows the whole way from logs to a map: demo."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from octoreplay.commands.aligning import align_with_bar, evidence_with_bar
from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.experiments import team_with_bar
from octoreplay.commands.options import check_new_folder, existing_path, force_option, lock_folder
from octoreplay.commands.progress import replay_with_bar, show_results
from octoreplay.commands.team_options import save_team_file

if TYPE_CHECKING:
    from rich.console import RenderableType

    from octoreplay.config.resolved import ResolvedRun
    from octoreplay.config.run import RunConfig
    from octoreplay.replay.alignment import Alignment
    from octoreplay.run_metrics import PairMetrics


_RULES = {"local": "local (nothing exchanged)", "gradient": "gradient (the paper's Algorithm 1)"}
"""Rules that the demo compares with the default one."""


@click.command(short_help="Simulate a team, find its frames, replay it and show its map.")
@click.argument("folder", type=existing_path, metavar="[DIR]", default=Path("octoreplay-demo"), required=False)
@click.option("--robots", type=click.IntRange(min=2), default=6, show_default=True, help="number of robots in the team")
@click.option("--duration", type=float, default=60.0, show_default=True, help="length of the logs [s]")
@click.option("--seed", type=int, default=0, show_default=True, help="seed of the village and of all noise")
@force_option
@prints
def demo(folder: Path, robots: int, duration: float, seed: int) -> int:
    """Simulate a team, find its frames, replay it, and write its map, figures and web page into DIR.

    The robots' logs are in frames of their own, as those of real robots. Three rules replay the same logs, and a table
    compares them. Takes about three minutes. The last line is the path of the page. A DIR of an earlier demo is written
    again, and logs of the same settings in it are used again.
    """
    from octoreplay.io.output_file import mark_written
    from octoreplay.report import export, plots
    from octoreplay.report.alignment_plots import team_figure
    from octoreplay.report.alignment_tables import contradiction_table
    from octoreplay.report.figures import save_figures
    from octoreplay.report.page.page import write_page
    from octoreplay.report.tables import made_files
    from octoreplay.result import open_result
    from octoreplay.simulate.settings import SimulationConfig
    from octoreplay.study.teams import holds_team

    if not holds_team(folder / "logs"):
        check_new_folder(folder)
    lock_folder(folder)
    here = terminal()
    result_path, ply, csv, figures, page = (
        folder / n for n in ("result.mcap", "map.ply", "metrics.csv", "figures", "report.html")
    )
    simulation = SimulationConfig(num_robots=robots, duration=duration, seed=seed, own_frames=True)
    team_file = team_with_bar(folder / "logs", simulation, replaces_others=True)
    config, alignment, before = _aligned(team_file, folder)
    summary = replay_with_bar(config, result_path, restart=True)
    with open_result(result_path) as result:
        plots.write_metrics_csv(result.metrics, csv)
        plots.write_figures(result.metrics, figures)
    after = summary.last.pairs
    titles = [f"{name}: {_clear(pairs)}" for name, pairs in (("before", before), ("after", after))]
    save_figures({"frames.png": team_figure(alignment, before=titles[0], after=titles[1])}, figures)
    export.export_map(result_path, ply, what="voxels")
    comparison = _compared_rules(config, folder, result_path, team_file.parent)
    write_page(result_path, page)
    mark_written(folder)
    document = show_results(summary, warnings=alignment.warnings)
    here.show(contradiction_table({"as in the logs": before, "found": after}))
    here.show(comparison)
    first = summary.last.robots[0].robot_id
    made = {
        folder / "logs": f"logs of {robots} robots, team file and the village as a mesh (world.ply)",
        folder / "aligned.yaml": "team file with the frames that were found",
        result_path: f"result; open it in Foxglove: 3D panel, frame 'team', topic /{first}/map",
        folder / "local.mcap": "result without any exchange",
        folder / "gradient.mcap": "result of the paper's rule",
        ply: "final map as cubes; open it in CloudCompare, MeshLab or Open3D",
        figures: "figures of the frames before and after, disagreement, contradiction and packet sizes",
        csv: "all metrics of every tick",
        page: "page of the result: map over time, charts, tables",
    }
    here.show(made_files(made))
    here.line("open the page in a browser:")
    here.line(str(page.resolve()))
    here.give(result=result_path, **document, written=list(made))
    return EXIT_DATA_LOST if summary.lost_data or not alignment.is_whole else 0


def _compared_rules(config: ResolvedRun, folder: Path, result_path: Path, truth: Path) -> RenderableType:
    """Replay the same logs without an exchange and with the paper's rule; table of all rules' last maps."""
    from octoreplay.evaluate.evaluation import evaluate_result
    from octoreplay.evaluate.verdict import run_verdict
    from octoreplay.report.evaluation_tables import rules_table
    from octoreplay.result import open_result

    rows = {}
    for rule, title in {**_RULES, config.consensus.rule: f"{config.consensus.rule} (the default)"}.items():
        path = folder / f"{rule}.mcap" if rule in _RULES else result_path
        if rule in _RULES:
            replay_with_bar(config.with_parameters({"rule": rule}), path, restart=True)
        with open_result(path) as result:
            rate = run_verdict(result.summary).sent_bytes_per_second
        rows[title] = (evaluate_result(path, truth=truth, over_time=False).final, rate)
    return rules_table(rows)


def _aligned(team_file: Path, folder: Path) -> tuple[ResolvedRun, Alignment, tuple[PairMetrics, ...]]:
    """The aligned team, its alignment, and the contradiction of the evidence before it; writes aligned.yaml."""
    from octoreplay.config.frames_file import load_frames_file
    from octoreplay.config.team_file import load_team_file
    from octoreplay.evaluate.truth_frame import FRAMES_FILE
    from octoreplay.io.robots import discover
    from octoreplay.replay.alignment import aligned_config, check_aligned
    from octoreplay.replay.own_maps import overlaid_contradiction
    from octoreplay.report.alignment_tables import alignment_tables

    team = load_team_file(team_file)
    resolved = discover.resolve(team)
    evidence = evidence_with_bar(resolved)
    # The truth is in the village's frame. The team gets it from one robot that knows where it started.
    places = load_frames_file(team_file.parent / FRAMES_FILE)
    placed = _placed(team, team.robots[0].robot_id, places)
    alignment = align_with_bar(placed, evidence)
    robots = [frame.robot_id for frame in alignment.teams[0]]
    if team.robots[0].robot_id not in robots:
        placed = _placed(team, robots[0], places)
        alignment = align_with_bar(placed, evidence)
    terminal().show(alignment_tables(alignment))
    check_aligned(alignment)
    # The page shows over time who saw what.
    aligned = aligned_config(placed, alignment.teams[0]).with_parameters({"evidence_every": team.output.state_every})
    save_team_file(aligned, folder / "aligned.yaml")
    return discover.resolve(aligned), alignment, overlaid_contradiction(resolved, evidence)


def _placed(team: RunConfig, robot_id: str, places: Mapping[str, tuple[float, ...]]) -> RunConfig:
    """The team with the true T_team_map of one robot."""
    robots = (
        dataclasses.replace(robot, T_team_map=places[robot_id]) if robot.robot_id == robot_id else robot
        for robot in team.robots
    )
    return dataclasses.replace(team, robots=tuple(robots))


def _clear(pairs: tuple[PairMetrics, ...]) -> str:
    """Clear contradiction of the worst pair as a title."""
    from octoreplay.report.tables import share
    from octoreplay.run_metrics import ranked_pairs

    ranked = ranked_pairs(pairs, "clear_contradiction")
    return f"{share(ranked[0].clear_contradiction)} clear contradiction, worst pair" if ranked else "no common space"
