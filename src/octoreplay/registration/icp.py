"""Registration of two labelled surfaces: iterative closest points between equal codes, distribution to distribution.

Each point carries a covariance that is small across its local surface and large along it, so that planes slide, edges
and corners hold (generalised ICP: Segal, Haehnel and Thrun, RSS 2009), and a code, such as its class. Points correspond
only to points of the same code. Residuals are weighted by Geman and McClure's function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from octoreplay.records import BoolArray, Float64Array, Int64Array
from octoreplay.registration.rigid import cross_matrix

# Distance between neighbouring codes in the tree's fourth coordinate [m]; no gate reaches it.
_CODE_DISTANCE = 1e4
_NUM_NEIGHBOURS = 30
_MIN_NEIGHBOURS = 6
MIN_CORRESPONDENCES = 20
# A principal direction whose variance is below this share of the largest one is across the surface.
_FLATNESS = 0.25
# Squared Mahalanobis distance at which Geman and McClure's weight is 1/4.
_ROBUST_SCALE = 4.0
_NUM_ITERATIONS = 12
# Iterations end where a step is below this share of the gate: in the last stage, and in others. A rotation is measured
# at a distance [m].
_RELATIVE_STEP, _COARSE_STEP, _LEVER = 0.005, 0.03, 10.0
# Number of neighbouring correspondences that carry the information of one independent measurement.
_CORRESPONDENCES_PER_SAMPLE = 50.0


@dataclass(frozen=True, eq=False)
class Surface:
    """Labelled surface points.

    - ``points`` (n, 3) float64 [m], projected onto the local surface.
    - ``codes`` (n,) int64: points correspond only to points of the same code.
    - ``covariances`` (n, 3, 3) float64 [m^2].
    - ``weights`` (n,) float64.
    """

    points: Float64Array
    codes: Int64Array
    covariances: Float64Array
    weights: Float64Array

    @classmethod
    def of_points(
        cls, points: Float64Array, codes: Int64Array, weights: Float64Array, *, spacing: float, radius: float
    ) -> Surface:
        """Return the surface of points (n, 3) that are about ``spacing`` [m] apart.

        Local surfaces come from the principal components of the points of equal code within ``radius`` [m].
        """
        if len(points) == 0:
            return cls(points, codes, np.zeros((0, 3, 3)), weights)
        tree = cKDTree(_keys(points, codes))
        _, neighbours = tree.query(_keys(points, codes), k=_NUM_NEIGHBOURS, distance_upper_bound=radius)
        exists = neighbours < len(points)
        offsets = np.where(exists[..., None], points[np.where(exists, neighbours, 0)] - points[:, None], 0.0)
        count = exists.sum(axis=1)[:, None]
        mean = offsets.sum(axis=1) / count
        spread = np.einsum("nki,nkj->nij", offsets, offsets) / count[..., None]
        variances, axes = np.linalg.eigh(spread - np.einsum("ni,nj->nij", mean, mean))
        is_across = (variances < _FLATNESS * variances[:, 2:]) & (count >= _MIN_NEIGHBOURS)
        across, along, isotropic = (0.3 * spacing) ** 2, (5.0 * spacing) ** 2, (0.5 * spacing) ** 2
        has_direction = is_across.any(axis=1, keepdims=True)
        shaped = np.where(has_direction, np.where(is_across, across + variances, along), isotropic)
        covariances = np.einsum("nik,nk,njk->nij", axes, shaped, axes)
        height = np.where(is_across, np.einsum("nik,ni->nk", axes, mean), 0.0)
        return cls(points + np.einsum("nik,nk->ni", axes, height), codes, covariances, weights)

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree over the points; the fourth coordinate separates the codes."""
        return cKDTree(_keys(self.points, self.codes))

    def distances(self, points: Float64Array, codes: Int64Array, limit: float) -> Float64Array:
        """Return the distance (m,) from points (m, 3) to the nearest point of the same code; inf beyond ``limit``."""
        return np.asarray(self.tree.query(_keys(points, codes), distance_upper_bound=limit)[0], np.float64)

    def subset(self, chosen: BoolArray) -> Surface:
        """Return the points where ``chosen`` (n,) is True."""
        return Surface(self.points[chosen], self.codes[chosen], self.covariances[chosen], self.weights[chosen])


