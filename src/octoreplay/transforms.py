"""Rigid transforms: positions [m], unit quaternions (x, y, z, w), matrices (4, 4) float64.

``T_a_b`` maps coordinates of frame b to frame a.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from octoreplay.records import Float64Array

Position: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
Pose: TypeAlias = tuple[Position, Quaternion]

# For closer rotations sin(angle) loses digits, and linear interpolation of the quaternions is as accurate.
_NEARLY_PARALLEL = 1.0 - 1e-9


def normalise(quaternion: Sequence[float]) -> Quaternion | None:
    """Return the unit quaternion (x, y, z, w) of the same direction; None where the length is 0 or not finite."""
    x, y, z, w = (float(value) for value in quaternion)
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(length) or length < 1e-6:
        return None
    return x / length, y / length, z / length, w / length


def slerp(first: Quaternion, second: Quaternion, fraction: float) -> Quaternion:
    """Return the rotation at a ``fraction`` in [0, 1] of the shorter arc between two rotations (Shoemake 1985)."""
    cosine = sum(a * b for a, b in zip(first, second, strict=True))
    sign = 1.0
    if cosine < 0.0:
        cosine, sign = -cosine, -1.0
    if cosine > _NEARLY_PARALLEL:
        from_first, from_second = 1.0 - fraction, fraction
    else:
        angle = math.acos(cosine)
        from_first = math.sin((1.0 - fraction) * angle) / math.sin(angle)
        from_second = math.sin(fraction * angle) / math.sin(angle)
    from_second *= sign
    x, y, z, w = (from_first * a + from_second * b for a, b in zip(first, second, strict=True))
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length


def interpolate(first: Pose, second: Pose, fraction: float) -> Pose:
    """Return the pose at a ``fraction`` in [0, 1] between two: linear in position, slerp in rotation."""
    (p, q), (r, s) = first, second
    x, y, z = (a + fraction * (b - a) for a, b in zip(p, r, strict=True))
    return (x, y, z), slerp(q, s, fraction)


def pose_matrix(position: Sequence[float], quaternion: Sequence[float]) -> Float64Array:
    """Return the transform (4, 4) of a position and a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), position[0]],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), position[1]],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), position[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def inverse(transform: Float64Array) -> Float64Array:
    """Return the inverse of a rigid transform (4, 4)."""
    result = np.eye(4)
    rotation = transform[:3, :3].T
    result[:3, :3] = rotation
    result[:3, 3] = -rotation @ transform[:3, 3]
    return result


def pose_difference(one: Float64Array, other: Float64Array) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two poses (4, 4)."""
    difference = inverse(one) @ other
    cosine = (float(np.trace(difference[:3, :3])) - 1) / 2
    return float(np.linalg.norm(difference[:3, 3])), math.acos(min(1.0, max(-1.0, cosine)))


def transform_of(numbers: Sequence[float]) -> Float64Array:
    """Return the transform (4, 4) of seven numbers x, y, z, qx, qy, qz, qw; the quaternion is normalised.

    Raises ValueError where the quaternion has length 0 or is not finite.
    """
    quaternion = normalise(numbers[3:7])
    if quaternion is None:
        raise ValueError("the quaternion has length 0 or is not finite")
    return pose_matrix(numbers[:3], quaternion)


def numbers_of(transform: Float64Array) -> tuple[float, ...]:
    """Return the seven numbers x, y, z, qx, qy, qz, qw of a rigid transform (4, 4); inverse of ``transform_of``."""
    return (*transform[:3, 3].tolist(), *rotation_to_quaternion(transform[:3, :3]))


def rotation_to_quaternion(rotation: npt.ArrayLike) -> Quaternion:
    """Return the quaternion (x, y, z, w), w >= 0, of a rotation matrix (3, 3).

    It is computed from the largest of the four components, which avoids division by a small number (Shepperd 1978).
    """
    r = np.asarray(rotation, dtype=np.float64)
    squares = np.array([1 + r[0, 0] - r[1, 1] - r[2, 2], 1 - r[0, 0] + r[1, 1] - r[2, 2],
                        1 - r[0, 0] - r[1, 1] + r[2, 2], 1 + r[0, 0] + r[1, 1] + r[2, 2]])  # fmt: skip
    largest = int(np.argmax(squares))
    rows = (
        (squares[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]),
        (r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]),
        (r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]),
        (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]),
    )
    x, y, z, w = (float(value) for value in rows[largest])
    norm = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
    return x / norm, y / norm, z / norm, w / norm
