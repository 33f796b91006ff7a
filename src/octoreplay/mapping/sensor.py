"""The inverse sensor model: one scan into the octrees of one robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from octoreplay.config import MapConfig, SensorConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.mapping.kernels import casting, storage
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import (
    CloudFrame,
    DepthFrame,
    Float64Array,
    Frame,
    Int32Array,
    Int64Array,
    UInt8Array,
)

MAX_GRID_CELLS = 1 << 32
"""Largest scratch grid of one scan, in cells."""


@dataclass(frozen=True)
class Increments:
    """What one scan adds to an octree's cells: log-odds for a hit, a pass and the classes not hit, and the limits."""

    hit: float
    miss: float
    hit_other: float
    least: float
    most: float


def clamped_increments(sensor: SensorConfig) -> Increments:
    """The evidence s of a robot: the sensor model's increments, clamped."""
    hit_other = sensor.miss if sensor.hit_other is None else sensor.hit_other
    return Increments(sensor.hit, sensor.miss, hit_other, sensor.clamp_min, sensor.clamp_max)


def unclamped_increments(sensor: SensorConfig) -> Increments:
    """The running sum behind the average readings of the evidence."""
    hit_other = sensor.miss if sensor.hit_other is None else sensor.hit_other
    return Increments(sensor.hit, sensor.miss, hit_other, -np.inf, np.inf)


COUNT_SCANS = Increments(1.0, 1.0, 1.0, -np.inf, np.inf)
"""Increments that count the scans which touched a cell, in an octree with one class."""


@dataclass(frozen=True, eq=False)
class TouchedCells:
    """The cells that one scan touches: brick codes (n,), and the marks (512 each, Morton order) of those bricks.

    A mark is 0 untouched, 1 passed, 1 + class_id hit. The marks are the caster's scratch memory, and are valid until it
    casts again.
    """

    codes: Int64Array
    marks: UInt8Array
    touched: Int64Array
    num_hit_bricks: int


