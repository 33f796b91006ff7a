"""Joint registration of a team's maps: all overlaps at once, from poses that are close."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from octoreplay.mapping.octree import Run
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
from octoreplay.registration.planes import PlanePoints, plane_distances
from octoreplay.registration.rigid import rotation_logs
from octoreplay.transforms import inverse

_NUM_ITERATIONS = 4
# Iterations of a stage end where no pose moves by more than this [m], or [rad] times ten metres.
_LEAST_STEP = 1e-3
_LEVER = 10.0
# Planes, lengths in spacings of the points: largest distances between correspondences in each stage, and under the
# guess; most iterations of each stage; least cosine between normals; standard deviation of a distance; distance at
# which a weight is 1/4, as a share of the gate; standard deviations of the guesses, rotations in radians.
_PLANE_GATES, _SEARCH_GATE = (8 / 3, 4 / 3, 2 / 3), 4.0
_PLANE_ITERATIONS = (2, 2, 4)
_LEAST_COSINE = 0.95
_PLANE_SIGMA, _ROBUST_SHARE = 1 / 3, 1 / 3
_GUESS_SHIFT, _GUESS_ANGLE = 2 / 3, math.radians(1.0)


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
            poses = _moved(poses, motions, centres)
            if _is_still(motions):
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
    return _solved(hessian, gradient)


def register_planes(
    planes: Sequence[PlanePoints], poses: Sequence[Float64Array], *, run: Run = map
) -> list[Float64Array]:
    """Return the poses (4, 4) of a team's planes in the frame of the first one, refined from close guesses ``poses``.

    The distances of points to planes count for every pair of robots, weighted by Geman and McClure's function. A
    direction that the planes leave free stays near the guess. ``run`` compares the pairs, one call for each; the result
    does not depend on it.
    """
    guesses = [np.array(T, np.float64) for T in poses]
    spacing = planes[0].spacing
    middles = [own.points.mean(axis=0) if len(own.points) else np.zeros(3) for own in planes]
    pairs = _close_samples(planes, guesses, _SEARCH_GATE * spacing, run)
    prior = np.diag([_GUESS_ANGLE**-2.0] * 3 + [(_GUESS_SHIFT * spacing) ** -2.0] * 3)
    poses = guesses
    for gate, num_iterations in zip(_PLANE_GATES, _PLANE_ITERATIONS, strict=True):
        for _ in range(num_iterations):
            centres = [T[:3, :3] @ middle + T[:3, 3] for T, middle in zip(poses, middles, strict=True)]
            hessian, gradient = _plane_equations(planes, pairs, poses, centres, gate * spacing, run)
            for n, (T, guess) in enumerate(zip(poses, guesses, strict=True)):
                own = slice(6 * n, 6 * n + 6)
                turn = rotation_logs((T[:3, :3] @ guess[:3, :3].T)[None])[0]
                shift = centres[n] - guess[:3, :3] @ middles[n] - guess[:3, 3]
                hessian[own, own] += prior
                gradient[own] += prior @ np.concatenate([turn, shift])
            motions = _solved(hessian, gradient)
            poses = _moved(poses, motions, centres)
            if _is_still(motions):
                break
    return poses


def _close_samples(
    planes: Sequence[PlanePoints], poses: Sequence[Float64Array], gate: float, run: Run
) -> dict[tuple[int, int], PlanePoints]:
    """Planes of the second robot of each pair with the samples that are close to the first robot's points."""

    def close(pair: tuple[int, int]) -> PlanePoints:
        a, b = pair
        T = inverse(poses[a]) @ poses[b]
        points = planes[b].sample_points @ T[:3, :3].T + T[:3, 3]
        distances, _ = planes[a].nearest(points, planes[b].class_ids[planes[b].samples], gate)
        return planes[b].with_samples(planes[b].samples[np.isfinite(distances)])

    pairs = list(itertools.permutations(range(len(planes)), 2))
    found = zip(pairs, run(close, pairs), strict=True)
    return {pair: moving for pair, moving in found if moving.samples.size >= MIN_CORRESPONDENCES}


def _plane_equations(
    planes: Sequence[PlanePoints],
    pairs: Mapping[tuple[int, int], PlanePoints],
    poses: Sequence[Float64Array],
    centres: Sequence[Float64Array],
    gate: float,
    run: Run,
) -> tuple[Float64Array, Float64Array]:
    """Gauss-Newton's matrix (6n, 6n) and gradient (6n,) of the distances for motions about the ``centres``."""

    def of_pair(pair: tuple[int, int]) -> tuple[Float64Array, Float64Array]:
        a, b = pair
        T = inverse(poses[a]) @ poses[b]
        found = plane_distances(pairs[pair], planes[a], T, gate, least_cosine=_LEAST_COSINE)
        points = found.points @ poses[a][:3, :3].T + poses[a][:3, 3]
        normals = found.normals @ poses[a][:3, :3].T
        sigma = _PLANE_SIGMA * planes[a].spacing
        weights = (sigma * (1.0 + np.square(found.distances / (_ROBUST_SHARE * gate)))) ** -2.0
        jacobian = np.concatenate(
            [-np.cross(points - centres[a], normals), -normals, np.cross(points - centres[b], normals), normals], axis=1
        )
        return (jacobian * weights[:, None]).T @ jacobian, jacobian.T @ (weights * found.distances)

    hessian, gradient = np.zeros((6 * len(planes), 6 * len(planes))), np.zeros(6 * len(planes))
    for (a, b), (of_both, pull) in zip(pairs, run(of_pair, pairs), strict=True):
        rows = np.r_[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
        hessian[np.ix_(rows, rows)] += of_both
        gradient[rows] += pull
    return hessian, gradient


def _moved(poses: Sequence[Float64Array], motions: Float64Array, centres: Sequence[Float64Array]) -> list[Float64Array]:
    """Poses after the motions (n, 6) about the centres; the first one stays."""
    return [poses[0], *(moved_pose(T, *step) for T, *step in list(zip(poses, motions, centres, strict=True))[1:])]


def _is_still(motions: Float64Array) -> bool:
    """True where no motion (n, 6) is large enough to go on."""
    return max(float(np.abs(motions[:, :3]).max()) * _LEVER, float(np.abs(motions[:, 3:]).max())) < _LEAST_STEP


def _solved(hessian: Float64Array, gradient: Float64Array) -> Float64Array:
    """Motions (n, 6) of Gauss and Newton's step; the first one is 0."""
    motions = np.zeros_like(gradient)
    # A surface without correspondences stays where it is.
    damping = max(1e-9 * np.trace(hessian), 1e-9) * np.eye(gradient.size - 6)
    motions[6:] = -np.linalg.solve(hessian[6:, 6:] + damping, gradient[6:])
    return motions.reshape(-1, 6)
