"""Export of stored maps to the files of other tools."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.file_sets import write_together
from octoreplay.io.output_file import mark_written
from octoreplay.log_odds import best_labels
from octoreplay.mapping.regions import leaf_tiles
from octoreplay.records import MAP_KINDS, POSTERIOR, FilePath, Int64Array, LeafTable
from octoreplay.report.cell_colors import COLORS, SCALED, LeafColors, common_limits, default_color, leaf_colors
from octoreplay.report.export_files import FORMATS, SPLITS, FileFormat, MapContent, MapFiles, warn_of_ground
from octoreplay.report.map_part import MapPart, finest_edge
from octoreplay.result import Result, open_result
from octoreplay.stored_map import StoredMap

SUFFIXES = tuple(FORMATS)
"""Suffixes of the formats."""


def export_map(
    result_path: FilePath, output: FilePath, robot: str | None = None, at: float | None = None,
    what: str = "points", color: str | None = None, *, free: bool = False, map_kind: str = POSTERIOR,
    heights: tuple[float, float] = (-math.inf, math.inf), split: str | None = None, bounds: Sequence[float] = (),
    tile: float | None = None, max_depth: int | None = None,
) -> dict[Path, int]:  # fmt: skip
    """Write a map of a result; return the files with the number of leaves in each, of a grid of known cells.

    The suffix of ``output`` chooses the format:

    - ``.ply``: leaf centres as points, or leaves as cubes; its comments name the options
    - ``.npz``: NumPy arrays (``io.results.npz``)
    - ``.glb``: surface of the leaves, with equal neighbouring faces merged (glTF 2.0)
    - ``.laz``, ``.las``: leaf centres with the label as classification (LAS 1.4); needs the extra ``las``
    - ``.bt``: OctoMap's OcTree, occupied and free leaves; ``.ot``: ColorOcTree with log-odds and colours
    - ``.yaml``: two-dimensional occupancy grid of ROS and nav2, with a ``.pgm`` image beside it

    Parameters
    ----------
    result_path, output : path
        Result file and file to write.
    robot : str, optional
        Robot of the map. None is the first robot; with color 'robot' it is the overlay of all robots' maps.
    at : float, optional
        Time since the run's start in seconds, None for the end.
    what : str
        For PLY, 'points' (leaf centres) or 'voxels' (cubes).
    color : str, optional
        One of ``cell_colors.COLORS``: 'label', 'height', 'robot', 'seen-by', 'disagreement', 'contradiction' or
        'probability'. None is 'label', or 'height' for a map with a single class.
    free : bool
        True to write free leaves too. OctoMap trees and grids always have them.
    map_kind : str
        'posterior' or 'mean' (``StoredMap``), for labels and probabilities; the disagreement is that of the mean.
    heights : (float, float)
        Lowest and highest z of the map [m]; leaves that overlap this range are written.
    split : str, optional
        'class' for a file of each class, 'robot' for a file of each robot's map. They are ``NAME-CLASS_ID-CLASS`` and
        ``NAME-ROBOT`` with the suffix of ``output``, and get their names when all of them are complete.
    bounds : sequence of float
        Box of the map to write, (zmin, zmax) or (xmin, ymin, zmin, xmax, ymax, zmax) in the map's frame [m]; leaves are
        cut at its sides (``Result.map``). Empty for the whole map.
    tile : float, optional
        Edge [m] of square tiles of the x-y plane: a file for each tile with leaves, ``NAME-xX_yY``, X and Y the tile's
        lower limits [m], multiples of the edge. Leaves are cut at the borders of tiles. The files get their names as
        those of ``split``.
    max_depth : int, optional
        Depth of the finest cells, from 1 to 19 (``StoredMap.coarsened``); all cells by default.

    Raises
    ------
    ConfigError
        An option or the suffix is unknown, options exclude each other, or an optional package is missing.
    InputError
        The result cannot be read, has no such map, or has maps in several frames that the options put together.
    OutputError
        A file cannot be written, or its format cannot hold the map.
    """
    output = Path(output)
    kind = _checked_format(output, what, color, map_kind, heights, split, robot)
    with open_result(result_path) as result, MapFiles(kind, what, output.parent) as files:
        at_ns = None if at is None else result.time_ns(at)
        part = MapPart(at_ns, bounds, max_depth)
        _check_tile(tile, finest_edge(result, max_depth))
        color = color or default_color(result.class_table)
        shown = _Shown(part, color, map_kind, heights, with_free=free or kind.has_free)
        groups = _groups(result, robot, color, split)
        is_empty = True
        for ids in groups:
            for content in _contents(result, ids, shown, in_parts=kind.encode is None):
                is_empty &= not len(content.leaves)
                for path, piece in _pieces(output, ids, content, split, tile, kind):
                    files.add(path, piece)
        if is_empty:
            raise _empty(result, groups, shown)
        write_together(files.contents())
        mark_written(output)
        return files.counts


class _Shown(NamedTuple):
    """What files show of a map: its part, colours, form, heights [m], and whether free leaves are written."""

    part: MapPart
    color: str
    map_kind: str
    heights: tuple[float, float]
    with_free: bool


def _checked_format(
    output: Path, what: str, color: str | None, map_kind: str, heights: tuple[float, float], split: str | None,
    robot: str | None,
) -> FileFormat:  # fmt: skip
    """Format of the output; ConfigError for options that are unknown or exclude each other."""
    suffix = output.suffix.lower().replace(".yml", ".yaml")
    kind = FORMATS.get(suffix)
    if kind is None:
        raise ConfigError(f"{output}: the name of the output must end in one of {', '.join(SUFFIXES)}")
    for name, value, choices in (
        ("what", what, ("points", "voxels")), ("color", color, COLORS), ("map", map_kind, MAP_KINDS),
        ("split", split, SPLITS),
    ):  # fmt: skip
        if value is not None and value not in choices:
            raise ConfigError(f"{name}: '{value}' is not one of {', '.join(choices)}")
    if not heights[0] < heights[1]:
        raise ConfigError(f"heights: the lowest, {heights[0]:g}, must be below the highest, {heights[1]:g}")
    if split is not None and split not in kind.splits:
        raise ConfigError(f"{output}: a {suffix} file holds occupied and free space together; split it by robot only")
    if split == "robot" and robot is not None:
        raise ConfigError(f"split: 'robot' writes the maps of all robots; leave out robot '{robot}'")
    return kind


def _check_tile(tile: float | None, edge: float) -> None:
    """Raise ConfigError for tiles smaller than a cell of this edge [m], and for numbers that are no edge."""
    if tile is not None and not edge <= tile < math.inf:
        raise ConfigError(f"tile: expects an edge of at least one cell of the map, {edge:g} m, got {tile:g}")


def _groups(result: Result, robot: str | None, color: str, split: str | None) -> list[tuple[str, ...]]:
    """Robots of the maps in each file."""
    if split == "robot":
        return [(robot_id,) for robot_id in result.robots]
    if robot is None and color == "robot":
        return [result.robots]
    return [(robot or result.robots[0],)]


def _contents(
    result: Result, robot_ids: Sequence[str], shown: _Shown, *, in_parts: bool
) -> Iterator[MapContent]:  # fmt: skip
    """Content of the file of some robots' maps, in the parts of the result or as a whole."""
    parts = list(shown.part.parts(result))
    if len(robot_ids) > 1:
        parts[0].check_one_frame(result)
    limits = None
    if len(parts) > 1 and shown.color in SCALED:
        # The scale of the colours is that of all parts.
        limits = common_limits(_content(result, robot_ids, shown, part).limits for part in parts)
    contents = (_content(result, robot_ids, shown, part, limits) for part in parts)
    yield from contents if in_parts else [MapContent.joined(list(contents))]


