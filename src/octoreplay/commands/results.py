"""Commands that read a result: metrics, export, query."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from octoreplay.commands.options import check_folder, check_output, existing_path, map_option
from octoreplay.errors import ConfigError


@click.command(short_help="Show the metrics of a result as tables, CSV or figures.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("--csv", type=existing_path, metavar="FILE.csv", help="write the metrics of every tick as CSV")
@click.option("--plot", type=existing_path, metavar="DIR",
              help="write figures of disagreement over time and packet sizes into this folder")  # fmt: skip
def metrics(result: Path, csv: Path | None, plot: Path | None) -> int:
    """Show the metrics of a result, and write them as CSV or figures."""
    from octoreplay.report import plots, tables
    from octoreplay.result import open_result

    if csv is not None:
        check_output(csv, ".csv")
    if plot is not None:
        check_folder(plot)
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


@click.command(short_help="Write a map of a result as a PLY file.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("-o", "--output", type=existing_path, required=True, metavar="MAP.ply", help="PLY file to write")
@click.option("--robot", default=None, metavar="ID",
              help="robot id, or 'central'  [default: the first robot; all robots with --color robot]")  # fmt: skip
@click.option("--at", type=float, default=None, metavar="SECONDS",
              help="time of the map since the run's start [s]  [default: the end]")  # fmt: skip
@click.option("--what", type=click.Choice(("points", "voxels")), default="points", show_default=True,
              help="write the centres of leaves (points) or cubes of their sizes (voxels)")  # fmt: skip
@click.option("--color", type=click.Choice(("label", "robot", "disagreement", "probability")), default="label",
              show_default=True, help="quantity shown by the colours")  # fmt: skip
@click.option("--free", is_flag=True, help="write free leaves too")
@map_option
def export(result: Path, output: Path, at: float | None, **options: Any) -> int:
    """Write a map of a result as a PLY file, which CloudCompare, MeshLab and Open3D open."""
    from octoreplay.report.export import export_ply
    from octoreplay.report.tables import size

    check_output(output, ".ply")
    count = export_ply(result, output, at=at, **options)
    click.echo(f"wrote {output} ({count:,} {'cubes' if options['what'] == 'voxels' else 'points'}, "
               f"{size(output.stat().st_size)})")  # fmt: skip
    return 0


@click.command(short_help="Show the classes at points or in a box of a map.")
@click.argument("result", type=existing_path, metavar="RESULT.mcap")
@click.option("--at", "points", type=(float, float, float), multiple=True, metavar="X Y Z",
              help="point in the team's frame [m]; may be repeated")  # fmt: skip
@click.option("--box", type=(float,) * 6, default=None, metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX",
              help="box in the team's frame [m]")  # fmt: skip
@click.option("--robot", default=None, metavar="ID", help="robot id, or 'central'  [default: the first robot]")
@click.option("--time", "seconds", type=float, default=None, metavar="SECONDS",
              help="time of the map since the run's start [s]  [default: the end]")  # fmt: skip
@map_option
def query(
    result: Path, points: tuple[tuple[float, float, float], ...], box: tuple[float, ...] | None, robot: str | None,
    seconds: float | None, map_kind: str,
) -> int:  # fmt: skip
    """Show the class probabilities of a robot's map at points, or the classes in a box."""
    import numpy as np

    from octoreplay.report import tables
    from octoreplay.result import open_result

    if not points and box is None:
        raise click.UsageError("name a point with --at X Y Z, or a box with --box XMIN YMIN ZMIN XMAX YMAX ZMAX")
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
            f" ({stored.title(map_kind)}, frame {stored.frame_id})",
            soft_wrap=True,
        )
        if points:
            answer = stored.query(np.array(points), map_kind=map_kind)
            tables.show(out, tables.point_answers(names, points, answer))
        if box is not None:
            found = stored.query_box(box[:3], box[3:], map_kind=map_kind)
            tables.show(out, tables.box_answer(names, found))
    return 0
