"""Commands that read a result: metrics, export, query."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from octoreplay.commands.console import prints, terminal
from octoreplay.commands.options import (
    check_new_folder,
    check_new_tiles,
    check_output,
    color_option,
    existing_path,
    force_option,
    lock_folder,
    map_option,
    max_depth_option,
    parse_bounds,
)
from octoreplay.commands.progress import show_results
from octoreplay.commands.suggestions import Choice
from octoreplay.errors import ConfigError


@click.command(short_help="Show the metrics of a result as tables, CSV or figures.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("--csv", type=existing_path, metavar="FILE.csv", help="write the metrics of every tick as CSV")
@click.option("--plot", type=existing_path, metavar="DIR",
              help="write figures of disagreement over time and packet sizes into this folder")  # fmt: skip
@force_option
@prints
def metrics(result: Path, csv: Path | None, plot: Path | None) -> int:
    """Show the metrics of a result, and write them as CSV or figures."""
    if csv is not None:
        check_output(csv, ".csv")
    if plot is not None:
        check_new_folder(plot)
        lock_folder(plot)

    from octoreplay.report import plots
    from octoreplay.result import open_result

    here = terminal()
    with open_result(result) as opened:
        document = show_results(opened.summary)
        written: list[Path] = []
        if csv is not None:
            plots.write_metrics_csv(opened.metrics, csv)
            written.append(csv)
        if plot is not None:
            written += plots.write_figures(opened.metrics, plot)
    for path in written:
        here.line(f"wrote {path}")
    here.give(result=result, **document, written=written)
    return 0


@click.command(short_help="Write a map of a result for other tools: PLY, GLB, LAZ, OctoMap, grid and others.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("-o", "--output", type=existing_path, required=True, metavar="FILE",
              help="file to write: .ply, .npz, .glb (mesh), .laz or .las, .bt or .ot (OctoMap), .yaml (occupancy"
                   " grid)")  # fmt: skip
@click.option("--robot", default=None, metavar="ID",
              help="robot id, or 'central'  [default: the first robot; all robots with --color robot]")  # fmt: skip
@click.option("--at", type=float, default=None, metavar="SECONDS",
              help="time of the map since the run's start [s]  [default: the end]")  # fmt: skip
@click.option("--what", type=Choice(("points", "voxels")), default="points", show_default=True,
              help="in a PLY file, the centres of leaves (points) or cubes of their sizes (voxels)")  # fmt: skip
@color_option
@click.option("--free", is_flag=True, help="write free leaves too; OctoMap files and grids always have them")
@click.option("--heights", type=(float, float), default=(-math.inf, math.inf), metavar="LOW HIGH",
              help="heights of the map to write [m]  [default: all]")  # fmt: skip
@click.option("--split", type=click.Choice(("class", "robot")), default=None,
              help="write a file of each class, or of each robot's map")  # fmt: skip
@click.option("--bounds", callback=parse_bounds, default=None, metavar="NUMBERS",
              help="part of the map to write, ZMIN,ZMAX or XMIN,YMIN,ZMIN,XMAX,YMAX,ZMAX in the map's frame [m]; leaves"
                   " are cut at its sides  [default: all]")  # fmt: skip
@click.option("--tile", type=float, default=None, metavar="METRES",
              help="write a file of each square tile of the x-y plane with this edge, FILE-xX_yY; leaves are cut at its"
                   " borders")  # fmt: skip
@max_depth_option
@map_option
@force_option
@prints
def export(result: Path, output: Path, at: float | None, **options: Any) -> int:
    """Write a map of a result to a file of another tool.

    PLY files open in CloudCompare, MeshLab and Open3D, GLB files in Blender and web viewers, LAZ files in CloudCompare,
    QGIS and PDAL, NPZ files in NumPy, .bt and .ot files in OctoMap's tools, and .yaml files, with a .pgm image beside
    them, in the map servers of ROS and nav2.
    """
    from octoreplay.report.export import SUFFIXES, export_map
    from octoreplay.report.tables import size

    check_output(output, SUFFIXES)
    if output.suffix.lower() in (".yaml", ".yml"):
        check_output(output.with_suffix(".pgm"), ".pgm")
    if options["tile"] is not None:
        check_new_tiles(output)
    units = {".ply": "cubes" if options["what"] == "voxels" else "points", ".las": "points", ".laz": "points",
             ".yaml": "known cells", ".yml": "known cells", ".pgm": "known cells"}  # fmt: skip
    here, counts = terminal(), export_map(result, output, at=at, **options)
    if options["tile"] is not None:
        here.line(f"wrote {len(counts):,} file{'s' * (len(counts) > 1)} such as {next(iter(counts))}")
    for path, count in counts.items():
        if options["tile"] is None or here.is_verbose:
            unit = units.get(path.suffix.lower(), "leaves")
            here.line(f"wrote {path} ({count:,} {unit}, {size(path.stat().st_size)})")
    here.give(result=result, written=list(counts), counts=list(counts.values()))
    return 0


@click.command(short_help="Show the classes at points or in a box of a map.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("--point", "points", type=(float, float, float), multiple=True, metavar="X Y Z",
              help="point in the team's frame [m]; may be repeated")  # fmt: skip
@click.option("--box", type=(float,) * 6, default=None, metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX",
              help="box in the team's frame [m]")  # fmt: skip
@click.option("--robot", default=None, metavar="ID", help="robot id, or 'central'  [default: the first robot]")
@click.option("--at", "seconds", type=float, default=None, metavar="SECONDS",
              help="time of the map since the run's start [s]  [default: the end]")  # fmt: skip
@click.option("--log-odds", is_flag=True, help="show the log-odds of the classes at points too")
@map_option
@prints
def query(
    result: Path, points: tuple[tuple[float, float, float], ...], box: tuple[float, ...] | None, robot: str | None,
    seconds: float | None, log_odds: bool, map_kind: str,
) -> int:  # fmt: skip
    """Show the probabilities of a robot's map at points, or the classes in a box.

    At a point: the probabilities that it is occupied and free, and those of the classes, from the posterior of the
    team. With --log-odds also h, the logarithm of each class's probability over that of free space.
    """
    from octoreplay.report.queries import answer_query
    from octoreplay.report.query_tables import box_answer, log_odds_table, point_answers, query_content
    from octoreplay.result import open_result

    if not points and box is None:
        raise click.UsageError("name a point with --point X Y Z, or a box with --box XMIN YMIN ZMIN XMAX YMAX ZMAX")
    if not all(math.isfinite(number) for point in points for number in point):
        raise ConfigError("point: expects finite numbers")
    if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ConfigError("box: every minimum must be below its maximum")
    here = terminal()
    with open_result(result) as opened:
        robot_id = opened.robots[0] if robot is None else robot
        at_ns = None if seconds is None else opened.time_ns(seconds)
        stored, answer, found = answer_query(opened, robot_id, at_ns, points=points, box=box, map_kind=map_kind)
        names, at = ("free", *opened.class_table.names), opened.seconds(stored.stamp_ns)
        title = stored.title(map_kind)
        here.line(f"map of {robot_id} {at:.1f} s after the start ({title}, frame {stored.frame_id})")
    if answer is not None:
        here.show(point_answers(names, points, answer))
        if log_odds or here.is_verbose:
            here.show(log_odds_table(names, points, answer))
    if found is not None:
        here.show(box_answer(names, found))
    here.give(result=result, robot_id=robot_id, seconds=at, map=title, frame_id=stored.frame_id,
              **query_content(names, points, answer, found))  # fmt: skip
    return 0
