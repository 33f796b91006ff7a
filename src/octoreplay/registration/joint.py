"""Joint registration of a team's maps: all overlaps at once, from poses that are close."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.icp import (
    MIN_CORRESPONDENCES,
    Surface,
    add_tilt_prior,
    correspondences,
    motion_jacobian,
    moved_pose,
    weighted_pulls,
)
from octoreplay.transforms import inverse

_NUM_ITERATIONS = 12
# Iterations of a stage end where no pose moves by more than this [m], or [rad] times ten metres.
_LEAST_STEP = 1e-3
_LEVER = 10.0


def register_together(
    surfaces: Sequence[Surface],
    poses: Sequence[Float64Array],
    *,
    gates: Sequence[float],
    tilt_sigma: float | None = None,
) -> list[Float64Array]:
    """Return the poses (4, 4) of a team's surfaces in the frame of the first one, refined from close guesses ``poses``.

    Every pair of surfaces with corresponding points within the gate counts, also pairs that are too weak alone. The
    distances between surfaces, ``gates`` and ``tilt_sigma`` are those of ``icp``.
    """
    poses = [np.array(T, np.float64) for T in poses]
    for gate in gates:
        for _ in range(_NUM_ITERATIONS):
            centres = [
                T[:3, :3] @ surface.points.mean(axis=0) + T[:3, 3] for T, surface in zip(poses, surfaces, strict=True)
            ]
            motions = _motions(surfaces, poses, centres, gate, tilt_sigma)
            moved = [moved_pose(T, *step) for T, *step in zip(poses, motions, centres, strict=True)]
            poses = [poses[0], *moved[1:]]
            if max(np.abs(motions[:, :3]).max() * _LEVER, np.abs(motions[:, 3:]).max()) < _LEAST_STEP:
                break
    return poses


def _motions(
    surfaces: Sequence[Surface],
    poses: Sequence[Float64Array],
    centres: Sequence[Float64Array],
    gate: float,
    tilt_sigma: float | None,
) -> Float64Array:
    """Gauss-Newton's motion (rotation, translation) of each surface about its centre, (n, 6); zeros for the first."""
    num = len(surfaces)
    hessian, gradient = np.zeros((6 * num, 6 * num)), np.zeros(6 * num)
    for a, b in itertools.combinations(range(num), 2):
        target, source = surfaces[a], surfaces[b]
        pairs = correspondences(source, target, inverse(poses[a]) @ poses[b], gate)
        if len(pairs[0]) < MIN_CORRESPONDENCES:
            continue
        here = source.points[pairs[0]] @ poses[b][:3, :3].T + poses[b][:3, 3]
        there = target.points[pairs[1]] @ poses[a][:3, :3].T + poses[a][:3, 3]
        rotations = poses[b][:3, :3], poses[a][:3, :3]
        information, pulls = weighted_pulls(source, target, rotations, pairs, here - there)
        jacobian = np.concatenate([-motion_jacobian(there - centres[a]), motion_jacobian(here - centres[b])], axis=2)
        flat = jacobian.reshape(-1, 12)
        rows = np.r_[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
        hessian[np.ix_(rows, rows)] += flat.T @ (information @ jacobian).reshape(-1, 12)
        gradient[rows] += flat.T @ pulls.ravel()
    if tilt_sigma is not None:
        for n in range(1, num):
            own = slice(6 * n, 6 * n + 6)
            add_tilt_prior(hessian[own, own], gradient[own], inverse(poses[0]) @ poses[n], tilt_sigma)
    free = slice(6, None)
    # A surface without correspondences stays where it is.
    damping = max(1e-9 * np.trace(hessian), 1e-9) * np.eye(6 * num - 6)
    motions = np.zeros(6 * num)
    motions[free] = -np.linalg.solve(hessian[free, free] + damping, gradient[free])
    return motions.reshape(num, 6)