class ScanCaster:
    """Finds the cells that scans touch; keeps scratch memory between them, so one per thread."""

    def __init__(self, sensor: SensorConfig, map_config: MapConfig, num_classes: int) -> None:
        self._sensor = sensor
        self._resolution = map_config.resolution
        self._num_classes = num_classes
        self._low, self._high = np.array(map_config.box).reshape(2, 3, 1)
        self._invalid = np.array(sensor.invalid_depth, np.float64)
        self._no_return = np.array(sensor.no_return_depth, np.float64)
        self._marks = np.zeros(0, np.uint8)
        self._slots = np.zeros(0, np.int32)
        self._flags = np.zeros(0, np.uint8)
        self._touched = np.zeros(0, np.int64)
        self._num_touched = 0
        self._keys = np.empty((0, 3), np.int32)
        self._kinds = np.empty(0, np.uint8)
        self._votes = np.zeros((0, num_classes), np.int32)
        self._rays = np.empty(0, np.int64)

    def cast(self, frame: Frame) -> TouchedCells:
        """The cells that a scan touches: each once, hit before passed.

        Rays follow ``sensor.rays``: one per distinct end cell to its centre, or one per point. Raises InputError where
        the scan leaves the key space, and ConfigError where max_range is too long for the resolution.
        """
        keys, kinds, ends = self._ends(frame)
        origin = np.ascontiguousarray(frame.T_team_sensor[:3, 3], np.float64)
        corner, edges, offsets, mapped = self._grid(keys, origin)
        casting.clear_marks(self._marks, self._flags, self._touched[: self._num_touched])
        self._make_room(int(np.prod(edges)))
        num_rays, num_touched = casting.mark_ends(
            keys, kinds, self._num_classes, corner, offsets, mapped, self._slots, self._votes, self._rays,
            self._marks, self._flags, self._touched,
        )  # fmt: skip
        if self._sensor.rays == "cells":
            keys = keys[self._rays[:num_rays]]
            ends = (keys.astype(np.float64) + 0.5) * self._resolution
        num_touched = casting.mark_free(
            origin, ends, keys, self._resolution, corner, mapped, self._marks, self._flags, self._touched, num_touched
        )
        self._num_touched = num_touched
        touched = self._touched[:num_touched]
        codes = np.empty(num_touched, np.int64)
        casting.touched_codes(touched, corner >> storage.BRICK_BITS, edges >> storage.BRICK_BITS, codes)
        hit_bricks = int(casting.count_hit_bricks(self._marks, touched, num_touched))
        return TouchedCells(codes, self._marks, touched, hit_bricks)

    def _ends(self, frame: Frame) -> tuple[Int32Array, UInt8Array, Float64Array]:
        """End cells' keys (n, 3), kinds (n,) and, for one ray per point, end points (n, 3)."""
        sensor = self._sensor
        size = frame.depth_image.size if isinstance(frame, DepthFrame) else len(frame.points)
        if size > self._kinds.size:
            self._keys = np.empty((size, 3), np.int32)
            self._kinds = np.empty(size, np.uint8)
            self._votes = np.zeros((size, self._num_classes), np.int32)
            self._rays = np.empty(size, np.int64)
        keys, kinds = self._keys, self._kinds
        ends = np.empty((size if sensor.rays == "all" else 0, 3))
        pose = np.ascontiguousarray(frame.T_team_sensor, np.float64)
        if isinstance(frame, DepthFrame):
            count = self._depth_ends(frame, pose, keys, kinds, ends)
        else:
            count = self._cloud_ends(frame, pose, keys, kinds, ends)
        reach = storage.KEY_OFFSET * self._resolution
        if count < 0 or not np.all(np.abs(pose[:3, 3]) < reach):
            raise InputError(
                f"robot '{frame.robot_id}', {frame.stamp_ns} ns: the scan lies outside the map, which reaches "
                f"{reach:g} m from its origin at a resolution of {self._resolution:g} m; check the poses, or give "
                "T_team_map or a coarser resolution"
            )
        return keys[:count], kinds[:count], ends[:count]

    def _depth_ends(
        self, frame: DepthFrame, pose: Float64Array, keys: Int32Array, kinds: UInt8Array, ends: Float64Array
    ) -> int:
        """Ends of a depth image's rays."""
        depth = frame.depth_image
        kind = np.uint16 if depth.dtype.kind in "ui" and depth.dtype.itemsize <= 2 else np.float32
        largest = float(np.iinfo(depth.dtype).max) if depth.dtype.kind in "ui" else np.inf
        camera = frame.camera
        classes = np.empty((0, 0), np.uint8) if frame.class_image is None else frame.class_image
        # A float image stores a value such as 2.1 as its nearest float32, and that is what it is to be compared with.
        stored = np.float32 if kind is np.float32 else np.float64
        invalid, no_return = (a.astype(stored).astype(np.float64) for a in (self._invalid, self._no_return))
        return int(
            casting.depth_to_ends(
                np.ascontiguousarray(depth, kind), frame.depth_unit, np.ascontiguousarray(classes),
                np.array([camera.fx, camera.fy, camera.cx, camera.cy]), pose, self._resolution, self._sensor.min_range,
                self._sensor.max_range, largest, invalid, no_return, keys, kinds, ends,
            )
        )  # fmt: skip

    def _cloud_ends(
        self, frame: CloudFrame, pose: Float64Array, keys: Int32Array, kinds: UInt8Array, ends: Float64Array
    ) -> int:
        """Ends of a point cloud's rays."""
        kind = np.float32 if frame.points.dtype == np.float32 else np.float64
        classes = np.empty(0, np.uint8) if frame.class_ids is None else frame.class_ids
        return int(
            casting.points_to_ends(
                np.ascontiguousarray(frame.points, kind), np.ascontiguousarray(classes), pose, self._resolution,
                self._sensor.min_range, self._sensor.max_range, keys, kinds, ends,
            )
        )  # fmt: skip

    def _grid(self, keys: Int32Array, origin: Float64Array) -> tuple[Int64Array, Int64Array, Int64Array, Int64Array]:
        """The scratch grid around a scan: lowest cell, edges in cells, axis offsets, those of mapped cells only."""
        start = np.floor(origin / self._resolution).astype(np.int64)
        low, high = start.copy(), start.copy()
        casting.widen_to_keys(keys, low, high)
        low, high = low >> storage.BRICK_BITS, high >> storage.BRICK_BITS
        corner = low << storage.BRICK_BITS
        num_bricks = high - low + 1
        edges = num_bricks << storage.BRICK_BITS
        if float(np.prod(edges.astype(np.float64))) > MAX_GRID_CELLS:
            raise ConfigError(
                f"resolution: {self._resolution:g} m is too fine for max_range {self._sensor.max_range:g} m: one scan "
                f"would span more than {MAX_GRID_CELLS:.1e} cells"
            )
        offsets = np.zeros((3, int(edges.max())), np.int64)
        casting.fill_axis_tables(num_bricks, offsets)
        centers = (np.arange(offsets.shape[1])[None, :] + corner[:, None] + 0.5) * self._resolution
        outside = (centers < self._low) | (centers >= self._high)
        return corner, edges, offsets, np.where(outside, np.int64(-(1 << 50)), offsets)

    def _make_room(self, num_cells: int) -> None:
        """Scratch grids for so many cells; fresh ones are zero and take no memory until they are touched."""
        if num_cells > self._marks.size:
            self._marks = np.zeros(num_cells, np.uint8)
            self._slots = np.zeros(num_cells, np.int32)
            self._flags = np.zeros(num_cells // storage.BRICK_CELLS, np.uint8)
            self._touched = np.zeros(num_cells // storage.BRICK_CELLS, np.int64)


def add_scan(octree: SemanticOctree, cells: TouchedCells, increments: Increments, revision: int) -> None:
    """Add one scan's increments to an octree; changed bricks get ``revision``."""
    indices = octree.find_or_add(cells.codes)
    octree.reserve(scalar=cells.codes.size, vector=cells.num_hit_bricks if octree.num_classes > 1 else 0)
    casting.apply_marks(
        octree.bricks, indices, cells.touched, cells.marks, np.float32(increments.hit), np.float32(increments.miss),
        np.float32(increments.hit_other), np.float32(increments.least), np.float32(increments.most), revision,
    )  # fmt: skip
