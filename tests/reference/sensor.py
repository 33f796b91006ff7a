"""Inverse sensor model of one scan: cells that it frees, cells that it hits, and their classes.

Each cell is updated once in a scan, and a cell that is hit is not also freed (OctoMap's rule).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.records import (
    NO_CLASS,
    BodyBox,
    BoolArray,
    CloudFrame,
    DepthFrame,
    Float64Array,
    Frame,
    Int64Array,
)
from reference.rays import Key, cells_before_end, coord_to_key, key_to_coord


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of one scan, one row for each ray.

    ``ends`` is (P, 3) float64, team frame [m]: the measured point, or the cut end of a ray beyond max_range.
    ``class_ids`` is (P,): 1..C for a point that hits its cell, NO_CLASS for one that only frees its ray (an ignored
    label, a cut ray, 'no return', another robot's body, zero confidence).
    ``confidences`` is (P,): label confidences in 1 / 255.
    """

    origin: Float64Array
    ends: Float64Array
    class_ids: Int64Array
    confidences: Int64Array


@dataclass(frozen=True, eq=False)
class ScanUpdate:
    """Cells that one scan touches, each once: ``freed`` (F, 3), ``hit`` (H, 3), and the class of each hit (H,).

    ``hit_strengths`` (H,) are the confidences of these classes in 1 / 255.
    """

    freed: Int64Array
    hit: Int64Array
    hit_classes: Int64Array
    hit_strengths: Int64Array


def scan_update(frame: Frame, sensor: SensorConfig, region: MapConfig) -> ScanUpdate:
    """Return the cells that a scan frees and hits, without cells with a centre outside the mapped region."""
    measured = measurements(frame, sensor)
    hit = hit_cells(measured, region.resolution)
    passed = passed_cells(measured, sensor.rays, region.resolution)
    hit = {key: winner for key, winner in hit.items() if in_region(key, region)}
    freed = sorted(key for key in passed if key not in hit and in_region(key, region))
    return ScanUpdate(
        freed=np.array(freed, dtype=np.int64).reshape(-1, 3),
        hit=np.array(sorted(hit), dtype=np.int64).reshape(-1, 3),
        hit_classes=np.array([hit[key][0] for key in sorted(hit)], dtype=np.int64),
        hit_strengths=np.array([hit[key][1] for key in sorted(hit)], dtype=np.int64),
    )


def in_region(key: Key, region: MapConfig) -> bool:
    """Return True where the cell's centre is in the mapped region [min, max)."""
    box = region.box
    centre = key_to_coord(key, region.resolution)
    return all(box[axis] <= centre[axis] < box[axis + 3] for axis in range(3))


def hit_cells(measured: Measurements, resolution: float) -> dict[Key, tuple[int, int]]:
    """Return the class of every end cell with a labelled point, and its strength in 1 / 255.

    The class with the largest sum of confidences wins, ties go to the lower id. Its strength is the mean confidence of
    its points, rounded half up.
    """
    votes: dict[Key, dict[int, list[int]]] = {}
    for end, class_id, confidence in zip(measured.ends, measured.class_ids, measured.confidences, strict=True):
        if class_id != NO_CLASS:
            of_cell = votes.setdefault(coord_to_key(end, resolution), {})
            of_cell.setdefault(int(class_id), []).append(int(confidence))
    winners = {key: min(of_cell, key=lambda c: (-sum(of_cell[c]), c)) for key, of_cell in votes.items()}
    return {key: (c, _rounded_mean(votes[key][c])) for key, c in winners.items()}


def _rounded_mean(numbers: list[int]) -> int:
    """Return the mean of integers, rounded half up."""
    return math.floor(sum(numbers) / len(numbers) + 0.5)


def passed_cells(measured: Measurements, rays: str, resolution: float) -> set[Key]:
    """Return all cells that any ray passes before its end cell.

    With ``rays`` 'cells', one ray goes to the centre of each distinct end cell (of hits, ignored points and cut rays).
    With 'all', one ray goes to each measured point or exact cut end.
    """
    origin = measured.origin.tolist()
    passed: set[Key] = set()
    end_keys = [coord_to_key(end, resolution) for end in measured.ends]
    if rays == "cells":
        for key in set(end_keys):
            passed.update(cells_before_end(origin, key_to_coord(key, resolution), key, resolution))
    else:
        for key, end in zip(end_keys, measured.ends, strict=True):
            passed.update(cells_before_end(origin, end.tolist(), key, resolution))
    return passed


