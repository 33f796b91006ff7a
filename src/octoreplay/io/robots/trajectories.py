"""Trajectories and trajectory files; ``trajectory_columns`` describes the formats."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.config.file_url import InputFile
from octoreplay.errors import InputError
from octoreplay.geodesy import enu_points
from octoreplay.io.robots.trajectory_columns import (
    MATRIX_FORMATS,
    columns_of,
    matrices_of,
    read_table,
    time_to_ns,
)
from octoreplay.io.text_tables import floats, rows
from octoreplay.records import Float64Array, Int64Array
from octoreplay.transforms import Pose, interpolate, normalise, pose_matrix, rotation_to_quaternion

LARGEST_POSITION = 100_000.0
"""Largest coordinate of a trajectory [m]. Projected coordinates (UTM) are larger, and no map covers as much."""

_MOVING, _NO_TURN = 1.0, 1e-9


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses T_map_body: ``positions`` (N, 3) in metres, ``rotations`` (N, 4) as (x, y, z, w), stamps (N,) ascending."""

    stamps_ns: Int64Array
    positions: Float64Array
    rotations: Float64Array

    def matrix_at(self, stamp_ns: int, pose_gap_ns: int) -> Float64Array | None:
        """Pose (4, 4) at a stamp, interpolated between two that are at most ``pose_gap_ns`` apart; else None."""
        index = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if index < self.stamps_ns.size and self.stamps_ns[index] == stamp_ns:
            return pose_matrix(self.positions[index], self.rotations[index])
        if index in (0, self.stamps_ns.size):
            return None
        before_ns, after_ns = int(self.stamps_ns[index - 1]), int(self.stamps_ns[index])
        if after_ns - before_ns > pose_gap_ns:
            return None
        (px, py, pz), (rx, ry, rz) = self.positions[index - 1 : index + 1].tolist()
        first, second = self.rotations[index - 1 : index + 1].tolist()
        pose = interpolate(
            ((px, py, pz), tuple(first)), ((rx, ry, rz), tuple(second)), (stamp_ns - before_ns) / (after_ns - before_ns)
        )
        return pose_matrix(*pose)


@dataclass(frozen=True, eq=False)
class TrajectoryRows:
    """Rows of a trajectory file: poses as in Trajectory, ``stamps_ns`` None where the format has no times.

    Rows that are not finite (lost tracking) or have a zero quaternion are NaN. ``name`` is the format.
    """

    stamps_ns: Int64Array | None
    positions: Float64Array
    rotations: Float64Array
    name: str = ""

    def __len__(self) -> int:
        return len(self.positions)

    def matrices(self) -> list[Float64Array | None]:
        """T_map_body of each row, (4, 4); None for a row that is NaN."""
        poses = zip(self.positions.tolist(), self.rotations.tolist(), strict=True)
        return [None if np.isnan(rotation[0]) else pose_matrix(position, rotation) for position, rotation in poses]


def trajectory(stamps_ns: Int64Array, poses: TrajectoryRows) -> Trajectory:
    """Return the trajectory of poses and stamps, sorted, without NaN; of rows with the same stamp the last is kept."""
    last_first = np.flatnonzero(~np.isnan(poses.rotations[:, 0]))[::-1]
    stamps, places = np.unique(stamps_ns[last_first], return_index=True)
    used = last_first[places]
    return Trajectory(stamps, poses.positions[used], poses.rotations[used])


def read_rows(path: InputFile, pose_format: str | None = None, origin: Sequence[float] | None = None) -> TrajectoryRows:
    """Return the poses of a trajectory file.

    Formats (``POSE_FORMATS``; found by the header and the number of columns where None is given): TUM, EuRoC, KITTI,
    4x4 matrices by rows or stacked, Redwood's logs, latitude and longitude, TartanAir (in NED axes, which become x
    forward, y left, z up). ``origin`` is subtracted from the positions [m]; for latitude, longitude and height it is
    the point whose east, north and up axes the positions are given in.

    Blanks or commas separate the numbers; # begins a comment. Raises InputError with the line where the file is empty,
    a row has another number of columns, a matrix is not a rigid transform, or the layout is not certain; without
    ``pose_format`` also for a moving track with identity rotations, and for positions above LARGEST_POSITION.
    """
    found, is_geodetic = _read(path, pose_format)
    if pose_format is None and found.stamps_ns is not None:
        _check_turning(path, found)
    return _in_axes(path, found, origin) if is_geodetic else _near_origin(path, found, origin)


def proposed_origin(path: InputFile, pose_format: str | None = None) -> tuple[float, float, float]:
    """Return an origin for the coordinates of a trajectory file: whole kilometres at its begin, and a whole height [m].

    Raises InputError as ``read_rows`` does, and for a file without a usable pose.
    """
    positions = _read(path, pose_format)[0].positions
    used = positions[np.isfinite(positions).all(axis=1)]
    if not len(used):
        raise InputError(f"{path}: holds no usable pose")
    x, y, z = used[0].tolist()
    return round(x, -3), round(y, -3), float(round(z))


