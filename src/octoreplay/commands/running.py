"""Commands that produce logs and results: run, simulate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay.commands.aligning import aligned_run, dof_option
from octoreplay.commands.console import prints, terminal
from octoreplay.commands.exit_codes import EXIT_DATA_LOST
from octoreplay.commands.options import (
    RareOption,
    SectionedCommand,
    check_output,
    existing_path,
    force_option,
    lock_folder,
    log_place,
    numbers,
    parse_size,
    preset_option,
    with_parameters,
)
from octoreplay.commands.progress import replay_tiles_with_bar, replay_with_bar, show_results, simulate_with_bar
from octoreplay.commands.suggestions import Choice
from octoreplay.commands.team_options import (
    base_config,
    is_team_file,
    save_team_file,
    static_pose_option,
    with_network,
)
from octoreplay.config.alignment import ON_AIR
from octoreplay.config.class_file import with_classes
from octoreplay.config.class_tables.label_rows import BUILT_IN
from octoreplay.config.file_url import InputFile
from octoreplay.config.parameters import PARAMETERS
from octoreplay.config.presets import with_options
from octoreplay.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from octoreplay.config.resolved import ResolvedRun
    from octoreplay.config.run import RunConfig


_BEFORE = "before"
_ALIGN_VALUES = (_BEFORE, ON_AIR, "off")


_AUTO = "auto"


def _parse_edge(ctx: click.Context, param: click.Parameter, value: Any) -> float | str | None:
    """Return the edge of tiles [m], or 'auto'. Raises BadParameter."""
    return value if value in (None, _AUTO) else float(click.FLOAT.convert(value, param, ctx))


class _RunCommand(SectionedCommand):
    """Command whose option ``--align`` may stand without a value."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments. ``--align`` before anything but one of its values means ``--align=before``."""
        return super().parse_args(ctx, list(_with_align_values(args)))


def _with_align_values(args: Sequence[str]) -> Iterator[str]:
    """Arguments with a value for every ``--align``."""
    words = iter(args)
    for word in words:
        if word == "--":
            yield from (word, *words)
        elif word != "--align":
            yield word
        else:
            following = next(words, None)
            if following in _ALIGN_VALUES:
                yield f"--align={following}"
                continue
            yield "--align=before"
            if following is not None:
                _check_input(following)
                yield from _with_align_values([following, *words])


def _check_input(word: str) -> None:
    """Raise UsageError for a word after ``--align`` that is no option, has no suffix, and is no existing folder."""
    if not word.startswith("-") and not Path(word).suffix and not Path(word).exists():
        raise click.UsageError(f"'{word}' is no file and no value of --align ({', '.join(_ALIGN_VALUES)})")


@with_parameters()
@click.command(cls=_RunCommand, short_help="Replay logs into maps and run a distributed consensus on them.")
@click.argument("inputs", nargs=-1, type=log_place, metavar="TEAM.yaml | LOG...")
@click.option("-o", "--output", type=existing_path, metavar="OUT.mcap", help="result to write")
@click.option("--config-from", type=existing_path, metavar="RESULT.mcap",
              help="use the logs and settings stored in this result, instead of TEAM.yaml or LOG")  # fmt: skip
@click.option("--resume", is_flag=True,
              help="continue an interrupted run after its last check point; ends with the same bytes")  # fmt: skip
@click.option("--restart", cls=RareOption, is_flag=True,
              help="remove the unfinished result that an earlier run left, and start from the beginning")  # fmt: skip
@click.option("--checkpoint-every", cls=RareOption, type=click.FloatRange(min=0.0), metavar="SECONDS",
              help="least time between check points, 0 for none  [default: at most 3 % of the run's time]")  # fmt: skip
@click.option("--memory-limit", cls=RareOption, callback=parse_size, metavar="SIZE",
              help="largest memory, such as 8GB: a run that takes more is replayed in tiles")  # fmt: skip
@click.option("--tiles", cls=RareOption, callback=_parse_edge, metavar="[METRES|auto]",
              help="replay tiles of the space with this edge one after the other; the maps are the same; auto: the"
              " largest tiles that fit into the memory")  # fmt: skip
@click.option("--tiles-z", cls=RareOption, is_flag=True, help="cut the heights too: tiles are cubes")
@click.option("--jobs", cls=RareOption, type=click.IntRange(min=1), metavar="N",
              help="number of --tiles that are replayed at once  [default: 1]")  # fmt: skip
