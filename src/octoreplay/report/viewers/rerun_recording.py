"""Recording of the Rerun viewer for a result: maps as boxes, poses, paths, links and metrics on one time axis.

rerun-sdk is an optional dependency: ``pip install 'octoreplay[rerun]'``.

Entities of the robots and of the centralised map lie below the frame that they are given in::

    <frame>/<robot>/map/<class>/part <n>   Boxes3D, occupied leaves at their true sizes, in the class's colour; of a
                                           result in tiles <frame>/<robot>/map/tile <k>/<class>/part <n>
    <frame>/<robot>/pose                   Transform3D of the sensor
    <frame>/<robot>/path                   LineStrips3D, one piece per tick
    <frame>/links                          LineStrips3D, the links of a tick
    metrics/...                            Scalars of the team, the robots, the links and the pairs of robots
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.output_file import unfinished
from octoreplay.log_odds import best_labels
from octoreplay.records import CENTRAL, MAP_KINDS, POSTERIOR, FilePath, Float64Array, LeafTable
from octoreplay.report.figures import COLORS
from octoreplay.report.viewers.scene import Scene, scene_of
from octoreplay.result import Result, open_result
from octoreplay.run_metrics import TickMetrics
from octoreplay.stored_map import StoredMap

TIMELINE = "elapsed"
"""Main time axis: time since the run's start. The others are ``stamp`` (log time) and ``tick``."""

MOST_BOXES = 50_000
"""Largest number of boxes in an entity: the viewer draws the first 60,000 instances of each."""

_TEAM_METRICS = {
    "total_distance": "Φ over the links", "total_distance_all": "Φ over all pairs",
    "label_disagreement": "label disagreement", "contradiction": "contradiction",
    "clear_contradiction": "clear contradiction",
}  # fmt: skip
"""Metrics of the team, and their names in legends."""
_ROBOT_METRICS = ("agreement", "agreement_occupied", "observed_volume", "entropy_bits", "num_leaves", "sent_bytes")
_PAIR_METRICS = ("contradiction", "clear_contradiction", "label_contradiction")
_TEAM_CHARTS = {
    "Disagreement Φ": ("total_distance", "total_distance_all"),
    "Labels and contradiction": ("label_disagreement", "contradiction", "clear_contradiction"),
}
_ROBOT_CHARTS = {
    "Agreement with the centralised map": "agreement",
    "Bytes sent per tick": "sent_bytes",
    "Observed volume [m³]": "observed_volume",
}
"""Time series of the blueprint: titles, and the metrics in each."""


class RecordingSummary(NamedTuple):
    """Numbers of a recording: stored maps and ticks in it."""

    num_maps: int
    num_ticks: int


