"""Points of one scan with their classes, for methods that work on points instead of cells."""

from __future__ import annotations

import math

import numpy as np

from octoreplay.config.sensor import SensorConfig
from octoreplay.records import BoolArray, CloudFrame, DepthFrame, Float64Array, Frame, UInt8Array


def range_of(frame: Frame, sensor: SensorConfig) -> tuple[float, float]:
    """Return the least and the largest distance of a scan's measured points [m]: its sensor's own, else the model's."""
    least = sensor.min_range if frame.min_range is None else float(frame.min_range)
    return least, sensor.max_range if frame.max_range is None else float(frame.max_range)


def scan_points(
    frame: Frame, sensor: SensorConfig, *, max_range: float, max_points: int
) -> tuple[Float64Array, UInt8Array]:
    """Return the measured points (P, 3) float64 of a scan in the sensor's frame [m], and their class ids (P,) uint8.

    Points are left out where the sensor model ignores them, beyond ``max_range`` [m] or the sensor's own, and inside
    robots' bodies. About
    ``max_points`` of the scan's points are used, evenly spread. A scan without labels has class 1 everywhere; 0 is a
    point without a usable label.
    """
    if isinstance(frame, CloudFrame):
        stride = max(1, math.ceil(len(frame.points) / max_points))
        points = frame.points[::stride].astype(np.float64)
        class_ids = None if frame.class_ids is None else frame.class_ids[::stride]
    else:
        stride = max(1, math.ceil(math.sqrt(frame.depth_image.size / max_points)))
        points = _image_points(frame, sensor, stride)
        class_ids = None if frame.class_image is None else frame.class_image[::stride, ::stride].ravel()
    if class_ids is None:
        class_ids = np.ones(len(points), np.uint8)
    distance = np.linalg.norm(points, axis=1)
    with np.errstate(invalid="ignore"):
        used = (distance >= max(range_of(frame, sensor)[0], 1e-6)) & (distance <= max_range)
        if frame.max_range is not None:
            used &= distance <= frame.max_range
    used &= ~_in_bodies(frame, points)
    return points[used], class_ids[used]


def _image_points(frame: DepthFrame, sensor: SensorConfig, stride: int) -> Float64Array:
    """Points (P, 3) of every ``stride``-th pixel of a depth image; NaN where the pixel has no measurement."""
    raw = frame.depth_image[::stride, ::stride]
    depth = raw * float(frame.depth_unit)
    special = np.asarray(sensor.invalid_depth + sensor.no_return_depth, np.float64)
    if raw.dtype.kind in "ui":
        special = np.append(special, float(np.iinfo(raw.dtype).max))
    else:
        special = special.astype(raw.dtype)
    depth[~(depth > 0) | ~np.isfinite(depth) | np.isin(raw, special)] = np.nan
    camera = frame.camera
    if camera.slopes is not None:
        x, y = camera.slopes[:, ::stride, ::stride]
    else:
        rows, columns = np.indices(raw.shape) * stride
        x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.stack([x * depth, y * depth, depth], axis=-1).reshape(-1, 3).astype(np.float64)


def _in_bodies(frame: Frame, points: Float64Array) -> BoolArray:
    """True (P,) for points inside a robot's body."""
    inside = np.zeros(len(points), np.bool_)
    for box in frame.boxes:
        T_box_sensor = box.T_box_team @ frame.T_team_sensor
        in_box = points @ T_box_sensor[:3, :3].T + T_box_sensor[:3, 3]
        inside |= ((in_box >= box.low) & (in_box <= box.high)).all(axis=1)
    return inside
