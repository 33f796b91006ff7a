"""The command line: options to configuration, then replay, simulate or report, then print.

The only module that prints or exits. Exit codes: 0 good; 1 input or run error; 2 usage or configuration; 3 finished,
but data was lost; 130 interrupted. Whatever a command needs is imported when it runs, so that ``--help`` is quick.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay import __version__
from octoreplay.class_file import with_classes
from octoreplay.class_tables.label_rows import BUILT_IN
from octoreplay.config import PARAMETERS, PRESETS, SECTIONS, Parameter, RunConfig
from octoreplay.errors import ConfigError, InputError, OctoreplayError, OutputError

if TYPE_CHECKING:
    from rich.console import Console

    from octoreplay.records import FrameCounts, RunSummary
    from octoreplay.replay.session import Progress

EXIT_ERROR, EXIT_USAGE, EXIT_DATA_LOST, EXIT_INTERRUPTED = 1, 2, 3, 130

_WORDS = {"float": "NUMBER", "int": "INTEGER", "floats": "NUMBERS", "str": "WORD"}
"""What ``--help`` calls the value of a parameter."""


class _ParameterOption(click.Option):
    """A command line option made from a configuration parameter."""

    section = ""


class _RunCommand(click.Command):
    """Lists the options of ``run`` under the headings of the configuration's sections."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        groups: dict[str, list[tuple[str, str]]] = {"Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and isinstance(parameter, click.Option):
                section = getattr(parameter, "section", "")
                groups.setdefault(SECTIONS.get(section, "Options"), []).append(record)
        for heading, records in groups.items():
            with formatter.section(heading):
                formatter.write_dl(records)


def _option(parameter: Parameter) -> _ParameterOption:
    """The option of one parameter: ``--name-with-dashes``, without a default, so that only what is given counts."""
    name = parameter.name.replace("_", "-")
    declaration = f"--{name}/--no-{name}" if parameter.kind == "bool" else f"--{name}"
    kind: Any = {"float": float, "int": int, "bool": bool}.get(parameter.kind, str)
    shown = parameter.kind != "bool" and parameter.default not in (None, ())
    default = f"  [default: {parameter.default}]" if shown else ""
    option = _ParameterOption(
        [declaration, parameter.name],
        type=click.Choice(parameter.choices) if parameter.choices else kind,
        default=None,
        help=parameter.help + default,
        metavar=None if parameter.choices else _WORDS.get(parameter.kind),
    )
    option.section = parameter.section
    return option


def _with_parameters(command: click.Command) -> click.Command:
    """Add every configuration parameter to a command as an option."""
    command.params.extend(_option(parameter) for parameter in PARAMETERS.values())
    return command


_existing = click.Path(path_type=Path, readable=False)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="octoreplay")
def cli() -> None:
    """Replay the logs of a robot team into semantic octree maps that the team agrees on.

    Start with "octoreplay demo". Exit codes: 0 good; 1 input or run error; 2 usage or configuration; 3 finished, but
    data was lost; 130 interrupted.
    """


