"""Commands about logs: info, init, import-rgbd, import-clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from octoreplay.commands.exit_codes import EXIT_DATA_LOST, EXIT_ERROR
from octoreplay.commands.options import check_output, existing_path, numbers
from octoreplay.commands.progress import progress_bar
from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError, OutputError
from octoreplay.io.text_files import write_whole


@click.command(short_help="Show what logs hold and what is missing for a run.")
@click.argument("logs", nargs=-1, required=True, type=existing_path, metavar="LOG...")
def info(logs: tuple[Path, ...]) -> int:
    """Show what logs hold: robots, topics, types, rates, spans, and what is missing for a run."""
    from octoreplay.io.robots.describe import describe
    from octoreplay.report import tables

    description = describe(logs)
    if any(log.error is None for log in description.logs):
        tables.show(tables.terminal(), tables.description(description))
    errors = [log.error for log in description.logs if log.error is not None]
    for error in errors:
        click.echo(f"error: {error}", err=True)
    return EXIT_ERROR if errors else 0


@click.command(short_help="Write a team file for some logs, to be changed by hand.")
@click.argument("logs", nargs=-1, required=True, type=existing_path, metavar="LOG...")
@click.option("-o", "--output", type=existing_path, required=True, metavar="TEAM.yaml", help="the team file")
@click.option("--force", is_flag=True, help="write over a file that is there")
def init(logs: tuple[Path, ...], output: Path, force: bool) -> int:
    """Write a team file with all that is found in logs, and all that can be set as comments.

    What a run would still miss stands in it too, and is said.
    """
    from octoreplay.config.team_template import team_template
    from octoreplay.io.robots.describe import describe

    check_output(output, ".yaml", logs)
    if output.exists() and not force:
        raise OutputError(f"{output}: is there already; name another file, or give --force to write over it")
    description = describe(logs)
    for log in description.logs:
        if log.error is not None:
            raise InputError(log.error)
    if not description.robots:
        raise InputError(description.missing[0])
    robots = tuple(summary.robot.with_absolute_paths() for summary in description.robots)
    missing = {summary.robot.robot_id: summary.missing for summary in description.robots}
    config = RunConfig(robots, classes=description.class_table)
    write_whole(output, team_template(config, {"": description.missing, **missing}, output.parent.resolve()))
    click.echo(f"wrote {output} ({len(robots)} robot{'s' if len(robots) > 1 else ''})")
    for sentence in (*description.missing, *(sentence for found in missing.values() for sentence in found)):
        click.echo(f"missing for a run: {sentence}", err=True)
    return 0


@click.command("import-rgbd", short_help="Write a folder of depth images as a log.")
@click.argument("folder", type=existing_path, metavar="DIR")
@click.option("-o", "--output", type=existing_path, required=True, metavar="LOG.mcap", help="the log")
@click.option("--rate", type=float, default=None, help="images per second, where the folder has no times [Hz]")
@click.option(
    "--times", type=existing_path, default=None, metavar="FILE", help="one time per line [s], in place of --rate"
)
@click.option("--robot", "robot_id", default=None, metavar="ID", help="the robot's name  [default: the log's]")
@click.option("--intrinsics", default=None, metavar="FX,FY,CX,CY", help="in place of the folder's [pixels]")
@click.option("--depth-unit", type=float, default=None, help="metres per depth value, in place of the format's own")
@click.option("--labels", type=existing_path, default=None, metavar="DIR", help="label PNGs, named like the depth ones")
@click.option(
    "--classes-from", type=existing_path, default=None, metavar="TEAM.yaml", help="a team file that names the labels"
)
@click.option("--first", type=int, default=0, show_default=True, help="first image to take, counted from 0")
@click.option("--last", type=int, default=None, help="last image to take  [default: the last one]")
@click.option("--every", type=int, default=1, show_default=True, help="take one image of so many")
def import_rgbd(folder: Path, output: Path, intrinsics: str | None, classes_from: Path | None, **options: Any) -> int:
    """Write a folder of depth images with poses (7-Scenes, TUM RGB-D, ScanNet) as a robot's log."""
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.datasets import rgbd_folder

    check_output(output, ".mcap")
    camera = None if intrinsics is None else numbers("intrinsics", intrinsics, 4)
    table = None if classes_from is None else load_team_file(classes_from).classes
    with progress_bar("import") as update:
        summary = rgbd_folder.import_rgbd(
            folder, output, intrinsics=camera, class_table=table, progress=lambda share: update(share, None, ""),
            **options,
        )  # fmt: skip
    labelled = f", {summary.num_labelled:,} with labels" if summary.num_labelled else ", no labels"
    click.echo(
        f"wrote {output} ({summary.layout}: robot {summary.robot_id}, {summary.num_frames:,} images{labelled},"
        f" {summary.duration:.1f} s)"
    )
    if summary.num_without_pose:
        click.echo(f"warning: {summary.num_without_pose:,} images without a usable pose were left out", err=True)
    return EXIT_DATA_LOST if summary.num_without_pose else 0


