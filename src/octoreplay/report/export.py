"""Export of a stored map as a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.results import ply
from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.records import (
    MAP_KINDS,
    MEAN,
    POSTERIOR,
    BoolArray,
    ClassTable,
    Float64Array,
    FloatArray,
    LeafTable,
    UInt8Array,
)
from octoreplay.result import Result, StoredMap, open_result

COLORS = ("label", "robot", "disagreement", "probability")
_OF_ALL_ROBOTS = ("robot", "disagreement")
"""Colours that are computed from the maps of all robots."""
FREE_COLOR = (225, 225, 225)

_RAMP = np.array(
    [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121],
     [109, 205, 89], [180, 222, 44], [253, 231, 37]], dtype=np.float64,
)  # fmt: skip
"""Matplotlib's viridis at ten even steps, from dark (low) to yellow (high)."""


def export_ply(
    result_path: Path, output: Path, robot: str | None = None, at: float | None = None, what: str = "points",
    color: str = "label", *, free: bool = False, map_kind: str = POSTERIOR,
) -> int:  # fmt: skip
    """Write a map of a result as a PLY file and return the number of leaves in it.

    The comments of the file name the options.

    Parameters
    ----------
    result_path, output : Path
        Result file and PLY file.
    robot : str, optional
        Robot of the map. None is the first robot; with color 'robot' it is the overlay of all robots' maps.
    at : float, optional
        Time since the run's start in seconds, None for the end.
    what : str
        'points' (leaf centres) or 'voxels' (cubes).
    color : str
        - 'label': colour of the most probable class; free leaves are grey
        - 'robot': mean colour of the robots whose map knows the leaf's centre
        - 'probability': probability of the label, from 1 / (C + 1), dark, to 1, yellow
        - 'disagreement': largest ||h_j - h|| over the other robots at the leaf's centre, from 0, dark, to the largest
          in the file, yellow (an unknown cell counts as the prior)
    free : bool
        True to write free leaves too.
    map_kind : str
        'posterior' for labels and probabilities of the team's posterior h_0 + N (h - h_0), 'mean' for those of h
        (``StoredMap``); the disagreement is that of h.

    Raises
    ------
    ConfigError
        ``what``, ``color`` or ``map_kind`` is unknown.
    InputError
        The result cannot be read, has no such map, or has maps in several frames that the options put together.
    OutputError
        The PLY file cannot be written.
    """
    if what not in ("points", "voxels"):
        raise ConfigError(f"what: '{what}' is not one of points, voxels")
    if color not in COLORS:
        raise ConfigError(f"color: '{color}' is not one of {', '.join(COLORS)}")
    if map_kind not in MAP_KINDS:
        raise ConfigError(f"map: '{map_kind}' is not one of {', '.join(MAP_KINDS)}")
    with open_result(result_path) as result:
        at_ns = None if at is None else result.time_ns(at)
        together = robot is None and color == "robot"
        chosen = result.robots if together else (result.robots[0] if robot is None else robot,)
        shown = [result.map(robot_id, at_ns=at_ns) for robot_id in chosen]
        if together or color in _OF_ALL_ROBOTS:
            _check_one_frame(result, at_ns)
        leaves = _leaves(shown, map_kind, free)
        colors, scale = _colors(result, shown, leaves, color, at_ns)
        comments = _comments(result, shown, color, scale, map_kind)
    write = ply.write_voxels if what == "voxels" else ply.write_points
    write(output, leaves, colors, comments)
    return len(leaves)


def _check_one_frame(result: Result, at_ns: int | None) -> None:
    """Raise InputError where the robots' maps are in several frames."""
    maps = [result.map(robot_id, at_ns=at_ns) for robot_id in result.robots]
    if len({stored.frame_id for stored in maps}) > 1:
        frames = ", ".join(f"{stored.robot_id} in {stored.frame_id}" for stored in maps)
        raise InputError(
            f"{result.path}: the robots' maps are in different frames ({frames}); name a robot and color 'label' or"
            " 'probability', or a later time"
        )


