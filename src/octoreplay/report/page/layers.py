"""Maps of a result as layers of tiles: the team's map, each robot's map and own scans, and the centralised map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.octree import codes_to_keys
from octoreplay.records import CENTRAL, Float64Array, Int64Array, UInt32Array
from octoreplay.report.map_part import finest_edge
from octoreplay.report.page.team_map import Evidence, RobotMap, TeamMap, together
from octoreplay.report.page.tiles import (
    DISAGREEMENT_STEPS,
    FEW_TILES,
    MAX_LEVEL,
    NO_TILE,
    PLAIN,
    TEAM_FIELDS,
    Cubes,
    Runs,
    TilePool,
    coarser,
    coarser_runs,
    cube_columns,
    run_columns,
    split_runs,
    tile_places,
    tiles_of,
)
from octoreplay.result import Result
from octoreplay.stored_map import StoredMap

TEAM_LAYER = "/team"
"""Name of the layer of the team's map; names of robots do not begin with a slash."""

_Contents = tuple[int, int, int]
"""Indices of a tile's cubes, values of the team's map, and free space in the pools."""


@dataclass
class Layer:
    """One map over time: the tiles that changed at each tick.

    Rows are tuples of level, tile code, index of the tick, and contents. ``kind`` is 'team', 'map', 'evidence' or
    'central'.
    """

    name: str
    robot_id: str
    kind: str
    title: str = ""
    rows: list[tuple[int, int, int, int, int, int]] = field(default_factory=list)
    latest: dict[tuple[int, int], _Contents] = field(default_factory=dict)

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """Return the rows as columns; ``places`` (n, 3) are those of the tiles on their level's grid of tiles."""
        rows = np.array(self.rows, dtype=np.int64).reshape(-1, 6)
        levels = rows[:, 0].astype(np.uint8)
        return {
            "levels": levels,
            "places": tile_places(rows[:, 1], levels),
            "ticks": rows[:, 2].astype(np.uint16),
            "cubes": rows[:, 3].astype(np.uint32),
            "team": rows[:, 4].astype(np.uint32),
            "free": rows[:, 5].astype(np.uint32),
        }


class Layers:
    """Layers of a result by name, and the pools of their tiles.

    ``masks`` are the distinct masks of robots that the values of the team's map name by their index. ``max_depth`` is
    as in ``StoredMap.coarsened``, and ``resolution`` the edge of the finest cells [m].
    """

    def __init__(self, result: Result, ticks: Sequence[int], max_depth: int | None = None) -> None:
        self.ticks = tuple(ticks)
        self.masks = _Masks()
        self.pools = {
            "cubes": TilePool({"steps": "<u2", **dict(PLAIN[1:])}),
            "team": TilePool({**dict(TEAM_FIELDS), "seen": "<u2"}),
            "free": TilePool({"gaps": "<u2", "lengths": "<u2"}),
        }
        self.layers: dict[str, Layer] = {}
        self.largest_disagreement = 0.0
        self.resolution = finest_edge(result, max_depth)
        self.bounds = Bounds(self.resolution)
        self.evidence = Evidence(result, ticks, max_depth)
        team_map = TeamMap(self.evidence)
        for index, maps in _chosen(result, ticks, max_depth):
            self._add_tick(index, maps, team_map)

    def contents_in_use(self, pool: str) -> UInt32Array:
        """Return the indices (n,) of the contents of a pool that a layer names, ascending."""
        named = np.concatenate([np.empty(0, np.uint32), *(layer.columns()[pool] for layer in self.layers.values())])
        used: UInt32Array = np.unique(named[named != NO_TILE])
        return used

    def keep_levels(self, team_level: int, robot_level: int) -> None:
        """Remove the tiles that are finer than a level: of the team's map, and of all other maps."""
        for layer in self.layers.values():
            finest = team_level if layer.kind == "team" else robot_level
            coarsest = max((row[0] for row in layer.rows), default=0)
            layer.rows = [row for row in layer.rows if row[0] >= min(finest, coarsest)]

    def finest_level(self, *, is_team: bool) -> int:
        """Return the finest level that the team's map has, or that all other maps have."""
        layers = [layer for layer in self.layers.values() if (layer.kind == "team") == is_team and layer.rows]
        return max((min(row[0] for row in layer.rows) for layer in layers), default=0)

    def _add_tick(self, index: int, maps: dict[str, RobotMap], team_map: TeamMap) -> None:
        """Add all maps of a tick."""
        tick = self.ticks[index]
        robots = together({name: own.stored for name, own in maps.items() if name != CENTRAL})
        cubes, runs = team_map.at(tick, [maps[name] for name in robots])
        self.bounds.add(cubes["code"])
        self.largest_disagreement = max(
            self.largest_disagreement, float(cubes["disagreement"].max(initial=0)) / DISAGREEMENT_STEPS
        )
        title = f"mean of the maps of {len(robots)} robots" if len(robots) > 1 else f"map of {', '.join(robots)}"
        self._add_tiles(Layer(TEAM_LAYER, "", "team", title), index, cubes, runs)
        for name, own in maps.items():
            self._add(index, name, "central" if name == CENTRAL else "map", own)
        evidence_tick, evidence = self.evidence.at(tick)
        for own in evidence if evidence_tick == tick else ():
            self._add(index, f"/evidence/{own.stored.robot_id}", "evidence", own)

    def _add(self, index: int, name: str, kind: str, own: RobotMap) -> None:
        """Add a map or the evidence of one robot."""
        title = "" if kind == "evidence" else own.stored.title()
        layer = Layer(name, own.stored.robot_id, kind, title)
        self._add_tiles(layer, index, own.cubes(), own.free_space)

    def _add_tiles(self, layer: Layer, index: int, cubes: Cubes, runs: Runs) -> None:
        """Add the tiles of all levels that differ from those of the tick before."""
        title, layer = layer.title, self.layers.setdefault(layer.name, layer)
        layer.title = title
        present: dict[tuple[int, int], _Contents] = {}
        for level in range(MAX_LEVEL + 1):
            found = self._contents(cubes, runs)
            present.update({(level, tile): contents for tile, contents in found.items()})
            if len(found) <= FEW_TILES:
                break
            cubes, runs = coarser(cubes), coarser_runs(runs)
        gone = dict.fromkeys(layer.latest.keys() - present.keys(), (NO_TILE, NO_TILE, NO_TILE))
        for place, contents in sorted({**present, **gone}.items()):
            if layer.latest.get(place) != contents:
                layer.rows.append((*place, index, *contents))
        layer.latest = present

    def _contents(self, cubes: Cubes, runs: Runs) -> dict[int, _Contents]:
        """Put the tiles of one level into the pools and return their contents by tile code."""
        found: dict[int, _Contents] = {}
        is_team = "seen" in (cubes.dtype.names or ())
        for tile, rows in tiles_of(cubes["code"]):
            columns = cube_columns(cubes[rows])
            if is_team:
                columns["seen"] = self.masks.indices(columns["seen"])
            found[tile] = (
                self.pools["cubes"].add(columns),
                self.pools["team"].add(columns) if is_team else NO_TILE,
                NO_TILE,
            )
        runs = split_runs(runs)
        for tile, rows in tiles_of(runs[:, 0]):
            first, second, _ = found.get(tile, (NO_TILE, NO_TILE, NO_TILE))
            found[tile] = (first, second, self.pools["free"].add(run_columns(runs[rows])))
        return found


