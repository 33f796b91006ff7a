"""PointCloud2 messages to points and raw labels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import DamagedMessageError

LABEL_FIELDS = ("label", "labels", "semantic", "semantic_label", "semantic_id", "class", "class_id", "category")
"""Fields that are taken as a point's raw label, the first that is there."""

# sensor_msgs/PointField: datatype number to element type.
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def label_field(cloud: Any) -> str | None:
    """The name of the field that holds the labels of a sensor_msgs/PointCloud2, or None."""
    names = {field.name for field in cloud.fields}
    return next((name for name in LABEL_FIELDS if name in names), None)


def decode_cloud(cloud: Any, where: str) -> tuple[npt.NDArray[Any], npt.NDArray[np.int64] | None]:
    """The points (P, 3) of a sensor_msgs/PointCloud2 and their raw labels (P,) int64, None without a label field.

    Points are float32 or float64 as in the message, in the sensor's frame, metres; rows that are not finite are left
    out, and so are points at the sensor itself, which is how lidars write 'no return'. ``where`` begins the errors.
    Raises InputError where x, y or z is missing or of no float type, DamagedMessageError where there are fewer bytes
    than the size says.
    """
    grid = {name: _column(cloud, name, where) for name in ("x", "y", "z")}
    kinds = {column.dtype.str[1:] for column in grid.values()}
    if not kinds <= {"f4", "f8"}:
        raise InputError(f"{where}: the fields x, y and z must be float32 or float64")
    dtype = np.float64 if "f8" in kinds else np.float32
    points = np.empty((cloud.height * cloud.width, 3), dtype=dtype)
    for axis, column in enumerate(grid.values()):
        points[:, axis] = column.reshape(-1)
    usable = np.isfinite(points).all(axis=1) & points.any(axis=1)
    are_all = bool(usable.all())
    name = label_field(cloud)
    labels = None
    if name is not None:
        raw = _column(cloud, name, where).reshape(-1)
        raw = raw if are_all else raw[usable]
        labels = np.nan_to_num(raw, nan=-1.0, posinf=-1.0, neginf=-1.0).astype(np.int64)
    return (points if are_all else points[usable]), labels


def _column(cloud: Any, name: str, where: str) -> npt.NDArray[Any]:
    """One field of all points: a view (height, width)."""
    field = next((f for f in cloud.fields if f.name == name), None)
    if field is None or field.datatype not in _FIELD_TYPES or field.count > 1:
        present = ", ".join(f.name for f in cloud.fields)
        raise InputError(f"{where}: the point cloud has no usable field '{name}'; its fields are {present}")
    dtype = np.dtype((">" if cloud.is_bigendian else "<") + _FIELD_TYPES[field.datatype])
    height, width = int(cloud.height), int(cloud.width)
    row_step = int(cloud.row_step) or width * int(cloud.point_step)
    needed = (height - 1) * row_step + width * int(cloud.point_step) if height * width else 0
    if len(cloud.data) < needed or field.offset + dtype.itemsize > cloud.point_step:
        raise DamagedMessageError(
            f"{where}: the cloud holds {len(cloud.data)} bytes, but {height} rows of {width} points of "
            f"{cloud.point_step} bytes are announced"
        )
    if height * width == 0:
        return np.empty((0, 0), dtype)
    return np.ndarray((height, width), dtype, cloud.data, int(field.offset), (row_step, int(cloud.point_step)))
