"""Command that repairs the drift of a team's poses: refine."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import click

from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import check_folder, check_new, check_output, existing_path, force_option, numbers
from octoreplay.commands.progress import lost_data, progress_bar, warn
from octoreplay.commands.team_options import is_team_file, save_team_file
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import OutputError

if TYPE_CHECKING:
    from octoreplay.replay.refinement import Refinement, RobotTrajectory


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
def refine(
    team: Path, output: Path, drift: str, frame_sigma: str, submap_seconds: float, hold_back: int, truth: Path | None,
    plot: Path | None, force: bool,
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
    from octoreplay.report import refinement_report, tables

    if not is_team_file([team]):
        raise click.UsageError(f"{team}: is no team file; write one with octoreplay init, then octoreplay align")
    poses = output.with_name(f"{output.stem}-poses")
    _check_outputs(team, output, poses, plot, force=force)
    model = DriftModel(*numbers("drift", drift, 2), *numbers("frame_sigma", frame_sigma, 2))
    settings = RefinementConfig(submap_seconds, hold_back, model)
    config = load_team_file(team)
    true = None if truth is None else read_truth(truth, [robot.robot_id for robot in config.robots])
    with progress_bar("refine") as update:
        refinement = refine_team(discover.resolve(config), settings, progress=lambda share: update(share, None, ""))
    errors = None if true is None else trajectory_errors(refinement.trajectories, true)
    out, err = tables.terminal(), tables.terminal(stderr=True)
    tables.show(out, refinement_report.refinement_table(refinement, errors))
    out.print(
        f"{refinement.num_submaps} submaps, {refinement.num_edges} registrations accepted,"
        f" {refinement.num_rejected} rejected", soft_wrap=True,
    )  # fmt: skip
    for sentence in lost_data(refinement.frame_counts):
        warn(err, sentence)
    _write(config, refinement, output, poses)
    out.print(f"wrote {output}", soft_wrap=True)
    if plot is not None:
        refinement_report.write_trajectory_figure(refinement, plot)
        out.print(f"wrote {plot}", soft_wrap=True)
    return EXIT_DATA_LOST if refinement.lost_data else 0


def _check_outputs(team: Path, output: Path, poses: Path, plot: Path | None, *, force: bool) -> None:
    """Check, before any work is done, that the outputs can be written."""
    check_output(output, ".yaml", [team])
    check_folder(poses)
    if plot is not None:
        check_output(plot, ".png")
    check_new(output, poses, force=force)


def _write(config: RunConfig, refinement: Refinement, output: Path, folder: Path) -> None:
    """Write the trajectories of the corrected robots, then the team file that names them."""
    from octoreplay.io.datasets.pose_files import write_tum

    partial = folder.with_name(f"{folder.name}.partial")
    corrected = {trajectory.robot_id: trajectory for trajectory in refinement.trajectories if trajectory.is_accepted}
    try:
        shutil.rmtree(partial, ignore_errors=True)
        if corrected:
            partial.mkdir()
        for robot_id, trajectory in corrected.items():
            write_tum(partial / f"{robot_id}.tum", trajectory.stamps_ns, trajectory.map_poses)
        if folder.exists():
            shutil.rmtree(folder)
        if corrected:
            partial.replace(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(partial, ignore_errors=True)
    robots = tuple(
        _with_trajectory(robot, corrected[robot.robot_id], folder) if robot.robot_id in corrected else robot
        for robot in config.robots
    )
    save_team_file(dataclasses.replace(config, robots=robots), output)


def _with_trajectory(robot: RobotConfig, trajectory: RobotTrajectory, folder: Path) -> RobotConfig:
    """Return a robot with its corrected trajectory."""
    return dataclasses.replace(
        robot,
        pose_topic=None,
        pose_times=None,
        pose_file=folder / f"{robot.robot_id}.tum",
        T_body_sensor=trajectory.T_body_sensor,
        T_team_map=trajectory.T_team_map,
        T_team_map_sigma=None,
        T_team_map_from="refined",
    )