class Bounds:
    """Axis-aligned boxes around occupied cells in metres.

    ``low`` and ``high`` (3,) are the corners of the box around all cells of all times, ``near`` and ``far`` (3,) those
    of the box around most cells of the last time, without the outermost hundredth on each side.
    """

    def __init__(self, resolution: float) -> None:
        self._resolution = resolution
        self.low: Float64Array = np.full(3, np.inf)
        self.high: Float64Array = np.full(3, -np.inf)
        self.near: Float64Array = np.full(3, -1.0)
        self.far: Float64Array = np.full(3, 1.0)

    def add(self, codes: Int64Array) -> None:
        """Add the first cells of cubes, by their Morton codes (M,)."""
        if len(codes):
            keys = codes_to_keys(codes)
            self.low = np.minimum(self.low, keys.min(axis=0) * self._resolution)
            self.high = np.maximum(self.high, (keys.max(axis=0) + 1) * self._resolution)
            near, far = np.quantile(keys, (0.01, 0.99), axis=0)
            self.near, self.far = near * self._resolution, (far + 1) * self._resolution


class _Masks:
    """Distinct masks of robots in the order in which they occur; the first is the empty one."""

    def __init__(self) -> None:
        self.values = [0]
        self._known = {0: 0}

    def indices(self, masks: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint16]:
        """Return the index of each mask (M,); masks after the 65,536th count as the empty one."""
        distinct, places = np.unique(masks, return_inverse=True)
        found = []
        for value in distinct.tolist():
            if value not in self._known and len(self.values) < 1 << 16:
                self._known[value] = len(self.values)
                self.values.append(value)
            found.append(self._known.get(value, 0))
        return np.array(found, dtype=np.uint16)[places]


def _chosen(result: Result, ticks: Sequence[int], max_depth: int | None) -> Iterator[tuple[int, dict[str, RobotMap]]]:
    """Yield the index of each of ``ticks`` and all maps at it by name."""
    indices = {tick: index for index, tick in enumerate(ticks)}
    names = (*result.robots, CENTRAL)
    for maps in result.history():
        tick = max(stored.tick for stored in maps.values())
        if tick in indices:
            shown = {name: stored.coarsened(max_depth) for name, stored in maps.items()}
            yield indices[tick], {name: _robot_map(names.index(name), stored) for name, stored in shown.items()}


def _robot_map(index: int, stored: StoredMap) -> RobotMap:
    """Map of a robot with its leaves."""
    return RobotMap(index, stored, stored.shown_octree().spans())
