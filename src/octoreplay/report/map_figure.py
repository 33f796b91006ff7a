"""Pictures of the maps of one result or of several side by side, with the legend of their colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from octoreplay.errors import ConfigError, InputError
from octoreplay.log_odds import best_labels
from octoreplay.mapping.merged_faces import finest_cells, first_cells
from octoreplay.mapping.octree import keys_to_codes
from octoreplay.records import POSTERIOR, Color, LeafTable, UInt8Array
from octoreplay.report import map_view
from octoreplay.report.cell_colors import (
    COLORS,
    CONTRADICTION_COLORS,
    SCALED,
    LeafColors,
    common_limits,
    default_color,
    leaf_colors,
    ramp,
    robot_color,
)
from octoreplay.report.figures import SCREEN, FigureStyle, plain
from octoreplay.report.map_part import MapPart, finest_edge
from octoreplay.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AZIMUTH, ELEVATION = math.radians(74.0), math.radians(42.0)
"""Direction of view of all pictures of maps."""
_DPI = 300
_MAX_COLUMNS = 3
_LEGEND = 0.5
"""Height of the legend in rows of axes."""
_SCALES = {
    "height": "height [m]",
    "probability": "probability of the label",
    "disagreement": "distance of the log-odds to another robot's",
}
"""Labels of the colours that are scales."""


def map_figure(
    results: Mapping[str, Result], look: FigureStyle = SCREEN, *, robot: str | None = None, at: float | None = None,
    color: str | None = None, max_depth: int | None = None,
) -> Figure:  # fmt: skip
    """Return the picture of the occupied leaves of each result's map, by label, seen obliquely from above.

    ``robot`` is the robot of the maps, None for the first one; ``at`` the time since the run's start in seconds, None
    for the end; ``color`` and ``max_depth`` as in ``export_map``. All pictures have one view and one scale. Raises
    ConfigError for an unknown ``color`` or another ``max_depth``, and InputError where a result has no such map, or one
    without an occupied leaf.
    """
    if color is not None and color not in COLORS:
        raise ConfigError(f"color: '{color}' is not one of {', '.join(COLORS)}")
    shown = color or default_color(next(iter(results.values())).class_table)
    maps = {label: _occupied(result, robot, at, max_depth, shown) for label, result in results.items()}
    common = common_limits(colors.limits for _, colors, _ in maps.values())
    if len(maps) > 1 and common is not None:
        maps = {label: _occupied(result, robot, at, max_depth, shown, common) for label, result in results.items()}
    columns = min(len(maps), _MAX_COLUMNS)
    pictures = _pictures(list(maps.values()), round(look.width / columns * _DPI))
    rows, (height, width) = math.ceil(len(maps) / columns), pictures[0].shape[:2]
    with look.applied():
        panel = look.width / columns * height / width
        figure = look.figure(rows * (panel + 0.15 * look.row_height) + _LEGEND * look.row_height)
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid:
            axes.set_axis_off()
        for axes, label, picture in zip(grid, maps, pictures, strict=False):
            axes.imshow(picture, interpolation="antialiased")
            if len(maps) > 1 or not look.is_print:
                axes.set_title(label, loc="left", fontsize="medium")
        first = next(iter(maps.values()))[1]
        if first.limits is not None:
            _add_scale(figure, list(grid), first.limits, _SCALES[shown])
        else:
            entries = _entries(results, [leaves for leaves, *_ in maps.values()], shown)
            _add_entries(figure, entries, look)
    return figure


def _occupied(
    result: Result, robot: str | None, at: float | None, max_depth: int | None, color: str,
    limits: tuple[float, float] | None = None,
) -> tuple[LeafTable, LeafColors, float]:  # fmt: skip
    """Occupied leaves of a map in Morton order, their colours, and the resolution [m]; read part by part."""
    whole = MapPart(None if at is None else result.time_ns(at), max_depth=max_depth)
    robot_id = robot or result.robots[0]
    parts = list(whole.parts(result))
    if limits is None and len(parts) > 1 and color in SCALED:
        # The scale of the colours is that of all parts.
        limits = common_limits(_part(result, robot_id, part, color, None)[1].limits for part in parts)
    found = [_part(result, robot_id, part, color, limits) for part in parts]
    leaves = LeafTable.joined([table for table, _ in found])
    if not len(leaves):
        raise InputError(f"{result.path}: the map of {robot_id} holds no occupied leaf; use a later time")
    resolution = finest_edge(result, max_depth)
    order = np.argsort(keys_to_codes(first_cells(leaves, resolution)[0]), kind="stable")
    colors = found[0][1]._replace(colors=np.concatenate([colors.colors for _, colors in found])[order])
    return leaves.taken(order), colors, resolution


def _part(
    result: Result, robot_id: str, part: MapPart, color: str, limits: tuple[float, float] | None
) -> tuple[LeafTable, LeafColors]:
    """Occupied leaves of a part of a map, and their colours."""
    stored = part.map(result, robot_id)
    leaves = stored.leaves(map_kind=POSTERIOR)
    leaves = leaves.taken(best_labels(leaves.log_odds) > 0)
    return leaves, leaf_colors(result, [stored], leaves, color, part, limits)


def _pictures(maps: Sequence[tuple[LeafTable, LeafColors, float]], width: int) -> list[UInt8Array]:
    """Pictures of maps from one direction at one scale, cut to the part that any of them fills."""
    points = np.concatenate([leaves.centers for leaves, *_ in maps])
    view = map_view.view_of(points, AZIMUTH, ELEVATION, width, 2 * width)
    pictures = [_picture(leaves, colors.colors, resolution, view) for leaves, colors, resolution in maps]
    is_filled = np.any([(picture < 255).any(axis=(1, 2)) for picture in pictures], axis=0)
    filled = np.flatnonzero(is_filled)
    return [picture[filled[0] : filled[-1] + 1] for picture in pictures]


def _picture(leaves: LeafTable, colors: UInt8Array, resolution: float, view: map_view.View) -> UInt8Array:
    """Picture of leaves as cubes on a white background."""
    try:
        keys, owners = finest_cells(leaves, resolution)
        centers = np.asarray((keys + 0.5) * resolution, np.float64)
        picture = map_view.draw(map_view.cube_faces(centers, resolution, colors[owners], np.ones(len(keys))), view)
    except ValueError as error:
        raise InputError(f"the map is too large for a picture: {error}; give a smaller max_depth") from error
    picture[(picture == np.array(map_view.BACKGROUND)).all(axis=2)] = 255
    return picture


def _entries(results: Mapping[str, Result], tables: Sequence[LeafTable], color: str) -> dict[str, Color]:
    """Names and colours of the legend."""
    if color == "contradiction":
        return dict(CONTRADICTION_COLORS.values())
    if color in ("robot", "seen-by"):
        robots = dict.fromkeys(robot_id for result in results.values() for robot_id in result.robots)
        entries = {robot_id: robot_color(index) for index, robot_id in enumerate(robots)}
        return {**entries, "several robots": (130, 130, 130)} if color == "seen-by" else entries
    entries = {}
    for result, leaves in zip(results.values(), tables, strict=True):
        present = np.unique(best_labels(leaves.log_odds)).tolist()
        entries |= {c.name.replace("_", " "): c.color for c in result.class_table.classes if c.class_id in present}
    return entries


def _add_entries(figure: Figure, entries: Mapping[str, Color], look: FigureStyle) -> None:
    """Add a legend of colours below the pictures."""
    from matplotlib.patches import Patch

    patches = [
        Patch(facecolor=_hex(color), edgecolor="#555555", linewidth=0.4, label=plain(name))
        for name, color in entries.items()
    ]
    figure.legend(
        handles=patches, frameon=False, fontsize="small", loc="outside lower center", ncols=look.columns,
        handlelength=1.2,
    )  # fmt: skip


def _hex(color: Color) -> str:
    """Colour as matplotlib takes it."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def _add_scale(figure: Figure, grid: list[Any], limits: tuple[float, float], label: str) -> None:
    """Add a colour scale below the pictures."""
    from matplotlib import rcParams
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    colors = ListedColormap(ramp(np.linspace(0.0, 1.0, 256)) / 255.0)
    bar = figure.colorbar(
        ScalarMappable(Normalize(*limits), colors), ax=grid, location="bottom", shrink=0.5, aspect=30, pad=0.02
    )
    bar.set_label(label, fontsize="small")
    bar.ax.tick_params(labelsize=0.9 * rcParams["font.size"], labelfontfamily=rcParams["font.family"])
    bar.outline.set_visible(False)
