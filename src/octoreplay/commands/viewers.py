"""Commands that write files for other viewers: foxglove-layout, rviz-config, rerun."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.options import check_output, existing_path, force_option, map_option, max_depth_option
from octoreplay.commands.progress import progress_bar
from octoreplay.io.output_file import write_whole


@click.command("foxglove-layout", short_help="Write a layout of Foxglove for a result.")
@click.argument("result", type=existing_path, required=False, default=None, metavar="[RESULT.mcap]")
@click.option("-o", "--output", type=existing_path, required=True, metavar="LAYOUT.json", help="layout to write")
@force_option
@prints
def foxglove_layout(result: Path | None, output: Path) -> int:
    """Write a layout of Foxglove that shows a result: maps, poses, links, plots and tables.

    Without a result the layout has the panels of the team, and no panel of a robot.
    """
    check_output(output, ".json", () if result is None else (result,))

    from octoreplay.report.viewers.foxglove import foxglove_layout
    from octoreplay.report.viewers.scene import Scene, scene_of
    from octoreplay.result import open_result

    if result is None:
        scene = Scene()
    else:
        with open_result(result) as opened:
            scene = scene_of(opened)
    write_whole(output, foxglove_layout(scene))
    terminal().line(f"wrote {output}; in Foxglove open the result, then Layouts > Import from file")
    terminal().give(result=result, written=[output])
    return 0


@click.command("rviz-config", short_help="Write a configuration of RViz for a result.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("-o", "--output", type=existing_path, required=True, metavar="VIEW.rviz", help="configuration to write")
@force_option
@prints
def rviz_config(result: Path, output: Path) -> int:
    """Write a configuration of RViz that shows a result, and beside it the QoS profiles for 'ros2 bag play'.

    'run --markers-every SECONDS' adds the maps as cubes of their true sizes to the result; without them RViz shows
    boxes of the finest leaf's size.
    """
    qos = output.with_suffix(".qos.yaml")
    check_output(output, ".rviz", (result,))
    check_output(qos, ".yaml", (result,))

    from octoreplay.report.viewers.rviz import playback_qos, rviz_config
    from octoreplay.report.viewers.scene import scene_of
    from octoreplay.result import open_result

    with open_result(result) as opened:
        scene = scene_of(opened)
    write_whole(output, rviz_config(scene))
    write_whole(qos, playback_qos(scene))
    here = terminal()
    here.line(f"wrote {output} and {qos}; show the result with")
    here.line(f"  rviz2 -d {shlex.quote(str(output))} --ros-args -p use_sim_time:=true")
    here.line(
        f"  ros2 bag play --storage mcap --clock 50 --qos-profile-overrides-path {shlex.quote(str(qos))}"
        f" {shlex.quote(str(result))}"
    )
    here.give(result=result, written=[output, qos])
    return 0


@click.command(short_help="Write a recording of the Rerun viewer for a result.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("-o", "--output", type=existing_path, required=True, metavar="OUT.rrd", help="recording to write")
@click.option("--robot", "robots", multiple=True, metavar="ID",
              help="robot whose maps are shown, or 'central'; may be repeated  [default: all and central]")  # fmt: skip
@click.option("--every", type=click.FloatRange(min=0), default=0.0, metavar="SECONDS",
              help="least time between two maps of a robot [s]  [default: all stored maps]")  # fmt: skip
@max_depth_option
@map_option
@force_option
@prints
def rerun(
    result: Path, output: Path, robots: tuple[str, ...], every: float, max_depth: int | None, map_kind: str
) -> int:
    """Write a result as a recording of the Rerun viewer: maps, poses, paths, links and metrics over time.

    Needs pip install 'octoreplay[rerun]'. 'rerun OUT.rrd' shows the recording.
    """
    check_output(output, ".rrd", (result,))

    from octoreplay.report.tables import size
    from octoreplay.report.viewers.rerun_recording import write_rerun

    with progress_bar("rerun") as update:
        summary = write_rerun(
            result, output, robots=robots, every=every, map_kind=map_kind, max_depth=max_depth,
            progress=lambda share: update(share, None, ""),
        )  # fmt: skip
    terminal().line(
        f"wrote {output} ({summary.num_maps:,} maps, {summary.num_ticks:,} ticks, {size(output.stat().st_size)});"
        f" show it with 'rerun {shlex.quote(str(output))}'"
    )
    terminal().give(result=result, written=[output], num_maps=summary.num_maps, num_ticks=summary.num_ticks)
    return 0
