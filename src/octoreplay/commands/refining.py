"""Command that repairs the drift of a team's poses: refine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from octoreplay import interrupts
from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import check_new_folder, check_output, existing_path, force_option, numbers
from octoreplay.commands.progress import lost_data, progress_bar
from octoreplay.commands.team_options import is_team_file, save_team_file
from octoreplay.config.run import RunConfig

if TYPE_CHECKING:
    from octoreplay.replay.refinement import Refinement


@click.command(short_help="Repair the drift of a team's poses.")
@click.argument("team", type=existing_path, metavar="TEAM.yaml")
@click.option("-o", "--output", type=existing_path, required=True, metavar="REFINED.yaml",
              help="team file to write; the trajectories go to the folder REFINED-poses beside it")  # fmt: skip
@click.option("--drift", default="1,0.5", show_default=True, metavar="PERCENT,DEGREES",
              help="expected drift: position [% of the way], heading [degrees per 10 m]")  # fmt: skip
@click.option("--frame-sigma", default="0.3,1", show_default=True, metavar="METRES,DEGREES",
              help="standard deviation of T_team_map: position [m], rotation about each axis [degrees]")  # fmt: skip
@click.option("--submap-seconds", type=float, default=6.0, show_default=True, help="length of a submap [s]")
@click.option("--hold-back", type=int, default=5, show_default=True, metavar="N",
              help="hold back every N-th scan for the test of the correction")  # fmt: skip
@click.option("--truth", type=existing_path, metavar="DIR",
              help="folder with the true trajectories ROBOT.tum, to show the errors")  # fmt: skip
@click.option("--plot", type=existing_path, metavar="FILE.png", help="write a figure of the trajectories")
@force_option
@prints
def refine(
    team: Path, output: Path, drift: str, frame_sigma: str, submap_seconds: float, hold_back: int, truth: Path | None,
    plot: Path | None,
) -> int:  # fmt: skip
    """Repair the drift of a team's poses, and write a team file with the corrected trajectories.

    T_team_map of every robot must be known (octoreplay align). Submaps that overlap are registered, within and between
    robots, and joined in a robust pose graph. A robot keeps its recorded poses unless scans that were held back show
    that the corrected ones are better.
    """
    from octoreplay.config.team_file import load_team_file
    from octoreplay.evaluate.trajectories import read_truth, trajectory_errors
    from octoreplay.io.robots import discover
    from octoreplay.registration.drift import DriftModel
    from octoreplay.replay.refinement import RefinementConfig, refine_team
    from octoreplay.report import refinement_report

    if not is_team_file([team]):
        raise click.UsageError(f"{team}: is no team file; write one with octoreplay init, then octoreplay align")
    poses = output.with_name(f"{output.stem}-poses")
    _check_outputs(team, output, poses, plot)
    model = DriftModel(*numbers("drift", drift, 2), *numbers("frame_sigma", frame_sigma, 2))
    settings = RefinementConfig(submap_seconds, hold_back, model)
    config = load_team_file(team)
    true = None if truth is None else read_truth(truth, [robot.robot_id for robot in config.robots])
    with progress_bar("refine") as update:
        refinement = refine_team(discover.resolve(config), settings, progress=lambda share: update(share, None, ""))
    errors = None if true is None else trajectory_errors(refinement.trajectories, true)
    here = terminal()
    here.show(refinement_report.refinement_table(refinement, errors))
    here.line(
        f"{refinement.num_submaps} submaps, {refinement.num_edges} registrations accepted,"
        f" {refinement.num_rejected} rejected"
    )
    for sentence in lost_data(refinement.frame_counts):
        here.warn(sentence)
    _write(config, refinement, output, poses)
    written = [output]
    if plot is not None:
        refinement_report.write_trajectory_figure(refinement, plot)
        written.append(plot)
    for path in written:
        here.line(f"wrote {path}")
    here.give(**refinement_report.refinement_content(refinement, errors), written=written)
    return EXIT_DATA_LOST if refinement.lost_data else 0


def _check_outputs(team: Path, output: Path, poses: Path, plot: Path | None) -> None:
    """Check, before any work is done, that the outputs can be written."""
    check_output(output, ".yaml", [team])
    check_new_folder(poses)
    if plot is not None:
        check_output(plot, ".png")


def _write(config: RunConfig, refinement: Refinement, output: Path, folder: Path) -> None:
    """Write the trajectories of the corrected robots, then the team file that names them."""
    from octoreplay.io.output_file import new_folder
    from octoreplay.replay.refinement import refined_config, write_trajectories

    with new_folder(folder) as new:
        write_trajectories(refinement, new.path)
        # Both or none: a team file must not name the trajectories of another run.
        with interrupts.deferred():
            new.put()
            save_team_file(refined_config(config, refinement, folder), output)