def write_rerun(
    result_path: FilePath,
    output: FilePath,
    *,
    robots: Sequence[str] = (),
    every: float = 0.0,
    map_kind: str = POSTERIOR,
    max_depth: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> RecordingSummary:
    """Write a result as a recording of the Rerun viewer, with a blueprint.

    Parameters
    ----------
    result_path, output : path
        Result file, and ``.rrd`` file to write.
    robots : sequence of str
        Robots whose maps are shown, or 'central'; all by default. Poses and metrics are those of all robots.
    every : float
        Least log time between two shown maps of a robot [s]. The last stored map is always shown.
    map_kind : str
        'posterior' or 'mean': form of the maps that the labels are of (``StoredMap``).
    max_depth : int, optional
        Depth of the finest cells of the maps, from 1 to 19 (``StoredMap.coarsened``); all cells by default.
    progress : callable, optional
        Called with the finished share, 0..1, after each stored tick.

    Raises
    ------
    ConfigError
        rerun-sdk is not installed, ``map_kind`` is unknown, or ``max_depth`` is no depth.
    InputError
        The result cannot be read, holds no tick or no map, or has no robot of this name.
    OutputError
        The file cannot be written.
    """
    rerun = _rerun()
    if map_kind not in MAP_KINDS:
        raise ConfigError(f"map: '{map_kind}' is not one of {', '.join(MAP_KINDS)}")
    output = Path(output)
    with open_result(result_path) as result:
        shown = _shown_maps(result, robots)
        with unfinished(output) as temporary:
            # Rerun's own time axes have the wall clock.
            stream = rerun.RecordingStream("octoreplay", recording_id=output.stem, send_properties=False)
            stream.set_log_time_enabled(False)
            stream.set_log_tick_enabled(False)
            stream.save(temporary, default_blueprint=_blueprint(result, shown))
            try:
                stream.send_recording_name(output.stem)
                writer = _Writer(rerun, stream, result)
                writer.write_classes()
                writer.write_metrics()
                writer.write_motion()
                num_maps = writer.write_maps(shown, every, map_kind, max_depth, progress)
                stream.flush()
            finally:
                stream.disconnect()
        return RecordingSummary(num_maps, len(result.metrics))


def _rerun() -> Any:
    """Import rerun-sdk, an optional dependency."""
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise ConfigError("rerun: rerun-sdk is not installed; use pip install 'octoreplay[rerun]'") from None


def _shown_maps(result: Result, robots: Sequence[str]) -> tuple[str, ...]:
    """Robots whose stored maps are shown. Raises InputError for an unknown one, and where no map is stored."""
    if not result.metrics:
        raise InputError(f"{result.path}: holds no map, since the run was interrupted before its first tick; repeat it")
    stored = {robot_id for robot_id in (*result.robots, CENTRAL) if result.stored_ticks(robot_id)}
    missing = [robot_id for robot_id in robots if not result.stored_ticks(robot_id)]
    if missing or not stored:
        names = ", ".join(missing) or "any robot"
        raise InputError(f"{result.path}: holds no map of {names}; run the logs again with a shorter --state-every")
    return tuple(name for name in (*result.robots, CENTRAL) if name in stored and (not robots or name in robots))


class _Writer:
    """Writer of one recording."""

    def __init__(self, rerun: Any, stream: Any, result: Result) -> None:
        self._rerun = rerun
        self._stream = stream
        self._result = result
        self._ticks = {tick.tick: tick for tick in result.metrics}
        self._parts: dict[tuple[str, ...], set[tuple[str, ...]]] = {}

    def write_classes(self) -> None:
        """Write what holds at all times: the classes' names and colours, and the direction of z in every frame."""
        rerun = self._rerun
        classes = [(entry.class_id, entry.name, entry.color) for entry in self._result.class_table.classes]
        self._stream.log("/", rerun.AnnotationContext(classes), static=True)
        for frame_id in _frames(self._result):
            self._stream.log(_path(frame_id), rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def write_metrics(self) -> None:
        """Write the metrics of the team, of each robot, link and pair."""
        table = self._result.as_table("ticks")
        for (name, label), color in zip(_TEAM_METRICS.items(), COLORS, strict=False):
            self._write_scalars(("metrics", "team", name), table, np.arange(len(table)), name, label, color)
        robots, links, pairs = (self._result.as_table(kind) for kind in ("robots", "links", "pairs"))
        colors = _colors(self._result)
        for (robot_id,), rows in _groups(robots, "robot_id"):
            for name in _ROBOT_METRICS:
                entity = ("metrics", "robots", robot_id, name)
                self._write_scalars(entity, robots, rows, name, robot_id, colors[robot_id])
        for (sender, receiver), rows in _groups(links, "sender", "receiver"):
            label, name = f"{sender} to {receiver}", "bytes_per_second"
            self._write_scalars(("metrics", "links", label, name), links, rows, name, label, colors[sender])
        for (first, second), rows in _groups(pairs, "first", "second"):
            label = f"{first} and {second}"
            for name in _PAIR_METRICS:
                self._write_scalars(("metrics", "pairs", label, name), pairs, rows, name, label, colors[first])

    def _write_scalars(self, entity: Sequence[str], table: Table, rows: Any, name: str, label: str, color: str) -> None:
        """Write some rows of a column as a time series with a label and a colour."""
        rerun = self._rerun
        self._stream.log(_path(*entity), rerun.SeriesLines(names=[label], colors=[_rgb(color)]), static=True)
        times = [
            rerun.TimeColumn(TIMELINE, duration=table["seconds"][rows]),
            rerun.TimeColumn("stamp", timestamp=table["stamp_ns"][rows].astype("datetime64[ns]")),
            rerun.TimeColumn("tick", sequence=table["tick"][rows]),
        ]
        values = rerun.Scalars.columns(scalars=table[name][rows].astype(np.float64))
        self._stream.send_columns(_path(*entity), times, values)

    def write_motion(self) -> None:
        """Write poses, paths and links of all ticks; what is left behind in a former frame is cleared."""
        poses = self._result.as_table("poses")
        places: dict[str, tuple[str, Float64Array]] = {}
        linked: set[str] = set()
        tables = np.column_stack([poses[name] for name in ("x", "y", "z", "qx", "qy", "qz", "qw")])
        colors = _colors(self._result)
        for (number,), rows in _groups(poses, "tick"):
            self._set_time(self._ticks[number])
            for row in rows.tolist():
                robot_id, frame_id = str(poses["robot_id"][row]), str(poses["frame_id"][row])
                before = places.get(robot_id)
                if before is not None and before[0] != frame_id:
                    self._clear(before[0], robot_id)
                    before = None
                self._write_pose(robot_id, frame_id, tables[row], before, colors[robot_id])
                places[robot_id] = (frame_id, tables[row, :3])
            linked = self._write_links(self._ticks[number], places, linked)

    def _write_pose(
        self, robot_id: str, frame_id: str, numbers: Float64Array, before: tuple[str, Float64Array] | None, color: str
    ) -> None:
        """Write one robot's pose and the piece of its path since the tick before."""
        rerun, rgb = self._rerun, _rgb(color)
        entity = _path(frame_id, robot_id, "pose")
        self._stream.log(
            entity, rerun.Transform3D(translation=numbers[:3], quaternion=rerun.Quaternion(xyzw=numbers[3:]))
        )
        if before is None:
            name = rerun.Points3D([[0.0, 0.0, 0.0]], labels=[robot_id], colors=[rgb], radii=[0.15])
            self._stream.log(entity, rerun.TransformAxes3D(axis_length=0.8), name)
        else:
            strip = rerun.LineStrips3D([[before[1], numbers[:3]]], colors=[rgb], radii=[0.04])
            self._stream.log(_path(frame_id, robot_id, "path"), strip)

    def _write_links(
        self, tick: TickMetrics, places: dict[str, tuple[str, Float64Array]], before: set[str]
    ) -> set[str]:
        """Write a tick's links, each once; return the frames that have some, and clear those that had some before."""
        rerun = self._rerun
        pairs = {frozenset((link.sender, link.receiver)): (link.sender, link.receiver) for link in tick.links}
        strips: dict[str, list[list[Float64Array]]] = {}
        for a, b in pairs.values():
            if a in places and b in places and places[a][0] == places[b][0]:
                strips.setdefault(places[a][0], []).append([places[a][1], places[b][1]])
        for frame_id, lines in strips.items():
            self._stream.log(
                _path(frame_id, "links"), rerun.LineStrips3D(lines, colors=[[200, 200, 200]], radii=[0.03])
            )
        for frame_id in before - strips.keys():
            self._stream.log(_path(frame_id, "links"), rerun.Clear(recursive=False))
        return set(strips)

    def write_maps(
        self, shown: Sequence[str], every: float, map_kind: str, max_depth: int | None,
        progress: Callable[[float], None] | None,
    ) -> int:  # fmt: skip
        """Write the stored maps of some robots, one part of the result after the other; return their number."""
        boxes = list(self._result.boxes(max_depth=max_depth))
        chosen = self._chosen_ticks(shown, every)
        last_tick = self._result.metrics[-1].tick
        for number, bounds in enumerate(boxes):
            tile = (f"tile {number + 1}",) if len(boxes) > 1 else ()
            frames: dict[str, str] = {}
            for maps in self._result.history(bounds=bounds):
                newest = max(stored.tick for stored in maps.values())
                for robot_id in shown:
                    if newest not in chosen[robot_id]:
                        continue
                    stored = maps[robot_id]
                    if frames.setdefault(robot_id, stored.frame_id) != stored.frame_id:
                        self._set_time(self._ticks[stored.tick])
                        self._clear(frames[robot_id], robot_id, "map")
                        frames[robot_id] = stored.frame_id
                    self._write_map(stored.coarsened(max_depth), map_kind, tile)
                if progress is not None:
                    progress((number + (newest + 1) / (last_tick + 1)) / len(boxes))
        return sum(map(len, chosen.values()))

    def _chosen_ticks(self, shown: Sequence[str], every: float) -> dict[str, set[int]]:
        """Ticks at which the map of each robot is shown: at least ``every`` seconds apart, and the last one."""
        chosen: dict[str, set[int]] = {}
        for robot_id in shown:
            ticks = self._result.stored_ticks(robot_id)
            chosen[robot_id] = {ticks[-1]}
            before = -math.inf
            for tick in ticks:
                seconds = self._ticks[tick].stamp_ns / 1e9
                if seconds - before >= every - 1e-9:
                    chosen[robot_id].add(tick)
                    before = seconds
        return chosen

    def _write_map(self, stored: StoredMap, map_kind: str, tile: tuple[str, ...]) -> None:
        """Write the occupied leaves of one map, by class and in parts; parts of an earlier map are cleared."""
        leaves = stored.leaves(map_kind=map_kind)
        labels = best_labels(leaves.log_odds)
        self._set_time(self._ticks[stored.tick])
        entity = (stored.frame_id, stored.robot_id, "map", *tile)
        parts: set[tuple[str, ...]] = set()
        for class_id, name in enumerate(self._result.class_table.names, start=1):
            rows = np.flatnonzero(labels == class_id)
            for number, start in enumerate(range(0, len(rows), MOST_BOXES)):
                part = (*entity, name, f"part {number + 1}")
                self._write_boxes(part, leaves, rows[start : start + MOST_BOXES], class_id)
                parts.add(part)
        for old in self._parts.get(entity, set()) - parts:
            self._clear(*old)
        self._parts[entity] = parts

    def _write_boxes(self, part: Sequence[str], leaves: LeafTable, rows: Any, class_id: int) -> None:
        """Write some leaves of one class as boxes."""
        boxes = self._rerun.Boxes3D(
            centers=leaves.centers[rows], half_sizes=np.repeat(leaves.sizes[rows, None] / 2, 3, axis=1),
            class_ids=[class_id], fill_mode=self._rerun.components.FillMode.Solid, show_labels=False,
        )  # fmt: skip
        self._stream.log(_path(*part), boxes)

    def _set_time(self, tick: TickMetrics) -> None:
        """Set the time of what is written next."""
        self._stream.set_time(TIMELINE, duration=np.timedelta64(tick.stamp_ns - self._result.start_ns, "ns"))
        self._stream.set_time("stamp", timestamp=np.datetime64(tick.stamp_ns, "ns"))
        self._stream.set_time("tick", sequence=tick.tick)

    def _clear(self, *entity: str) -> None:
        """End an entity and all below it at the present time."""
        self._stream.log(_path(*entity), self._rerun.Clear(recursive=True))


def _frames(result: Result) -> list[str]:
    """All frames of maps in a result, that of the first robot's last map first."""
    last = result.metrics[-1].frame_of(result.robots[0])
    all_frames = [tick.frame_of(robot_id) for tick in result.metrics for robot_id in result.robots]
    return list(dict.fromkeys([last, *all_frames]))


def _groups(table: Table, *names: str) -> Iterable[tuple[tuple[Any, ...], Any]]:
    """Yield the values of some columns, and the rows that have them, in the order of their first rows."""
    rows: dict[tuple[Any, ...], list[int]] = {}
    for row, key in enumerate(zip(*(table[name].tolist() for name in names), strict=True)):
        rows.setdefault(key, []).append(row)
    for key, found in rows.items():
        yield key, np.array(found)


def _path(*parts: str) -> str:
    """Return the path of an entity; special characters of names are escaped."""
    return str(_rerun().new_entity_path(list(parts)))


def _colors(result: Result) -> dict[str, str]:
    """Colour of each robot."""
    return {robot_id: COLORS[index % len(COLORS)] for index, robot_id in enumerate(result.robots)}


def _rgb(color: str) -> list[int]:
    """Red, green and blue of a colour #RRGGBB."""
    return [int(color[start : start + 2], 16) for start in (1, 3, 5)]


def _eye(blueprint: Any, scene: Scene) -> Any:
    """Return a view from above at an angle onto the robots' paths."""
    center = np.array(scene.center)
    position = center + np.array([-0.8, -0.8, 0.8]) * scene.extent
    return blueprint.EyeControls3D(position=position, look_target=center, eye_up=(0.0, 0.0, 1.0))


def _blueprint(result: Result, shown: Sequence[str]) -> Any:
    """Return the blueprint: one 3-D view per frame on the left, charts on the right, on one time axis."""
    blueprint = importlib.import_module("rerun.blueprint")
    boundary = blueprint.TimeRangeBoundary
    trail = blueprint.VisibleTimeRanges(
        timeline=TIMELINE, start=boundary.infinite(), end=boundary.cursor_relative(seconds=0.0)
    )
    scene = scene_of(result)
    views = []
    for frame_id in _frames(result):
        overrides = {_path(frame_id, robot_id, "path"): trail for robot_id in result.robots}
        members = [name for name in shown if any(tick.frame_of(name) == frame_id for tick in result.metrics)]
        for robot_id in members[1:]:
            # Equal boxes of several robots in one place would flicker.
            overrides[_path(frame_id, robot_id, "map")] = blueprint.EntityBehavior(visible=False)
        views.append(
            blueprint.Spatial3DView(
                origin=_path(frame_id), name=f"Maps in {frame_id}", overrides=overrides,
                eye_controls=_eye(blueprint, scene) if frame_id == scene.frame_id else None,
            )
        )  # fmt: skip
    charts = {
        **{title: [_path("metrics", "team", name) for name in names] for title, names in _TEAM_CHARTS.items()},
        **{
            title: [_path("metrics", "robots", robot_id, name) for robot_id in result.robots]
            for title, name in _ROBOT_CHARTS.items()
        },
    }
    series = [
        blueprint.TimeSeriesView(
            origin="/", contents=[f"+ {entity}" for entity in entities], name=title,
            plot_legend=blueprint.PlotLegend(corner=blueprint.Corner2D.RightTop),
        )
        for title, entities in charts.items()
    ]  # fmt: skip
    left = blueprint.Tabs(*views) if len(views) > 1 else views[0]
    return blueprint.Blueprint(
        blueprint.Horizontal(left, blueprint.Vertical(*series), column_shares=[2, 1]),
        blueprint.TimePanel(timeline=TIMELINE, expanded=False),
        blueprint.SelectionPanel(expanded=False),
        auto_views=False,
    )
