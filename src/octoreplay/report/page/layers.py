"""Maps of a result as layers of tiles: the team's map, each robot's map and own scans, and the centralised map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.octree import KEY_BITS, codes_to_keys
from octoreplay.records import CENTRAL, Float64Array, Int64Array, UInt32Array
from octoreplay.report.map_part import MapPart, finest_edge
from octoreplay.report.page.team_map import Evidence, EvidencePart, RobotMap, TeamMap, together
from octoreplay.report.page.tile_store import NOTHING, Contents, Rows, TileStore, most_tiles, update
from octoreplay.report.page.tiles import (
    DISAGREEMENT_STEPS,
    FEW_TILES,
    LARGEST,
    MAX_LEVEL,
    NO_TILE,
    Cubes,
    Runs,
    tile_places,
)
from octoreplay.result import Result

TEAM_LAYER = "/team"
"""Name of the layer of the team's map; names of robots do not begin with a slash."""

_KINDS = ("team", "map", "evidence", "central")
"""Kinds of layers in their order."""


@dataclass
class Layer:
    """One map over time: the tiles that changed at each tick.

    ``kind`` is 'team', 'map', 'evidence' or 'central', and ``levels`` has the rows of each level, the finest first.
    """

    name: str
    robot_id: str
    kind: str
    title: str = ""
    levels: dict[int, Rows] = field(default_factory=dict)

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """Return the rows of all levels as columns; ``places`` (n, 3) are those of the tiles on their level's grid."""
        rows = np.concatenate([np.empty((0, 5), np.int64), *self.levels.values()])
        levels = np.repeat(list(self.levels), [len(part) for part in self.levels.values()]).astype(np.uint8)
        return {
            "levels": levels,
            "places": tile_places(rows[:, 1], levels),
            "ticks": rows[:, 0].astype(np.uint16),
            "cubes": rows[:, 2].astype(np.uint32),
            "team": rows[:, 3].astype(np.uint32),
            "free": rows[:, 4].astype(np.uint32),
        }


class Layers:
    """Layers of a result in their order, and the store of their tiles; a context manager.

    Results in tiles are read one tile after the other; their layers are those of the same maps in one file.
    ``max_depth`` is as in ``StoredMap.coarsened``, and ``resolution`` the edge of the finest cells [m]. Raises
    OutputError where the temporary file of the tiles cannot be written.
    """

    def __init__(self, result: Result, ticks: Sequence[int], max_depth: int | None = None) -> None:
        self.ticks = tuple(ticks)
        self.largest_disagreement = 0.0
        self.resolution = finest_edge(result, max_depth)
        self.bounds = Bounds(self.resolution)
        self.evidence = Evidence(result, ticks)
        with ExitStack() as stack:
            self.store = stack.enter_context(TileStore())
            found: dict[str, _FoundTiles] = {}
            # A tile of the page is in one part.
            edge_depth = max((KEY_BITS if max_depth is None else max_depth) - LARGEST, 1)
            for bounds in result.boxes(max_depth=edge_depth):
                self._add_part(result, MapPart(None, bounds, max_depth), found)
            names = (*result.robots, CENTRAL)
            self.layers = sorted(
                (tiles.layer(self.store) for tiles in found.values()),
                key=lambda layer: (_KINDS.index(layer.kind), names.index(layer.robot_id or CENTRAL)),
            )
            self.store.sort_masks()
            self._at_exit = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._at_exit.close()

    def contents_in_use(self, pool: str) -> UInt32Array:
        """Return the indices (n,) of the contents of a pool that a layer names, in the order of their first use."""
        named = np.concatenate([np.empty(0, np.uint32), *(layer.columns()[pool] for layer in self.layers)])
        used, first = np.unique(named[named != NO_TILE], return_index=True)
        in_order: UInt32Array = used[np.argsort(first)]
        return in_order

    def keep_levels(self, team_level: int, robot_level: int) -> None:
        """Remove the tiles that are finer than a level: of the team's map, and of all other maps."""
        for layer in self.layers:
            finest = team_level if layer.kind == "team" else robot_level
            coarsest = max(layer.levels, default=0)
            layer.levels = {level: rows for level, rows in layer.levels.items() if level >= min(finest, coarsest)}

    def finest_level(self, *, is_team: bool) -> int:
        """Return the finest level that the team's map has, or that all other maps have."""
        layers = [layer for layer in self.layers if (layer.kind == "team") == is_team and layer.levels]
        return max((min(layer.levels) for layer in layers), default=0)

    def _add_part(self, result: Result, part: MapPart, found: dict[str, _FoundTiles]) -> None:
        """Add the finest tiles of a part of all maps at all ticks."""
        evidence = EvidencePart(self.evidence, part)
        team_map = TeamMap(evidence)
        for index, maps in _chosen(result, self.ticks, part):
            self._add_tick(index, maps, team_map, evidence, found)
        for tiles in found.values():
            tiles.end_part()

    def _add_tick(
        self, index: int, maps: dict[str, RobotMap], team_map: TeamMap, evidence: EvidencePart,
        found: dict[str, _FoundTiles],
    ) -> None:  # fmt: skip
        """Add a part of all maps of a tick."""

        def add(name: str, robot_id: str, kind: str, title: str, cubes: Cubes, runs: Runs) -> None:
            tiles = found.setdefault(name, _FoundTiles(name, robot_id, kind))
            tiles.add(index, title, self.store.put(cubes, runs))

        tick = self.ticks[index]
        robots = together({name: own.stored for name, own in maps.items() if name != CENTRAL})
        cubes, runs = team_map.at(tick, [maps[name] for name in robots])
        self.bounds.add(index, cubes["code"])
        self.largest_disagreement = max(
            self.largest_disagreement, float(cubes["disagreement"].max(initial=0)) / DISAGREEMENT_STEPS
        )
        title = f"mean of the maps of {len(robots)} robots" if len(robots) > 1 else f"map of {', '.join(robots)}"
        add(TEAM_LAYER, "", "team", title, cubes, runs)
        for name, own in maps.items():
            kind = "central" if name == CENTRAL else "map"
            add(name, own.stored.robot_id, kind, own.stored.title(), own.cubes(), own.free_space)
        evidence_tick, own_maps = evidence.at(tick)
        for own in own_maps if evidence_tick == tick else ():
            robot_id = own.stored.robot_id
            add(f"/evidence/{robot_id}", robot_id, "evidence", "", own.cubes(), own.free_space)


