"""Covariance of the frames of a team, accumulated along the chains of pairs.

The error of a pose T is a small motion d = (rotation [rad], translation [m]) on its left, T = exp(d) T^, about the
origin of the frame that T maps to (Barfoot and Furgale, IEEE Transactions on Robotics, 2014). For a chain
T_a_c = T_a_b T_b_c of independent errors

    S_a_c = S_a_b + Ad(T_a_b) S_b_c Ad(T_a_b)^T,    Ad(T) = [[R, 0], [[t]x R, R]],

and for an inverse S_b_a = Ad(T_b_a) S_a_b Ad(T_b_a)^T. Loops of pairs are not used, so the values are upper limits for
robots that several pairs join.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.team import TeamAlignment

# Information [1/rad^2, 1/m^2] that every pose is given: a direction that no surface fixes has a deviation of 1 km.
_LEAST_INFORMATION = 1e-6


def frame_covariances(alignment: TeamAlignment, root: int) -> dict[int, tuple[int | None, Float64Array]]:
    """Return the neighbour towards ``root`` and the covariance (6, 6) of every robot in the component of ``root``.

    The covariance is that of the robot's map frame in the frame of ``root``: rotation [rad] about the axes of that
    frame, then position of the map frame's origin [m]. That of ``root`` is zero, and its neighbour None.
    """
    neighbours: dict[int, list[int]] = {}
    for index, parent in enumerate(alignment.parents):
        if parent is not None:
            neighbours.setdefault(index, []).append(parent)
            neighbours.setdefault(parent, []).append(index)
    pairs = {(pair.first, pair.second): pair for pair in alignment.pairs}
    poses = _poses_from(alignment.T_component_map, root)
    # Errors about the origin of the root's frame, which chain with the formulas above.
    found: dict[int, tuple[int | None, Float64Array]] = {root: (None, np.zeros((6, 6)))}
    queue = [root]
    for index in queue:
        for other in neighbours.get(index, ()):
            if other not in found:
                across = _covariance(pairs[min(index, other), max(index, other)], to=index)
                turn = adjoint(poses[index])
                found[other] = index, found[index][1] + turn @ across @ turn.T
                queue.append(other)
    return {index: (parent, about_point(value, poses[index][:3, 3])) for index, (parent, value) in found.items()}


def adjoint(T: Float64Array) -> Float64Array:
    """Return Ad(T) (6, 6) of a transform (4, 4), for motions (rotation, translation)."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[3:, :3] = _cross(T[:3, 3]) @ T[:3, :3]
    return result


def _covariance(pair: PairAlignment, *, to: int) -> Float64Array:
    """Covariance of a pair's pose, which maps to the frame of the robot ``to``."""
    covariance: Float64Array = np.linalg.inv(pair.information + _LEAST_INFORMATION * np.eye(6))
    if to == pair.first:
        return covariance
    turn = np.linalg.inv(adjoint(pair.T_first_second))
    return turn @ covariance @ turn.T


def about_point(covariance: Float64Array, arm: Float64Array) -> Float64Array:
    """Return the covariance (6, 6) of a motion with the translation of a point at ``arm`` (3,) [m] from the origin."""
    shift = np.eye(6)
    shift[3:, :3] = -_cross(arm)
    result: Float64Array = shift @ covariance @ shift.T
    return result


def _poses_from(T_component_map: Sequence[Float64Array], root: int) -> list[Float64Array]:
    """Poses in the frame of ``root``."""
    back = np.linalg.inv(T_component_map[root])
    return [back @ T for T in T_component_map]


def _cross(v: Float64Array) -> Float64Array:
    """Matrix [v]x of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