@_with_parameters
@cli.command(cls=_RunCommand, short_help="Replay logs into maps that the team agrees on.")
@click.argument("inputs", nargs=-1, type=_existing, metavar="TEAM.yaml | LOG...")
@click.option("-o", "--output", type=_existing, metavar="OUT.mcap", help="the result")
@click.option("--config-from", type=_existing, metavar="RESULT.mcap", help="repeat a run with the settings it stored")
@click.option(
    "--save-team", type=_existing, metavar="TEAM.yaml", help="save robots, topics and settings as a team file"
)
@click.option("--preset", type=click.Choice(tuple(PRESETS)), help="a named set of settings; options override it")
@click.option("--edges", metavar="A:B[:W],...", help="links of the communication graph, with weights if all have one")
@click.option("--one-way", metavar="A:B,...", help="links that carry from A to B only")
@click.option("--schedule", type=_existing, metavar="FILE.yaml", help="when which robots and links are up or down")
@click.option("--classes", metavar="NAME|FILE", help=f"what labels mean: {', '.join(BUILT_IN)}, or a file")
def run(
    inputs: tuple[Path, ...], output: Path | None, config_from: Path | None, save_team: Path | None,
    preset: str | None, edges: str | None, one_way: str | None, schedule: Path | None, classes: str | None,
    **parameters: Any,
) -> int:  # fmt: skip
    """Replay a team's logs into maps that the team agrees on.

    Give a team file, or logs (MCAP, ROS 1 bags, rosbag2 folders) in which robots and topics are found by themselves.
    What was found is shown, and --save-team saves it.
    """
    from octoreplay.io.robots import discover
    from octoreplay.report import tables

    if output is None and save_team is None:
        raise click.UsageError("give the result's name: -o OUT.mcap (or --save-team TEAM.yaml to stop before the run)")
    if output is not None:
        _check_output(output, ".mcap")
    if save_team is not None:
        _check_output(save_team, ".yaml", inputs)
    out, err = tables.terminal(), tables.terminal(stderr=True)
    base = _base_config(inputs, config_from, err)
    base = base if classes is None else with_classes(base, classes)
    given = {name: value for name, value in parameters.items() if value is not None}
    config = discover.resolve(_with_network(_with_options(base, preset, edges, given), one_way, schedule))
    if config_from is None and not _is_team_file(inputs):
        tables.show(out, tables.chosen_inputs(config))
        if config.classes is not None:
            tables.show(out, tables.class_list(config.classes))
    if save_team is not None:
        _save_team(config, save_team)
        out.print(f"saved {save_team}", soft_wrap=True)
    if output is None:
        return 0
    summary = _replay(config, output)
    tables.show(out, tables.results(summary))
    _show_warnings(err, summary)
    out.print(f"wrote {output} ({tables.size(output.stat().st_size)})", soft_wrap=True)
    return EXIT_DATA_LOST if summary.lost_data else 0


@cli.command(short_help="Write the logs of a simulated team.")
@click.argument("folder", type=_existing, metavar="DIR")
@click.option("--robots", type=int, default=6, show_default=True, help="robots in the team")
@click.option("--duration", type=float, default=60.0, show_default=True, help="length of the logs [s]")
@click.option("--rate", type=float, default=4.0, show_default=True, help="images per second and robot [Hz]")
@click.option("--image", default="160x120", show_default=True, metavar="WxH", help="image size [pixels]")
@click.option("--seed", type=int, default=0, show_default=True, help="the village, the drives and the noise")
@click.option("--resolution", type=float, default=0.3, show_default=True, help="edge of the finest cell [m]")
@click.option("--label-noise", type=float, default=0.1, show_default=True, help="share of pixels with a wrong label")
@click.option("--depth-noise/--no-depth-noise", default=True, show_default=True, help="noise that grows with range")
@click.option("--world-size", type=float, default=None, help="edge of the square village [m]  [default: fits the team]")
def simulate(folder: Path, robots: int, image: str, world_size: float | None, **options: Any) -> int:
    """Write the logs of a simulated team that explores a village into DIR.

    One ordinary MCAP log per robot, team.yaml, and the ground truth (world.npz, world.ply). The same options give the
    same bytes.
    """
    values = {"num_robots": robots, "image": _image_size(image), **options}
    if world_size is not None:
        values["world_size"] = world_size
    team_file = _simulate(folder, values)
    click.echo(f"next: octoreplay run {team_file} -o {folder / 'result.mcap'}")
    return 0


@cli.command(short_help="Simulate, replay and export, to see it all at once.")
@click.argument("folder", type=_existing, metavar="[DIR]", default=Path("octoreplay-demo"), required=False)
@click.option("--robots", type=int, default=6, show_default=True, help="robots in the team")
@click.option("--duration", type=float, default=60.0, show_default=True, help="length of the logs [s]")
@click.option("--seed", type=int, default=0, show_default=True, help="another seed, another village")
def demo(folder: Path, robots: int, duration: float, seed: int) -> int:
    """Simulate a team, replay it, and export what it found, all into DIR (octoreplay-demo).

    Takes under two minutes. Says what it made and how to look at it.
    """
    from octoreplay.io.robots import discover
    from octoreplay.report import export, plots, tables
    from octoreplay.result import open_result
    from octoreplay.team_file import load_team_file

    out, err = tables.terminal(), tables.terminal(stderr=True)
    result_path, ply, csv, figures = (folder / n for n in ("result.mcap", "map.ply", "metrics.csv", "figures"))
    team_file = _simulate(folder / "logs", {"num_robots": robots, "duration": duration, "seed": seed})
    summary = _replay(discover.resolve(load_team_file(team_file)), result_path)
    with open_result(result_path) as result:
        plots.write_metrics_csv(result.metrics, csv)
        plots.write_figures(result.metrics, figures)
    export.export_ply(result_path, ply, what="voxels")
    tables.show(out, tables.results(summary))
    _show_warnings(err, summary)
    first = summary.last.robots[0].robot_id
    tables.show(
        out,
        tables.made_files(
            {
                folder / "logs": f"what {robots} robots recorded, and the village they drove through (world.ply)",
                result_path: f"the result; open it in Foxglove: 3D panel, frame 'team', topic /{first}/map",
                ply: "the agreed map as cubes; open it in CloudCompare, MeshLab or Open3D",
                figures: "disagreement over time and packet sizes, as pictures",
                csv: "every number of every tick",
            }
        ),
    )
    out.print(f"more: octoreplay metrics {result_path}", soft_wrap=True)
    return EXIT_DATA_LOST if summary.lost_data else 0