def _leaves(maps: list[StoredMap], map_kind: str, free: bool) -> LeafTable:
    """Leaves of some maps; a leaf of several maps is taken from the first one."""
    tables = [stored.leaves(map_kind=map_kind) for stored in maps]
    centers = np.concatenate([table.centers for table in tables])
    sizes = np.concatenate([table.sizes for table in tables])
    log_odds = np.concatenate([table.log_odds for table in tables])
    keep = np.ones(len(sizes), dtype=np.bool_)
    if len(tables) > 1:
        # Centres lie on multiples of half the resolution, so that rounding gives equal leaves equal keys.
        keys = np.column_stack([np.rint(centers / (maps[0].resolution / 2)), np.rint(sizes / maps[0].resolution)])
        _, first = np.unique(keys.astype(np.int64), axis=0, return_index=True)
        keep[:] = False
        keep[first] = True
    if not free:
        keep &= best_labels(log_odds) > 0
    return LeafTable(centers[keep], sizes[keep], log_odds[keep])


def _colors(
    result: Result, shown: list[StoredMap], leaves: LeafTable, color: str, at_ns: int | None
) -> tuple[UInt8Array, str]:
    """Colours (L, 3) of the leaves, and the meaning of the scale."""
    if color == "label":
        return _label_colors(result.class_table, leaves), "the classes' own"
    if color == "probability":
        least = 1.0 / (result.class_table.num_classes + 1)
        values = (label_probabilities(leaves.log_odds) - least) / (1.0 - least)
        return _ramp(values), f"dark {least:.3f}, yellow 1"
    ids = {stored.robot_id: stored for stored in shown}
    maps = [ids.get(robot_id) or result.map(robot_id, at_ns=at_ns) for robot_id in result.robots]
    if color == "robot":
        known = np.column_stack([stored.query(leaves.centers, map_kind=MEAN).known for stored in maps])
        return _robot_colors(known), ", ".join(f"{m.robot_id} {_robot_color(i)}" for i, m in enumerate(maps))
    values = _disagreement(shown[0], maps, leaves.centers)
    largest = float(values.max(initial=0.0))
    return _ramp(values / largest if largest > 0 else values), f"dark 0, yellow {largest:.6g}"


def _label_colors(class_table: ClassTable, leaves: LeafTable) -> UInt8Array:
    """Colours (L, 3) of the labels; free is grey."""
    palette = np.concatenate([np.array([FREE_COLOR], dtype=np.uint8), class_table.colors])
    return palette.take(best_labels(leaves.log_odds), axis=0)


def _robot_color(index: int) -> tuple[int, int, int]:
    """Colour of a robot by its index."""
    return PALETTE[index % len(PALETTE)]


def _robot_colors(known: BoolArray) -> UInt8Array:
    """Mean colour (L, 3) of the robots that know a leaf, from (L, N)."""
    palette = np.array([_robot_color(index) for index in range(known.shape[1])], dtype=np.float64)
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    mean: Float64Array = known.astype(np.float64) @ palette / count
    return (mean + 0.5).astype(np.uint8)


def _disagreement(own: StoredMap, maps: list[StoredMap], points: Float64Array) -> FloatArray:
    """Largest distance (P,) float64 between one robot's log-odds and another's at points."""
    h = own.query(points, map_kind=MEAN).log_odds.astype(np.float64)
    largest = np.zeros(len(points))
    for other in maps:
        if other is not own:
            difference = other.query(points, map_kind=MEAN).log_odds - h
            np.maximum(largest, np.linalg.norm(difference, axis=1), out=largest)
    return largest


def _ramp(values: FloatArray) -> UInt8Array:
    """Colours (L, 3) of values (L,) in 0..1."""
    place = np.clip(values, 0.0, 1.0) * (len(_RAMP) - 1)
    steps = np.arange(len(_RAMP))
    return np.rint(np.column_stack([np.interp(place, steps, _RAMP[:, k]) for k in range(3)])).astype(np.uint8)


def _comments(result: Result, shown: list[StoredMap], color: str, scale: str, map_kind: str) -> list[str]:
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
        f"color: {color} ({scale})",
    ]
    return ["".join(c if c.isascii() and c.isprintable() else "?" for c in line) for line in lines]
