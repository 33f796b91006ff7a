"""Points, raw labels and confidences of point clouds and laser scans."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Cloud, CloudField, Scan
from octoreplay.io.sensors.images import MAX_PIXELS, confidences
from octoreplay.records import BoolArray, Int64Array, UInt8Array

LABEL_FIELDS = (
    "label", "labels", "label_id", "semantic", "semantic_label", "semantic_id", "class", "class_id", "category",
    "semantic_color",
)  # fmt: skip
"""Names of fields with raw labels, in order of preference; colours are palette entries."""

COLOR_FIELDS = ("rgb", "rgba", "semantic_color")
"""Names of fields with packed colours: four bytes blue, green, red, alpha, as an integer or a float (PCL)."""

TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
"""Names of fields with the time of each point: drivers of Ouster, Velodyne, Hesai, RoboSense and Livox."""

CONFIDENCE_FIELDS = ("confidence", "label_confidence", "semantic_confidence", "probability", "prob", "conf")
"""Names of fields with label confidences, in order of preference."""

# Floats from this on are not exact integers, hence no labels.
_LABEL_LIMIT = 1 << 53


@dataclass(frozen=True, eq=False)
class Points:
    """Points (P, 3) float32 or float64 in the sensor's frame [m], with their labels and confidences.

    ``labels`` are raw labels (P,) int64, or colours (P, 3) uint8 red, green, blue; ``confidences`` (P,) uint8 in
    255ths; None where the message has none. ``times`` (P,) are the points' times as the message has them, of any unit
    and origin; None unless they are wanted and present.
    """

    points: npt.NDArray[Any]
    labels: Int64Array | UInt8Array | None = None
    confidences: UInt8Array | None = None
    times: npt.NDArray[Any] | None = None


def label_field(names: Iterable[str], wanted: str | None = None) -> str | None:
    """Return the field of a cloud's labels: the wanted one, else the first of LABEL_FIELDS; None without any."""
    present = set(names)
    return next((name for name in ((wanted,) if wanted else LABEL_FIELDS) if name in present), None)


def decode_cloud(
    cloud: Cloud,
    where: str,
    *,
    wanted_labels: str | None = None,
    wanted_confidences: str | None = None,
    wants_times: bool = False,
) -> Points:
    """Return the points of a cloud in its own frame, with labels and confidences where it has them.

    Points that are not finite, and points at the origin (lidars' 'no return'), are left out. ``where`` begins the
    errors. Raises InputError where x, y, z or a wanted field is missing,
    DamagedMessageError where the message has fewer bytes than its size requires.
    """
    fields = {field.name: field for field in cloud.fields if field.kind and field.count == 1}
    label = label_field(fields, wanted_labels)
    confidence = label_field(fields, wanted_confidences) if wanted_confidences else _first(CONFIDENCE_FIELDS, fields)
    for wanted, found in ((wanted_labels, label), (wanted_confidences, confidence), *((name, name) for name in "xyz")):
        if wanted and found not in fields:
            names = ", ".join(field.name for field in cloud.fields)
            raise InputError(f"{where}: the point cloud has no usable field '{wanted}'; its fields are {names}")
    columns = [_column(cloud, fields[name], where) for name in "xyz"]
    narrow = all(column.dtype.str[1:] == "f4" for column in columns)
    points = np.empty((columns[0].size, 3), dtype=np.float32 if narrow else np.float64)
    with np.errstate(invalid="ignore"):
        for axis, column in enumerate(columns):
            points[:, axis] = column
        usable = np.asarray(np.isfinite(points).all(axis=1) & points.any(axis=1))
    time = _first(TIME_FIELDS, fields) if wants_times else None
    keep: slice | BoolArray = slice(None) if bool(usable.all()) else usable
    return Points(
        points[keep],
        None if label is None else _labels(cloud, fields[label], where, keep),
        None if confidence is None else confidences(_column(cloud, fields[confidence], where)[keep]),
        None if time is None else _column(cloud, fields[time], where)[keep],
    )


def decode_scan(scan: Scan) -> Points:
    """Return the points of a planar scan in its own frame: range x (cos angle, sin angle, 0).

    Source: sensor_msgs/LaserScan. Ranges that are NaN, infinite or out of the limits are left out.
    """
    ranges = scan.ranges
    angles = scan.angle_min + scan.angle_increment * np.arange(ranges.size)
    good = np.isfinite(ranges) & (ranges >= scan.range_min) & (ranges <= scan.range_max) & (ranges > 0.0)
    ranges, angles = ranges[good], angles[good]
    flat = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(ranges.size)], axis=1)
    return Points(flat)


def _first(names: Iterable[str], present: Collection[str]) -> str | None:
    """The first name that is present; None without any."""
    return next((name for name in names if name in present), None)


def _labels(cloud: Cloud, field: CloudField, where: str, keep: slice | BoolArray) -> Int64Array | UInt8Array:
    """Raw labels (P,) int64 of a field, or its colours (P, 3) uint8."""
    if field.name not in COLOR_FIELDS:
        raw = _column(cloud, field, where)[keep]
        if raw.dtype.kind != "f":
            return raw.astype(np.int64)
        # NaN and numbers out of range become -1, the value of signed images for no label.
        return np.where(np.abs(raw) < _LABEL_LIMIT, raw, -1).astype(np.int64)
    packed = np.ascontiguousarray(_column(cloud, field, where)[keep])
    if packed.dtype.itemsize != 4:
        raise InputError(f"{where}: the field '{field.name}' packs colours and must have four bytes")
    bits = packed.astype(packed.dtype.newbyteorder("=")).view(np.uint32)
    return np.stack([(bits >> shift & 0xFF).astype(np.uint8) for shift in (16, 8, 0)], axis=1)


def _column(cloud: Cloud, field: CloudField, where: str) -> npt.NDArray[Any]:
    """One field of all points, (P,), row by row. Raises DamagedMessageError where the sizes do not fit."""
    dtype = np.dtype((">" if cloud.is_big_endian else "<") + field.kind)
    height, width = cloud.height, cloud.width
    row_step = cloud.row_step or width * cloud.point_step
    needed = (height - 1) * row_step + width * cloud.point_step if height * width else 0
    fits = field.offset >= 0 and field.offset + dtype.itemsize <= cloud.point_step
    # With overlapping rows a few bytes could hold any number of points.
    fits = fits and (height < 2 or row_step >= width * cloud.point_step)
    if min(height, width) < 0 or len(cloud.data) < needed or (height * width and not fits):
        raise DamagedMessageError(
            f"{where}: the cloud holds {len(cloud.data)} bytes, but {height} rows of {width} points of "
            f"{cloud.point_step} bytes are expected"
        )
    if height * width > MAX_PIXELS:
        raise InputError(f"{where}: a cloud of {height * width} points is too large; {MAX_PIXELS} can be read")
    if not needed:
        return np.empty(0, dtype)
    strides = (row_step, cloud.point_step)
    return np.ndarray((height, width), dtype, cloud.data, field.offset, strides).reshape(-1)