@click.option("--scheduler", cls=RareOption, metavar="tcp://HOST:PORT",
              help="address of a dask scheduler; --tiles are replayed on its workers")  # fmt: skip
@click.option("--result-per-tile", cls=RareOption, is_flag=True,
              help="write the maps of each of the --tiles to a file in OUT.maps, and all else to OUT.mcap")  # fmt: skip
@click.option("--report", type=existing_path, metavar="PAGE.html",
              help="write the result as a web page too, as 'octoreplay report' does")  # fmt: skip
@click.option("--save-team", type=existing_path, metavar="TEAM.yaml",
              help="write robots, topics and settings to this team file")  # fmt: skip
@preset_option
@click.option("--edges", cls=RareOption, metavar="A:B[:W],...",
              help="edge list of the communication graph; give a weight W for all edges or for none")  # fmt: skip
@click.option("--one-way", cls=RareOption, metavar="A:B,...", help="links that carry packets from A to B only")
@click.option("--schedule", cls=RareOption, type=existing_path, metavar="FILE.yaml",
              help="schedule of failures of robots and links (docs/communication.md)")  # fmt: skip
@click.option("--align", type=Choice(_ALIGN_VALUES), metavar="[before|on-air|off]",
              help=f"{PARAMETERS['align'].help}; before, also without a value: find the frames first, as 'octoreplay"
              " align' does, and leave other robots out")  # fmt: skip
@dof_option(RareOption)
@static_pose_option
@click.option("--classes", metavar="NAME|FILE",
              help=f"class table that gives the meaning of labels: {', '.join(BUILT_IN)}, or a file")  # fmt: skip
@force_option
@prints
def run(
    inputs: tuple[InputFile, ...], output: Path | None, config_from: Path | None, resume: bool, restart: bool,
    checkpoint_every: float | None, memory_limit: int | None, tiles: float | str | None, tiles_z: bool,
    jobs: int | None, scheduler: str | None, result_per_tile: bool, report: Path | None, save_team: Path | None,
    preset: str | None, edges: str | None, one_way: str | None, schedule: Path | None, align: str | None,
    dof: str | None, static_poses: tuple[str, ...], classes: str | None, **parameters: Any,
) -> int:  # fmt: skip
    """Replay a team's logs into semantic octree maps and run a distributed consensus on them.

    The input is a team file, or logs (MCAP, ROS 1 bags, rosbag2 folders) in which robots and topics are detected. What
    is detected is shown, and --save-team writes it to a team file.
    """
    if output is None and save_team is None:
        raise click.UsageError("name the result with -o OUT.mcap (or use --save-team TEAM.yaml to stop before the run)")
    if dof is not None and align != _BEFORE:
        raise click.UsageError(
            "--dof needs --align" + ("; robots that align on air know their vertical axes" if align == ON_AIR else "")
        )
    if resume and restart:
        raise click.UsageError("--resume continues an earlier run and --restart removes it; give one of them")
    if tiles is None and (jobs is not None or scheduler is not None or tiles_z or result_per_tile):
        raise click.UsageError("--jobs, --scheduler, --tiles-z and --result-per-tile need --tiles")
    if tiles is not None and checkpoint_every is not None:
        raise click.UsageError("--checkpoint-every is for runs without --tiles")
    if output is not None:
        _check_result(output, config_from, resume=resume, restart=restart)
    if report is not None:
        check_output(report, ".html")
    if save_team is not None:
        check_output(save_team, ".yaml", inputs)

    from octoreplay.io.robots import discover
    from octoreplay.io.robots.survey import LogSurveys
    from octoreplay.report.log_tables import chosen_inputs, class_list
    from octoreplay.report.tables import size

    here = terminal()
    given = {name: value for name, value in parameters.items() if value is not None}
    if align is not None:
        given["align"] = "off" if align == _BEFORE else align
    with LogSurveys() as surveys:
        base = base_config(inputs, config_from, surveys, static_poses)
        base = base if classes is None else with_classes(base, classes)
        chosen = with_network(with_options(base, preset, edges, given), one_way, schedule)
        if align == _BEFORE:
            config, alignment = aligned_run(chosen, int(dof or 4), surveys)
        else:
            config, alignment = discover.resolve(chosen, surveys), None
    for sentence in config.warnings:
        here.warn(sentence)
    if config_from is None and not is_team_file(inputs):
        here.show(chosen_inputs(config), class_list(config.classes))
    else:
        for line in _found_frames(base, config):
            here.line(line)
    if save_team is not None:
        save_team_file(config, save_team)
        here.line(f"saved {save_team}")
        here.give(team_file=save_team)
    if output is None:
        return 0
    if tiles is None and memory_limit is not None and _takes_more(config, output, memory_limit, resume=resume):
        tiles = _AUTO
    if tiles is not None:
        summary = replay_tiles_with_bar(
            config, output, None if tiles == _AUTO else float(tiles), cut_heights=tiles_z, num_jobs=jobs or 1,
            scheduler=scheduler, memory_limit=memory_limit, result_per_tile=result_per_tile,
            restart=restart, resume=resume,
        )  # fmt: skip
    else:
        summary = replay_with_bar(
            config, output, restart=restart, resume=resume, checkpoint_every=checkpoint_every, memory_limit=memory_limit
        )
    document = show_results(summary)
    here.line(f"wrote {output} ({size(output.stat().st_size)})")
    if report is not None:
        from octoreplay.report.page.page import write_page

        here.line(f"wrote {report} ({size(write_page(output, report))})")
    here.give(result=output, team_file=save_team, report=report, **document)
    is_whole = summary.last.num_components == 1 and (alignment is None or alignment.is_whole)
    return EXIT_DATA_LOST if summary.lost_data or not is_whole else 0


