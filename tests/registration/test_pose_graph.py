"""Robust pose graphs with known solutions."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.registration.pose_graph import Bias, PoseGraphEdge, PosePrior, _Graph, _State, solve
from octoreplay.registration.rigid import inverses, moved, rotation_logs
from octoreplay.transforms import inverse
from support.long_suite import long


def at(*step):
    """Pose (4, 4) after a step (rotation vector, translation) from the origin."""
    return moved(np.eye(4)[None], np.array([step], np.float64))[0]


def random_poses(rng, num_poses):
    """A random walk of poses (n, 4, 4)."""
    poses = np.tile(np.eye(4), (num_poses, 1, 1))
    for index in range(1, num_poses):
        poses[index] = poses[index - 1] @ at(
            *rng.normal(size=6) * [0.1, 0.1, 0.6, 1.0, 0.5, 0.2] + [0, 0, 0, 1.0, 0, 0]
        )
    return poses


def measured(poses, first, second, rng, sigmas, *, trusted=False):
    """Edge between two poses with errors of the standard deviations ``sigmas`` (6,)."""
    T = moved((inverse(poses[first]) @ poses[second])[None], rng.normal(size=(1, 6)) * sigmas)[0]
    return PoseGraphEdge(first, second, T, np.diag(1.0 / np.asarray(sigmas) ** 2), trusted)


SIGMAS = np.array([0.005, 0.005, 0.01, 0.05, 0.05, 0.02])


def chain_with_loops(rng, num_poses=30, num_loops=25):
    """True poses, and edges of a chain with loops."""
    poses = random_poses(rng, num_poses)
    edges = [measured(poses, k, k + 1, rng, SIGMAS, trusted=True) for k in range(num_poses - 1)]
    pairs = [rng.choice(num_poses, 2, replace=False) for _ in range(num_loops)]
    edges += [measured(poses, int(a), int(b), rng, SIGMAS) for a, b in pairs]
    return poses, edges


def integrated(edges, num_poses, start):
    """Poses of the chain's measurements alone."""
    poses = [start]
    for edge in edges[: num_poses - 1]:
        poses.append(poses[-1] @ edge.T_first_second)
    return np.array(poses)


def wrong_edge(rng, num_poses):
    first, second = rng.choice(num_poses, 2, replace=False)
    T = at(*rng.normal(size=6) * [0.3, 0.3, 1.5, 5, 5, 1])
    return PoseGraphEdge(int(first), int(second), T, np.diag(1.0 / SIGMAS**2))


def position_errors(poses, truth):
    return np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_exact_measurements_give_the_true_poses(seed):
    rng = np.random.default_rng(seed)
    truth, edges = chain_with_loops(rng)
    exact = [PoseGraphEdge(e.first, e.second, inverse(truth[e.first]) @ truth[e.second], e.information) for e in edges]
    start = moved(truth, np.concatenate([np.zeros((1, 6)), rng.normal(size=(29, 6)) * 0.2]))
    solution = solve(start, exact)
    np.testing.assert_allclose(solution.poses, truth, atol=1e-6)
    np.testing.assert_array_equal(solution.weights, 1.0)


@pytest.mark.parametrize("seed", range(4))
def test_wrong_edges_are_rejected_and_right_ones_kept(seed):
    rng = np.random.default_rng(seed)
    truth, edges = chain_with_loops(rng)
    wrong = [wrong_edge(rng, 30) for _ in range(15)]
    start = integrated(edges, 30, truth[0])
    solution = solve(start, [*edges, *wrong])
    assert solution.weights[: len(edges)].mean() > 0.97
    np.testing.assert_array_equal(solution.weights[len(edges) :], 0.0)
    assert position_errors(solution.poses, truth).mean() < 0.7 * position_errors(start, truth).mean()


@long
def test_poses_do_not_depend_on_the_frame_of_the_initial_poses():
    rng = np.random.default_rng(5)
    truth, edges = chain_with_loops(rng)
    edges += [wrong_edge(rng, 30) for _ in range(5)]
    start = integrated(edges, 30, truth[0])
    T_other = at(0.5, -0.4, 2.0, 30.0, -20.0, 3.0)
    here, there = solve(start, edges), solve(T_other @ start, edges)
    np.testing.assert_allclose(there.poses, T_other @ here.poses, atol=1e-5)
    np.testing.assert_array_equal(there.weights, here.weights)


def test_components_are_solved_apart_and_held_at_their_first_pose():
    rng = np.random.default_rng(6)
    truth, edges = chain_with_loops(rng)
    shifted = [PoseGraphEdge(e.first + 30, e.second + 30, e.T_first_second, e.information, e.is_trusted) for e in edges]
    T_other = at(0.0, 0.0, 1.0, 9.0, 1.0, 0.0)
    start = integrated(edges, 30, truth[0])
    solution = solve(np.concatenate([start, T_other @ start, np.eye(4)[None]]), [*edges, *shifted])
    np.testing.assert_array_equal(solution.components, [0] * 30 + [1] * 30 + [2])
    np.testing.assert_array_equal(solution.poses[[0, 30, 60]], [truth[0], T_other @ truth[0], np.eye(4)])
    np.testing.assert_allclose(solution.poses[30:60], T_other @ solution.poses[:30], atol=1e-6)


