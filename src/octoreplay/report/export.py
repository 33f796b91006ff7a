"""Export of stored maps to the files of other tools."""

from __future__ import annotations

import datetime
import logging
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io.file_sets import write_together
from octoreplay.io.output_file import mark_written
from octoreplay.io.results import glb, las, npz, octomap_trees, ply
from octoreplay.io.results.occupancy_grid import OCCUPIED, grid_files, grid_of
from octoreplay.log_odds import best_labels
from octoreplay.mapping.merged_faces import merged_faces
from octoreplay.mapping.regions import leaf_tiles
from octoreplay.records import MAP_KINDS, POSTERIOR, BoolArray, ClassTable, FilePath, Int64Array, LeafTable, UInt8Array
from octoreplay.report.cell_colors import COLORS, LeafColors, default_color, leaf_colors
from octoreplay.report.map_part import MapPart, finest_edge
from octoreplay.result import Result, open_result
from octoreplay.stored_map import StoredMap

_log = logging.getLogger(__name__)

SPLITS = ("class", "robot")
"""Properties by which a map is divided into several files."""


_MOST_OCCUPIED = 0.5
"""Share of the known cells of a grid above which the ground is probably in it."""


class _Content(NamedTuple):
    """Content of one file: leaves with colours (L, 3) and robots (L,), and what describes them."""

    leaves: LeafTable
    colors: UInt8Array
    robots: Int64Array
    comments: Sequence[str]
    classes: ClassTable
    resolution: float
    day: datetime.date

    def taken(self, chosen: BoolArray | Int64Array) -> _Content:
        """Return the content with the leaves where ``chosen`` (L,) is True, or at positions ``chosen`` (n,)."""
        return self._replace(leaves=self.leaves.taken(chosen), colors=self.colors[chosen], robots=self.robots[chosen])


_Files = dict[Path, tuple[bytes, int]]
"""Contents of files, and the number of leaves or of known cells in each."""


def _encode_ply(path: Path, content: _Content, what: str) -> _Files:
    """PLY file."""
    encode = ply.voxels_file if what == "voxels" else ply.points_file
    return {path: (encode(content.leaves, content.colors, content.comments), len(content.leaves))}


def _encode_npz(path: Path, content: _Content, _: str) -> _Files:
    """NumPy archive."""
    archive = npz.archive_file(content.leaves, content.colors, content.classes, content.resolution)
    return {path: (archive, len(content.leaves))}


def _encode_glb(path: Path, content: _Content, _: str) -> _Files:
    """GLB file."""
    faces = merged_faces(content.leaves, content.colors, content.resolution)
    return {path: (glb.mesh_file(*faces, content.comments), len(content.leaves))}


def _encode_las(path: Path, content: _Content, _: str) -> _Files:
    """LAS or LAZ file."""
    is_compressed = path.suffix.lower() == ".laz"
    points = las.points_file(
        content.leaves, content.colors, content.classes, content.robots, content.day, compressed=is_compressed
    )
    return {path: (points, len(content.leaves))}


def _encode_tree(path: Path, content: _Content, _: str) -> _Files:
    """OctoMap file."""
    is_binary = path.suffix.lower() == ".bt"
    tree = octomap_trees.tree_file(content.leaves, content.colors, content.resolution, binary=is_binary)
    return {path: (tree, len(content.leaves))}


def _encode_grid(path: Path, content: _Content, _: str) -> _Files:
    """Occupancy grid and its image."""
    grid = grid_of(content.leaves, content.resolution)
    return {name: (data, grid.num_known) for name, data in grid_files(path, grid).items()}


def _warn_of_ground(path: Path, content: _Content) -> None:
    """Warn where the ground seems to be in an occupancy grid."""
    grid = grid_of(content.leaves, content.resolution)
    share = np.count_nonzero(grid.cells == OCCUPIED) / max(grid.num_known, 1)
    if share > _MOST_OCCUPIED:
        _log.warning(
            "warning: %s: %.0f %% of the known cells are occupied, as with the ground in the grid; leave it out with"
            " --heights LOW HIGH, such as --heights 0.2 1.5", path, 100 * share,
        )  # fmt: skip