def measurements(frame: Frame, sensor: SensorConfig) -> Measurements:
    """Return the rays of one scan that carry information, in the team's frame."""
    if isinstance(frame, DepthFrame):
        points, class_ids, confidences, no_return = _depth_points(frame, sensor)
    else:
        points, class_ids, confidences, no_return = _cloud_points(frame)
    distance = np.sqrt((points**2).sum(axis=1))
    used = no_return | ((distance >= sensor.min_range) & (distance > 0))
    points, class_ids, distance, no_return = points[used], class_ids[used], distance[used], no_return[used]
    confidences = confidences[used]
    if sensor.confidence_model == "none":
        confidences[:] = 255
    cut = no_return | (distance > sensor.max_range)
    points[cut] *= (sensor.max_range / distance[cut])[:, None]
    class_ids[cut | (confidences == 0)] = NO_CLASS
    rotation, origin = frame.T_team_sensor[:3, :3], frame.T_team_sensor[:3, 3]
    ends = points @ rotation.T + origin
    is_own, is_others = (~cut & in_any_box(ends, [b for b in frame.boxes if b.is_own == own]) for own in (True, False))
    class_ids[is_others] = NO_CLASS
    kept = ~is_own
    return Measurements(origin.astype(np.float64), ends[kept], class_ids[kept], confidences[kept])


def in_any_box(points: Float64Array, boxes: Iterable[BodyBox]) -> BoolArray:
    """Return where points (P, 3) in the team's frame are in a box or on its faces."""
    within = np.zeros(len(points), dtype=bool)
    for box in boxes:
        places = points @ box.T_box_team[:3, :3].T + box.T_box_team[:3, 3]
        within |= ((box.low <= places) & (places <= box.high)).all(axis=1)
    return within


def _depth_points(frame: DepthFrame, sensor: SensorConfig) -> tuple[Float64Array, Int64Array, Int64Array, BoolArray]:
    """Return points (P, 3) in the sensor's frame, classes, confidences and 'no return' mask of the usable pixels.

    A pixel without return gets the point at depth 1 m; only its direction is used. Pixels without a ray are not usable.
    """
    image, camera = frame.depth_image, frame.camera
    across, down = np.meshgrid(
        (np.arange(image.shape[1]) - camera.cx) / camera.fx, (np.arange(image.shape[0]) - camera.cy) / camera.fy
    )
    if camera.slopes is not None:
        across, down = camera.slopes.astype(np.float64)
    no_return = _equals_any(image, sensor.no_return_depth)
    measured = ~no_return & ~_without_information(image, sensor.invalid_depth)
    depth = image.astype(np.float64) * frame.depth_unit
    depth[no_return] = 1.0
    v, u = np.nonzero((measured | no_return) & np.isfinite(across) & np.isfinite(down))
    z = depth[v, u]
    points = np.stack([across[v, u] * z, down[v, u] * z, z], axis=1)
    classes = np.ones(image.shape, dtype=np.int64) if frame.class_image is None else frame.class_image
    confidences = np.full(image.shape, 255) if frame.confidence_image is None else frame.confidence_image
    return points, classes[v, u].astype(np.int64), confidences[v, u].astype(np.int64), no_return[v, u]


def _without_information(image: npt.NDArray[Any], invalid_depth: tuple[float, ...]) -> BoolArray:
    """Return True for depths that are <= 0, not finite, the largest value of an integer type, or in invalid_depth."""
    if np.issubdtype(image.dtype, np.integer):
        by_type = (image <= 0) | (image == np.iinfo(image.dtype).max)
    else:
        by_type = ~np.isfinite(image) | ~(image > 0)
    without: BoolArray = by_type | _equals_any(image, invalid_depth)
    return without


def _equals_any(image: npt.NDArray[Any], values: tuple[float, ...]) -> BoolArray:
    """Return True where the raw depth is one of ``values`` in the image's dtype; NaN equals NaN."""
    found = np.zeros(image.shape, dtype=bool)
    for value in values:
        if np.issubdtype(image.dtype, np.integer):
            found |= image == value
        elif math.isnan(value):
            found |= np.isnan(image)
        else:
            found |= image == image.dtype.type(value)
    return found


def _cloud_points(frame: CloudFrame) -> tuple[Float64Array, Int64Array, Int64Array, BoolArray]:
    """Return the finite points of a cloud, their classes and confidences, and a 'no return' mask of False."""
    finite = np.isfinite(frame.points).all(axis=1)
    points = frame.points[finite].astype(np.float64)
    if frame.class_ids is None:
        class_ids = np.ones(len(points), dtype=np.int64)
    else:
        class_ids = frame.class_ids[finite].astype(np.int64)
    confidences = np.full(len(finite), 255) if frame.confidences is None else frame.confidences
    return points, class_ids, confidences[finite].astype(np.int64), np.zeros(len(points), dtype=bool)
