"""Poses between the maps of two robots: found, refused, and unchanged by the choice of frames."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import AcceptLimits, align_pair
from octoreplay.transforms import inverse
from support.block_worlds import NUM_CLASSES, RESOLUTION, BlockWorld, pose_error, upright_pose
from support.long_suite import examples, long, one_in

RADIUS = 9.0
CENTRES = ((-4.0, 0.0), (3.0, 2.0))


@functools.cache
def _view(robot, yaw, x, y, seed=1):
    return BlockWorld(seed).view(CENTRES[robot], RADIUS, upright_pose(yaw, x, y, 0.2))


def _aligned(first, second, **options):
    return align_pair([first, second], 0, 1, **options)


def test_the_true_pose_is_accepted():
    pair = _aligned(_view(0, 0.3, 4.0, -7.0), _view(1, -2.0, 11.0, 5.0))
    assert pair.is_accepted, pair.refusal
    T_true = inverse(upright_pose(0.3, 4.0, -7.0)) @ upright_pose(-2.0, 11.0, 5.0)
    shift, angle = pose_error(pair.T_first_second, T_true)
    assert shift < 0.2
    assert angle < 1.0
    assert pair.verification.obstacles.share_same > 0.95


@long
@given(st.floats(-math.pi, math.pi), st.floats(-40, 40), st.floats(-40, 40))
@examples(15)
def test_moving_a_frame_moves_the_pose(yaw, x, y):
    first = _view(0, 0.0, 0.0, 0.0)
    pair = _aligned(first, _view(1, yaw, x, y))
    assert pair.is_accepted, pair.refusal
    shift, angle = pose_error(pair.T_first_second @ inverse(upright_pose(yaw, x, y)), np.eye(4))
    assert shift < 0.3
    assert angle < 1.5


@long
def test_swapping_the_robots_inverts_the_pose():
    maps = [_view(0, 0.3, 4.0, -7.0), _view(1, -2.0, 11.0, 5.0)]
    forth, back = _aligned(*maps), _aligned(*reversed(maps))
    assert forth.is_accepted
    assert back.is_accepted
    shift, angle = pose_error(forth.T_first_second @ back.T_first_second, np.eye(4))
    assert shift < 0.1
    assert angle < 0.5
    assert forth.verification.score == pytest.approx(back.verification.score, rel=0.05)


@long
def test_other_worlds_are_refused():
    pair = _aligned(_view(0, 0.0, 0.0, 0.0), _view(1, 1.0, 2.0, 3.0, seed=7))
    assert not pair.is_accepted
    assert pair.refusal


@pytest.mark.parametrize("dof", one_in(2, [4, 6]))
def test_the_mirror_image_is_refused(dof):
    own = _view(0, 0.0, 0.0, 0.0)
    mirrored = OwnMap(own.states[::-1].copy(), own.low, own.resolution, own.num_classes)
    assert not _aligned(own, mirrored, dof=dof).is_accepted


def test_a_robot_upside_down_is_refused():
    turned = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    T = np.eye(4)
    T[:3, :3] = turned
    upside_down = BlockWorld(1).view(CENTRES[1], RADIUS, T)
    assert not _aligned(_view(0, 0.0, 0.0, 0.0), upside_down).is_accepted


@long
def test_a_world_that_repeats_itself_is_ambiguous():
    world = BlockWorld(1, num_blocks=0)
    # The same three blocks every 12 m, on ground of one class.
    shifts = np.array([(x, y, 0.0) for x in range(-24, 25, 12) for y in range(-24, 25, 12)])
    low = np.array([(0.0, 0.0, 0.0), (3.0, 1.0, 0.0), (5.0, 6.0, 0.0)])
    size = np.array([(2.0, 1.0, 2.0), (1.0, 3.0, 2.0), (1.5, 1.5, 2.5)])
    world.low = (low + shifts[:, None]).reshape(-1, 3)
    world.high = (low + size + shifts[:, None]).reshape(-1, 3)
    world.class_ids = np.tile([3, 4, 5], len(shifts))
    world.roads = np.full((3, 2), 1000.0)
    pair = _aligned(world.view((0.0, 0.0), 14.0, np.eye(4)), world.view((6.0, 0.0), 14.0, upright_pose(0.4, 2.0, 1.0)))
    assert not pair.is_accepted
    assert "another pose" in pair.refusal


def test_an_empty_map_is_refused():
    empty = OwnMap.of_cells(np.empty((0, 3), np.int64), np.empty(0, np.uint8), RESOLUTION, NUM_CLASSES)
    for maps in ((empty, _view(0, 0.0, 0.0, 0.0)), (_view(0, 0.0, 0.0, 0.0), empty), (empty, empty)):
        for dof in (4, 6):
            assert not _aligned(*maps, dof=dof).is_accepted


@long
def test_a_guess_is_verified_like_any_candidate():
    first, second = _view(0, 0.0, 0.0, 0.0), _view(1, -2.0, 11.0, 5.0)
    T_true = upright_pose(-2.0, 11.0, 5.0)
    right = _aligned(first, second, guesses=[T_true])
    wrong = _aligned(first, second, guesses=[upright_pose(1.0, 3.0, 3.0)])
    for pair in (right, wrong):
        assert pair.is_accepted
        assert pose_error(pair.T_first_second, T_true)[0] < 0.2


@long
@pytest.mark.parametrize(
    ("limits", "number"),
    [
        (AcceptLimits(min_score=1e6), "L "),
        (AcceptLimits(min_cells=10**6), "overlap"),
        (AcceptLimits(max_contra=-1.0), "q_c"),
        (AcceptLimits(max_tilt=-1.0), "tilt"),
    ],
)
def test_the_refusal_names_the_number_that_failed(limits, number):
    pair = _aligned(_view(0, 0.3, 4.0, -7.0), _view(1, -2.0, 11.0, 5.0), limits=limits)
    assert pair.refusal.startswith(number)


@long
def test_any_orientation_without_a_vertical_axis():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([2.0, -0.5, 1.0]).as_matrix()
    T[:3, 3] = 1.0, 2.0, 3.0
    world = BlockWorld(1)
    pair = _aligned(world.view(CENTRES[0], RADIUS, np.eye(4)), world.view(CENTRES[1], RADIUS, T), dof=6)
    assert pair.is_accepted, pair.refusal
    shift, angle = pose_error(pair.T_first_second, T)
    assert shift < 0.2
    assert angle < 1.0
