"""Submaps and the registration of two of them."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.registration.rigid import moved, rotation_logs
from octoreplay.registration.submaps import Submap, _both_residuals, overlapping_pairs, register
from octoreplay.transforms import inverse
from support.drifting_team import VOXEL, yard


def submap(T_world_anchor: np.ndarray, seed: int, *, robot: int = 0, classes_plus: int = 0) -> Submap:
    """Submap of the yard around an anchor, with noise of its own."""
    points, classes = yard(np.random.default_rng(1))
    points = points + np.random.default_rng(seed).normal(0.0, 0.02, points.shape)
    seen = np.linalg.norm(points - T_world_anchor[:3, 3], axis=1) < 7.0
    T = inverse(T_world_anchor)
    return Submap.of_points(
        robot, 0, T_world_anchor, points[seen] @ T[:3, :3].T + T[:3, 3], classes[seen] + np.uint8(classes_plus), VOXEL
    )


def at(*step: float) -> np.ndarray:
    """Pose after a step (rotation vector, translation) from the origin."""
    return moved(np.eye(4)[None], np.array([step], np.float64))[0]


FIRST, SECOND = at(0, 0, 0.3, 0, 0, 1), at(0, 0, -1.2, 2, 1, 1)
TRUE = inverse(FIRST) @ SECOND


def registered(first: Submap, second: Submap, guess: np.ndarray) -> np.ndarray | None:
    """Transform after rounds with smaller and smaller gates."""
    for gate in (1.5, 1.0, 0.8, 0.6, 0.6):
        found = register(first, second, guess, gate, is_final=gate < 0.7)
        if found is None:
            return None
        guess = found.T_first_second
    return guess


@pytest.mark.parametrize("step", [(0, 0, 0, 0, 0, 0), (0.01, -0.01, 0.06, 0.4, -0.3, 0.1)])
def test_two_views_are_registered(step: tuple[float, ...]) -> None:
    guess = moved(TRUE[None], np.array([step], np.float64))[0]
    found = registered(submap(FIRST, 1), submap(SECOND, 2), guess)
    assert found is not None
    error = inverse(TRUE) @ found
    assert np.linalg.norm(error[:3, 3]) < 0.03
    assert np.linalg.norm(rotation_logs(error[None, :3, :3])) < 0.006


def test_swapping_the_submaps_inverts_the_step() -> None:
    first, second = submap(FIRST, 1), submap(SECOND, 2)
    guess = moved(TRUE[None], np.array([[0.0, 0.0, 0.01, 0.05, -0.02, 0.02]]))[0]
    forward = register(first, second, guess, 0.4, is_final=False)
    backward = register(second, first, inverse(guess), 0.4, is_final=False)
    assert forward is not None
    assert backward is not None
    np.testing.assert_allclose(forward.T_first_second @ backward.T_first_second, np.eye(4), atol=2e-3)


def test_surfaces_of_other_classes_do_not_match() -> None:
    assert register(submap(FIRST, 1), submap(SECOND, 2, classes_plus=10), TRUE, 1.5, is_final=False) is None


def test_a_wrong_guess_is_refused() -> None:
    guess = moved(TRUE[None], np.array([[0.0, 0.0, 0.7, 2.5, 2.0, 0.0]]))[0]
    assert registered(submap(FIRST, 1), submap(SECOND, 2), guess) is None


def test_ground_alone_gives_no_information_along_itself() -> None:
    ground = np.random.default_rng(0).uniform(-8, 8, (30_000, 3)) * [1, 1, 0]
    classes = np.ones(len(ground), np.uint8)
    one = Submap.of_points(0, 0, np.eye(4), ground[::2], classes[::2], VOXEL)
    other = Submap.of_points(1, 0, np.eye(4), ground[1::2], classes[1::2], VOXEL)
    found = register(one, other, np.eye(4), 0.4, is_final=True)
    assert found is not None
    assert found.information[[2, 3, 4], [2, 3, 4]].max() < 1e-6 * found.information[5, 5]


def test_a_voxel_has_its_most_frequent_class_and_points_without_class_are_left_out() -> None:
    points = np.array([[0.01, 0.01, 0.01]] * 4 + [[0.11, 0.11, 0.11]] * 3 + [[0.9, 0.9, 0.9]] * 9)
    classes = np.array([2] * 4 + [1] * 3 + [0] * 9, np.uint8)
    found = Submap.of_points(0, 0, np.eye(4), points, classes, VOXEL)
    np.testing.assert_allclose(found.planes.points, [[0.01, 0.01, 0.01]])
    np.testing.assert_array_equal(found.planes.class_ids, [2])


@pytest.mark.parametrize("num_points", [0, 2])
def test_an_empty_submap_has_no_overlap(num_points: int) -> None:
    empty = Submap.of_points(0, 0, np.eye(4), np.zeros((num_points, 3)), np.ones(num_points, np.uint8), VOXEL)
    full = submap(FIRST, 1)
    assert overlapping_pairs([empty, full], np.array([np.eye(4), FIRST])) == []
    assert register(empty, full, np.eye(4), 1.0, is_final=False) is None


def test_pairs_are_those_with_common_cells() -> None:
    submaps = [submap(FIRST, 1), submap(SECOND, 2), submap(FIRST, 3)]
    poses = np.array([FIRST, SECOND, at(0, 0, 0, 100, 0, 1)])
    assert overlapping_pairs(submaps, poses) == [(0, 1)]


def test_the_derivatives_of_the_distances_are_those_of_finite_differences() -> None:
    first, second = submap(FIRST, 1), submap(SECOND, 2)
    guess = moved(TRUE[None], np.array([[0.0, 0.0, 0.01, 0.05, -0.02, 0.02]]))[0]
    _, jacobian = _both_residuals(first, second, guess, 0.5)
    for axis, step in enumerate(np.eye(6) * 1e-7):
        ahead, _ = _both_residuals(first, second, moved(guess[None], step[None])[0], 0.5)
        behind, _ = _both_residuals(first, second, moved(guess[None], -step[None])[0], 0.5)
        np.testing.assert_allclose((ahead - behind) / 2e-7, jacobian[:, axis], atol=1e-5)