@cli.command(short_help="Write a map of a result as a PLY file.")
@click.argument("result", type=_existing, metavar="RESULT.mcap")
@click.option("-o", "--output", type=_existing, required=True, metavar="MAP.ply", help="the PLY file")
@click.option(
    "--robot", default=None, metavar="ID", help="whose map  [default: the first robot's; all with color robot]"
)
@click.option(
    "--at", type=float, default=None, metavar="SECONDS", help="time since the run's start  [default: the end]"
)
@click.option("--what", type=click.Choice(("points", "voxels")), default="points", show_default=True,
              help="leaf centres, or cubes of the leaves' sizes")  # fmt: skip
@click.option("--color", type=click.Choice(("label", "robot", "disagreement", "probability")), default="label",
              show_default=True, help="what the colours say")  # fmt: skip
@click.option("--free", is_flag=True, help="free leaves too")
@click.option("--team-posterior", is_flag=True, help="h_0 + N (h - h_0) in place of the robot's own h")
def export(result: Path, output: Path, at: float | None, **options: Any) -> int:
    """Write a map of a result as a PLY file, which CloudCompare, MeshLab and Open3D open."""
    from octoreplay.report.export import export_ply
    from octoreplay.report.tables import size

    _check_output(output, ".ply")
    count = export_ply(result, output, at=at, **options)
    click.echo(f"wrote {output} ({count:,} {'cubes' if options['what'] == 'voxels' else 'points'}, "
               f"{size(output.stat().st_size)})")  # fmt: skip
    return 0


@cli.command(short_help="Show a result's numbers, as table, CSV or figures.")
@click.argument("result", type=_existing, metavar="RESULT.mcap")
@click.option("--csv", type=_existing, metavar="FILE.csv", help="every tick's metrics as CSV")
@click.option("--plot", type=_existing, metavar="DIR", help="figures: disagreement over time, packet sizes")
def metrics(result: Path, csv: Path | None, plot: Path | None) -> int:
    """Show what a run came to, and write its metrics as CSV or pictures."""
    from octoreplay.report import plots, tables
    from octoreplay.result import open_result

    if csv is not None:
        _check_output(csv, ".csv")
    with open_result(result) as opened:
        tables.show(tables.terminal(), tables.results(opened.summary))
        written: list[Path] = []
        if csv is not None:
            plots.write_metrics_csv(opened.metrics, csv)
            written.append(csv)
        if plot is not None:
            written += plots.write_figures(opened.metrics, plot)
    for path in written:
        click.echo(f"wrote {path}")
    return 0


@cli.command(short_help="Show what logs hold and what is missing for a run.")
@click.argument("logs", nargs=-1, required=True, type=_existing, metavar="LOG...")
def info(logs: tuple[Path, ...]) -> int:
    """Show what logs hold: robots, topics, types, rates, spans, and what is missing for a run."""
    from octoreplay.io.robots import discover
    from octoreplay.report import tables

    description = discover.describe(logs)
    if any(log.error is None for log in description.logs):
        tables.show(tables.terminal(), tables.description(description))
    errors = [log.error for log in description.logs if log.error is not None]
    for error in errors:
        click.echo(f"error: {error}", err=True)
    return EXIT_ERROR if errors else 0