def _read(path: InputFile, pose_format: str | None) -> tuple[TrajectoryRows, bool]:
    """The poses of a file in its own coordinates; True where these are latitudes and longitudes."""
    table, names = read_table(path)
    matrices = None if names else matrices_of(path, table, pose_format)
    if matrices is not None:
        poses = [_pose_of_matrix(where, numbers) for where, numbers in matrices[1]]
        return TrajectoryRows(None, *_arrays(poses), matrices[0]), False
    if pose_format in MATRIX_FORMATS:
        raise InputError(f"{table[0][0]}: is not the begin of a matrix, which pose_format {pose_format} expects")
    columns = columns_of(path, table, names, pose_format)
    time = columns.time
    stamps = None if time is None else np.array([time_to_ns(w, words[time]) for w, words in table], dtype=np.int64)
    chosen = (*columns.position, *columns.quaternion)
    positions, rotations = _arrays([_pose(floats(where, [words[k] for k in chosen])) for where, words in table])
    if pose_format == "tartanair":
        positions, rotations = positions * (1.0, -1.0, -1.0), rotations * (1.0, -1.0, -1.0, 1.0)
    return TrajectoryRows(stamps, positions, rotations, columns.name), columns.is_geodetic


def _check_turning(path: InputFile, found: TrajectoryRows) -> None:
    """Raise InputError for a track that moves with identity rotations, which positions without rotations have."""
    used = ~np.isnan(found.rotations[:, 0])
    way = np.ptp(found.positions[used], axis=0).max() if used.any() else 0.0
    if way > _MOVING and (np.abs(found.rotations[used, :3]) < _NO_TURN).all():
        raise InputError(
            f"{path}: the rotation of all {np.count_nonzero(used):,} poses is the identity along {way:.1f} m, as in "
            "files with positions only; give a trajectory with rotations, or name pose_format if they are true"
        )


def _near_origin(path: InputFile, found: TrajectoryRows, origin: Sequence[float] | None) -> TrajectoryRows:
    """The rows with positions relative to an origin. Raises InputError for coordinates such as UTM without one."""
    positions = found.positions if origin is None else found.positions - np.asarray(origin)
    largest = np.abs(positions[np.isfinite(positions)]).max(initial=0.0)
    if largest > LARGEST_POSITION:
        first = positions[np.isfinite(positions).all(axis=1)][0] if origin is None else np.asarray(origin)
        raise InputError(
            f"{path}: its positions reach {largest:,.0f} m, such as UTM coordinates, too large for a map; give "
            f"pose_origin: {_origin_text(first, -3)}, the same for every robot of the team"
        )
    return dataclasses.replace(found, positions=positions)


def _in_axes(path: InputFile, found: TrajectoryRows, origin: Sequence[float] | None) -> TrajectoryRows:
    """The rows with positions east, north and up of an origin instead of latitude, longitude and height."""
    used = np.isfinite(found.positions).all(axis=1)
    if not used.any() or (np.abs(found.positions[used][:, :2]) > (90.0, 360.0)).any():
        raise InputError(f"{path}: its positions are not latitudes and longitudes in degrees")
    if origin is None:
        raise InputError(
            f"{path}: its positions are latitudes and longitudes; give pose_origin: "
            f"{_origin_text(found.positions[used][0], 5)}, the same for every robot of the team"
        )
    return dataclasses.replace(found, positions=enu_points(found.positions, np.asarray(origin)))


def _origin_text(position: Float64Array, digits: int) -> str:
    """A rounded origin as it is written in a team file."""
    x, y, z = position.tolist()
    return f"[{round(x, digits):.{max(digits, 0)}f}, {round(y, digits):.{max(digits, 0)}f}, {round(z):d}]"


def read_times(path: InputFile) -> Int64Array:
    """Return the times [ns] of a text file with one time per line (``time_to_ns``). Raises InputError with the line."""
    return np.array([time_to_ns(where, fields[0]) for where, fields in rows(path)], dtype=np.int64)


def rigid(where: str, T: Float64Array) -> Float64Array:
    """Return a (4, 4) matrix unchanged. Raises InputError where it is not a rigid transform."""
    rotation = T[:3, :3]
    # No element of a rotation is above 1, and products of large numbers overflow. Files round numbers, so rotations
    # are not exactly orthogonal.
    is_rotation = np.abs(rotation).max() < 2.0 and np.allclose(rotation @ rotation.T, np.eye(3), atol=0.02)
    if not is_rotation or np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: its upper left 3x3 part is not a rotation")
    return T


_LOST: Pose = ((float("nan"),) * 3, (float("nan"),) * 4)


def _pose(numbers: list[float]) -> Pose:
    """A pose from position and quaternion."""
    x, y, z = numbers[:3]
    rotation = normalise(numbers[3:])
    return _LOST if rotation is None or not np.isfinite(numbers[:3]).all() else ((x, y, z), rotation)


def _pose_of_matrix(where: str, numbers: list[float]) -> Pose:
    """A pose from the upper 3x4 part of its matrix."""
    if not np.isfinite(numbers).all():
        return _LOST
    T = np.eye(4)
    T[:3] = np.array(numbers).reshape(3, 4)
    x, y, z = rigid(where, T)[:3, 3].tolist()
    return (x, y, z), rotation_to_quaternion(T[:3, :3])


def _arrays(poses: list[Pose]) -> tuple[Float64Array, Float64Array]:
    """Positions (N, 3) and rotations (N, 4)."""
    return np.array([position for position, _ in poses]), np.array([rotation for _, rotation in poses])