class _FoundTiles:
    """Finest tiles of one map, found in one part of space after the other, each over all ticks."""

    def __init__(self, name: str, robot_id: str, kind: str) -> None:
        self._layer = Layer(name, robot_id, kind)
        self._latest: dict[int, Contents] = {}
        self._rows: list[tuple[int, ...]] = []
        self._parts: list[Rows] = []

    def add(self, index: int, title: str, present: dict[int, Contents]) -> None:
        """Add the tiles of the part at a tick that differ from those of the tick before."""
        self._layer.title = title
        gone = dict.fromkeys(self._latest.keys() - present.keys(), NOTHING)
        changed = {
            tile: contents for tile, contents in {**present, **gone}.items() if self._latest.get(tile) != contents
        }
        update(self._latest, changed)
        self._rows.extend((index, tile, *contents) for tile, contents in changed.items())

    def end_part(self) -> None:
        """Begin the next part of space."""
        self._parts.append(np.array(self._rows, np.int64).reshape(-1, 5))
        self._latest, self._rows = {}, []

    def layer(self, store: TileStore) -> Layer:
        """Return the layer with all levels, up to the first one that never has more than FEW_TILES tiles."""
        rows = np.concatenate(self._parts)
        rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
        levels = [rows] if len(rows) else []
        while 0 < len(levels) <= MAX_LEVEL and most_tiles(levels[-1]) > FEW_TILES:
            levels.append(store.coarser_rows(levels[-1]))
        self._layer.levels = dict(enumerate(levels))
        return self._layer


class Bounds:
    """Axis-aligned boxes around occupied cells in metres.

    ``low`` and ``high`` (3,) are the corners of the box around all cells of all times, ``near`` and ``far`` (3,) those
    of the box around most cells of the last time, without the outermost hundredth on each side.
    """

    def __init__(self, resolution: float) -> None:
        self._resolution = resolution
        self._last = -1
        self._counts = [_KeyCounts() for _ in range(3)]
        self.low: Float64Array = np.full(3, np.inf)
        self.high: Float64Array = np.full(3, -np.inf)

    def add(self, index: int, codes: Int64Array) -> None:
        """Add the first cells of cubes at a tick, by their Morton codes (M,)."""
        if not len(codes):
            return
        keys = codes_to_keys(codes)
        self.low = np.minimum(self.low, keys.min(axis=0) * self._resolution)
        self.high = np.maximum(self.high, (keys.max(axis=0) + 1) * self._resolution)
        if index > self._last:
            self._last, self._counts = index, [_KeyCounts() for _ in range(3)]
        if index == self._last:
            for counts, of_axis in zip(self._counts, keys.T, strict=True):
                counts.add(of_axis)

    @property
    def near(self) -> Float64Array:
        """Lower corner (3,) of the box around most cells; -1 m without a cell."""
        if self._last < 0:
            return np.full(3, -1.0)
        return np.array([counts.quantile(0.01) for counts in self._counts]) * self._resolution

    @property
    def far(self) -> Float64Array:
        """Upper corner (3,) of the box around most cells; 1 m without a cell."""
        if self._last < 0:
            return np.full(3, 1.0)
        return (np.array([counts.quantile(0.99) for counts in self._counts]) + 1) * self._resolution


class _KeyCounts:
    """Numbers of cells by their key along one axis."""

    def __init__(self) -> None:
        self._keys: Int64Array = np.empty(0, np.int64)
        self._counts: Int64Array = np.empty(0, np.int64)

    def add(self, keys: Int64Array) -> None:
        """Count keys (M,)."""
        new, counts = np.unique(keys, return_counts=True)
        both, places = np.unique(np.concatenate([self._keys, new]), return_inverse=True)
        self._counts = np.bincount(places, np.concatenate([self._counts, counts])).astype(np.int64)
        self._keys = both

    def quantile(self, share: float) -> float:
        """Return the key below which there is a share of the cells, between two cells by linear interpolation."""
        ends = np.cumsum(self._counts)
        place = share * (ends[-1] - 1)
        low, high = self._keys[np.searchsorted(ends, [np.floor(place), np.ceil(place)], side="right")]
        return float(low + (high - low) * (place - np.floor(place)))


def _chosen(result: Result, ticks: Sequence[int], part: MapPart) -> Iterator[tuple[int, dict[str, RobotMap]]]:
    """Yield the index of each of ``ticks`` and a part of all maps at it by name."""
    indices = {tick: index for index, tick in enumerate(ticks)}
    names = (*result.robots, CENTRAL)
    for maps in result.history(bounds=part.bounds):
        tick = max(stored.tick for stored in maps.values())
        if tick in indices:
            shown = {name: stored.coarsened(part.max_depth) for name, stored in maps.items()}
            yield indices[tick], {name: RobotMap.of(names.index(name), stored) for name, stored in shown.items()}