@dataclass(frozen=True, eq=False)
class IcpResult:
    """Result of a registration.

    - ``T_target_source`` (4, 4) float64.
    - ``information`` (6, 6): inverse covariance of a small motion (rotation [rad], translation [m]) that is applied on
      the left, about the target's origin; zeros without a result.
    - ``num_correspondences``: in both directions, at the last iteration.
    """

    T_target_source: Float64Array
    information: Float64Array
    num_correspondences: int


def icp(
    source: Surface,
    target: Surface,
    T_target_source: Float64Array,
    *,
    gates: Sequence[float],
    tilt_sigma: float | None = None,
) -> IcpResult:
    """Return the pose of ``source`` in ``target``'s frame, refined from a guess.

    ``gates`` are the largest distances between correspondences [m], one stage each. ``tilt_sigma`` is the standard
    deviation of the angle between both frames' vertical axes [rad]; None for no prior.
    """
    T = np.array(T_target_source, np.float64)
    hessian, num = np.zeros((6, 6)), 0
    centre = np.zeros(3)
    near_source, near_target = _close_parts(source, target, T, 1.5 * gates[0])
    for gate in gates:
        for _ in range(_NUM_ITERATIONS):
            pairs = correspondences(near_source, near_target, T, gate)
            num = len(pairs[0])
            if num < MIN_CORRESPONDENCES:
                return IcpResult(T, np.zeros((6, 6)), num)
            moved = near_source.points[pairs[0]] @ T[:3, :3].T + T[:3, 3]
            centre = moved.mean(axis=0)
            hessian, gradient = _normal_equations(near_source, near_target, T, pairs, moved, centre)
            if tilt_sigma is not None:
                add_tilt_prior(hessian, gradient, T, tilt_sigma)
            damping = 1e-9 * np.trace(hessian) * np.eye(6)
            motion = -np.linalg.solve(hessian + damping, gradient)
            T = moved_pose(T, motion, centre)
            shift, angle = np.linalg.norm(motion[3:]), np.linalg.norm(motion[:3])
            least = (_RELATIVE_STEP if gate == gates[-1] else _COARSE_STEP) * gate
            if shift < least and angle < least / _LEVER:
                break
    about_origin = np.eye(6)
    about_origin[3:, :3] = -cross_matrix(centre)
    return IcpResult(T, about_origin.T @ hessian @ about_origin / _CORRESPONDENCES_PER_SAMPLE, num)


def _keys(points: Float64Array, codes: Int64Array) -> Float64Array:
    """Points (n, 4) of the search tree."""
    return np.column_stack([points, codes * _CODE_DISTANCE])


def _close_parts(source: Surface, target: Surface, T: Float64Array, gate: float) -> tuple[Surface, Surface]:
    """The points of each surface with a point of the other one of the same code nearby."""
    moved = source.points @ T[:3, :3].T + T[:3, 3]
    distances, _ = target.tree.query(_keys(moved, source.codes), distance_upper_bound=gate)
    close_source = source.subset(np.isfinite(distances))
    back = (target.points - T[:3, 3]) @ T[:3, :3]
    distances, _ = source.tree.query(_keys(back, target.codes), distance_upper_bound=gate)
    return close_source, target.subset(np.isfinite(distances))


def correspondences(source: Surface, target: Surface, T: Float64Array, gate: float) -> tuple[Int64Array, Int64Array]:
    """Return indices of corresponding points: each source's nearest target, then each target's nearest source."""
    if len(source.points) == 0 or len(target.points) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    moved = source.points @ T[:3, :3].T + T[:3, 3]
    forth, nearest_target = target.tree.query(_keys(moved, source.codes), distance_upper_bound=gate)
    back_points = (target.points - T[:3, 3]) @ T[:3, :3]
    back, nearest_source = source.tree.query(_keys(back_points, target.codes), distance_upper_bound=gate)
    is_forth, is_back = np.isfinite(forth), np.isfinite(back)
    return (
        np.concatenate([np.flatnonzero(is_forth), nearest_source[is_back]]),
        np.concatenate([nearest_target[is_forth], np.flatnonzero(is_back)]),
    )


