"""Tiles of all maps as indices of contents in pools, and the tiles of the next coarser level."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from octoreplay.records import Int64Array
from octoreplay.report.page.tile_pool import STARTS, TilePool
from octoreplay.report.page.tiles import (
    NO_TILE,
    PLAIN,
    TEAM_FIELDS,
    TILE_BITS,
    Cubes,
    Runs,
    coarser,
    coarser_runs,
    cube_columns,
    run_columns,
    split_runs,
    tiles_of,
)

_MOST_PARENTS = 256
"""Number of coarser tiles that are made at a time, which limits the memory."""


class Contents(NamedTuple):
    """Indices of a tile's cubes, values of the team's map, and free space in the pools; NO_TILE for none."""

    cubes: int = NO_TILE
    team: int = NO_TILE
    free: int = NO_TILE


NOTHING = Contents()
"""Contents of a tile that a map does not have."""

Rows = Int64Array
"""Changed tiles (n, 5) of one map and level, in order: index of the tick, tile code, and the fields of ``Contents``."""


class TileStore:
    """Pools of the contents of tiles by name; a context manager.

    Values of the team's map name a mask of robots by its index in ``masks``. Methods raise OutputError as TilePool.
    """

    def __init__(self) -> None:
        self.masks = _Masks()
        with ExitStack() as stack:
            self.pools = {
                name: stack.enter_context(TilePool(fields))
                for name, fields in (
                    ("cubes", {"steps": "<u2", **dict(PLAIN[1:])}),
                    ("team", {**dict(TEAM_FIELDS), "seen": "<u2"}),
                    ("free", {"gaps": "<u2", "lengths": "<u2"}),
                )
            }
            self._at_exit = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._at_exit.close()

    def put(self, cubes: Cubes, runs: Runs) -> dict[int, Contents]:
        """Store the tiles of a part of a map, and return their contents by tile code."""
        found: dict[int, Contents] = {}
        is_team = "seen" in (cubes.dtype.names or ())
        for tile, rows in tiles_of(cubes["code"]):
            columns = cube_columns(cubes[rows])
            if is_team:
                columns["seen"] = self.masks.indices(columns["seen"])
            team = self.pools["team"].add(columns) if is_team else NO_TILE
            found[tile] = Contents(self.pools["cubes"].add(columns), team)
        runs = split_runs(runs)
        for tile, rows in tiles_of(runs[:, 0]):
            free = self.pools["free"].add(run_columns(runs[rows]))
            found[tile] = found.get(tile, NOTHING)._replace(free=free)
        return found

    def coarser_rows(self, rows: Rows) -> Rows:
        """Store the tiles of the next coarser level than that of ``rows``, and return their rows."""
        fine: dict[int, Contents] = {}
        coarse: dict[int, Contents] = {}
        found: list[tuple[int, ...]] = []
        for index, changed in changes(rows):
            update(fine, changed)
            parents = sorted({tile >> 3 for tile in changed})
            for first in range(0, len(parents), _MOST_PARENTS):
                some = parents[first : first + _MOST_PARENTS]
                children = {tile: fine[tile] for p in some for tile in range(8 * p, 8 * p + 8) if tile in fine}
                present = self.put(coarser(self._cubes(children)), coarser_runs(self._runs(children)))
                changed_parents = {
                    tile: contents
                    for tile in some
                    if (contents := present.get(tile, NOTHING)) != coarse.get(tile, NOTHING)
                }
                update(coarse, changed_parents)
                found.extend((index, tile, *contents) for tile, contents in changed_parents.items())
        return np.array(found, np.int64).reshape(-1, 5)

    def sort_masks(self) -> None:
        """Bring the masks into ascending order, once all tiles are stored."""
        self.pools["team"].replace("seen", self.masks.sort())

    def _cubes(self, tiles: Mapping[int, Contents]) -> Cubes:
        """Cubes of tiles with ascending codes."""
        chosen = [(tile, contents) for tile, contents in tiles.items() if contents.cubes != NO_TILE]
        columns = self.pools["cubes"].columns([contents.cubes for _, contents in chosen])
        is_team = any(contents.team != NO_TILE for _, contents in chosen)
        if is_team:
            columns |= self.pools["team"].columns([contents.team for _, contents in chosen])
            columns["seen"] = np.array(self.masks.values, np.uint64)[columns["seen"]]
        codes = _codes([tile for tile, _ in chosen], columns.pop(STARTS), columns.pop("steps"))
        cubes = np.empty(len(codes), [*PLAIN, *TEAM_FIELDS] if is_team else [*PLAIN])
        cubes["code"] = codes
        for name, values in columns.items():
            cubes[name] = values
        return cubes

    def _runs(self, tiles: Mapping[int, Contents]) -> Runs:
        """Free space of tiles with ascending codes."""
        chosen = [(tile, contents) for tile, contents in tiles.items() if contents.free != NO_TILE]
        columns = self.pools["free"].columns([contents.free for _, contents in chosen])
        codes = _codes([tile for tile, _ in chosen], columns[STARTS], columns["gaps"])
        return np.column_stack([codes, columns["lengths"].astype(np.int64) + 1])


def changes(rows: Rows) -> Iterator[tuple[int, dict[int, Contents]]]:
    """Yield the index of each tick with changed tiles, and their contents by tile code."""
    firsts = np.flatnonzero(np.diff(rows[:, 0], prepend=-1))
    for part in np.split(rows, firsts[1:]) if len(firsts) else []:
        yield int(part[0, 0]), {tile: Contents(*contents) for _, tile, *contents in part.tolist()}


def update(tiles: dict[int, Contents], changed: Mapping[int, Contents]) -> None:
    """Change the contents of some tiles; tiles with NOTHING are removed."""
    for tile, contents in changed.items():
        if contents == NOTHING:
            del tiles[tile]
        else:
            tiles[tile] = contents


def most_tiles(rows: Rows) -> int:
    """Return the largest number of tiles that a map has at a level at any time."""
    tiles: dict[int, Contents] = {}
    largest = 0
    for _, changed in changes(rows):
        update(tiles, changed)
        largest = max(largest, len(tiles))
    return largest


def _codes(tiles: Sequence[int], starts: npt.NDArray[Any], steps: npt.NDArray[Any]) -> Int64Array:
    """Codes (n,) of the cells whose steps from the code before are given, tile by tile."""
    codes = np.concatenate([[0], np.cumsum(steps, dtype=np.int64)])
    in_tiles = codes[1:] - np.repeat(codes[starts[:-1]], np.diff(starts))
    found: Int64Array = in_tiles + np.repeat(np.array(tiles, np.int64) << TILE_BITS, np.diff(starts))
    return found


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

    def sort(self) -> npt.NDArray[np.uint16]:
        """Bring the masks into ascending order, and return the new index of each old one."""
        order = np.argsort(np.array(self.values, np.uint64), kind="stable")
        self.values = [self.values[place] for place in order.tolist()]
        self._known = {value: index for index, value in enumerate(self.values)}
        return np.argsort(order, kind="stable").astype(np.uint16)
