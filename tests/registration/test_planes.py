"""Planes around points, and the joint registration of a team's planes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.registration.joint import register_planes
from octoreplay.registration.planes import PlanePoints, plane_distances
from octoreplay.transforms import inverse
from support.block_worlds import pose_error
from support.long_suite import examples
from support.poses import pose_of

SPACING = 0.2
NOISE = 0.02


def _walls(seed, T_world_own=None, *, axes=(0, 1, 2), from_behind=False, shift=0.0):
    """Planes of some walls of a corner, each of a class, in a frame of their own, seen from inside or from behind."""
    T = np.eye(4) if T_world_own is None else T_world_own
    rng = np.random.default_rng(seed)
    lattice = np.stack(np.meshgrid(np.arange(0, 4, SPACING), np.arange(0, 4, SPACING)), axis=-1).reshape(-1, 2)
    points, views = [], []
    for axis in axes:
        across = rng.normal(shift, NOISE, len(lattice))
        points.append(np.insert(lattice + rng.uniform(0, SPACING, 2), axis, across, axis=1))
        views.append(np.tile(np.eye(3)[axis] * (-1 if from_behind else 1), (len(lattice), 1)))
    class_ids = np.repeat(np.array(axes) + 1, len(lattice)).astype(np.uint8)
    own = (np.concatenate(points) - T[:3, 3]) @ T[:3, :3]
    return PlanePoints.of_points(own, class_ids, SPACING, num_samples=3000, views=np.concatenate(views) @ T[:3, :3])


def test_normals_point_to_the_side_that_was_seen():
    front, back = _walls(0, axes=(2,)), _walls(0, axes=(2,), from_behind=True)
    assert front.is_flat.mean() > 0.9
    assert (front.normals[front.is_flat, 2] > 0.9).all()
    assert (back.normals[back.is_flat, 2] < -0.9).all()


def test_flat_points_are_nearer_to_the_surface_than_the_measured_ones():
    planes = _walls(0, axes=(2,))
    assert planes.points[planes.is_flat, 2].std() < 0.6 * NOISE


@pytest.mark.parametrize("from_behind", [False, True])
def test_the_other_side_of_a_thin_wall_does_not_correspond(from_behind):
    front, other = _walls(0, axes=(0,)), _walls(1, axes=(0,), from_behind=from_behind, shift=-0.1)
    found = plane_distances(other, front, np.eye(4), 0.3, least_cosine=0.9)
    assert (len(found.distances) == 0) == from_behind


def test_without_views_both_sides_correspond():
    front = _walls(0, axes=(0,))
    other = PlanePoints.of_points(front.points, front.class_ids, SPACING, num_samples=3000)
    assert not other.is_oriented
    assert len(plane_distances(other, front, np.eye(4), 0.3, least_cosine=0.9).distances) > 100


def test_other_classes_do_not_correspond():
    one, other = _walls(0, axes=(0,)), _walls(1, axes=(0,))
    other = PlanePoints.of_points(other.points, other.class_ids + np.uint8(1), SPACING, num_samples=3000)
    assert len(plane_distances(other, one, np.eye(4), 0.3, least_cosine=0.9).distances) == 0


def test_distances_are_those_along_the_normals():
    one, other = _walls(0, axes=(2,)), _walls(1, axes=(2,), shift=0.07)
    found = plane_distances(other, one, np.eye(4), 0.3, least_cosine=0.9)
    assert np.median(found.distances) == pytest.approx(0.07, abs=0.01)


TRUE = [pose_of((0.0, 0.0, 0.1 * n, 0.4 * n, 0.0, 0.2)) for n in range(4)]
small = st.tuples(*[st.floats(-0.015, 0.015)] * 3, *[st.floats(-0.1, 0.1)] * 3)


@given(errors=st.tuples(small, small, small))
@examples(10)
def test_known_poses_are_recovered(errors):
    planes = [_walls(seed, T) for seed, T in enumerate(TRUE)]
    guesses = [TRUE[0], *(T @ pose_of(error) for T, error in zip(TRUE[1:], errors, strict=True))]
    found = register_planes(planes, guesses)
    assert np.array_equal(found[0], guesses[0])
    for T, expected in zip(found, TRUE, strict=True):
        shift, angle = pose_error(T, expected)
        assert shift < 0.01
        assert angle < 0.25


def test_free_directions_stay_near_the_guess():
    planes = [_walls(seed, axes=(2,)) for seed in range(2)]
    guess = pose_of((0.0, 0.0, 0.0, 0.4, -0.3, 0.06))
    found = register_planes(planes, [np.eye(4), guess])[1]
    assert np.linalg.norm(found[:2, 3] - guess[:2, 3]) < SPACING / 2
    assert abs(found[2, 3]) < 0.01


def test_swapping_two_robots_inverts_the_pose():
    planes = [_walls(seed, T) for seed, T in enumerate(TRUE[:2])]
    guess = inverse(TRUE[0]) @ TRUE[1] @ pose_of((0.0, 0.005, 0.01, 0.05, 0.05, -0.05))
    forth = register_planes(planes, [np.eye(4), guess])[1]
    back = register_planes(planes[::-1], [np.eye(4), inverse(guess)])[1]
    np.testing.assert_allclose(forth @ back, np.eye(4), atol=2e-3)


def test_moving_all_frames_changes_nothing():
    planes = [_walls(seed, T) for seed, T in enumerate(TRUE)]
    guesses = [TRUE[0], *(T @ pose_of((0.0, 0.01, 0.01, 0.05, 0.0, -0.05)) for T in TRUE[1:])]
    move = pose_of((0.3, -0.2, 2.0, 5.0, -7.0, 3.0))
    found = register_planes(planes, guesses)
    for T, other in zip(found, register_planes(planes, [move @ T for T in guesses]), strict=True):
        np.testing.assert_allclose(inverse(move) @ other, T, atol=2e-3)


def test_empty_planes_and_planes_far_away_stay():
    nothing = PlanePoints.of_points(
        np.empty((0, 3)), np.empty(0, np.uint8), SPACING, num_samples=3000, views=np.empty((0, 3))
    )
    far = pose_of((0.0, 0.0, 0.0, 50.0, 0.0, 0.0))
    found = register_planes([_walls(0), nothing, _walls(1)], [np.eye(4), pose_of((0, 0, 1, 1, 2, 3)), far])
    np.testing.assert_allclose(found[1], pose_of((0, 0, 1, 1, 2, 3)), atol=1e-9)
    np.testing.assert_allclose(found[2], far, atol=1e-9)
