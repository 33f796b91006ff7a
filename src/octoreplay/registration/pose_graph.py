"""Robust pose graph: poses in SE(3) from relative measurements and priors.

Poses are found by Levenberg-Marquardt on the manifold. Wrong edges get the weight 0 by graduated non-convexity with
truncated least squares (Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial Perception,
RA-L 2020).

Small motions are (rotation phi [rad], translation rho [m]) on the left, about the pose's own origin: a step changes
T = (R, t) to (Exp(phi) R, t + rho), and no step depends on the distance from the world's origin. The error of an edge
with the measurement Z = T_first_second is (Log(R_i^T R_j R_Z^T), R_i^T (t_j - t_i) - t_Z), along the axes of the first
pose; that of a prior is along the world's axes. Information matrices and covariances have the same components. Those
of ``icp`` are about the origin of the target's frame instead; ``covariance.about_point`` converts covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from octoreplay.records import BoolArray, Float64Array, Int64Array
from octoreplay.registration.rigid import cross_matrices, inverse_left_jacobians, inverses, moved, rotation_logs

INLIER_THRESHOLD = 16.81
"""Largest squared Mahalanobis error of an inlier: the 99 % quantile of the chi-square distribution with 6 degrees."""

_MU_FACTOR = 1.4
_MAX_ROUNDS = 60
_MAX_STEPS = 50
_LEAST_DECREASE = 1e-9
_MAX_DAMPING = 1e8


@dataclass(frozen=True, eq=False)
class Bias:
    """Dependence of a measurement on an unknown systematic error b: the measurement's error is ``jacobian`` b.

    ``index`` is the systematic error's number, ``jacobian`` (6, k) float64.
    """

    index: int
    jacobian: Float64Array


@dataclass(frozen=True, eq=False)
class PoseGraphEdge:
    """Measured transform between two poses.

    ``first`` and ``second`` are indices of poses, ``T_first_second`` (4, 4) float64 maps the second pose's frame to the
    first's, and ``information`` (6, 6) float64 is the inverse covariance of the error. A trusted edge is never
    rejected. Edges with the same ``bias`` share a systematic error.
    """

    first: int
    second: int
    T_first_second: Float64Array
    information: Float64Array
    is_trusted: bool = False
    bias: Bias | None = None


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
    - ``biases`` (b, k) float64: systematic errors.
    - ``weights`` (m,) float64: weight of each edge, 0 for a rejected and 1 for an accepted edge.
    - ``squared_errors`` (m,) float64: squared Mahalanobis error of each edge.
    - ``components`` (n,) int64: number of the connected component of each pose, over the edges with a weight above 0.
    - ``covariances`` (c, 6, 6) float64: marginal covariances of the chosen poses, along the world's axes. Without a
      prior in a pose's component, they are relative to the component's held pose.
    """

    poses: Float64Array
    biases: Float64Array
    weights: Float64Array
    squared_errors: Float64Array
    components: Int64Array
    covariances: Float64Array


