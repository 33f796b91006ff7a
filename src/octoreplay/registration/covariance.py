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
from dataclasses import dataclass, replace

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.rigid import cross_matrix
from octoreplay.registration.team import TeamAlignment
from octoreplay.transforms import inverse

# Information [1/rad^2, 1/m^2] that every pose is given: a direction that no surface fixes has a deviation of 1 km.
_LEAST_INFORMATION = 1e-6


@dataclass(frozen=True, eq=False)
class ChainedFrame:
    """Frame of one robot at the end of a chain of pairs.

    - ``root``: robot at the other end, ``partner``: its neighbour in the chain; None for the root itself.
    - ``T_root_map`` (4, 4) float64: pose of the robot's map.
    - ``covariance`` (6, 6) float64: rotation about the axes of the root's map [rad], position [m].
    """

    root: int
    partner: int | None
    T_root_map: Float64Array
    covariance: Float64Array


def chained_frames(alignment: TeamAlignment, roots: Sequence[int]) -> dict[int, ChainedFrame]:
    """Return the frame of every robot in the component of ``roots``, each along the shortest chain from a root."""
    neighbours: dict[int, list[int]] = {}
    for index, parent in enumerate(alignment.parents):
        if parent is not None:
            neighbours.setdefault(index, []).append(parent)
            neighbours.setdefault(parent, []).append(index)
    pairs = {(pair.first, pair.second): pair for pair in alignment.pairs}
    T = alignment.T_component_map
    # Covariances about the origin of the root's map, which chain with the formulas above.
    found = {root: ChainedFrame(root, None, np.eye(4), np.zeros((6, 6))) for root in roots}
    queue = list(roots)
    for index in queue:
        near = found[index]
        for other in neighbours.get(index, ()):
            if other not in found:
                turn = adjoint(near.T_root_map)
                across = _covariance(pairs[min(index, other), max(index, other)], to=index)
                covariance: Float64Array = near.covariance + turn @ across @ turn.T
                found[other] = ChainedFrame(near.root, index, inverse(T[near.root]) @ T[other], covariance)
                queue.append(other)
    return {
        index: replace(frame, covariance=about_point(frame.covariance, frame.T_root_map[:3, 3]))
        for index, frame in found.items()
    }


def adjoint(T: Float64Array) -> Float64Array:
    """Return Ad(T) (6, 6) of a transform (4, 4), for motions (rotation, translation)."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[3:, :3] = cross_matrix(T[:3, 3]) @ T[:3, :3]
    return result


def _covariance(pair: PairAlignment, *, to: int) -> Float64Array:
    """Covariance of a pair's pose, which maps to the frame of the robot ``to``."""
    covariance = np.asarray(np.linalg.inv(pair.information + _LEAST_INFORMATION * np.eye(6)), np.float64)
    if to == pair.first:
        return covariance
    turn = adjoint(inverse(pair.T_first_second))
    return turn @ covariance @ turn.T


def about_point(covariance: Float64Array, arm: Float64Array) -> Float64Array:
    """Return the covariance (6, 6) of a motion with the translation of a point at ``arm`` (3,) [m] from the origin."""
    shift = np.eye(6)
    shift[3:, :3] = -cross_matrix(arm)
    result: Float64Array = shift @ covariance @ shift.T
    return result
