"""Commands for logs: info, init, import-rgbd, import-clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from octoreplay.commands.exit_codes import EXIT_DATA_LOST, EXIT_ERROR
from octoreplay.commands.options import check_new, check_output, existing_path, force_option, numbers
from octoreplay.commands.progress import progress_bar
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError
from octoreplay.io.text_files import write_whole

_strict_frames = click.option(
    "--strict-frames", is_flag=True, help=f"{PARAMETERS['strict_frames'].help}, instead of a warning"
)
_map_frame = click.option(
    "--map-frame", default="map", show_default=True, metavar="NAME",
    help="name of the frame of the poses; logs that say 'map' share one frame, logs that say 'odom' do not",
)  # fmt: skip


@click.command(short_help="Show the contents of logs and what is missing for a run.")
@click.argument("logs", nargs=-1, required=True, type=existing_path, metavar="LOG...")
@_strict_frames
def info(logs: tuple[Path, ...], strict_frames: bool) -> int:
    """Show the contents of logs: robots, topics, types, rates and time spans, and what is missing for a run.

    Frames and clocks of robots that do not fit together are named as warnings.
    """
    from octoreplay.io.robots.describe import describe
    from octoreplay.report import tables

    description = describe(logs, strict_frames=strict_frames)
    if any(log.error is None for log in description.logs):
        tables.show(tables.terminal(), tables.description(description))
    errors = [log.error for log in description.logs if log.error is not None]
    for error in errors:
        click.echo(f"error: {error}", err=True)
    for sentence in description.warnings:
        click.echo(f"warning: {sentence}", err=True)
    return EXIT_ERROR if errors else 0


@click.command(short_help="Write a team file for logs, to be edited by hand.")
@click.argument("logs", nargs=-1, required=True, type=existing_path, metavar="LOG...")
@click.option("-o", "--output", type=existing_path, required=True, metavar="TEAM.yaml", help="team file to write")
@force_option
@_strict_frames
def init(logs: tuple[Path, ...], output: Path, force: bool, strict_frames: bool) -> int:
    """Write a team file with the robots and topics found in logs, and every other setting as a comment.

    Anything that is missing for a run is named in the file and on the terminal, and so are frames and clocks of robots
    that do not fit together.
    """
    from octoreplay.config.team_template import team_template
    from octoreplay.io.robots.describe import describe

    check_output(output, ".yaml", logs)
    check_new(output, force=force)
    description = describe(logs, strict_frames=strict_frames)
    for log in description.logs:
        if log.error is not None:
            raise InputError(log.error)
    if not description.robots:
        raise InputError(description.missing[0])
    robots = tuple(summary.robot.with_absolute_paths() for summary in description.robots)
    missing = {summary.robot.robot_id: summary.missing for summary in description.robots}
    config = RunConfig(robots, classes=description.class_table)
    notes = {summary.robot.robot_id: summary.notes for summary in description.robots}
    notes[""] = tuple(f"warning: {sentence}" for sentence in description.warnings)
    write_whole(
        output, team_template(config, {"": description.missing, **missing}, output.parent.resolve(), notes=notes)
    )
    click.echo(f"wrote {output} ({len(robots)} robot{'s' if len(robots) > 1 else ''})")
    for sentence in (*description.missing, *(sentence for found in missing.values() for sentence in found)):
        click.echo(f"missing for a run: {sentence}", err=True)
    for sentence in description.warnings:
        click.echo(f"warning: {sentence}", err=True)
    return 0


@click.command("import-rgbd", short_help="Convert a folder of depth images to a log.")
@click.argument("folder", type=existing_path, metavar="DIR")
@click.option("-o", "--output", type=existing_path, required=True, metavar="LOG.mcap", help="log to write")
@click.option("--rate", type=float, default=None, help="image rate, if the folder contains no times [Hz]")
@click.option("--times", type=existing_path, default=None, metavar="FILE",
              help="file with the time of each image, one a line, instead of --rate [s]")  # fmt: skip
@click.option("--robot", "robot_id", default=None, metavar="ID", help="robot id  [default: name of the log]")
@click.option("--intrinsics", default=None, metavar="FX,FY,CX,CY",
              help="camera intrinsics, instead of those in the folder [pixels]")  # fmt: skip
@click.option("--depth-unit", type=float, default=None,
              help="metres per depth value  [default: that of the dataset's format]")  # fmt: skip
@click.option("--labels", type=existing_path, default=None, metavar="DIR",
              help="folder of label PNGs, named like the depth images")  # fmt: skip
@click.option("--classes-from", type=existing_path, default=None, metavar="TEAM.yaml",
              help="team file whose classes the labels have")  # fmt: skip
@click.option("--first", type=int, default=0, show_default=True, help="index of the first image to import, from 0")
@click.option("--last", type=int, default=None, help="index of the last image to import  [default: the last]")
@click.option("--every", type=int, default=1, show_default=True, help="import every n-th image")
@_map_frame
@force_option
def import_rgbd(
    folder: Path, output: Path, intrinsics: str | None, classes_from: Path | None, force: bool, **options: Any
) -> int:
    """Convert a folder of depth images with poses (7-Scenes, TUM RGB-D, ScanNet) to a robot's log."""
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.datasets import rgbd_folder

    check_output(output, ".mcap")
    check_new(output, force=force)
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
        click.echo(f"warning: {summary.num_without_pose:,} images without a usable pose were skipped", err=True)
    return EXIT_DATA_LOST if summary.num_without_pose else 0


@click.command("import-clouds", short_help="Convert a folder of point clouds to a log.")
@click.argument("folder", type=existing_path, metavar="DIR")
@click.option("-o", "--output", type=existing_path, required=True, metavar="LOG.mcap", help="log to write")
@click.option("--rate", type=float, default=None, help="cloud rate, if the folder contains no times [Hz]")
@click.option("--times", type=existing_path, default=None, metavar="FILE",
              help="file with the time of each cloud, one a line, instead of --rate [s]")  # fmt: skip
@click.option("--poses", type=existing_path, default=None, metavar="FILE",
              help="trajectory in TUM or KITTI format  [default: a pose file in DIR, or VIEWPOINT of PCD]")  # fmt: skip
@click.option("--frame", type=click.Choice(("sensor", "world")), default=None,
              help="frame of the points  [default: sensor; world for poses from VIEWPOINT]")  # fmt: skip
@click.option("--robot", "robot_id", default=None, metavar="ID", help="robot id  [default: name of the log]")
@click.option("--labels", type=existing_path, default=None, metavar="DIR",
              help="folder of KITTI .label files, named like the clouds")  # fmt: skip
@click.option("--classes-from", type=existing_path, default=None, metavar="TEAM.yaml",
              help="team file whose classes the labels have")  # fmt: skip
@click.option("--first", type=int, default=0, show_default=True, help="index of the first cloud to import, from 0")
@click.option("--last", type=int, default=None, help="index of the last cloud to import  [default: the last]")
@click.option("--every", type=int, default=1, show_default=True, help="import every n-th cloud")
@_map_frame
@force_option
def import_clouds(folder: Path, output: Path, classes_from: Path | None, force: bool, **options: Any) -> int:
    """Convert a folder of point clouds with poses (PCD, PLY, KITTI) to a robot's log."""
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.datasets import cloud_folder

    check_output(output, ".mcap")
    check_new(output, force=force)
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
            click.echo(f"warning: {count:,} clouds without {reason} were skipped", err=True)
    return EXIT_DATA_LOST if summary.num_without_pose or summary.num_empty else 0
