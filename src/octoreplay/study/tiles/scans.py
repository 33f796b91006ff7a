"""Work files with the cells that every scan of a robot touches, divided among blocks of the space.

Rays are cast once for a run, and each tile reads its part of every scan.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Self

import numpy as np
import zstandard

from octoreplay.errors import InputError
from octoreplay.io.output_file import write_whole, writing
from octoreplay.io.robots.sensor_logs import SensorCounts
from octoreplay.mapping.octree import KEY_BITS, brick_keys
from octoreplay.mapping.sensor import CastFrame, TouchedCells
from octoreplay.records import BoolArray, Float64Array, Frame, Int64Array
from octoreplay.replay.checkpoint import pickled, unpickled
from octoreplay.study.tiles.geometry import Tile

SAMPLE = 16
"""One of so many bricks is counted for the forecast of memory."""

_HASH = np.uint64(0x9E3779B97F4A7C15)
_HASH_BITS = np.uint64(32)
_LEVEL = 1
_WORDS = 9
"""Words of 8 bytes of a brick without strengths: its code and its marks. Strengths take as many as the marks."""
_NOTHING = TouchedCells(np.empty(0, np.int64), np.empty((0, 8), np.uint64), np.empty((0, 8), np.uint64))


class ScanFiles:
    """Paths of the files of one robot's scans in a folder; ``index`` is its place in the team."""

    def __init__(self, folder: Path, index: int) -> None:
        self.cells = folder / f"robot_{index}.cells"
        self.index = folder / f"robot_{index}.index"


@dataclass(frozen=True, eq=False)
class ScanIndex:
    """Scans of one robot: F frames in the order of their stamps, whose cells are in P parts.

    Attributes
    ----------
    block_cells : int
        Edge of the blocks that divide the cells [cell].
    stamps, sensors : (F,) int64 array
        Stamps on the team's clock [ns], and index of the sensor.
    poses : (F, 4, 4) float64 array
        Pose of the sensor in the team's frame.
    frames : (P,) int64 array
        Frame of each part, ascending.
    blocks : (P, 2) or (P, 3) int64 array
        Place of each part in the grid of columns along x and y, or of cubes.
    places : (P, 3) int64 array
        First byte of each part in the file of cells, its length [byte], and its number of bricks.
    sample : (k,) int64 array
        Ascending codes of the bricks that the robot touches: one of SAMPLE, chosen by a hash of the code.
    counts : SensorCounts
        Messages of each sensor by outcome.
    """

    block_cells: int
    stamps: Int64Array
    sensors: Int64Array
    poses: Float64Array
    frames: Int64Array
    blocks: Int64Array
    places: Int64Array
    sample: Int64Array
    counts: SensorCounts

    def save(self, path: Path) -> None:
        """Write the index. Raises OutputError."""
        content = vars(self) | {"counts": vars(self.counts)}
        write_whole(path, zstandard.compress(pickled(content), _LEVEL))


def load_index(path: Path) -> ScanIndex:
    """Return a stored index. Raises InputError for a file that cannot be read."""
    try:
        content = unpickled(zstandard.decompress(path.read_bytes()))
        return ScanIndex(**content | {"counts": SensorCounts(**content["counts"])})
    except (OSError, zstandard.ZstdError, UnpicklingError, TypeError, KeyError) as error:
        raise InputError(f"{path}: cannot be read: {error}; run with --restart to start from the beginning") from error


class ScanWriter:
    """Writer of the scans of one robot, in the order of their stamps; a context manager. Methods raise OutputError.

    Blocks have an edge of ``block_cells``; they are columns with ``num_axes`` 2, and cubes with 3.
    """

    def __init__(self, files: ScanFiles, block_cells: int, num_axes: int) -> None:
        self._files = files
        self._block_cells = block_cells
        self._num_axes = num_axes
        self._compressor = zstandard.ZstdCompressor(_LEVEL)
        self._frames: list[tuple[int, int]] = []
        self._poses: list[Float64Array] = []
        self._parts: list[tuple[int, ...]] = []
        self._length = 0
        self._sample = _Distinct()
        with ExitStack() as stack:
            with writing(files.cells):
                files.index.unlink(missing_ok=True)
                self._file = stack.enter_context(files.cells.open("wb"))
            self._closing = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with writing(self._files.cells):
            self._closing.close()

    def write(self, frame: Frame, cells: TouchedCells) -> None:
        """Write the cells that a frame touches."""
        number = len(self._frames)
        self._frames.append((frame.stamp_ns, frame.sensor_index))
        self._poses.append(np.array(frame.T_team_sensor))
        self._sample.add(cells.codes[is_sampled(cells.codes)])
        blocks = brick_keys(cells.codes)[:, : self._num_axes] // self._block_cells
        ids = functools.reduce(lambda high, low: (high << KEY_BITS) + low, blocks.T)
        order = np.argsort(ids, kind="stable")
        firsts = np.flatnonzero(np.diff(ids[order], prepend=np.iinfo(np.int64).min))
        for bricks in np.split(order, firsts)[1:]:
            self._write_part(number, blocks[bricks[0]].tolist(), bricks, cells)

    def _write_part(self, number: int, block: list[int], bricks: Int64Array, cells: TouchedCells) -> None:
        """Write the bricks (n,) of a scan in one block."""
        planes = [np.diff(cells.codes[bricks], prepend=0), cells.marks[bricks]]
        if cells.strengths.size:
            planes.append(cells.strengths[bricks])
        data = self._compressor.compress(b"".join(plane.tobytes() for plane in planes))
        with writing(self._files.cells):
            self._file.write(data)
        self._parts.append((number, *block, self._length, len(data), bricks.size))
        self._length += len(data)

    def finish(self, counts: SensorCounts) -> None:
        """Write the index, which makes the files complete."""
        with writing(self._files.cells):
            self._file.flush()
            os.fsync(self._file.fileno())
        parts = np.array(self._parts, np.int64).reshape(-1, 4 + self._num_axes)
        stamps, sensors = np.array(self._frames, np.int64).reshape(-1, 2).T
        poses = np.array(self._poses, np.float64).reshape(-1, 4, 4)
        ScanIndex(
            self._block_cells, stamps, sensors, poses, parts[:, 0], parts[:, 1:-3], parts[:, -3:], self._sample.codes,
            counts,
        ).save(self._files.index)  # fmt: skip


