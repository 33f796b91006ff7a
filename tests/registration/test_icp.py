"""Refinement of poses between labelled surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from octoreplay.registration.icp import Surface, icp
from octoreplay.transforms import inverse
from support.block_worlds import pose_error
from support.long_suite import examples

SPACING = 0.2


def _corner(seed=0):
    """Points on three walls of a corner, with a class for each wall."""
    rng = np.random.default_rng(seed)
    points, codes = [], []
    for axis in range(3):
        wall = rng.uniform(0, 4, (400, 3))
        wall[:, axis] = 0.0
        points.append(wall)
        codes.append(np.full(400, axis + 1))
    return np.concatenate(points), np.concatenate(codes)


def _surface(points, codes):
    return Surface.of_points(points, codes, np.ones(len(points)), spacing=SPACING, radius=3.5 * SPACING)


def _small_pose(numbers):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(numbers[:3]).as_matrix()
    T[:3, 3] = numbers[3:]
    return T


@given(st.tuples(*[st.floats(-0.08, 0.08)] * 3, *[st.floats(-0.3, 0.3)] * 3))
@examples(25)
def test_a_known_motion_is_recovered(numbers):
    points, codes = _corner()
    T_true = _small_pose(numbers)
    # The source samples the same walls at other places.
    others, other_codes = _corner(1)
    source = (others - T_true[:3, 3]) @ T_true[:3, :3]
    found = icp(_surface(source, other_codes), _surface(points, codes), np.eye(4), gates=[1.0, 0.5, 0.25])
    shift, angle = pose_error(found.T_target_source, T_true)
    assert shift < 0.03
    assert angle < 0.6
    assert found.num_correspondences > 800


def test_points_of_other_codes_do_not_correspond():
    points, codes = _corner()
    found = icp(_surface(points, codes + 10), _surface(points, codes), np.eye(4), gates=[1.0])
    assert found.num_correspondences == 0
    assert np.array_equal(found.T_target_source, np.eye(4))
    assert not found.information.any()


def test_a_plane_leaves_its_own_directions_free():
    points, codes = _corner()
    floor = codes == 3
    found = icp(_surface(points[floor], codes[floor]), _surface(points[floor], codes[floor]), np.eye(4), gates=[0.5])
    information = np.diag(found.information)
    # Motions: rotations about x, y, z, then shifts along x, y, z.
    assert information[5] > 50 * information[3]
    assert information[5] > 50 * information[4]


def test_the_tilt_prior_keeps_vertical_axes_parallel():
    points, codes = _corner()
    tilted = _small_pose((0.05, 0.0, 0.0, 0.0, 0.0, 0.0))
    source = _surface((points - tilted[:3, 3]) @ tilted[:3, :3], codes)
    free = icp(source, _surface(points, codes), np.eye(4), gates=[0.5])
    held = icp(source, _surface(points, codes), np.eye(4), gates=[0.5], tilt_sigma=1e-5)
    assert pose_error(free.T_target_source, tilted)[1] < 0.3
    assert held.T_target_source[2, 2] == pytest.approx(1.0, abs=1e-4)


def test_the_information_is_about_the_origin_of_the_target():
    """Moving the target's frame changes the information by the adjoint of the motion."""
    points, codes = _corner()
    shift = np.array([30.0, -20.0, 5.0])
    here = icp(_surface(points, codes), _surface(points, codes), np.eye(4), gates=[0.5])
    T = np.eye(4)
    T[:3, 3] = shift
    there = icp(_surface(points, codes), _surface(points + shift, codes), T, gates=[0.5])
    x, y, z = shift
    adjoint = np.eye(6)
    adjoint[3:, :3] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    assert np.allclose(there.information, adjoint.T @ here.information @ adjoint, rtol=1e-3)
    assert np.allclose(inverse(T) @ there.T_target_source, np.eye(4), atol=1e-3)