@cli.command(short_help="Write a team file for some logs, to be changed by hand.")
@click.argument("logs", nargs=-1, required=True, type=_existing, metavar="LOG...")
@click.option("-o", "--output", type=_existing, required=True, metavar="TEAM.yaml", help="the team file")
@click.option("--force", is_flag=True, help="write over a file that is there")
def init(logs: tuple[Path, ...], output: Path, force: bool) -> int:
    """Write a team file with all that is found in logs, and all that can be set as comments.

    What a run would still miss stands in it too, and is said.
    """
    from octoreplay.io.robots import discover
    from octoreplay.team_file import team_template

    _check_output(output, ".yaml", logs)
    if output.exists() and not force:
        raise OutputError(f"{output}: is there already; name another file, or give --force to write over it")
    description = discover.describe(logs)
    for log in description.logs:
        if log.error is not None:
            raise InputError(log.error)
    if not description.robots:
        raise InputError(description.missing[0])
    robots = tuple(summary.robot.with_absolute_paths() for summary in description.robots)
    missing = {summary.robot.robot_id: summary.missing for summary in description.robots}
    config = RunConfig(robots, classes=description.class_table)
    _write_text(output, team_template(config, {"": description.missing, **missing}, output.parent.resolve()))
    click.echo(f"wrote {output} ({len(robots)} robot{'s' if len(robots) > 1 else ''})")
    for sentence in (*description.missing, *(sentence for found in missing.values() for sentence in found)):
        click.echo(f"missing for a run: {sentence}", err=True)
    return 0


@cli.command(short_help="Ask a map what is at a point or in a box.")
@click.argument("result", type=_existing, metavar="RESULT.mcap")
@click.option("--at", "points", type=(float, float, float), multiple=True, metavar="X Y Z",
              help="what is at this point [m], in the team's frame; may be given several times")  # fmt: skip
@click.option("--box", type=(float,) * 6, default=None, metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX",
              help="what is in this box [m]")  # fmt: skip
@click.option("--robot", default=None, metavar="ID", help="whose map is asked  [default: the first robot's]")
@click.option("--time", "seconds", type=float, default=None, metavar="SECONDS",
              help="time since the run's start  [default: the end]")  # fmt: skip
@click.option("--team-posterior", is_flag=True, help="h_0 + N (h - h_0) in place of the robot's own h")
def query(
    result: Path, points: tuple[tuple[float, float, float], ...], box: tuple[float, ...] | None, robot: str | None,
    seconds: float | None, team_posterior: bool,
) -> int:  # fmt: skip
    """Ask a robot's map what is at a point or in a box, and how sure it is."""
    import numpy as np

    from octoreplay.report import tables
    from octoreplay.result import open_result

    if not points and box is None:
        raise click.UsageError("ask for a point, --at X Y Z, or a box, --box XMIN YMIN ZMIN XMAX YMAX ZMAX")
    if not all(math.isfinite(number) for point in points for number in point):
        raise ConfigError("at: expects finite numbers")
    if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ConfigError("box: every minimum must be below its maximum")
    out = tables.terminal()
    with open_result(result) as opened:
        robot_id = opened.robots[0] if robot is None else robot
        stored = opened.map(robot_id, at_ns=None if seconds is None else opened.time_ns(seconds))
        names = ("free", *opened.class_table.names)
        out.print(
            f"map of {robot_id} {opened.seconds(stored.stamp_ns):.1f} s after the start"
            f" ({'team posterior' if team_posterior else 'as the robot holds it'})",
            soft_wrap=True,
        )
        if points:
            answer = stored.query(np.array(points), team_posterior=team_posterior)
            tables.show(out, tables.point_answers(names, points, answer))
        if box is not None:
            found = stored.query_box(box[:3], box[3:], team_posterior=team_posterior)
            tables.show(out, tables.box_answer(names, found))
    return 0


