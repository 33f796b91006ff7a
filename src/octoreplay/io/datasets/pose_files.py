"""Pose files: one 4x4 matrix per file, and tables.

``T_map_sensor`` is (4, 4) float64 and maps sensor coordinates to map coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError, escaped
from octoreplay.io.output_file import write_whole
from octoreplay.io.robots.trajectories import Trajectory, read_rows, rigid, trajectory
from octoreplay.io.text_tables import floats, read_matrix, rows, seconds_to_ns
from octoreplay.records import Float64Array
from octoreplay.transforms import inverse, normalise, numbers_of, pose_matrix

POSE_GAP_NS = 200_000_000
"""Largest time between two poses that are interpolated."""

_SAME_TIME_NS = 1_000_000

PoseReader: TypeAlias = Callable[[], Float64Array | None]
"""Function that reads T_map_sensor of one frame; None without a usable one."""


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Rows of a pose file: T_map_sensor, None where a row is not finite; stamps [ns] in a file with times only.

    ``name`` is the kind of file.
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


def fixed_reader(T_map_sensor: Float64Array | None) -> PoseReader:
    """Return a reader of a known pose."""
    return lambda: T_map_sensor


def read_pose_graph(path: Path) -> dict[int, Float64Array]:
    """Return the poses T_map_vertex of a g2o file by the number of their vertex.

    Vertices are rows 'VERTEX_SE3:QUAT id x y z qx qy qz qw'; all other rows are skipped
    (https://github.com/RainerKuemmerle/g2o/wiki/File-Format-SLAM-3D). Raises InputError for a file without vertices
    and for a vertex without these numbers.
    """
    vertices = {}
    for where, fields in rows(path):
        if fields[0] != "VERTEX_SE3:QUAT":
            continue
        # Ids may be keys of gtsam above 2^53, which are not exact as floats.
        numbers = floats(where, fields[2:])
        rotation = normalise(numbers[3:]) if len(numbers) == 7 and np.isfinite(numbers).all() else None
        if rotation is None or not (fields[1].isascii() and fields[1].isdigit() and len(fields[1]) <= 20):
            raise InputError(f"{where}: expects an id, a position and a quaternion x y z w")
        vertices[int(fields[1])] = pose_matrix(numbers[:3], rotation)
    if not vertices:
        raise InputError(f"{path}: holds no row VERTEX_SE3:QUAT")
    return vertices


def read_keyframe(path: Path) -> tuple[int, Float64Array | None]:
    """Return stamp [ns] and pose T_map_sensor of a keyframe of hdl_graph_slam, from its file ``data``.

    The file has a row 'stamp SECONDS NANOSECONDS' and, after a row 'estimate', four rows of a matrix
    (https://github.com/koide3/hdl_graph_slam, src/hdl_graph_slam/keyframe.cpp). Raises InputError without them.
    """
    lines = list(rows(path))
    words = {fields[0]: number for number, (_, fields) in reversed(list(enumerate(lines)))}
    if not {"stamp", "estimate"} <= words.keys():
        raise InputError(f"{path}: expects the rows 'stamp' and 'estimate' of a keyframe of hdl_graph_slam")
    where, stamp = lines[words["stamp"]]
    matrix = [floats(*line) for line in lines[words["estimate"] + 1 :][:4]]
    if len(stamp) != 3 or not (stamp[2].isascii() and stamp[2].isdigit()) or [len(row) for row in matrix] != [4] * 4:
        raise InputError(f"{where}: expects 'stamp SECONDS NANOSECONDS', and four rows of 4 numbers after 'estimate'")
    stamp_ns = seconds_to_ns(where, stamp[1]) + int(stamp[2][:9])
    T = np.array(matrix)
    return stamp_ns, rigid(f"{path}, estimate", T) if np.isfinite(T).all() else None


def read_poses(path: Path, pose_format: str | None = None, origin: Sequence[float] | None = None) -> PoseTable:
    """Return the poses of a trajectory file (``trajectories.read_rows``).

    KITTI's poses are those of the left camera; with ``calib.txt`` beside the file they become the lidar's,
    inv(Tr) T_map_camera Tr, in a map that starts at the lidar (https://github.com/PRBonn/semantic-kitti-api).
    Raises InputError as ``read_rows`` does.
    """
    found = read_rows(path, pose_format, origin)
    if found.stamps_ns is not None:
        return PoseTable(found.name, found.matrices(), trajectory(found.stamps_ns, found), found.stamps_ns.tolist())
    calibration = path.with_name("calib.txt")
    if not calibration.is_file() or pose_format not in (None, "kitti"):
        return PoseTable(found.name, found.matrices())
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


def write_tum(path: Path, stamps_ns: npt.ArrayLike, poses: Float64Array, *, comments: Sequence[str] = ()) -> None:
    """Write a trajectory as a TUM file: poses (T, 4, 4) float64 and their stamps (T,) int64 [ns].

    ``read_tum_track`` returns the same stamps and positions; rotations become unit quaternions. ``comments`` are lines
    at the beginning. Raises OutputError if the file cannot be written.
    """
    lines = [f"# {escaped(comment)}\n" for comment in comments]
    lines += ["# time x y z qx qy qz qw\n"]
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
