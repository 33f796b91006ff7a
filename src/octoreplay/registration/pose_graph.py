"""Robust pose graph: poses in SE(3) from relative measurements and priors.

Poses are found by Levenberg-Marquardt on the manifold. Wrong edges get the weight 0 by graduated non-convexity with
truncated least squares (Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial Perception,
RA-L 2020).

A pose T = (R, t) is changed by a step (rho, phi) to (R Exp(phi), t + R rho). The error of an edge with the measurement
Z = T_first_second is (R_Z^T (R_i^T (t_j - t_i) - t_Z), Log(R_Z^T R_i^T R_j)): translation [m] and rotation [rad], both
in the second pose's frame. Information matrices have the same order of components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from octoreplay.records import BoolArray, Float64Array, Int64Array
from octoreplay.registration.rigid import cross_matrices, inverse_right_jacobians, inverses, moved, rotation_logs

INLIER_THRESHOLD = 16.81
"""Largest squared Mahalanobis error of an inlier: the 99 % quantile of the chi-square distribution with 6 degrees."""

_MU_FACTOR = 1.4
_MAX_ROUNDS = 60
_MAX_STEPS = 50
_CONVERGED = 1e-8
_MAX_DAMPING = 1e8


@dataclass(frozen=True, eq=False)
class PoseGraphEdge:
    """Measured transform between two poses.

    ``first`` and ``second`` are indices of poses, ``T_first_second`` (4, 4) float64 maps the second pose's frame to the
    first's, and ``information`` (6, 6) float64 is the inverse covariance of the error. A trusted edge is never
    rejected.
    """

    first: int
    second: int
    T_first_second: Float64Array
    information: Float64Array
    is_trusted: bool = False


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Measured pose: ``T_world_pose`` (4, 4) float64 with ``information`` (6, 6) float64; it is never rejected."""

    index: int
    T_world_pose: Float64Array
    information: Float64Array


@dataclass(frozen=True, eq=False)
class PoseGraphSolution:
    """Solution of a pose graph.

    - ``poses`` (n, 4, 4) float64.
    - ``weights`` (m,) float64: weight of each edge, 0 for a rejected and 1 for an accepted edge.
    - ``squared_errors`` (m,) float64: squared Mahalanobis error of each edge.
    - ``components`` (n,) int64: number of the connected component of each pose, over the edges with a weight above 0.
    - ``covariances`` (k, 6, 6) float64: marginal covariances of the chosen poses. Without a prior in a pose's
      component, they are relative to the component's held pose.
    """

    poses: Float64Array
    weights: Float64Array
    squared_errors: Float64Array
    components: Int64Array
    covariances: Float64Array


def solve(
    initial: Float64Array,
    edges: Sequence[PoseGraphEdge],
    priors: Sequence[PosePrior] = (),
    *,
    inlier_threshold: float = INLIER_THRESHOLD,
    covariances_of: Sequence[int] = (),
) -> PoseGraphSolution:
    """Return the most probable poses and the weights of the edges.

    In each connected component without a prior, the pose with the lowest index is held at its initial value. An edge
    that is not trusted is rejected where its squared Mahalanobis error is above ``inlier_threshold``.

    Parameters
    ----------
    initial : (n, 4, 4) float64
        Initial poses in one frame.
    edges, priors : sequences
        Measurements. Information matrices are symmetric and positive semidefinite.
    inlier_threshold : float
        Largest squared Mahalanobis error of an accepted edge.
    covariances_of : sequence of int
        Poses whose marginal covariances are returned.

    Raises
    ------
    ValueError
        An edge or a prior names a pose that does not exist.
    """
    graph = _Graph(len(initial), edges, priors)
    poses, weights = _graduated(graph, np.array(initial, np.float64), inlier_threshold)
    squared = graph.squared_errors(poses)
    return PoseGraphSolution(
        poses,
        weights[: graph.num_edges],
        squared[: graph.num_edges],
        graph.components(weights),
        graph.covariances(poses, weights, covariances_of),
    )


def _graduated(graph: _Graph, poses: Float64Array, threshold: float) -> tuple[Float64Array, Float64Array]:
    """Poses and weights by graduated non-convexity: the surrogate cost is convex at first, the truncated one at last."""
    weights = np.ones(len(graph.trusted))
    poses = _optimised(graph, poses, weights)
    doubtful = np.flatnonzero(~graph.trusted)
    squared = graph.squared_errors(poses)[doubtful]
    if squared.size == 0 or squared.max() <= threshold:
        return poses, weights
    mu = threshold / (2.0 * squared.max() - threshold)
    for _ in range(_MAX_ROUNDS):
        weights[doubtful] = _truncated_weights(squared, mu, threshold)
        poses = _optimised(graph, poses, weights)
        squared = graph.squared_errors(poses)[doubtful]
        if np.isin(weights, (0.0, 1.0)).all():
            break
        mu *= _MU_FACTOR
    weights[doubtful] = squared <= threshold
    return _optimised(graph, poses, weights), weights