@cli.command("import-rgbd", short_help="Write a folder of depth images as a log.")
@click.argument("folder", type=_existing, metavar="DIR")
@click.option("-o", "--output", type=_existing, required=True, metavar="LOG.mcap", help="the log")
@click.option("--rate", type=float, default=None, help="images per second, where the folder has no times [Hz]")
@click.option("--times", type=_existing, default=None, metavar="FILE", help="one time per line [s], in place of --rate")
@click.option("--robot", "robot_id", default=None, metavar="ID", help="the robot's name  [default: the log's]")
@click.option("--intrinsics", default=None, metavar="FX,FY,CX,CY", help="in place of the folder's [pixels]")
@click.option("--depth-unit", type=float, default=None, help="metres per depth value, in place of the format's own")
@click.option("--labels", type=_existing, default=None, metavar="DIR", help="label PNGs, named like the depth ones")
@click.option(
    "--classes-from", type=_existing, default=None, metavar="TEAM.yaml", help="a team file that names the labels"
)
@click.option("--first", type=int, default=0, show_default=True, help="first image to take, counted from 0")
@click.option("--last", type=int, default=None, help="last image to take  [default: the last one]")
@click.option("--every", type=int, default=1, show_default=True, help="take one image of so many")
def import_rgbd(folder: Path, output: Path, intrinsics: str | None, classes_from: Path | None, **options: Any) -> int:
    """Write a folder of depth images with poses (7-Scenes, TUM RGB-D, ScanNet) as a robot's log."""
    from octoreplay.io.datasets import rgbd_folder
    from octoreplay.team_file import load_team_file

    _check_output(output, ".mcap")
    numbers = None if intrinsics is None else _numbers("intrinsics", intrinsics, 4)
    table = None if classes_from is None else load_team_file(classes_from).classes
    with _progress("import") as update:
        summary = rgbd_folder.import_rgbd(
            folder, output, intrinsics=numbers, class_table=table, progress=lambda share: update(share, None, ""),
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


@cli.command("import-clouds", short_help="Write a folder of point clouds as a log.")
@click.argument("folder", type=_existing, metavar="DIR")
@click.option("-o", "--output", type=_existing, required=True, metavar="LOG.mcap", help="the log")
@click.option("--rate", type=float, default=None, help="clouds per second, where the folder has no times [Hz]")
@click.option("--times", type=_existing, default=None, metavar="FILE", help="one time per line [s], in place of --rate")
@click.option("--poses", type=_existing, default=None, metavar="FILE",
              help="poses as TUM or KITTI have them  [default: those beside the clouds, or VIEWPOINT]")  # fmt: skip
@click.option("--frame", type=click.Choice(("sensor", "world")), default=None,
              help="what the points are given in  [default: sensor, but world with VIEWPOINT]")  # fmt: skip
@click.option("--robot", "robot_id", default=None, metavar="ID", help="the robot's name  [default: the log's]")
@click.option("--labels", type=_existing, default=None, metavar="DIR", help="KITTI .label files, named like the clouds")
@click.option(
    "--classes-from", type=_existing, default=None, metavar="TEAM.yaml", help="a team file that names the labels"
)
@click.option("--first", type=int, default=0, show_default=True, help="first cloud to take, counted from 0")
@click.option("--last", type=int, default=None, help="last cloud to take  [default: the last one]")
@click.option("--every", type=int, default=1, show_default=True, help="take one cloud of so many")
def import_clouds(folder: Path, output: Path, classes_from: Path | None, **options: Any) -> int:
    """Write a folder of point clouds with poses (PCD, PLY, KITTI) as a robot's log."""
    from octoreplay.io.datasets import cloud_folder
    from octoreplay.team_file import load_team_file

    _check_output(output, ".mcap")
    table = None if classes_from is None else load_team_file(classes_from).classes
    with _progress("import") as update:
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its code; SIGTERM ends a run as Ctrl-C does."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    logging.basicConfig(format="%(message)s")
    logging.getLogger("octoreplay").setLevel(logging.INFO)
    sys.exit(_exit_code(arguments))


def _exit_code(arguments: Sequence[str] | None) -> int:
    """Run one command; every failure becomes one sentence on stderr and an exit code."""
    try:
        code = cli.main(args=arguments, prog_name="octoreplay", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (KeyboardInterrupt, click.Abort) as error:
        # click turns a KeyboardInterrupt into Abort and keeps it as the cause.
        click.echo(str(error) or str(error.__cause__ or "") or "interrupted", err=True)
        return EXIT_INTERRUPTED
    except ConfigError as error:
        click.echo(f"error: {error}", err=True)
        return EXIT_USAGE
    except OctoreplayError as error:
        click.echo(f"error: {error}", err=True)
        return EXIT_ERROR
    return code if isinstance(code, int) else 0


# --- from options to a configuration ----------------------------------------------------------------------------------


def _is_team_file(inputs: Sequence[Path]) -> bool:
    return any(path.suffix.lower() in (".yaml", ".yml") for path in inputs)


def _base_config(inputs: tuple[Path, ...], config_from: Path | None, err: Console) -> RunConfig:
    """The configuration before any option: of a stored result, of a team file, or found in logs."""
    from octoreplay.io.results.result_reader import ResultReader
    from octoreplay.io.robots import discover
    from octoreplay.team_file import load_team_file

    if config_from is not None:
        if inputs:
            raise click.UsageError(f"--config-from {config_from} names the logs too; leave out {inputs[0]}")
        with ResultReader(config_from) as reader:
            for sentence in reader.changed_inputs():
                _warn(err, sentence)
            return reader.config
    if not inputs:
        raise click.UsageError("give a team file or logs: octoreplay run TEAM.yaml -o OUT.mcap")
    if _is_team_file(inputs):
        if len(inputs) > 1:
            raise click.UsageError("give one team file, or logs, not both")
        return load_team_file(inputs[0])
    return RunConfig(robots=discover.discover(inputs))


def _with_options(base: RunConfig, preset: str | None, edges: str | None, given: dict[str, Any]) -> RunConfig:
    """The configuration with preset and options: an option beats the preset, which beats the file."""
    parameters = {**(PRESETS[preset] if preset is not None else {}), **given}
    network: dict[str, Any] = {name: parameters.pop(name) for name in ("topology", "weights") if name in parameters}
    config = base.with_parameters(parameters)
    if edges is not None:
        links = _links(edges)
        weighted = any(weight is not None for *_, weight in links)
        network = {"topology": "edges", "weights": "given" if weighted else "metropolis", **network, "edges": links}
    elif network.get("topology", "edges") != "edges":
        # A topology by name replaces the file's list of edges, and with it the weights given there.
        network["edges"] = ()
        if base.network.weights == "given":
            network.setdefault("weights", "metropolis")
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **network))