class _Format(NamedTuple):
    """Format of a suffix: its encoder, whether it needs free leaves, and the properties that it can be split by."""

    encode: Callable[[Path, _Content, str], _Files]
    has_free: bool = False
    splits: tuple[str, ...] = SPLITS


_FORMATS: Mapping[str, _Format] = {
    ".ply": _Format(_encode_ply),
    ".npz": _Format(_encode_npz),
    ".glb": _Format(_encode_glb),
    ".laz": _Format(_encode_las),
    ".las": _Format(_encode_las),
    ".bt": _Format(_encode_tree, has_free=True, splits=("robot",)),
    ".ot": _Format(_encode_tree, has_free=True, splits=("robot",)),
    ".yaml": _Format(_encode_grid, has_free=True, splits=("robot",)),
}
SUFFIXES = tuple(_FORMATS)
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
    with open_result(result_path) as result:
        at_ns = None if at is None else result.time_ns(at)
        part = MapPart(at_ns, bounds, max_depth)
        _check_tile(tile, finest_edge(result, max_depth))
        with_free = free or kind.has_free
        contents = _contents(result, robot, part, color, map_kind, heights, split, with_free=with_free)
        parts = dict(_parts(output, contents, result.class_table, split))
    if kind.encode is _encode_grid:
        for path, whole in parts.items():
            _warn_of_ground(path, whole)
    if tile is not None:
        parts = {name: piece for path, whole in parts.items() for name, piece in _tiles(path, whole, tile)}
    files = _encoded(kind, parts, what)
    write_together({path: data for path, (data, _) in files.items()})
    mark_written(output)
    return {path: count for path, (_, count) in files.items()}


def _encoded(kind: _Format, parts: Mapping[Path, _Content], what: str) -> _Files:
    """Files of all parts; OutputError for a map that the format cannot hold."""
    files: _Files = {}
    for path, content in parts.items():
        try:
            files |= kind.encode(path, content, what)
        except ValueError as error:
            raise OutputError(f"{path}: {error}; export a PLY or NPZ file") from error
    return files


def _checked_format(
    output: Path, what: str, color: str | None, map_kind: str, heights: tuple[float, float], split: str | None,
    robot: str | None,
) -> _Format:  # fmt: skip
    """Format of the output; ConfigError for options that are unknown or exclude each other."""
    suffix = output.suffix.lower().replace(".yml", ".yaml")
    kind = _FORMATS.get(suffix)
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


def _contents(
    result: Result, robot: str | None, part: MapPart, color: str | None, map_kind: str,
    heights: tuple[float, float], split: str | None, *, with_free: bool,
) -> dict[tuple[str, ...], _Content]:  # fmt: skip
    """Contents of the files by the robots of their maps; InputError where there is no leaf to write."""
    color = color or default_color(result.class_table)
    groups: list[tuple[str, ...]]
    if split == "robot":
        groups = [(robot_id,) for robot_id in result.robots]
    elif robot is None and color == "robot":
        part.check_one_frame(result)
        groups = [result.robots]
    else:
        groups = [(robot or result.robots[0],)]
    contents = {ids: _content(result, ids, part, color, map_kind, heights, with_free=with_free) for ids in groups}
    _check_leaves(result, contents, part, heights)
    return contents