def _check_result(output: Path, config_from: Path | None, *, resume: bool, restart: bool) -> None:
    """Check the path of the result, and of the unfinished result of an earlier run that this run must not remove.

    A run that continues may replace the result, as the interrupted one. Raises OutputError.
    """
    from octoreplay.io.results.result_writer import check_unstarted, partial_path
    from octoreplay.replay.checkpoint import can_resume

    continues = resume and can_resume(output)
    check_output(output, ".mcap", is_kept=not continues)
    if not resume and not restart:
        check_unstarted(output)
        return
    if not continues and config_from is not None and config_from.resolve() == partial_path(output).resolve():
        raise OutputError(f"{config_from}: this run would remove this result of --config-from; name another output")


def _takes_more(config: ResolvedRun, output: Path, memory_limit: int, *, resume: bool) -> bool:
    """Return True for a run that takes more memory than a limit without tiles, and can be replayed in them."""
    from octoreplay.replay.checkpoint import can_resume
    from octoreplay.study.tiles.forecast import takes_tiles
    from octoreplay.study.tiles.run import check_separable
    from octoreplay.study.tiles.work_folder import can_resume_tiles

    if resume and (can_resume_tiles(output) or can_resume(output)):
        return can_resume_tiles(output)
    try:
        check_separable(config)
    except ConfigError:
        return False
    return takes_tiles(config, memory_limit)


def _found_frames(given: RunConfig, config: ResolvedRun) -> Iterator[str]:
    """Lines on the robots whose poses TF transforms to a map frame that the configuration does not name."""
    named = {robot.robot_id for robot in given.robots if robot.map_frame is not None}
    # An alignment may have left robots out.
    for resolved in config.robots:
        if resolved.robot_id not in named and resolved.frame is not None and resolved.frame.origin:
            yield f"{resolved.robot_id}: map frame {resolved.map_frame} ({resolved.frame.origin})"


@click.command(short_help="Write the logs of a simulated team.")
@click.argument("folder", type=existing_path, metavar="DIR")
@click.option("--robots", type=int, default=None,
              help="number of robots in the team  [default: 6, or one for each path]")  # fmt: skip
@click.option("--duration", type=float, default=60.0, show_default=True, help="length of the logs [s]")
@click.option("--rate", type=float, default=4.0, show_default=True, help="images or scans per second and robot [Hz]")
@click.option("--sensor", type=Choice(("camera", "lidar")), default="camera", show_default=True,
              help="depth and label images of a camera, or labelled point clouds of a LiDAR")  # fmt: skip
@click.option("--image", default="160x120", show_default=True, metavar="WxH", help="image size [pixels]")
@click.option("--scan", default="64x1024", show_default=True, metavar="RINGSxCOLUMNS", help="size of a LiDAR's scans")
@click.option("--scan-view", default="-22.5,22.5", show_default=True, metavar="LOW,HIGH",
              help="elevation of a LiDAR's lowest and highest ring [degrees]")  # fmt: skip
@click.option("--scan-range", type=float, default=100.0, show_default=True, help="range of a LiDAR [m]")
@click.option("--seed", type=int, default=0, show_default=True, help="seed of the village and of all noise")
@click.option("--resolution", type=float, default=0.3, show_default=True,
              help="cell size of the ground truth, and resolution in the team file [m]")  # fmt: skip
