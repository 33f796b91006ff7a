"""Inverse sensor model: insertion of one scan into an octree."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.mapping.kernels import casting, ends, evidence, storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.scan_memory import BrickMemory, Runs
from octoreplay.mapping.scan_points import range_of
from octoreplay.mapping.snapshot import Snapshot
from octoreplay.records import (
    CloudFrame,
    DepthFrame,
    Float32Array,
    Float64Array,
    Frame,
    Int32Array,
    Int64Array,
    UInt8Array,
    UInt64Array,
    read_only,
)

MAX_GRID_CELLS = 1 << 32
"""Maximum size of the scratch grid of one scan [cell]."""


@dataclass(frozen=True)
class Increments:
    """Log-odds that one scan adds to a cell: ``hit`` to the class hit, ``hit_other`` to the others, ``miss`` if passed.

    Sums are clamped to [``least``, ``most``]. ``confidence_model`` is that of SensorConfig; the increments of a hit
    that a confidence changes are rounded to multiples of ``quantum``, and 0 does not round.
    """

    hit: float
    miss: float
    hit_other: float
    least: float
    most: float
    confidence_model: str = "none"
    quantum: float = 0.0

    def by_strength(self, num_classes: int) -> tuple[Float32Array, Float32Array]:
        """Return the log-odds of the class hit and of the others, each (256,) float32 for the strengths 0 to 255."""
        strengths = np.arange(256) / 255
        hits, others = np.full(256, self.hit), np.full(256, self.hit_other)
        if self.confidence_model in ("hit", "tempered"):
            hits = self._rounded(self.hit * strengths)
        if self.confidence_model == "tempered":
            others = self._rounded(self.hit_other * strengths)
        if self.confidence_model == "mixture" and num_classes > 1:
            hits, others = map(self._rounded, self._mixtures(strengths, num_classes))
        return read_only(hits.astype(np.float32)), read_only(others.astype(np.float32))

    def _mixtures(self, strengths: Float64Array, num_classes: int) -> tuple[Float64Array, Float64Array]:
        """Log-odds of the class hit and of the others where the label is right with the probabilities ``strengths``.

        Another class is the right one with equal probability. The likelihoods of both cases are added, relative to
        that of the case without doubt, so that the log-odds of strength 1 are exact.
        """
        ratio = math.exp(self.hit - self.hit_other)
        wrong = 1.0 - strengths
        hits = self.hit + np.log(strengths + wrong / ratio)
        others = self.hit_other + np.log(strengths + wrong * (ratio + num_classes - 2) / (num_classes - 1))
        return hits, others

    def _rounded(self, log_odds: Float64Array) -> Float64Array:
        """Nearest multiples of the quantum."""
        return np.rint(log_odds / self.quantum) * self.quantum if self.quantum else log_odds


def clamped_increments(sensor: SensorConfig, quantum: float = 0.0) -> Increments:
    """Return the sensor model's increments with its clamping limits: evidence s of a robot."""
    return _increments(sensor, sensor.clamp_min, sensor.clamp_max, quantum)


def unclamped_increments(sensor: SensorConfig) -> Increments:
    """Return the sensor model's increments without limits: the sum behind the averages of the evidence."""
    return _increments(sensor, -np.inf, np.inf, 0.0)


def _increments(sensor: SensorConfig, least: float, most: float, quantum: float) -> Increments:
    """Increments of a sensor model."""
    hit_other = sensor.miss if sensor.hit_other is None else sensor.hit_other
    return Increments(sensor.hit, sensor.miss, hit_other, least, most, sensor.confidence_model, quantum)


COUNT_SCANS = Increments(1.0, 1.0, 1.0, -np.inf, np.inf)
"""Increments that count the scans that touched a cell, in an octree with one class."""


@dataclass(frozen=True, eq=False)
class TouchedCells:
    """Cells that one scan touches. The arrays are the caster's memory, valid until its next cast.

    - ``codes`` (n,): Morton codes of the bricks with a touched cell.
    - ``marks`` (n, 8) uint64: one byte for each cell of the bricks in Morton order: 0 untouched, 1 passed, 1 + class_id
      hit.
    - ``strengths`` (n, 8) uint64: label confidence of each hit in 1 / 255, parallel to ``marks``; size 0 for full
      confidence.
    """

    codes: Int64Array
    marks: UInt64Array
    strengths: UInt64Array


@dataclass(frozen=True, eq=False)
class CastFrame:
    """Frame whose rays were cast before, with the cells that they touch; the other fields are those of a frame."""

    robot_id: str
    stamp_ns: int
    T_team_sensor: Float64Array
    sensor_index: int
    cells: TouchedCells


