"""Files of one point cloud: PCD, PLY and KITTI's ``.bin`` with ``.label``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.datasets.pcd import read_pcd
from octoreplay.io.datasets.ply_files import raw_labels, read_ply
from octoreplay.io.sensors.clouds import LABEL_FIELDS

FORMATS = {".pcd": "PCD", ".ply": "PLY", ".bin": "KITTI"}
"""What files with these endings are."""

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_KITTI_COLUMNS = ("x", "y", "z", "intensity")
_REMEDY = "fetch it again or take it out of the folder"


@dataclass(frozen=True, eq=False)
class Cloud:
    """The P points of a file as they are there: (P, 3) float32 or float64 metres, rows that are not finite too.

    ``labels`` is (P,) uint32 raw labels, 65535 for what is no label; ``rgb`` (P,) uint32 0x00RRGGBB; ``intensity``
    (P,) float32; each None where the file has none. ``num_extra_columns`` of the file have no name and were not read.
    """

    points: npt.NDArray[Any]
    labels: npt.NDArray[np.uint32] | None = None
    rgb: npt.NDArray[np.uint32] | None = None
    intensity: npt.NDArray[np.float32] | None = None
    num_extra_columns: int = 0


def read_cloud(path: Path) -> Cloud:
    """The cloud of a file, which its ending tells the format of.

    Raises InputError where it is damaged, cut or has no fields x, y and z.
    """
    suffix = path.suffix.lower()
    if suffix == ".pcd":
        columns, num_extra_columns = read_pcd(path)
    else:
        columns, num_extra_columns = (_read_ply(path) if suffix == ".ply" else _read_kitti(path)), 0
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise InputError(
            f"{path}: has no field '{missing[0]}' of one number a point; its fields are {', '.join(columns)}"
        )
    kind = np.result_type(np.float32, *(columns[name].dtype for name in "xyz" if columns[name].dtype.kind == "f"))
    label_field = next((name for name in LABEL_FIELDS if name in columns), None)
    # A damaged number may be none at all, or too large for its new type; neither is worth a warning of its own.
    with np.errstate(over="ignore", invalid="ignore"):
        return Cloud(
            np.stack([columns[name] for name in "xyz"], axis=1).astype(kind),
            None if label_field is None else raw_labels(columns[label_field]),
            _rgb(columns),
            columns["intensity"].astype(np.float32) if "intensity" in columns else None,
            num_extra_columns,
        )


def read_kitti_labels(path: Path, num_points: int) -> npt.NDArray[np.uint32]:
    """The labels (P,) of a KITTI ``.label`` file: the low 16 bits of each number; the high ones name the instance.

    Raises InputError where it is not as long as its cloud of ``num_points``.
    """
    data = _read_bytes(path)
    if len(data) != 4 * num_points:
        raise InputError(
            f"{path}: holds {len(data) / 4:g} labels of 4 bytes, but its cloud has {num_points} points; it is cut, or "
            "of another cloud"
        )
    return np.frombuffer(data, "<u4") & np.uint32(0xFFFF)


def _read_ply(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The properties of the element 'vertex', in the machine's byte order."""
    ply = read_ply(path, _REMEDY)
    points = ply["vertex"].data
    return {
        name: np.array(points[name], points[name].dtype.newbyteorder("="))
        for name in points.dtype.names or ()
        if points[name].dtype.kind in "iuf"
    }


def _read_kitti(path: Path) -> dict[str, npt.NDArray[Any]]:
    """x, y, z and intensity of KITTI's Velodyne."""
    data = _read_bytes(path)
    if path.name.lower().endswith(".pcd.bin") or len(data) % 16:
        raise InputError(
            f"{path}: {len(data)} bytes are not KITTI's points of 16 bytes (x y z intensity as float32); it is cut, or "
            "of another layout such as that of nuScenes: write it as PCD or PLY"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    return {name: points[:, k] for k, name in enumerate(_KITTI_COLUMNS)}


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _rgb(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.uint32] | None:
    """Colours packed as 0x00RRGGBB: of PCL's field rgb or rgba, whose bits they are, or of three fields of a byte."""
    for name in ("rgb", "rgba"):
        if name in columns and columns[name].dtype.itemsize == 4:
            return np.ascontiguousarray(columns[name]).view(np.uint32) & np.uint32(0xFFFFFF)
    for names in _COLORS:
        if all(name in columns and columns[name].dtype == np.uint8 for name in names):
            red, green, blue = (columns[name].astype(np.uint32) for name in names)
            return np.asarray((red << 16) | (green << 8) | blue, np.uint32)
    return None