class ScanFile:
    """Scans of one robot in one tile, a source of frames; a context manager. Raises InputError for damaged files."""

    def __init__(self, files: ScanFiles, robot_id: str, tile: Tile) -> None:
        self._files = files
        self._robot_id = robot_id
        self._index = load_index(files.index)
        self._parts = np.flatnonzero(is_within(self._index, tile))

    def __enter__(self) -> Self:
        try:
            self._file = self._files.cells.open("rb")
        except OSError as error:
            raise self._damage(error) from error
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def frames(self) -> Iterator[CastFrame]:
        """Yield all frames of the robot with the cells that are in the tile."""
        index = self._index
        ends = np.searchsorted(index.frames[self._parts], np.arange(index.stamps.size + 1)).tolist()
        for number, (stamp_ns, sensor) in enumerate(zip(index.stamps.tolist(), index.sensors.tolist(), strict=True)):
            parts = self._parts[ends[number] : ends[number + 1]].tolist()
            yield CastFrame(self._robot_id, stamp_ns, index.poses[number], sensor, self._cells(parts))

    def _cells(self, parts: list[int]) -> TouchedCells:
        """Cells of some parts of one scan."""
        if not parts:
            return _NOTHING
        found = [self._read(*self._index.places[part].tolist()) for part in parts]
        if len(found) == 1:
            return found[0]
        columns = zip(*((cells.codes, cells.marks, cells.strengths) for cells in found), strict=True)
        return TouchedCells(*map(np.concatenate, columns))

    def _read(self, start: int, length: int, num_bricks: int) -> TouchedCells:
        """Cells of one part."""
        try:
            data = zstandard.decompress(os.pread(self._file.fileno(), length, start))
        except (OSError, zstandard.ZstdError) as error:
            raise self._damage(error) from error
        # A copy, because kernels are compiled for arrays that can be written.
        words: Any = np.frombuffer(data, np.int64).copy()
        ends = num_bricks, num_bricks * _WORDS
        marks, strengths = (plane.view(np.uint64).reshape(-1, 8) for plane in np.split(words, ends)[1:])
        return TouchedCells(np.cumsum(words[:num_bricks]), marks, strengths)

    def _damage(self, error: Exception) -> InputError:
        return InputError(
            f"{self._files.cells}: cannot be read: {error}; run with --restart to start from the beginning"
        )


def is_within(index: ScanIndex, tile: Tile) -> BoolArray:
    """Return True (P,) for the parts of scans that are in a tile, which consists of whole blocks."""
    place = [axis for axis in (tile.x, tile.y, tile.z) if axis is not None]
    return np.asarray((index.blocks // (tile.num_cells // index.block_cells) == place).all(axis=1))


def scan_bytes(scans: Sequence[ScanIndex], num_cells: int) -> list[int]:
    """Return the bytes of all scans in each tile with an edge of ``num_cells``, in the order of ``tiles_of``."""
    blocks = np.concatenate([index.blocks for index in scans]) // (num_cells // scans[0].block_cells)
    _, tiles = np.unique(blocks, axis=0, return_inverse=True)
    lengths = np.concatenate([index.places[:, 1] for index in scans])
    return [int(total) for total in np.bincount(tiles.ravel(), lengths)]


class _Distinct:
    """Distinct codes of bricks."""

    def __init__(self) -> None:
        self._codes = np.empty(0, np.int64)
        self._added: list[Int64Array] = []
        self._num_added = 0

    def add(self, codes: Int64Array) -> None:
        """Add codes (n,)."""
        self._added.append(codes)
        self._num_added += codes.size
        # Sorting doubles as rarely as the array grows.
        if self._num_added > max(self._codes.size, 1 << 16):
            self._merge()

    @property
    def codes(self) -> Int64Array:
        """Ascending codes."""
        self._merge()
        return self._codes

    def _merge(self) -> None:
        self._codes = np.unique(np.concatenate([self._codes, *self._added]))
        self._added, self._num_added = [], 0


def is_sampled(codes: Int64Array) -> BoolArray:
    """Return True (n,) for one of SAMPLE codes, alike for all robots and scans."""
    return np.asarray((codes.view(np.uint64) * _HASH >> _HASH_BITS) % np.uint64(SAMPLE) == 0)