def sensor_reach(sensor: SensorConfig, map_config: MapConfig) -> float:
    """Return the largest coordinate of a sensor with which all its rays stay in the key space [m].

    It is at least half of the key space's reach, however large ``max_range`` is.
    """
    reach = storage.KEY_OFFSET * map_config.resolution
    return reach - min(sensor.max_range + 2 * map_config.resolution, reach / 2)


class ScanCaster:
    """Ray caster: finds the cells that a scan touches. It reuses scratch memory, so each thread needs its own."""

    def __init__(self, sensor: SensorConfig, map_config: MapConfig, num_classes: int) -> None:
        self._sensor = sensor
        self._resolution = map_config.resolution
        self._num_classes = num_classes
        self._low, self._high = np.array(map_config.box).reshape(2, 3)
        self._is_bounded = bool(np.isfinite(map_config.box).any())
        self._special = np.array(sensor.invalid_depth + sensor.no_return_depth, np.float64)
        self._meanings = np.repeat([0.0, np.inf], [len(sensor.invalid_depth), len(sensor.no_return_depth)])
        # The scratch grid is empty between casts.
        self._marks = np.zeros(0, np.uint8)
        self._strengths = np.zeros(0, np.uint8)
        self._flags = np.zeros(0, np.uint8)
        self._bricks = BrickMemory(0, has_strengths=False)
        self._scratch = np.empty((0, 0), np.float32), np.empty((0, 0)), np.empty((0, 0), np.int32)
        self._scratch_rows(ends.BLOCK)
        self._runs = Runs(0, num_classes, sensor.rays)

    def cast(self, frame: Frame) -> TouchedCells:
        """Return the cells that a scan touches. A cell that is hit is not also passed.

        ``sensor.rays`` selects one ray for each distinct end cell, to its centre, or one for each point. Labels are
        weighted by their confidences, unless the sensor model ignores these; points in robots' bodies hit nothing.
        Raises InputError where the scan leaves the key space, and ConfigError where max_range is too long for the
        resolution.
        """
        # numpy takes longer than Python for three numbers.
        origin = [float(coord) / self._resolution for coord in frame.T_team_sensor[:3, 3]]
        if not all(1 - storage.KEY_OFFSET <= coord < storage.KEY_OFFSET for coord in origin):
            raise self._outside(frame)
        origin_key = [math.floor(coord) for coord in origin]
        self._find_runs(frame)
        runs = self._runs
        corner, num_blocks, marks, flags = self._grid(*self._box(frame, origin_key))
        tables = np.empty((6, casting.BLOCK_EDGE * num_blocks.max() + casting.VECTOR), np.uint32)
        casting.fill_tables(num_blocks, tables)
        strengths = self._strength_plane(0 if self._confidences(frame).size == 0 else marks.size)
        num_ends, end_marks = runs.reduce(corner, tables, marks, strengths)
        start = np.array([self._start(*coords) for coords in zip(origin, origin_key, corner.tolist(), strict=True)])
        casting.mark_free(start, *runs.rays(num_ends), self._resolution, corner, num_blocks, tables, marks, flags)
        casting.mark_hits(runs.end_places[:num_ends], end_marks, marks, flags)
        if self._is_bounded:
            casting.clear_outside(*self._mapped(corner, num_blocks), num_blocks, marks, flags)
        return self._take_bricks(corner, num_blocks, marks, strengths, flags)

    def _take_bricks(
        self, corner: Int64Array, num_blocks: Int64Array, marks: UInt8Array, strengths: UInt8Array, flags: UInt8Array
    ) -> TouchedCells:
        """Return the touched cells of the scratch grid, and empty it."""
        # One more than the bricks: the kernel writes bricks without a mark too, and overwrites them with the next.
        places, has_strengths = int(np.count_nonzero(flags)) * casting.BRICKS_PER_BLOCK + 1, strengths.size > 0
        if places > self._bricks.codes.size or has_strengths > (self._bricks.strengths.size > 0):
            self._bricks = BrickMemory(2 * places, has_strengths=has_strengths)
        bricks = self._bricks
        brick_strengths = bricks.strengths if has_strengths else bricks.strengths[:0]
        num_bricks = casting.take_bricks(
            marks.view(np.uint64), strengths.view(np.uint64), flags, corner, num_blocks, bricks.codes, bricks.marks,
            brick_strengths,
        )  # fmt: skip
        return TouchedCells(bricks.codes[:num_bricks], bricks.marks[:num_bricks], brick_strengths[:num_bricks])

    def _find_runs(self, frame: Frame) -> None:
        """Write the ends of the scan's rays into the runs."""
        size = frame.depth_image.size if isinstance(frame, DepthFrame) else len(frame.points)
        if size > self._runs.capacity:
            self._runs = Runs(size, self._num_classes, self._sensor.rays)
        self._runs.counters[:] = 0
        pose = np.ascontiguousarray(frame.T_team_sensor, np.float64)
        if not np.isfinite(pose).all():
            raise self._outside(frame)
        if isinstance(frame, CloudFrame):
            self._find_cloud_runs(frame, frame.points, frame.class_ids, pose)
        elif frame.camera.slopes is None:
            self._find_depth_runs(frame, pose)
        else:
            classes = None if frame.class_image is None else frame.class_image.ravel()
            self._find_cloud_runs(frame, self._lens_points(frame, frame.camera.slopes), classes, pose)

    def _find_depth_runs(self, frame: DepthFrame, pose: Float64Array) -> None:
        """Find the runs of a depth image without lens distortion."""
        camera = frame.camera
        depth, *values = self._depths(frame)
        # A scan without labels has class 1 everywhere.
        classes = read_only(np.ones(depth.shape, np.uint8)) if frame.class_image is None else frame.class_image
        ends.depth_to_runs(
            depth, frame.depth_unit, np.ascontiguousarray(classes),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]), pose, self._resolution,
            *range_of(frame, self._sensor), *values, self._confidences(frame), _boxes(frame),
            *self._scratch_rows(depth.shape[1]), *self._runs.outputs,
        )  # fmt: skip

    def _scratch_rows(self, size: int) -> tuple[Float32Array, Float64Array, Int32Array]:
        """Return the scratch memory of the kernels that process ``size`` points at once."""
        if size + 1 > self._scratch[0].shape[1]:
            shape = (ends.NUM_SCRATCH_ROWS, size + 1)
            self._scratch = np.empty(shape, np.float32), np.empty(shape), np.empty(shape, np.int32)
        return self._scratch

    def _lens_points(self, frame: DepthFrame, slopes: Float32Array) -> Float64Array:
        """Return the points (P, 3) of a depth image in the sensor's frame [m], at most 2 x max_range deep."""
        depth, *values = self._depths(frame)
        points = np.empty((depth.size, 3))
        farthest = 2.0 * self._sensor.max_range
        ends.depth_to_points(depth, frame.depth_unit, read_only(slopes), farthest, *values, points)
        return points

    def _confidences(self, frame: Frame) -> UInt8Array:
        """Return the label confidences (P,) in 1 / 255; size 0 for full confidence, and where they change nothing."""
        given = frame.confidence_image if isinstance(frame, DepthFrame) else frame.confidences
        if self._sensor.confidence_model == "none":
            given = None
        # Read-only like frames from logs, so that kernels are compiled for one signature.
        return read_only(np.empty(0, np.uint8) if given is None else given.ravel())

    def _depths(self, frame: DepthFrame) -> tuple[npt.NDArray[Any], float, Float64Array, Float64Array]:
        """Return a depth image as kernel arguments: image, largest value of its dtype, special values, meanings."""
        depth = frame.depth_image
        kind = np.uint16 if depth.dtype.kind in "ui" and depth.dtype.itemsize <= 2 else np.float32
        largest = float(np.iinfo(depth.dtype).max) if depth.dtype.kind in "ui" else np.inf
        # A float image stores a value such as 2.1 as the nearest float32, so that is what pixels are compared with.
        stored = np.float32 if kind is np.float32 else np.float64
        special = self._special.astype(stored).astype(np.float64)
        return np.ascontiguousarray(depth, kind), largest, special, self._meanings

    def _find_cloud_runs(
        self, frame: Frame, points: npt.NDArray[Any], class_ids: UInt8Array | None, pose: Float64Array
    ) -> None:
        """Find the runs of points (P, 3) with the classes (P,)."""
        kind = np.float32 if points.dtype == np.float32 else np.float64
        classes = read_only(np.ones(len(points), np.uint8)) if class_ids is None else class_ids
        ends.points_to_runs(
            np.ascontiguousarray(points, kind), np.ascontiguousarray(classes), pose, self._resolution,
            *range_of(frame, self._sensor), self._confidences(frame), _boxes(frame),
            *self._scratch_rows(ends.BLOCK)[1:], *self._runs.outputs,
        )  # fmt: skip

    def _box(self, frame: Frame, origin_key: list[int]) -> tuple[list[int], list[int]]:
        """Return the lowest and highest key of the origin and all ends."""
        bounds = np.array([origin_key, origin_key], np.int64)
        ends.extend_bounds(self._runs.keys, self._runs.num_runs, bounds[0], bounds[1])
        low, high = bounds.tolist()
        if min(low) <= -storage.KEY_OFFSET or max(high) >= storage.KEY_OFFSET:
            raise self._outside(frame)
        if (
            math.prod(most - least + 2 * casting.BLOCK_EDGE for least, most in zip(low, high, strict=True))
            > MAX_GRID_CELLS
        ):
            raise ConfigError(
                f"resolution: {self._resolution:g} m is too fine for max_range {self._sensor.max_range:g} m: one scan "
                f"would span more than {MAX_GRID_CELLS:.1e} cells"
            )
        return low, high

    def _outside(self, frame: Frame) -> InputError:
        """Return the error of a scan that leaves the key space."""
        reach = storage.KEY_OFFSET * self._resolution
        return InputError(
            f"robot '{frame.robot_id}', {frame.stamp_ns} ns: the scan lies outside the map, which reaches "
            f"{reach:g} m from its origin at a resolution of {self._resolution:g} m; check the poses, or give "
            "T_team_map or a coarser resolution"
        )

    def _grid(self, low: list[int], high: list[int]) -> tuple[Int64Array, Int64Array, UInt8Array, UInt8Array]:
        """Return an empty scratch grid around the cells low..high: lowest cell, size in blocks, marks, flags."""
        first = [key >> casting.BLOCK_BITS for key in low]
        num_blocks = [(key >> casting.BLOCK_BITS) - block + 1 for key, block in zip(high, first, strict=True)]
        size = math.prod(num_blocks)
        if size > self._flags.size:
            # np.zeros maps fresh memory, which takes no physical memory until it is written.
            self._marks = np.zeros(size * casting.BLOCK_CELLS, np.uint8)
            self._flags = np.zeros(size, np.uint8)
        marks = self._marks[: size * casting.BLOCK_CELLS]
        return np.array(first) << casting.BLOCK_BITS, np.array(num_blocks), marks, self._flags[:size]

    def _strength_plane(self, size: int) -> UInt8Array:
        """Return memory for the strengths in a scratch grid of ``size`` cells; only those of hit cells are read."""
        if size > self._strengths.size:
            self._strengths = np.zeros(size, np.uint8)
        return self._strengths[:size]

    @staticmethod
    def _start(coord: float, key: int, corner: int) -> float:
        """Return a coordinate [cell] in the scratch grid, rounded to a multiple of casting.FRACTION within its cell."""
        inside = round((coord - key) / casting.FRACTION) * casting.FRACTION
        return key - corner + min(inside, 1.0 - casting.FRACTION)

    def _mapped(self, corner: Int64Array, num_blocks: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Return the box [low, high) (3,) of the scratch grid's cells with centres within the configured bounds."""
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for axis in range(3):
            local = np.arange(num_blocks[axis] * casting.BLOCK_EDGE)
            centers = (local + corner[axis] + 0.5) * self._resolution
            low[axis] = np.count_nonzero(centers < self._low[axis])
            high[axis] = np.count_nonzero(centers < self._high[axis])
        return low, high


def _boxes(frame: Frame) -> Float64Array:
    """Return the boxes (b, 4, 6) of robots' bodies in the kernels' format."""
    boxes = np.zeros((len(frame.boxes), 4, 6))
    for rows, box in zip(boxes, frame.boxes, strict=True):
        rows[:3, :4], rows[:3, 4], rows[:3, 5] = box.T_box_team[:3], box.low, box.high
        rows[ends.IS_OWN, 0] = box.is_own
    return boxes


@functools.lru_cache(maxsize=16)
def _by_strength(increments: Increments, num_classes: int) -> tuple[Float32Array, Float32Array]:
    """Stored log-odds of ``Increments.by_strength``: making them would take a tenth of the time of a scan."""
    return increments.by_strength(num_classes)


def add_scan(
    octree: SemanticOctree, cells: TouchedCells, increments: Increments, revision: int, before: Snapshot | None = None
) -> None:
    """Add the increments of one scan to an octree, in place; changed bricks get ``revision``.

    ``before`` is a snapshot of the octree from before its first scan with this revision.
    """
    indices = octree.find_or_add(cells.codes)
    miss, least, most = np.float32(increments.miss), np.float32(increments.least), np.float32(increments.most)
    wanted = np.zeros((indices.size, octree.bricks.masks.shape[1]), np.uint64)
    known, changes = np.empty(indices.size, np.uint64), np.empty(indices.size, np.bool_)
    evidence.wanted_rows(
        octree.bricks, indices, cells.marks, octree.num_classes, miss, least, most, wanted, known, changes
    )
    if before is not None:
        before.save(octree.codes[indices[changes & (octree.revisions[indices] < revision)]])
    octree.expand_bricks(indices, wanted, known, changes)
    hits, others = _by_strength(increments, octree.num_classes)
    evidence.apply_marks(
        octree.bricks, indices, changes, cells.marks, cells.strengths.view(np.uint8), octree.num_classes, hits, others,
        miss, least, most, revision, np.empty((2, storage.BRICK_CELLS), np.float32),
    )  # fmt: skip
