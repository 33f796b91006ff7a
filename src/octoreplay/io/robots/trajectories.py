"""Trajectories, and trajectory files in evo's formats (TUM, KITTI).

Formats: https://github.com/MichaelGrupp/evo/wiki/Formats
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay.errors import InputError
from octoreplay.io.text_tables import floats, rows, seconds_to_ns
from octoreplay.records import Float64Array, Int64Array
from octoreplay.transforms import Pose, interpolate, normalise, pose_matrix, rotation_to_quaternion


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

    Rows that are not finite (lost tracking) or have a zero quaternion are NaN.
    """

    stamps_ns: Int64Array | None
    positions: Float64Array
    rotations: Float64Array

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


def read_rows(path: Path) -> TrajectoryRows:
    """Return the poses of a trajectory file: TUM (time x y z qx qy qz qw) or KITTI (3x4 matrix by rows, 12 numbers).

    Blanks or commas separate the numbers; # begins a comment. Raises InputError with the line where the file is empty,
    a row has another number of columns, or a matrix is not a rigid transform.
    """
    table = list(rows(path))
    if not table:
        raise InputError(f"{path}: holds no poses")
    width = len(table[0][1])
    odd = next(((where, len(fields)) for where, fields in table if len(fields) != width or width not in (8, 12)), None)
    if odd is not None:
        raise InputError(
            f"{odd[0]}: expects 8 numbers in every row (TUM: time x y z qx qy qz qw), or 12 (KITTI: the rows of a 3x4 "
            f"matrix), got {odd[1]}"
        )
    if width == 12:
        poses = [_pose_of_matrix(where, floats(where, fields)) for where, fields in table]
        return TrajectoryRows(None, *_arrays(poses))
    stamps = np.array([seconds_to_ns(where, fields[0]) for where, fields in table], dtype=np.int64)
    return TrajectoryRows(stamps, *_arrays([_pose(floats(where, fields[1:])) for where, fields in table]))


def read_times(path: Path) -> Int64Array:
    """Return the times [ns] of a text file with one time in seconds per line. Raises InputError with the line."""
    return np.array([seconds_to_ns(where, fields[0]) for where, fields in rows(path)], dtype=np.int64)


def rigid(where: str, T: Float64Array) -> Float64Array:
    """Return a (4, 4) matrix unchanged. Raises InputError where it is not a rigid transform."""
    rotation = T[:3, :3]
    # Files round their numbers, so rotations are not exactly orthogonal.
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=0.02) or np.linalg.det(rotation) < 0:
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