def _normal_equations(
    source: Surface,
    target: Surface,
    T: Float64Array,
    pairs: tuple[Int64Array, Int64Array],
    moved: Float64Array,
    centre: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Gauss-Newton's matrix (6, 6) and gradient (6,) for a small motion about ``centre``."""
    residuals = moved - target.points[pairs[1]]
    information, pulls = weighted_pulls(source, target, (T[:3, :3], np.eye(3)), pairs, residuals)
    jacobian = motion_jacobian(moved - centre)
    flat = jacobian.reshape(-1, 6)
    return flat.T @ (information @ jacobian).reshape(-1, 6), flat.T @ pulls.ravel()


def weighted_pulls(
    source: Surface,
    target: Surface,
    rotations: tuple[Float64Array, Float64Array],
    pairs: tuple[Int64Array, Int64Array],
    residuals: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return the weighted information (n, 3, 3) of correspondences and its product with their ``residuals`` (n, 3).

    ``rotations`` turn the source's and the target's frame to that of the residuals.
    """
    i, j = pairs
    turn, other = rotations
    information = _inverse_symmetric(other @ target.covariances[j] @ other.T + turn @ source.covariances[i] @ turn.T)
    pulls = np.einsum("nij,nj->ni", information, residuals)
    squares = np.einsum("ni,ni->n", residuals, pulls)
    weights = np.sqrt(source.weights[i] * target.weights[j]) / (1.0 + squares / _ROBUST_SCALE) ** 2
    return information * weights[:, None, None], pulls * weights[:, None]


def motion_jacobian(arms: Float64Array) -> Float64Array:
    """Return the derivatives (n, 3, 6) of points at ``arms`` (n, 3) by a small motion (rotation, translation)."""
    jacobian = np.zeros((len(arms), 3, 6))
    jacobian[:, 0, 1], jacobian[:, 0, 2] = arms[:, 2], -arms[:, 1]
    jacobian[:, 1, 0], jacobian[:, 1, 2] = -arms[:, 2], arms[:, 0]
    jacobian[:, 2, 0], jacobian[:, 2, 1] = arms[:, 1], -arms[:, 0]
    jacobian[:, 0, 3] = jacobian[:, 1, 4] = jacobian[:, 2, 5] = 1.0
    return jacobian


def add_tilt_prior(hessian: Float64Array, gradient: Float64Array, T: Float64Array, sigma: float) -> None:
    """Add the prior of parallel vertical axes to the equations of a motion, in place.

    The rotation (w_x, w_y) turns z to (w_y, -w_x, 1). ``sigma`` is the standard deviation of the angle [rad].
    """
    weight = _CORRESPONDENCES_PER_SAMPLE / sigma**2
    hessian[[0, 1], [0, 1]] += weight
    gradient[:2] += weight * np.array([-T[1, 2], T[0, 2]])


def moved_pose(T: Float64Array, motion: Float64Array, centre: Float64Array) -> Float64Array:
    """Return the pose (4, 4) after a small motion (rotation vector, translation) about ``centre``."""
    result = np.eye(4)
    rotation = Rotation.from_rotvec(motion[:3]).as_matrix()
    result[:3, :3] = rotation @ T[:3, :3]
    result[:3, 3] = rotation @ (T[:3, 3] - centre) + centre + motion[3:]
    return result


def _inverse_symmetric(m: Float64Array) -> Float64Array:
    """Inverses of symmetric matrices (n, 3, 3), by cofactors: numpy.linalg.inv takes five times as long."""
    a, b, c, d, e, f = m[:, 0, 0], m[:, 0, 1], m[:, 0, 2], m[:, 1, 1], m[:, 1, 2], m[:, 2, 2]
    rows = np.stack(
        [d * f - e * e, c * e - b * f, b * e - c * d, c * e - b * f, a * f - c * c, b * c - a * e, b * e - c * d,
         b * c - a * e, a * d - b * b], axis=1)  # fmt: skip
    determinant = a * rows[:, 0] + b * rows[:, 1] + c * rows[:, 2]
    return rows.reshape(-1, 3, 3) / determinant[:, None, None]