def _content(
    result: Result, robot_ids: Sequence[str], shown: _Shown, part: MapPart,
    limits: tuple[float, float] | None = None,
) -> MapContent:  # fmt: skip
    """Content of the file of some robots' maps in a part of the result; ``limits`` are those of a scale."""
    maps = [part.map(result, robot_id) for robot_id in robot_ids]
    leaves, owners = _leaves(maps, shown.map_kind)
    keep = leaves.between(*shown.heights)
    if not shown.with_free:
        keep &= best_labels(leaves.log_odds) > 0
    leaves = leaves.taken(keep)
    colors = leaf_colors(result, maps, leaves, shown.color, part, limits)
    indices = np.array([_index(result, stored) for stored in maps], np.int64)
    day = datetime.datetime.fromtimestamp(maps[0].stamp_ns // 10**9, datetime.UTC).date()
    comments = _comments(result, maps, shown, colors)
    return MapContent(
        leaves, colors.colors, indices[owners[keep]], comments, result.class_table, maps[0].resolution, day,
        colors.limits,
    )  # fmt: skip


def _index(result: Result, stored: StoredMap) -> int:
    """Index of a map's robot in the team; the number of robots for the centralised map."""
    ids = result.robots
    return ids.index(stored.robot_id) if stored.robot_id in ids else len(ids)


def _empty(result: Result, groups: Sequence[Sequence[str]], shown: _Shown) -> InputError:
    """Error for maps without a leaf to write."""
    if shown.heights != (-math.inf, math.inf):
        low, high = shown.heights
        return InputError(f"{result.path}: the map holds nothing from {low:g} m to {high:g} m; give other heights")
    names = ", ".join(robot_id for ids in groups for robot_id in ids)
    where, remedy = (" within the bounds", "other bounds") if len(shown.part.bounds) else ("", "a later time")
    return InputError(f"{result.path}: the map of {names} holds no occupied leaf{where}; use --free, or {remedy}")


def _pieces(
    output: Path, ids: Sequence[str], content: MapContent, split: str | None, tile: float | None, kind: FileFormat
) -> Iterator[tuple[Path, MapContent]]:
    """Content of each file to write; files without a leaf are left out."""
    for path, piece in _split(output, ids, content, split):
        if kind.is_grid:
            warn_of_ground(path, piece)
        yield from [(path, piece)] if tile is None else _tiles(path, piece, tile)


def _split(
    output: Path, ids: Sequence[str], content: MapContent, split: str | None
) -> Iterator[tuple[Path, MapContent]]:
    """Content of each class or robot."""
    if split == "class":
        labels = best_labels(content.leaves.log_odds)
        for class_id, name in enumerate(("free", *content.classes.names)):
            if (labels == class_id).any():
                # File systems may refuse characters of a class name; the number keeps names apart.
                part = f"{class_id}-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
                yield _named(output, part), content.taken(labels == class_id)
    elif len(content.leaves):
        yield _named(output, ids[0]) if split else output, content


def _tiles(path: Path, whole: MapContent, edge: float) -> Iterator[tuple[Path, MapContent]]:
    """Content of each tile of a file."""
    for tile in leaf_tiles(whole.leaves, whole.resolution, edge):
        piece = whole.taken(tile.leaves)
        leaves = LeafTable(tile.centers, tile.sizes, piece.leaves.log_odds)
        # Ten digits hide the rounding of a product such as 3 * 0.7.
        x, y = (f"{number * edge:.10g}" for number in (tile.column, tile.row))
        yield _named(path, f"x{x}_y{y}"), piece._replace(leaves=leaves)


def _named(output: Path, part: str) -> Path:
    """Path of a part of the output."""
    return output.with_name(f"{output.stem}-{part}{output.suffix}")


def _leaves(maps: Sequence[StoredMap], map_kind: str) -> tuple[LeafTable, Int64Array]:
    """Leaves of some maps, and the position of the map of each; a leaf of several maps is taken from the first one."""
    tables = [stored.leaves(map_kind=map_kind) for stored in maps]
    owners = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    if len(tables) == 1:
        return tables[0], owners
    leaves = LeafTable.joined(tables)
    centers, sizes = leaves.centers, leaves.sizes
    # Centres lie on multiples of half the resolution, so that rounding gives equal leaves equal keys.
    keys = np.column_stack([np.rint(centers / (maps[0].resolution / 2)), np.rint(sizes / maps[0].resolution)])
    _, first = np.unique(keys.astype(np.int64), axis=0, return_index=True)
    keep = np.zeros(len(sizes), dtype=np.bool_)
    keep[first] = True
    return leaves.taken(keep), owners[keep]


def _comments(result: Result, maps: Sequence[StoredMap], shown: _Shown, colors: LeafColors) -> list[str]:
    """Comments of the file: map, time, classes and colours."""
    last = maps[0]
    names = ", ".join(f"{c.class_id} {c.name}" for c in result.class_table.classes)
    kinds = ", ".join(dict.fromkeys(stored.title(shown.map_kind) for stored in maps))
    when = f"tick {last.tick}, {result.seconds(last.stamp_ns):g} s after the start"
    lines = [
        f"octoreplay map of {', '.join(stored.robot_id for stored in maps)} at {when}",
        f"resolution {last.resolution:g} m, log-odds: {kinds}",
        f"frame: {last.frame_id}",
        f"classes: 0 free, {names}",
        f"color: {shown.color} ({colors.scale})",
    ]
    if len(shown.part.bounds):
        lines.insert(3, f"bounds: {', '.join(f'{number:g}' for number in shown.part.bounds)} m")
    return ["".join(c if c.isascii() and c.isprintable() else "?" for c in line) for line in lines]