@long
def test_a_component_that_only_rejected_edges_join_is_named_apart():
    rng = np.random.default_rng(7)
    truth, edges = chain_with_loops(rng, 10, 10)
    more = [PoseGraphEdge(e.first + 10, e.second + 10, e.T_first_second, e.information, e.is_trusted) for e in edges]
    contradicting = [PoseGraphEdge(k, k + 10, at(0, 0, 0, 10.0 * k, 0, 0), np.eye(6) * 1e4) for k in (1, 4, 8)]
    start = np.concatenate([truth, truth])
    solution = solve(start, [*edges, *more, *contradicting])
    assert solution.weights[-3:].sum() <= 1


def test_a_prior_sets_the_frame_and_its_weight_counts():
    rng = np.random.default_rng(8)
    truth, edges = chain_with_loops(rng, 10, 5)
    T_prior = at(0.0, 0.0, 0.7, 3.0, 4.0, 0.0)
    strong = PosePrior(4, T_prior, np.eye(6) * 1e4)
    weak = PosePrior(4, np.eye(4), np.eye(6) * 1e-4)
    solution = solve(truth, edges, [strong, weak])
    np.testing.assert_allclose(solution.poses[4], T_prior, atol=1e-5)
    free = solve(truth, edges)
    np.testing.assert_allclose(
        inverses(solution.poses) @ solution.poses[4], inverses(free.poses) @ free.poses[4], atol=1e-4
    )


@long
def test_covariances_are_those_of_repeated_measurements():
    rng = np.random.default_rng(9)
    truth, _ = chain_with_loops(rng, 6, 0)
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 5), (1, 4)]
    steps, covariance = [], np.zeros((6, 6))
    for _ in range(400):
        edges = [measured(truth, a, b, rng, SIGMAS) for a, b in pairs]
        solution = solve(truth, edges, inlier_threshold=1e9, covariances_of=(3, 0))
        turn = solution.poses[3, :3, :3] @ truth[3, :3, :3].T
        steps.append([*rotation_logs(turn[None])[0], *(solution.poses[3] - truth[3])[:3, 3]])
        covariance += solution.covariances[0] / 400
    np.testing.assert_array_equal(solution.covariances[1], 0.0)
    np.testing.assert_allclose(np.diag(np.cov(np.array(steps).T)), np.diag(covariance), rtol=0.3)


def test_a_single_pose_without_measurements_stays():
    pose = at(0.1, 0.2, 0.3, 1.0, 2.0, 3.0)[None]
    np.testing.assert_array_equal(solve(pose, []).poses, pose)


def test_an_edge_to_a_missing_pose_is_refused():
    with pytest.raises(ValueError, match="outside 0 to 1"):
        solve(np.tile(np.eye(4), (2, 1, 1)), [PoseGraphEdge(0, 2, np.eye(4), np.eye(6))])


def test_the_jacobians_are_those_of_finite_differences():
    rng = np.random.default_rng(10)
    poses, _ = chain_with_loops(rng, 4, 0)
    # Large errors, and poses far from the world's origin.
    poses[:, :3, 3] += [300.0, -200.0, 50.0]
    edges = [measured(poses, a, b, rng, np.repeat([0.5, 2.0], 3)) for a, b in ((0, 1), (2, 1), (3, 0))]
    prior = PosePrior(2, at(*rng.normal(size=6)), np.eye(6))
    graph = _Graph(4, edges, [prior], None)
    state = _State(poses, np.zeros((0, 1)))
    first, second = graph.jacobians(state, graph.errors(state))
    analytic = np.zeros((4, 6, 24))
    for row, (a, b) in enumerate(((0, 1), (2, 1), (3, 0))):
        analytic[row, :, 6 * a : 6 * a + 6] = first[row]
        analytic[row, :, 6 * b : 6 * b + 6] = second[row]
    analytic[3, :, 12:18] = second[3]
    steps = np.eye(24) * 1e-6
    numeric = [(graph.errors(state.moved(step)) - graph.errors(state.moved(-step))) / 2e-6 for step in steps]
    np.testing.assert_allclose(analytic, np.moveaxis(numeric, 0, 2), atol=1e-6)


def test_a_systematic_error_of_two_edges_is_found():
    T_step = at(0.0, 0.0, 0.4, 1.0, 0.0, 0.0)
    truth = np.array([np.eye(4), T_step, T_step @ T_step])
    # Both edges are 0.3 rad short about z and 0.2 m long along x; the prior fixes the last pose.
    biased = at(0.0, 0.0, 0.1, 1.2, 0.0, 0.0)
    bias = Bias(0, np.array([[0.0, 0.0, 0.3, -0.2, 0.0, 0.0]]).T)
    edges = [PoseGraphEdge(k, k + 1, biased, np.eye(6) * 1e6, is_trusted=True, bias=bias) for k in range(2)]
    priors = [PosePrior(k, truth[k], np.eye(6) * 1e8) for k in (0, 2)]
    solution = solve(truth[[0, 0, 0]], edges, priors, bias_information=np.eye(1)[None] * 1e-3)
    np.testing.assert_allclose(solution.biases, [[1.0]], atol=1e-4)
    np.testing.assert_allclose(solution.poses, truth, atol=1e-4)
