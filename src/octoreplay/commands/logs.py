"""Commands for logs: info, init, import-rgbd, import-clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from octoreplay.commands.console import echo, prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST, EXIT_ERROR
from octoreplay.commands.options import (
    check_new_folder,
    check_output,
    existing_path,
    force_option,
    lock_folder,
    log_place,
    numbers,
)
from octoreplay.commands.progress import progress_bar
from octoreplay.commands.suggestions import Choice
from octoreplay.config.file_url import InputFile
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.robot import POSE_FORMATS
from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError
from octoreplay.io.output_file import write_whole

_strict_frames = click.option(
    "--strict-frames", is_flag=True, help=f"{PARAMETERS['strict_frames'].help}, instead of a warning"
)
_map_frame = click.option(
    "--map-frame", default="map", show_default=True, metavar="NAME",
    help="name of the frame of the poses; logs that say 'map' share one frame, logs that say 'odom' do not",
)  # fmt: skip


@click.command(short_help="Show the contents of logs and what is missing for a run.")
@click.argument("logs", nargs=-1, required=True, type=log_place, metavar="LOG...")
@_strict_frames
@click.option("--classes", metavar="NAME|FILE",
              help="class table of the run, to compare the labels with  [default: that of the logs]")  # fmt: skip
@prints
def info(logs: tuple[InputFile, ...], strict_frames: bool, classes: str | None) -> int:
    """Show the contents of logs: robots, topics, types, rates and time spans, and what is missing for a run.

    A table counts the raw labels in a sample of the messages. Frames, clocks, and labels that do not fit together are
    named as warnings. Exit code 1 if a log cannot be opened,
    or a run of the logs would be refused.
    """
    from octoreplay.config.class_file import named_class_table
    from octoreplay.io.robots.describe import describe
    from octoreplay.report.log_tables import description as described

    here = terminal()
    table = None if classes is None else named_class_table(classes)
    description = describe(logs, strict_frames=strict_frames, classes=table)
    for sentence in description.warnings:
        here.warn(sentence)
    if any(log.error is None for log in description.logs):
        here.show(described(description))
    errors = [log.error for log in description.logs if log.error is not None]
    for error in errors:
        echo(f"error: {error}", err=True)
    here.give(**vars(description))
    return EXIT_ERROR if errors or not description.is_ready else 0


@click.command(short_help="Write a team file for logs, to be edited by hand.")
@click.argument("logs", nargs=-1, required=True, type=log_place, metavar="LOG...")
@click.option("-o", "--output", type=existing_path, required=True, metavar="TEAM.yaml", help="team file to write")
@force_option
@_strict_frames
@prints
def init(logs: tuple[InputFile, ...], output: Path, strict_frames: bool) -> int:
    """Write a team file with the robots and topics found in logs, and every other setting as a comment.

    Anything that is missing for a run is named in the file and on the terminal, and so are frames and clocks of robots
    that do not fit together.
    """
    from octoreplay.config.team_template import team_template
    from octoreplay.io.robots.describe import describe

    check_output(output, ".yaml", logs)
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
    here = terminal()
    here.line(f"wrote {output} ({len(robots)} robot{'s' if len(robots) > 1 else ''})")
    lacking = (*description.missing, *(sentence for found in missing.values() for sentence in found))
    for sentence in lacking:
        here.note(f"missing for a run: {sentence}")
    for sentence in description.warnings:
        here.warn(sentence)
    here.give(team_file=output, robots=[robot.robot_id for robot in robots], missing=lacking)
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
@click.option("--camera-axes", type=Choice(("optical", "opengl")), default="optical", show_default=True,
              help="axes of the camera in the poses: z forward (optical), or z back (opengl, Habitat)")  # fmt: skip
@_map_frame
@force_option
@prints
def import_rgbd(
    folder: Path, output: Path, robot_id: str | None, intrinsics: str | None, classes_from: Path | None, **options: Any
) -> int:
    """Convert a folder of depth images with poses to a robot's log.

    Layouts: 7-Scenes, TUM RGB-D, ScanNet, SUN3D, Replica, ICL-NUIM, M3ED, Redwood and Open3D. A folder whose subfolders
    are such sequences gives a log of each, in the folder DIR of -o DIR.
    """
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.datasets import rgbd_folder
    from octoreplay.io.datasets.rgbd_layouts import find_layout, find_sequences

    is_log = output.suffix.lower() == ".mcap"
    sequences = [] if is_log else find_sequences(folder)
    if not sequences:
        find_layout(folder)
        check_output(output, ".mcap")
    else:
        check_new_folder(output)
        lock_folder(output)
        if robot_id is not None:
            raise click.UsageError("--robot names one robot; the robots of several sequences have their folders' names")
    jobs = {output / f"{path.name}.mcap": path for path in sequences} or {output: folder}
    camera = None if intrinsics is None else numbers("intrinsics", intrinsics, 4)
    table = None if classes_from is None else load_team_file(classes_from).classes
    here = terminal()
    summaries: list[rgbd_folder.ImportSummary] = []
    with progress_bar("import") as update:
        for path, sequence in jobs.items():
            path.parent.mkdir(exist_ok=True)
            summary = rgbd_folder.import_rgbd(
                sequence, path, robot_id=robot_id, intrinsics=camera, class_table=table,
                progress=lambda share: update((len(summaries) + share) / len(jobs), None, ""), **options,
            )  # fmt: skip
            summaries.append(summary)
    for summary in summaries:
        labelled = f", {summary.num_labelled:,} with labels" if summary.num_labelled else ", no labels"
        here.line(
            f"wrote {summary.path} ({summary.layout}: robot {summary.robot_id}, {summary.num_frames:,} images"
            f"{labelled}, {summary.duration:.1f} s)"
        )
        if summary.num_without_pose:
            here.warn(f"{summary.path}: {summary.num_without_pose:,} images without a usable pose were skipped")
    if sequences:
        here.give(logs=[vars(summary) for summary in summaries])
    else:
        here.give(log=output, **vars(summaries[0]))
    return EXIT_DATA_LOST if any(summary.num_without_pose for summary in summaries) else 0


@click.command("import-clouds", short_help="Convert a folder of point clouds to a log.")
@click.argument("folder", type=existing_path, metavar="DIR")
@click.option("-o", "--output", type=existing_path, required=True, metavar="LOG.mcap", help="log to write")
@click.option("--rate", type=float, default=None, help="cloud rate, if the folder contains no times [Hz]")
@click.option("--times", type=existing_path, default=None, metavar="FILE",
              help="file with the time of each cloud, one a line, instead of --rate [s]")  # fmt: skip
@click.option("--poses", type=existing_path, default=None, metavar="FILE",
              help="trajectory file, or a pose graph (.g2o) whose vertices have the numbers in the clouds' names "
                   " [default: a pose file in DIR, or VIEWPOINT of PCD]")  # fmt: skip
@click.option("--identity-poses", is_flag=True, help="the clouds are in one frame already: all poses are the identity")
@click.option("--pose-format", type=Choice(POSE_FORMATS), default=None,
              help="format of the trajectory file  [default: by its header and its columns]")  # fmt: skip
@click.option("--pose-origin", default=None, metavar="X,Y,Z",
              help="origin of the map in the file's coordinates: UTM [m], or latitude, longitude, height")  # fmt: skip
@click.option("--frame", type=Choice(("sensor", "world")), default=None,
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
@prints
def import_clouds(
    folder: Path, output: Path, classes_from: Path | None, pose_origin: str | None, **options: Any
) -> int:
    """Convert a folder of point clouds with poses (PCD, PLY, KITTI) to a robot's log.

    The clouds may be in subfolders, one each, as hdl_graph_slam writes them.
    """
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.datasets import cloud_folder

    check_output(output, ".mcap")
    table = None if classes_from is None else load_team_file(classes_from).classes
    origin = None if pose_origin is None else numbers("pose_origin", pose_origin, 3)
    with progress_bar("import") as update:
        summary = cloud_folder.import_clouds(
            folder,
            output,
            class_table=table,
            pose_origin=origin,
            progress=lambda share: update(share, None, ""),
            **options,
        )
    labelled = f", {summary.num_labelled:,} with labels" if summary.num_labelled else ", no labels"
    here = terminal()
    here.line(
        f"wrote {output} ({summary.layout}: robot {summary.robot_id}, {summary.num_frames:,} clouds{labelled},"
        f" {summary.duration:.1f} s; poses from {summary.poses}, points in the {summary.frame}'s frame)"
    )
    content = vars(summary).copy()
    for sentence in content.pop("warnings"):
        here.warn(sentence)
    for count, reason in ((summary.num_without_pose, "a usable pose"), (summary.num_empty, "a finite point")):
        if count:
            here.warn(f"{count:,} clouds without {reason} were skipped")
    here.give(log=output, **content)
    return EXIT_DATA_LOST if summary.num_without_pose or summary.num_empty else 0
