"""Point cloud files: PCD, PLY and KITTI's ``.bin`` with ``.label``."""

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
"""Format of each file suffix."""

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_KITTI_COLUMNS = ("x", "y", "z", "intensity")
_REMEDY = "fetch it again or remove it from the folder"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (P, 3) of a file, float32 or float64 metres, including rows that are not finite.

    ``labels`` is (P,) uint32 raw labels, 65535 where invalid; ``rgb`` (P,) uint32 0x00RRGGBB; ``intensity`` (P,)
    float32; each None where the file has none. ``num_extra_columns`` columns have no name and were not read.
    """

    points: npt.NDArray[Any]
    labels: npt.NDArray[np.uint32] | None = None
    rgb: npt.NDArray[np.uint32] | None = None
    intensity: npt.NDArray[np.float32] | None = None
    num_extra_columns: int = 0


def read_cloud(path: Path) -> Cloud:
    """Return the cloud of a file; the suffix gives the format.

    Raises InputError where the file is damaged, cut or has no fields x, y and z.
    """
    suffix = path.suffix.lower()
    if suffix == ".pcd":
        columns, num_extra_columns = read_pcd(path)
    else:
        columns, num_extra_columns = (_read_ply(path) if suffix == ".ply" else _read_kitti(path)), 0
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise InputError(
            f"{path}: has no field '{missing[0]}' with one number per point; its fields are {', '.join(columns)}"
        )
    kind = np.result_type(np.float32, *(columns[name].dtype for name in "xyz" if columns[name].dtype.kind == "f"))
    label_field = next((name for name in LABEL_FIELDS if name in columns), None)
    # Damaged numbers may be NaN or too large for the type; numpy must not warn of them.
    with np.errstate(over="ignore", invalid="ignore"):
        return Cloud(
            np.stack([columns[name] for name in "xyz"], axis=1).astype(kind),
            None if label_field is None else raw_labels(columns[label_field]),
            _rgb(columns),
            columns["intensity"].astype(np.float32) if "intensity" in columns else None,
            num_extra_columns,
        )


def read_kitti_labels(path: Path, num_points: int) -> npt.NDArray[np.uint32]:
    """Return the labels (P,) of a KITTI ``.label`` file: the low 16 bits of each number, without the instance bits.

    Raises InputError where the file does not hold ``num_points`` labels.
    """
    data = read_bytes(path)
    if len(data) != 4 * num_points:
        raise InputError(
            f"{path}: holds {len(data) / 4:g} labels of 4 bytes, but its cloud has {num_points} points; it is cut, or "
            "belongs to another cloud"
        )
    return np.frombuffer(data, "<u4") & np.uint32(0xFFFF)


def _read_ply(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Properties of the element 'vertex', in native byte order."""
    ply = read_ply(path, _REMEDY)
    points = ply["vertex"]
    return {
        name: np.array(points[name], points[name].dtype.newbyteorder("="))
        for name in points.dtype.names or ()
        if points[name].dtype.kind in "iuf"
    }


def _read_kitti(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Columns x, y, z and intensity of a KITTI file."""
    data = read_bytes(path)
    if path.name.lower().endswith(".pcd.bin") or len(data) % 16:
        raise InputError(
            f"{path}: {len(data)} bytes are not KITTI's points of 16 bytes (x y z intensity as float32); it is cut, or "
            "has another layout such as that of nuScenes: convert it to PCD or PLY"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    return {name: points[:, k] for k, name in enumerate(_KITTI_COLUMNS)}


def read_bytes(path: Path) -> bytes:
    """Return the content of a file. Raises InputError where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _rgb(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.uint32] | None:
    """Colours 0x00RRGGBB from the bits of PCL's field rgb or rgba, or from three uint8 fields; None without colours."""
    for name in ("rgb", "rgba"):
        if name in columns and columns[name].dtype.itemsize == 4:
            return np.ascontiguousarray(columns[name]).view(np.uint32) & np.uint32(0xFFFFFF)
    for names in _COLORS:
        if all(name in columns and columns[name].dtype == np.uint8 for name in names):
            red, green, blue = (columns[name].astype(np.uint32) for name in names)
            return np.asarray((red << 16) | (green << 8) | blue, np.uint32)
    return None