@click.command("import-clouds", short_help="Write a folder of point clouds as a log.")
@click.argument("folder", type=existing_path, metavar="DIR")
@click.option("-o", "--output", type=existing_path, required=True, metavar="LOG.mcap", help="the log")
@click.option("--rate", type=float, default=None, help="clouds per second, where the folder has no times [Hz]")
@click.option(
    "--times", type=existing_path, default=None, metavar="FILE", help="one time per line [s], in place of --rate"
)
@click.option("--poses", type=existing_path, default=None, metavar="FILE",
              help="poses as TUM or KITTI have them  [default: those beside the clouds, or VIEWPOINT]")  # fmt: skip
@click.option("--frame", type=click.Choice(("sensor", "world")), default=None,
              help="what the points are given in  [default: sensor, but world with VIEWPOINT]")  # fmt: skip
@click.option("--robot", "robot_id", default=None, metavar="ID", help="the robot's name  [default: the log's]")
@click.option(
    "--labels", type=existing_path, default=None, metavar="DIR", help="KITTI .label files, named like the clouds"
)
@click.option(
    "--classes-from", type=existing_path, default=None, metavar="TEAM.yaml", help="a team file that names the labels"
)
@click.option("--first", type=int, default=0, show_default=True, help="first cloud to take, counted from 0")
@click.option("--last", type=int, default=None, help="last cloud to take  [default: the last one]")
@click.option("--every", type=int, default=1, show_default=True, help="take one cloud of so many")
def import_clouds(folder: Path, output: Path, classes_from: Path | None, **options: Any) -> int:
    """Write a folder of point clouds with poses (PCD, PLY, KITTI) as a robot's log."""
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.datasets import cloud_folder

    check_output(output, ".mcap")
    table = None if classes_from is None else load_team_file(classes_from).classes
    with progress_bar("import") as update:
        summary = cloud_folder.import_clouds(
            folder, output, class_table=table, progress=lambda share: update(share, None, ""), **options
        )
    labelled = f", {summary.num_labelled:,} with labels" if summary.num_labelled else ", no labels"
    click.echo(
        f"wrote {output} ({summary.layout}: robot {summary.robot_id}, {summary.num_frames:,} clouds{labelled},"
        f" {summary.duration:.1f} s; poses from {summary.poses}, points in the {summary.frame}'s frame)"
    )
    for sentence in summary.warnings:
        click.echo(f"warning: {sentence}", err=True)
    for count, reason in ((summary.num_without_pose, "a usable pose"), (summary.num_empty, "a finite point")):
        if count:
            click.echo(f"warning: {count:,} clouds without {reason} were left out", err=True)
    return EXIT_DATA_LOST if summary.num_without_pose or summary.num_empty else 0