def _with_network(config: RunConfig, one_way: str | None, schedule: Path | None) -> RunConfig:
    """The configuration with one-way links and a schedule, where they are given."""
    from octoreplay.team_file import load_schedule

    changes: dict[str, Any] = {}
    if one_way is not None:
        changes["one_way"] = tuple(_pair(entry) for entry in one_way.split(","))
    if schedule is not None:
        changes["schedule"] = load_schedule(schedule)
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **changes))


def _pair(text: str) -> tuple[str, str]:
    """A one-way link from A:B."""
    sender, _, receiver = text.strip().partition(":")
    if not sender or not receiver or ":" in receiver:
        raise ConfigError(f"one_way: '{text}' is not A:B")
    return sender, receiver


def _links(text: str) -> tuple[tuple[str, str, float | None], ...]:
    """Edges from A:B[:W],C:D[:W],..."""
    links = []
    for entry in text.split(","):
        ends = entry.strip().split(":")
        if len(ends) not in (2, 3) or not all(ends):
            raise ConfigError(f"edges: '{entry}' is not A:B or A:B:WEIGHT")
        try:
            links.append((ends[0], ends[1], float(ends[2]) if len(ends) == 3 else None))
        except ValueError:
            raise ConfigError(f"edges: the weight in '{entry}' is not a number") from None
    return tuple(links)


def _numbers(name: str, text: str, count: int) -> tuple[float, ...]:
    """So many numbers from text with commas."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise ConfigError(f"{name}: expects {count} numbers with commas between them, got '{text}'")
    return numbers


def _image_size(text: str) -> tuple[int, int]:
    """Width and height from WxH."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ConfigError(f"image: expects WIDTHxHEIGHT such as 160x120, got '{text}'")
    return int(width), int(height)


def _check_output(path: Path, suffix: str, inputs: Sequence[Path] = ()) -> None:
    """Refuse an output before any work is done: another kind of file, no file at all, or an input of the command."""
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: is a folder or a device; give a file name such as out{suffix}")
    if path.suffix.lower() != suffix and not (suffix == ".yaml" and path.suffix.lower() == ".yml"):
        raise ConfigError(f"{path}: the output's name must end in {suffix}")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: cannot be written: the folder '{path.parent}' does not exist")
    if any(path.resolve() == entry.resolve() for entry in inputs):
        raise OutputError(f"{path}: is an input of this command; name another output")


def _save_team(config: RunConfig, path: Path) -> None:
    """Write a team file whose log paths hold from its own folder."""
    from octoreplay.team_file import dump_team

    robots = tuple(robot.with_absolute_paths() for robot in config.robots)
    _write_text(path, dump_team(dataclasses.replace(config, robots=robots), path.parent.resolve()))


