"""Files of a result in tiles, opened where they are needed, and the boxes that they cut space into."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from octoreplay.config.sensor import region_of
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.results.tile_files import TileFile, TileList
from octoreplay.mapping.key_box import KeyBox
from octoreplay.mapping.octree import KEY_BITS, KEY_OFFSET
from octoreplay.records import Int64Array

MOST_OPEN = 16
"""Number of files that stay open."""

Bounds = tuple[float, ...]


class _Closing(Protocol):
    def close(self) -> None: ...


ResultT = TypeVar("ResultT", bound=_Closing)


class ResultTiles(Generic[ResultT]):
    """Results of the tiles of the result ``path``; ``open_file`` opens one.

    ``end_ns`` is the stamp of the last tick of an unfinished result, whose tiles hold later ones too; None for all.
    """

    def __init__(
        self, path: Path, tiles: TileList, open_file: Callable[[Path], ResultT], end_ns: int | None = None
    ) -> None:
        self.end_ns = end_ns
        self.num_cells = tiles.num_cells
        self.files = tiles.files
        self.num_bytes = sum(file.size for file in tiles.files)
        self._path = path
        self._open_file = open_file
        self._opened: dict[TileFile, ResultT] = {}
        self._reader: ResultReader | None = None

    @property
    def reader(self) -> ResultReader:
        """Reader of one of the files, which tells the ticks of all. Raises InputError as ``open_new``."""
        if self._reader is None:
            self._reader = ResultReader(self.files[0].checked_path(self._path))
        return self._reader

    def close(self) -> None:
        """Close all files."""
        if self._reader is not None:
            self._reader.close()
        while self._opened:
            self._opened.popitem()[1].close()

    def has(self, stamp_ns: int) -> bool:
        """Return True for the stamp of a tick that the result has."""
        return self.end_ns is None or stamp_ns <= self.end_ns

    def touching(self, box: KeyBox | None) -> tuple[TileFile, ...]:
        """Return the files of the tiles that touch a box, all for None; of one tile at least."""
        return tuple(file for file in self.files if box is None or self._overlaps(file, box)) or self.files[:1]

    def is_inside(self, file: TileFile, box: KeyBox) -> bool:
        """Return True where a box holds all cells of a tile."""
        low, high = self._limits(file)
        heights = (-KEY_OFFSET, KEY_OFFSET)
        return bool(
            (box.low[:2] <= low).all() and (box.high[:2] >= high).all() and (box.low[2], box.high[2]) == heights
        )

    def opened(self, file: TileFile) -> ResultT:
        """Return the result of a tile, which stays open until others were opened. Raises InputError as ``open_new``."""
        found = self._opened.pop(file, None) or self.open_new(file)
        self._opened[file] = found
        if len(self._opened) > MOST_OPEN:
            self._opened.pop(next(iter(self._opened))).close()
        return found

    def open_new(self, file: TileFile) -> ResultT:
        """Return the result of a tile, opened anew. Raises InputError for a file that is missing or another one."""
        return self._open_file(file.checked_path(self._path))

    def _overlaps(self, file: TileFile, box: KeyBox) -> bool:
        low, high = self._limits(file)
        return bool((low < box.high[:2]).all() and (high > box.low[:2]).all())

    def _limits(self, file: TileFile) -> tuple[Int64Array, Int64Array]:
        """First keys (2,) of a tile along x and y, and those after its last ones."""
        low = np.array([file.x, file.y], np.int64) * self.num_cells
        return low, low + self.num_cells


def boxes_of(
    tiles: Sequence[ResultTiles[Any] | None], resolution: float, bounds: Sequence[float], max_depth: int | None
) -> Iterator[Bounds]:
    """Yield boxes that cut the cells in ``bounds`` along the tiles of all results; see ``Result.boxes``."""
    present = [of_result for of_result in tiles if of_result is not None]
    if len(present) < len(tiles):
        yield tuple(bounds)
        return
    num_cells = max([2 ** (KEY_BITS - (max_depth or KEY_BITS)), *(of_result.num_cells for of_result in present)])
    columns = {
        (file.x * of_result.num_cells // num_cells, file.y * of_result.num_cells // num_cells)
        for of_result in present
        for file in of_result.files
    }
    region, edge, reach = np.array(region_of(bounds)), num_cells * resolution, KEY_OFFSET * resolution
    num_boxes = 0
    for x, y in sorted(columns):
        column = np.array([x * edge, y * edge, -reach, (x + 1) * edge, (y + 1) * edge, reach])
        box = np.concatenate([np.maximum(column[:3], region[:3]), np.minimum(column[3:], region[3:])])
        limits = tuple(box.tolist())
        if not KeyBox.of(limits, resolution).is_empty:
            num_boxes += 1
            yield limits
    if not num_boxes:
        yield tuple(bounds)