def _truncated_weights(squared: Float64Array, mu: float, threshold: float) -> Float64Array:
    """Weights of the truncated least squares surrogate (eq. 14 of the paper)."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(threshold * mu * (mu + 1.0) / squared) - mu
    weights = np.where(squared >= (mu + 1.0) / mu * threshold, 0.0, between)
    return np.where(squared <= mu / (mu + 1.0) * threshold, 1.0, np.clip(weights, 0.0, 1.0))


def _optimised(graph: _Graph, poses: Float64Array, weights: Float64Array) -> Float64Array:
    """Poses of the least weighted squared error, by Levenberg-Marquardt."""
    is_free = graph.free_poses(weights)
    columns = np.flatnonzero(np.repeat(is_free, 6))
    if columns.size == 0:
        return poses
    cost, damping = graph.cost(poses, weights), 1e-6
    for _ in range(_MAX_STEPS):
        hessian, gradient = graph.normal_equations(poses, weights)
        hessian, gradient = hessian[columns][:, columns], gradient[columns]
        while True:
            step = np.zeros(6 * len(poses))
            step[columns] = _factorised(hessian, damping).solve(-gradient)
            candidate = moved(poses, step.reshape(-1, 6))
            new_cost = graph.cost(candidate, weights)
            if new_cost <= cost or damping > _MAX_DAMPING:
                break
            damping *= 10.0
        if new_cost > cost:
            return poses
        poses, decrease, cost = candidate, cost - new_cost, new_cost
        damping = max(damping * 0.1, 1e-9)
        if decrease <= _CONVERGED * (1.0 + cost) and np.abs(step).max() < 1e-6:
            break
    return poses


class _Graph:
    """Arrays of all measurements: the edges, then the priors as edges from the world to a pose."""

    def __init__(self, num_poses: int, edges: Sequence[PoseGraphEdge], priors: Sequence[PosePrior]) -> None:
        self.num_poses, self.num_edges = num_poses, len(edges)
        # The pose after the last is the world: the identity, which never moves.
        self.first = np.array([e.first for e in edges] + [num_poses] * len(priors), np.int64)
        self.second = np.array([e.second for e in edges] + [p.index for p in priors], np.int64)
        ends = np.concatenate([self.first[: len(edges)], self.second])
        if ends.size and (ends.min() < 0 or ends.max() >= num_poses):
            raise ValueError(f"a measurement names a pose outside 0 to {num_poses - 1}")
        measured = [e.T_first_second for e in edges] + [p.T_world_pose for p in priors]
        self.measured = np.array(measured, np.float64).reshape(-1, 4, 4)
        information = [e.information for e in edges] + [p.information for p in priors]
        self.information = np.array(information, np.float64).reshape(-1, 6, 6)
        self.trusted: BoolArray = np.array([e.is_trusted for e in edges] + [True] * len(priors), np.bool_)

    def components(self, weights: Float64Array) -> Int64Array:
        """Component (n,) of each pose over the edges with a weight; priors do not join poses."""
        used = np.flatnonzero(weights[: self.num_edges] > 0)
        shape = (self.num_poses, self.num_poses)
        joined = coo_matrix((np.ones(used.size), (self.first[used], self.second[used])), shape)
        return np.asarray(connected_components(joined, directed=False)[1], np.int64)

    def free_poses(self, weights: Float64Array) -> BoolArray:
        """True (n,) for poses that may move: all but the first of each component without a prior."""
        components = self.components(weights)
        has_prior = np.zeros(components.max(initial=-1) + 1, np.bool_)
        has_prior[components[self.second[self.num_edges :]]] = True
        _, lowest = np.unique(components, return_index=True)
        is_free = np.ones(self.num_poses, np.bool_)
        is_free[lowest[~has_prior]] = False
        return is_free

    def errors(self, poses: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Errors (m, 6), and the transforms (m, 4, 4) from the second to the first poses."""
        with_world = np.concatenate([poses, np.eye(4)[None]])
        relative = inverses(with_world[self.first]) @ with_world[self.second]
        rotation_z = self.measured[:, :3, :3].transpose(0, 2, 1)
        shift = np.einsum("mij,mj->mi", rotation_z, relative[:, :3, 3] - self.measured[:, :3, 3])
        return np.concatenate([shift, rotation_logs(rotation_z @ relative[:, :3, :3])], axis=1), relative

    def squared_errors(self, poses: Float64Array) -> Float64Array:
        """Squared Mahalanobis errors (m,)."""
        errors, _ = self.errors(poses)
        return np.einsum("mi,mij,mj->m", errors, self.information, errors)

    def cost(self, poses: Float64Array, weights: Float64Array) -> float:
        """Half the weighted sum of squared errors."""
        return 0.5 * float(weights @ self.squared_errors(poses))

    def normal_equations(self, poses: Float64Array, weights: Float64Array) -> tuple[csc_matrix, Float64Array]:
        """Hessian (6n, 6n) and gradient (6n,) of the cost, with the Gauss-Newton approximation."""
        errors, relative = self.errors(poses)
        first, second = self._jacobians(errors, relative)
        information = self.information * weights[:, None, None]
        weighted = [np.einsum("mia,mij->maj", jacobian, information) for jacobian in (first, second)]
        blocks, rows, columns = [], [], []
        for left, row in zip(weighted, (self.first, self.second), strict=True):
            for right, column in ((first, self.first), (second, self.second)):
                blocks.append(left @ right)
                rows.append(row)
                columns.append(column)
        hessian = _block_matrix(np.concatenate(blocks), np.concatenate(rows), np.concatenate(columns), self.num_poses)
        gradient = np.zeros((self.num_poses + 1, 6))
        for left, row in zip(weighted, (self.first, self.second), strict=True):
            np.add.at(gradient, row, np.einsum("maj,mj->ma", left, errors))
        return hessian, gradient[:-1].ravel()

    def _jacobians(self, errors: Float64Array, relative: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Derivatives (m, 6, 6) of the errors by the steps of the first and of the second poses."""
        first, second = np.zeros((2, len(errors), 6, 6))
        rotation_z = self.measured[:, :3, :3].transpose(0, 2, 1)
        inverse_right = inverse_right_jacobians(errors[:, 3:])
        first[:, :3, :3] = -rotation_z
        first[:, :3, 3:] = rotation_z @ cross_matrices(relative[:, :3, 3])
        first[:, 3:, 3:] = -inverse_right @ relative[:, :3, :3].transpose(0, 2, 1)
        second[:, :3, :3] = rotation_z @ relative[:, :3, :3]
        second[:, 3:, 3:] = inverse_right
        return first, second

    def covariances(self, poses: Float64Array, weights: Float64Array, chosen: Sequence[int]) -> Float64Array:
        """Marginal covariances (k, 6, 6) of chosen poses; 0 for a held pose."""
        result = np.zeros((len(chosen), 6, 6))
        columns = np.flatnonzero(np.repeat(self.free_poses(weights), 6))
        if columns.size == 0 or not chosen:
            return result
        hessian, _ = self.normal_equations(poses, weights)
        factor = _factorised(hessian[columns][:, columns], 1e-12)
        place = np.full(6 * self.num_poses, -1)
        place[columns] = np.arange(columns.size)
        for row, index in enumerate(chosen):
            places = place[6 * index : 6 * index + 6]
            if places[0] >= 0:
                unit = np.zeros((columns.size, 6))
                unit[places, np.arange(6)] = 1.0
                result[row] = factor.solve(unit)[places]
        return result


def _block_matrix(blocks: Float64Array, rows: Int64Array, columns: Int64Array, num_poses: int) -> csc_matrix:
    """Sparse matrix (6n, 6n) of blocks (k, 6, 6) at block positions (k,); blocks of the world are left out."""
    inside = (rows < num_poses) & (columns < num_poses)
    blocks, rows, columns = blocks[inside], rows[inside], columns[inside]
    within = np.arange(6)
    row = np.broadcast_to(6 * rows[:, None, None] + within[:, None], blocks.shape)
    column = np.broadcast_to(6 * columns[:, None, None] + within, blocks.shape)
    shape = (6 * num_poses, 6 * num_poses)
    return coo_matrix((blocks.ravel(), (row.ravel(), column.ravel())), shape).tocsc()


def _factorised(hessian: csc_matrix, damping: float) -> SuperLU:
    """Factors of the damped Hessian; a symmetric ordering keeps them sparse."""
    damped = hessian.copy()
    diagonal = hessian.diagonal()
    # Directions that no measurement constrains stay where they are.
    damped.setdiag(diagonal * (1.0 + damping) + 1e-9 * max(diagonal.max(initial=0.0), 1.0))
    return splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