def _write_text(path: Path, text: str) -> None:
    """Write a whole text file."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


# --- running and showing ----------------------------------------------------------------------------------------------


def _replay(config: RunConfig, output: Path) -> RunSummary:
    """Run with a progress bar; says where the finished part is when interrupted."""
    from octoreplay.io.results.result_writer import partial_path
    from octoreplay.replay.session import replay_team

    with _progress("replay") as update:

        def show(progress: Progress) -> None:
            elapsed = progress.log_ns / 1e9
            done = None if not progress.total_ns else min(1.0, progress.log_ns / progress.total_ns)
            stage = f"settling, tick {progress.tick}" if progress.settling else f"{elapsed:.1f} s"
            update(done, None if progress.settling else elapsed, f"{stage}  \u03a6 {progress.total_distance:.3g}")

        try:
            return replay_team(config, output, progress=show)
        except KeyboardInterrupt:
            partial = partial_path(output)
            kept = f"; what was finished is in {partial}" if partial.exists() else ""
            raise KeyboardInterrupt(f"interrupted{kept}") from None


def _simulate(folder: Path, options: dict[str, Any]) -> Path:
    """Simulate with a progress bar and say what was written; the team file."""
    from octoreplay.report.tables import size
    from octoreplay.simulate.team import SimulationConfig, simulate_team

    with _progress("simulate") as update:
        summary = simulate_team(folder, SimulationConfig(**options), lambda share: update(share, None, ""))
    click.echo(
        f"simulated {len(summary.logs)} robots: {summary.num_frames:,} images, {size(summary.num_bytes)} in {folder}"
    )
    return summary.team_file


def _ignore(*_: object) -> None:
    """Progress that nobody watches."""


@contextlib.contextmanager
def _progress(title: str) -> Iterator[Callable[[float | None, float | None, str], None]]:
    """A progress bar on stderr when that is a terminal: update(share done, log seconds done, text)."""
    from rich import progress as bars

    from octoreplay.report.tables import terminal

    console = terminal(stderr=True)
    if not console.is_terminal:
        yield _ignore
        return
    columns = (
        bars.TextColumn("{task.description}"), bars.BarColumn(bar_width=24), bars.TaskProgressColumn(),
        bars.TimeElapsedColumn(), bars.TextColumn("{task.fields[text]}"),
    )  # fmt: skip
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=1.0, text="")

        def update(done: float | None, log_seconds: float | None, text: str) -> None:
            wall = bar.tasks[0].elapsed or 0.0
            speed = f"  {log_seconds / wall:.1f}x real time" if log_seconds is not None and wall > 0.5 else ""
            bar.update(task, completed=done or 0.0, text=text + speed)

        yield update


def _show_warnings(err: Console, summary: RunSummary) -> None:
    """The run's warnings, and what was lost of each robot's log."""
    for sentence in summary.warnings:
        _warn(err, sentence)
    # Robots may share a log.
    for sentence in dict.fromkeys(s for counts in summary.frame_counts.values() for s in counts.truncated_files):
        _warn(err, sentence)
    for robot_id, counts in summary.frame_counts.items():
        for sentence in _losses(counts):
            _warn(err, f"{robot_id}: {sentence}")


def _losses(counts: FrameCounts) -> Iterator[str]:
    """What could not be used of what one robot's logs hold, a sentence each."""
    for cause, what in (
        ("no_pose", "had no pose: none within pose_gap on both sides, or one beyond the map's reach"),
        ("no_label", "had no labels or confidences within pair_tolerance"),
        ("late", "came more than reorder_window late"),
        ("undecodable", "could not be read"),
    ):
        count, first = getattr(counts, cause), counts.first_missing.get(cause)
        if count:
            yield f"{count:,} of the images or clouds {what}" + (f"; the first: {first}" if first else "")
    if counts.duplicate:
        yield f"{counts.duplicate:,} images or clouds had the stamp of another one, and were left out"
    for what, numbers, spelling in (
        ("labels", counts.unknown_label_pixels, "{}"),
        ("colours", counts.unknown_colors, "#{:06x}"),
    ):
        if numbers:
            shown = ", ".join(spelling.format(number) for number in sorted(numbers)[:8])
            more = ", ..." if len(numbers) > 8 else ""
            total = sum(numbers.values())
            yield f"{total:,} pixels or points with {what} that no class has were ignored: {shown}{more}"


def _warn(err: Console, sentence: str) -> None:
    from rich.text import Text

    err.print(Text.assemble(("warning: ", "yellow"), sentence), soft_wrap=True)