def solve(
    initial: Float64Array,
    edges: Sequence[PoseGraphEdge],
    priors: Sequence[PosePrior] = (),
    *,
    bias_information: Float64Array | None = None,
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
    bias_information : (b, k, k) float64, optional
        Inverse prior covariances of the systematic errors, whose means are 0.
    inlier_threshold : float
        Largest squared Mahalanobis error of an accepted edge.
    covariances_of : sequence of int
        Poses whose marginal covariances are returned.

    Raises
    ------
    ValueError
        An edge or a prior names a pose that does not exist.
    """
    graph = _Graph(len(initial), edges, priors, bias_information)
    state = _State(np.array(initial, np.float64), np.zeros(graph.bias_shape))
    state, weights = _graduated(graph, state, inlier_threshold)
    num_edges = len(edges)
    return PoseGraphSolution(
        state.poses,
        state.biases,
        weights[:num_edges],
        graph.squared_errors(state)[:num_edges],
        graph.components(weights),
        graph.covariances(state, weights, covariances_of),
    )


class _State(NamedTuple):
    """Unknowns: poses (n, 4, 4) and systematic errors (b, k)."""

    poses: Float64Array
    biases: Float64Array

    def moved(self, step: Float64Array) -> _State:
        """State after a step (6n + bk,)."""
        split = 6 * len(self.poses)
        poses = moved(self.poses, step[:split].reshape(-1, 6))
        return _State(poses, self.biases + step[split:].reshape(self.biases.shape))


def _graduated(graph: _Graph, state: _State, threshold: float) -> tuple[_State, Float64Array]:
    """State and weights by graduated non-convexity: the surrogate cost is convex first and the truncated one last."""
    weights = np.ones(len(graph.trusted))
    state = _optimised(graph, state, weights)
    doubtful = np.flatnonzero(~graph.trusted)
    squared = graph.squared_errors(state)[doubtful]
    if squared.size == 0 or squared.max() <= threshold:
        return state, weights
    mu = threshold / (2.0 * squared.max() - threshold)
    for _ in range(_MAX_ROUNDS):
        weights[doubtful] = _truncated_weights(squared, mu, threshold)
        state = _optimised(graph, state, weights)
        squared = graph.squared_errors(state)[doubtful]
        if np.isin(weights, (0.0, 1.0)).all():
            break
        mu *= _MU_FACTOR
    weights[doubtful] = squared <= threshold
    return _optimised(graph, state, weights), weights


def _truncated_weights(squared: Float64Array, mu: float, threshold: float) -> Float64Array:
    """Weights of the truncated least squares surrogate (eq. 14 of the paper)."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(threshold * mu * (mu + 1.0) / squared) - mu
    weights = np.where(squared >= (mu + 1.0) / mu * threshold, 0.0, between)
    return np.where(squared <= mu / (mu + 1.0) * threshold, 1.0, np.clip(weights, 0.0, 1.0))


def _optimised(graph: _Graph, state: _State, weights: Float64Array) -> _State:
    """State of the least weighted squared error, by Levenberg-Marquardt."""
    columns = graph.free_columns(weights)
    if columns.size == 0:
        return state
    cost, damping = graph.cost(state, weights), 1e-6
    step = np.zeros(graph.num_columns)
    for _ in range(_MAX_STEPS):
        hessian, gradient = graph.normal_equations(state, weights, columns)
        new_cost = np.inf
        while new_cost > cost and damping < _MAX_DAMPING:
            step[columns] = -_factorised(hessian, damping).solve(gradient)
            candidate = state.moved(step)
            new_cost = graph.cost(candidate, weights)
            damping *= 10.0
        if new_cost > cost:
            break
        is_done = cost - new_cost <= _LEAST_DECREASE * (1.0 + cost)
        state, cost, damping = candidate, new_cost, max(damping * 0.01, 1e-9)
        if is_done:
            break
    return state


class _Graph:
    """Arrays of all measurements: the edges, then the priors of poses as edges from the world."""

    def __init__(
        self,
        num_poses: int,
        edges: Sequence[PoseGraphEdge],
        priors: Sequence[PosePrior],
        bias_information: Float64Array | None,
    ) -> None:
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
        self.roots = _square_roots(np.array(information, np.float64).reshape(-1, 6, 6))
        self.trusted: BoolArray = np.array([e.is_trusted for e in edges] + [True] * len(priors), np.bool_)
        bias_information = np.zeros((0, 1, 1)) if bias_information is None else np.asarray(bias_information)
        self.bias_shape = bias_information.shape[:2]
        self.bias_roots = _square_roots(bias_information)
        self.bias_edges = np.array([k for k, e in enumerate(edges) if e.bias is not None], np.int64)
        biases = [e.bias for e in edges if e.bias is not None]
        self.bias_of = np.array([bias.index for bias in biases], np.int64)
        jacobians = np.array([bias.jacobian for bias in biases], np.float64)
        self.bias_jacobians = jacobians.reshape(len(biases), 6, self.bias_shape[1])

    @property
    def num_columns(self) -> int:
        """Number of unknowns."""
        return int(6 * self.num_poses + self.bias_shape[0] * self.bias_shape[1])

    def components(self, weights: Float64Array) -> Int64Array:
        """Component (n,) of each pose over the edges with a weight; priors do not join poses."""
        used = np.flatnonzero(weights[: self.num_edges] > 0)
        shape = (self.num_poses, self.num_poses)
        joined = coo_matrix((np.ones(used.size), (self.first[used], self.second[used])), shape)
        return np.asarray(connected_components(joined, directed=False)[1], np.int64)

    def free_columns(self, weights: Float64Array) -> Int64Array:
        """Unknowns that may change: all but the first pose of each component without a prior."""
        components = self.components(weights)
        has_prior = np.zeros(components.max(initial=-1) + 1, np.bool_)
        has_prior[components[self.second[self.num_edges :]]] = True
        _, lowest = np.unique(components, return_index=True)
        is_free = np.ones(self.num_columns, np.bool_)
        is_free[(6 * lowest[~has_prior, None] + np.arange(6)).ravel()] = False
        return np.flatnonzero(is_free)

    def errors(self, state: _State) -> Float64Array:
        """Errors (m, 6)."""
        with_world = np.concatenate([state.poses, np.eye(4)[None]])
        relative = inverses(with_world[self.first]) @ with_world[self.second]
        turns = rotation_logs(relative[:, :3, :3] @ self.measured[:, :3, :3].transpose(0, 2, 1))
        errors = np.concatenate([turns, relative[:, :3, 3] - self.measured[:, :3, 3]], axis=1)
        errors[self.bias_edges] -= np.einsum("eij,ej->ei", self.bias_jacobians, state.biases[self.bias_of])
        return errors

    def squared_errors(self, state: _State) -> Float64Array:
        """Squared Mahalanobis errors (m,)."""
        whitened = np.einsum("mij,mj->mi", self.roots, self.errors(state))
        return np.asarray(np.square(whitened).sum(axis=1))

    def cost(self, state: _State, weights: Float64Array) -> float:
        """Half the weighted sum of squared errors, with those of the systematic errors."""
        biases = np.einsum("bij,bj->bi", self.bias_roots, state.biases)
        return 0.5 * float(weights @ self.squared_errors(state) + np.square(biases).sum())

    def normal_equations(
        self, state: _State, weights: Float64Array, columns: Int64Array
    ) -> tuple[csc_matrix, Float64Array]:
        """Hessian (c, c) and gradient (c,) of the cost by some unknowns (c,), with the Gauss-Newton approximation."""
        errors = self.errors(state)
        roots = self.roots * np.sqrt(weights)[:, None, None]
        jacobian = self._rows(roots, *self.jacobians(state, errors))[:, columns]
        biases = np.einsum("bij,bj->bi", self.bias_roots, state.biases)
        whitened = np.concatenate([np.einsum("mij,mj->mi", roots, errors).ravel(), biases.ravel()])
        return (jacobian.T @ jacobian).tocsc(), jacobian.T @ whitened

    def _rows(self, roots: Float64Array, first: Float64Array, second: Float64Array) -> csr_matrix:
        """Jacobian of all whitened errors: those of the measurements, then those of the systematic errors."""
        num_rows, (num_biases, size) = 6 * len(self.first), self.bias_shape
        edges, start = np.arange(len(self.first)), 6 * self.num_poses
        inside = np.flatnonzero(self.first < self.num_poses)
        parts = (
            ((roots @ first)[inside], 6 * inside, 6 * self.first[inside]),
            (roots @ second, 6 * edges, 6 * self.second),
            (-roots[self.bias_edges] @ self.bias_jacobians, 6 * self.bias_edges, start + size * self.bias_of),
            (self.bias_roots, num_rows + size * np.arange(num_biases), start + size * np.arange(num_biases)),
        )
        values, rows, columns = [], [], []
        for blocks, row, column in parts:
            values.append(blocks.ravel())
            rows.append(np.broadcast_to((row[:, None] + np.arange(blocks.shape[1]))[:, :, None], blocks.shape).ravel())
            columns.append(
                np.broadcast_to((column[:, None] + np.arange(blocks.shape[2]))[:, None], blocks.shape).ravel()
            )
        shape = (num_rows + size * num_biases, self.num_columns)
        return coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape).tocsr()

    def jacobians(self, state: _State, errors: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Derivatives (m, 6, 6) of the errors (m, 6) by the steps of the first and of the second poses."""
        with_world = np.concatenate([state.poses, np.eye(4)[None]])
        to_first = with_world[self.first, :3, :3].transpose(0, 2, 1)
        arms = with_world[self.second, :3, 3] - with_world[self.first, :3, 3]
        first, second = np.zeros((2, len(errors), 6, 6))
        # The systematic error is subtracted after the logarithm and small.
        second[:, :3, :3] = inverse_left_jacobians(errors[:, :3]) @ to_first
        second[:, 3:, 3:] = to_first
        first[:] = -second
        first[:, 3:, :3] = to_first @ cross_matrices(arms)
        return first, second

    def covariances(self, state: _State, weights: Float64Array, chosen: Sequence[int]) -> Float64Array:
        """Marginal covariances (c, 6, 6) of chosen poses; 0 for a held pose."""
        result = np.zeros((len(chosen), 6, 6))
        columns = self.free_columns(weights)
        if columns.size == 0 or not chosen:
            return result
        factor = _factorised(self.normal_equations(state, weights, columns)[0], 0.0)
        place = np.full(self.num_columns, -1)
        place[columns] = np.arange(columns.size)
        for row, index in enumerate(chosen):
            places = place[6 * index : 6 * index + 6]
            if places[0] >= 0:
                unit = np.zeros((columns.size, 6))
                unit[places, np.arange(6)] = 1.0
                result[row] = factor.solve(unit)[places]
        return result


def _square_roots(information: Float64Array) -> Float64Array:
    """Matrices S (n, k, k) with S^T S = information (n, k, k)."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1))


def _factorised(hessian: csc_matrix, damping: float) -> SuperLU:
    """Factors of the damped Hessian; a symmetric ordering keeps them sparse."""
    diagonal = hessian.diagonal()
    damped = hessian.copy()
    # Directions that no measurement constrains stay where they are.
    damped.setdiag(diagonal * (1.0 + damping) + 1e-12 * max(diagonal.max(initial=0.0), 1.0))
    return splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
