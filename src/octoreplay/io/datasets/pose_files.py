"""Pose files: one 4x4 matrix per file, and tables of TUM and KITTI.

``T_map_sensor`` is (4, 4) float64 and maps sensor coordinates to map coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.robots.trajectories import Trajectory, read_rows, rigid, trajectory
from octoreplay.io.text_files import write_whole
from octoreplay.io.text_tables import floats, read_matrix, rows
from octoreplay.records import Float64Array
from octoreplay.transforms import inverse, numbers_of

POSE_GAP_NS = 200_000_000
"""Largest time between two poses that are interpolated."""

_SAME_TIME_NS = 1_000_000

PoseReader: TypeAlias = Callable[[], Float64Array | None]
"""Function that reads T_map_sensor of one frame; None without a usable one."""


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Rows of a pose file: T_map_sensor, None where a row is not finite; stamps [ns] in a TUM file only.

    ``name`` is the format.
    """

    name: str
    poses: list[Float64Array | None]
    track: Trajectory | None = None
    stamps: list[int] | None = None

    def at(self, stamp_ns: int) -> Float64Array | None:
        """Return T_map_sensor of a TUM file at a time: a row at most 1 ms away, else interpolated; None without any.

        The tolerance covers the rounding of times in rows and file names.
        """
        if self.track is None:
            return None
        stamps = self.track.stamps_ns
        index = int(np.searchsorted(stamps, stamp_ns))
        near = min(stamps[max(index - 1, 0) : index + 1].tolist(), key=lambda s: abs(s - stamp_ns), default=stamp_ns)
        return self.track.matrix_at(near if abs(near - stamp_ns) <= _SAME_TIME_NS else stamp_ns, POSE_GAP_NS)


def matrix_reader(path: Path) -> PoseReader:
    """Return a reader of a file with one 4x4 matrix; it gives None where the file is missing or not finite.

    The reader raises InputError for another number of numbers and for a matrix that is not a rigid transform.
    """

    def read() -> Float64Array | None:
        T = read_matrix(path, (4,)) if path.is_file() else None
        return rigid(str(path), T) if T is not None and np.isfinite(T).all() else None

    return read


def read_poses(path: Path) -> PoseTable:
    """Return the poses of a TUM file (stamp, position, quaternion x y z w) or a KITTI file (3x4 part of a matrix).

    KITTI's poses are those of the left camera; with ``calib.txt`` beside the file they become the lidar's,
    inv(Tr) T_map_camera Tr, in a map that starts at the lidar (https://github.com/PRBonn/semantic-kitti-api).
    Raises InputError where the file is empty, has another number of columns or a matrix that is not a rigid transform.
    """
    found = read_rows(path)
    if found.stamps_ns is not None:
        return PoseTable("TUM", found.matrices(), trajectory(found.stamps_ns, found), found.stamps_ns.tolist())
    calibration = path.with_name("calib.txt")
    if not calibration.is_file():
        return PoseTable("KITTI", found.matrices())
    T_camera_lidar = _read_calibration(calibration)
    T_lidar_camera = inverse(T_camera_lidar)
    return PoseTable(
        "KITTI, camera to lidar by calib.txt",
        [None if T is None else T_lidar_camera @ T @ T_camera_lidar for T in found.matrices()],
    )


def read_tum_track(path: Path) -> Trajectory:
    """Return the trajectory of a TUM file. Raises InputError for another format."""
    found = read_rows(path)
    if found.stamps_ns is None:
        raise InputError(f"{path}: expects rows of a time, a position and a quaternion (TUM)")
    return trajectory(found.stamps_ns, found)


def write_tum(path: Path, stamps_ns: npt.ArrayLike, poses: Float64Array) -> None:
    """Write a trajectory as a TUM file: poses (T, 4, 4) float64 and their stamps (T,) int64 [ns].

    ``read_tum_track`` returns the same stamps and positions; rotations become unit quaternions. Raises OutputError if
    the file cannot be written.
    """
    lines = ["# time x y z qx qy qz qw\n"]
    for stamp_ns, T in zip(np.asarray(stamps_ns, dtype=np.int64).tolist(), poses, strict=True):
        lines.append(f"{Decimal(stamp_ns).scaleb(-9):f} {' '.join(map(repr, numbers_of(T)))}\n")
    write_whole(path, "".join(lines))


def track_reader(track: Trajectory, stamp_ns: int) -> PoseReader:
    """Return a reader of the interpolated pose at a stamp; it gives None where the track has none there."""
    return lambda: track.matrix_at(stamp_ns, POSE_GAP_NS)


def _read_calibration(path: Path) -> Float64Array:
    """T_camera_lidar of a KITTI calib.txt: its row 'Tr:'."""
    for where, fields in rows(path):
        if fields[0] == "Tr:" and len(fields) == 13:
            T = np.eye(4)
            T[:3] = np.array(floats(where, fields[1:])).reshape(3, 4)
            if np.isfinite(T).all():
                return rigid(where, T)
    raise InputError(
        f"{path}: has no usable row 'Tr:' (lidar to camera); correct it, or remove the file for lidar poses"
    )