@click.option(
    "--label-noise", type=float, default=0.1, show_default=True, help="share of pixels or points with a wrong label"
)
@click.option("--patchy-noise", type=float, default=0.0, show_default=True,
              help="share of the places, cubes of 2 m, that a robot always labels wrongly")  # fmt: skip
@click.option("--similar-errors", is_flag=True,
              help="wrong labels are of the class that resembles the right one, such as roof for building")  # fmt: skip
@click.option("--confidences", type=float, default=None, metavar="TEMPERATURE",
              help="write confidences of the labels; 1: calibrated, less: too high")  # fmt: skip
@click.option("--depth-noise", type=float, default=1.0, show_default=True, metavar="FACTOR",
              help="factor on the noise of a depth camera, which grows with depth, or of a LiDAR's ranges")  # fmt: skip
@click.option("--pose-noise", type=float, default=0.0, show_default=True,
              help="standard deviation of the recorded poses' error, correlated over ten seconds [m]")  # fmt: skip
@click.option("--odometry-drift", default="0,0", show_default=True, metavar="PERCENT,DEGREES",
              help="drift of the recorded poses: of the way [%], of the heading per 10 m [degrees]")  # fmt: skip
@click.option("--own-frames", is_flag=True,
              help="record each robot's poses in an odometry frame of its own")  # fmt: skip
@click.option("--fixes", type=float, default=None, metavar="SIGMA",
              help="write a position fix (GPS) each second, with this standard deviation [m]")  # fmt: skip
@click.option("--kinds-per-class", type=int, default=1, show_default=True,
              help="divide each of the eight classes into this many classes")  # fmt: skip
@click.option("--colour", type=Choice(("raw", "jpeg", "png")), default=None,
              help="write colour images with light, shadow and noise in this form")  # fmt: skip
@click.option("--colour-offset", default="0,0,0", show_default=True, metavar="X,Y,Z",
              help="position of the colour camera in the depth camera's frame; 0,0,0: aligned [m]")  # fmt: skip
@click.option("--no-labels", is_flag=True, help="write no labels and no class names")
@click.option("--world-size", type=float, default=70.0, show_default=True, help="edge length of the square village [m]")
@click.option("--speed", type=float, default=1.0, show_default=True, help="speed of the robots [m/s]")
@click.option("--paths", type=existing_path, default=None, metavar="FILE",
              help="YAML file with the waypoints of each robot; without it the robots explore")  # fmt: skip
@prints
def simulate(folder: Path, robots: int | None, paths: Path | None, no_labels: bool, **options: Any) -> int:
    """Simulate a team that drives through a village and write its logs into DIR.

    Writes one MCAP log per robot, team.yaml and the ground truth (world.npz, world.ply; with own frames, noise of
    poses or drift also frames.yaml and truth/ROBOT.tum). Equal options give equal bytes.
    """
    from octoreplay.config.paths_file import load_paths_file

    given = () if paths is None else load_paths_file(paths)
    options |= {
        "num_robots": (len(given) or 6) if robots is None else robots, "paths": given, "has_labels": not no_labels,
        "image": _size("image", options["image"], "WIDTHxHEIGHT such as 160x120"),
        "scan": _size("scan", options["scan"], "RINGSxCOLUMNS such as 64x1024"),
        "scan_view": numbers("scan_view", options["scan_view"], 2),
        "odometry_drift": _drift(options["odometry_drift"]),
        "colour_offset": numbers("colour_offset", options["colour_offset"], 3),
    }  # fmt: skip
    lock_folder(folder)
    team_file = simulate_with_bar(folder, options)
    command, suffix = ("align", "aligned.yaml") if options["own_frames"] else ("run", "result.mcap")
    terminal().line(f"next: octoreplay {command} {team_file} -o {folder / suffix}")
    terminal().give(team_file=team_file)
    return 0


def _size(name: str, text: str, form: str) -> tuple[int, int]:
    """The two whole numbers of a text NxN."""
    first, _, second = text.lower().partition("x")
    if not (first.isdecimal() and second.isdecimal()):
        raise ConfigError(f"{name}: expects {form}, got '{text}'")
    return int(first), int(second)


def _drift(text: str) -> tuple[float, float]:
    """Percent and degrees of a text PERCENT,DEGREES."""
    try:
        percent, degrees = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"odometry_drift: expects PERCENT,DEGREES such as 1,0.5, got '{text}'") from None
    return percent, degrees
