"""Joint registration of several surfaces."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.registration.icp import Surface, icp
from octoreplay.registration.joint import register_together
from octoreplay.transforms import inverse
from support.block_worlds import pose_error
from support.long_suite import examples
from support.poses import pose_of

SPACING = 0.2
GATES = (1.0, 0.5, 0.25)


def _corner(seed, T_world_own, num_points=400, walls=(0, 1, 2)):
    """Surface of some of the walls of a corner, each with a class, in a frame of its own."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 4, (len(walls), num_points, 3))
    for axis, wall in zip(walls, points, strict=True):
        wall[:, axis] = 0.0
    own = (points.reshape(-1, 3) - T_world_own[:3, 3]) @ T_world_own[:3, :3]
    codes = np.repeat(np.array(walls) + 1, num_points)
    return Surface.of_points(own, codes, np.ones(len(own)), spacing=SPACING, radius=3.5 * SPACING)


TRUE = [pose_of((0.0, 0.0, 0.1 * n, 0.4 * n, 0.0, 0.2)) for n in range(4)]
small = st.tuples(*[st.floats(-0.05, 0.05)] * 3, *[st.floats(-0.2, 0.2)] * 3)


@given(errors=st.tuples(small, small, small))
@examples(10)
def test_known_poses_are_recovered(errors):
    surfaces = [_corner(seed, T) for seed, T in enumerate(TRUE)]
    guesses = [TRUE[0], *(T @ pose_of(error) for T, error in zip(TRUE[1:], errors, strict=True))]
    found = register_together(surfaces, guesses, gates=GATES)
    assert np.array_equal(found[0], guesses[0])
    for T, expected in zip(found, TRUE, strict=True):
        shift, angle = pose_error(T, expected)
        assert shift < 0.03
        assert angle < 0.6


def test_every_overlap_counts():
    """The third surface shares one wall with the first one, and a second wall with the second one alone."""
    first, second, third = (_corner(seed, T) for seed, T in enumerate(TRUE[:3]))
    own = np.where(second.codes == 2, 9, second.codes), np.where(third.codes == 2, 9, third.codes)
    second = replace(second, codes=own[0])
    third = replace(third, codes=own[1]).subset(third.codes != 3)
    guess = TRUE[2] @ pose_of((0.0, 0.0, 0.0, 0.0, 0.15, 0.0))
    alone = icp(third, first, guess, gates=GATES).T_target_source
    together = register_together([first, second, third], [TRUE[0], TRUE[1], guess], gates=GATES)[2]
    errors = [abs(float((inverse(TRUE[2]) @ T)[1, 3])) for T in (alone, together)]
    assert errors[1] < 0.7 * errors[0]


def test_two_surfaces_are_registered_as_by_icp():
    target, source = _corner(0, TRUE[0]), _corner(1, TRUE[1])
    guess = TRUE[1] @ pose_of((0.02, 0.0, 0.03, 0.1, -0.1, 0.05))
    expected = icp(source, target, guess, gates=GATES).T_target_source
    shift, angle = pose_error(register_together([target, source], [np.eye(4), guess], gates=GATES)[1], expected)
    assert shift < 2e-3
    assert angle < 0.1


def test_moving_all_frames_changes_nothing():
    surfaces = [_corner(seed, T) for seed, T in enumerate(TRUE)]
    guesses = [TRUE[0], *(T @ pose_of((0.0, 0.02, 0.02, 0.1, 0.0, -0.1)) for T in TRUE[1:])]
    move = pose_of((0.3, -0.2, 2.0, 5.0, -7.0, 3.0))
    found = register_together(surfaces, guesses, gates=GATES)
    moved = register_together(surfaces, [move @ T for T in guesses], gates=GATES)
    for T, other in zip(found, moved, strict=True):
        shift, angle = pose_error(inverse(move) @ other, T)
        assert shift < 2e-3
        assert angle < 0.1


def test_the_tilt_prior_keeps_vertical_axes_parallel():
    # A floor alone leaves the directions along it free, and noise tilts it.
    surfaces = [_corner(seed, T, walls=(2,), num_points=60) for seed, T in enumerate(TRUE)]
    tilted = [TRUE[0], *(T @ pose_of((0.04, 0.0, 0.0, 0.0, 0.0, 0.1)) for T in TRUE[1:])]
    for T in register_together(surfaces, tilted, gates=GATES, tilt_sigma=math.radians(0.01))[1:]:
        assert math.degrees(math.acos(min(1.0, T[2, 2]))) < 0.3


def test_surfaces_without_correspondences_stay():
    surfaces = [_corner(0, TRUE[0]), _corner(1, TRUE[1])]
    far = pose_of((0.0, 0.0, 0.0, 50.0, 0.0, 0.0))
    found = register_together(surfaces, [np.eye(4), far], gates=GATES)
    assert np.allclose(found[1], far)