def _content(
    result: Result, robot_ids: Sequence[str], part: MapPart, color: str, map_kind: str,
    heights: tuple[float, float], *, with_free: bool,
) -> _Content:  # fmt: skip
    """Content of the file of some robots' maps."""
    shown = [part.map(result, robot_id) for robot_id in robot_ids]
    leaves, owners = _leaves(shown, map_kind)
    keep = leaves.between(*heights)
    if not with_free:
        keep &= best_labels(leaves.log_odds) > 0
    leaves = leaves.taken(keep)
    colors = leaf_colors(result, shown, leaves, color, part)
    indices = np.array([_index(result, stored) for stored in shown], np.int64)
    day = datetime.datetime.fromtimestamp(shown[0].stamp_ns // 10**9, datetime.UTC).date()
    return _Content(
        leaves, colors.colors, indices[owners[keep]], _comments(result, shown, part, color, colors, map_kind),
        result.class_table, shown[0].resolution, day,
    )  # fmt: skip


def _index(result: Result, stored: StoredMap) -> int:
    """Index of a map's robot in the team; the number of robots for the centralised map."""
    ids = result.robots
    return ids.index(stored.robot_id) if stored.robot_id in ids else len(ids)


def _check_leaves(
    result: Result, contents: Mapping[tuple[str, ...], _Content], part: MapPart, heights: tuple[float, float]
) -> None:
    """Raise InputError where there is no leaf to write."""
    if any(len(content.leaves) for content in contents.values()):
        return
    if heights != (-math.inf, math.inf):
        low, high = heights
        raise InputError(f"{result.path}: the map holds nothing from {low:g} m to {high:g} m; give other heights")
    names = ", ".join(robot_id for ids in contents for robot_id in ids)
    where, remedy = (" within the bounds", "other bounds") if len(part.bounds) else ("", "a later time")
    raise InputError(f"{result.path}: the map of {names} holds no occupied leaf{where}; use --free, or {remedy}")


def _parts(
    output: Path, contents: Mapping[tuple[str, ...], _Content], classes: ClassTable, split: str | None
) -> Iterator[tuple[Path, _Content]]:
    """Content of each file to write; files without a leaf are left out."""
    for ids, content in contents.items():
        if split == "class":
            labels = best_labels(content.leaves.log_odds)
            for class_id, name in enumerate(("free", *classes.names)):
                if (labels == class_id).any():
                    # File systems may refuse characters of a class name; the number keeps names apart.
                    part = f"{class_id}-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
                    yield _named(output, part), content.taken(labels == class_id)
        elif len(content.leaves):
            yield _named(output, ids[0]) if split else output, content


def _tiles(path: Path, whole: _Content, edge: float) -> Iterator[tuple[Path, _Content]]:
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
    centers = np.concatenate([table.centers for table in tables])
    sizes = np.concatenate([table.sizes for table in tables])
    log_odds = np.concatenate([table.log_odds for table in tables])
    # Centres lie on multiples of half the resolution, so that rounding gives equal leaves equal keys.
    keys = np.column_stack([np.rint(centers / (maps[0].resolution / 2)), np.rint(sizes / maps[0].resolution)])
    _, first = np.unique(keys.astype(np.int64), axis=0, return_index=True)
    keep = np.zeros(len(sizes), dtype=np.bool_)
    keep[first] = True
    return LeafTable(centers, sizes, log_odds).taken(keep), owners[keep]


def _comments(
    result: Result, shown: Sequence[StoredMap], part: MapPart, color: str, colors: LeafColors, map_kind: str
) -> list[str]:
    """Comments of the file: map, time, classes and colours."""
    last = shown[0]
    names = ", ".join(f"{c.class_id} {c.name}" for c in result.class_table.classes)
    kinds = ", ".join(dict.fromkeys(stored.title(map_kind) for stored in shown))
    when = f"tick {last.tick}, {result.seconds(last.stamp_ns):g} s after the start"
    lines = [
        f"octoreplay map of {', '.join(stored.robot_id for stored in shown)} at {when}",
        f"resolution {last.resolution:g} m, log-odds: {kinds}",
        f"frame: {last.frame_id}",
        f"classes: 0 free, {names}",
        f"color: {color} ({colors.scale})",
    ]
    if len(part.bounds):
        lines.insert(3, f"bounds: {', '.join(f'{number:g}' for number in part.bounds)} m")
    return ["".join(c if c.isascii() and c.isprintable() else "?" for c in line) for line in lines]
