"""Frames of a team from the poses of pairs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import AcceptLimits, PairAlignment
from octoreplay.registration.team import align_team, join_pairs
from octoreplay.registration.verify import CellCounts, Verification
from octoreplay.transforms import inverse
from support.block_worlds import BlockWorld, pose_error, upright_pose
from support.long_suite import long

FRAMES = [
    upright_pose(0.0, 0.0, 0.0),
    upright_pose(1.0, 5.0, 2.0),
    upright_pose(-2.0, -3.0, 4.0),
    upright_pose(2.5, 1.0, 9.0),
]


def _empty_maps(num):
    return [OwnMap.of_cells(np.empty((0, 3), np.int64), np.empty(0, np.uint8), 0.3, 2) for _ in range(num)]


def _pair(first, second, score, *, T=None, refusal=""):
    pose = inverse(FRAMES[first]) @ FRAMES[second] if T is None else T
    agreement = Verification(CellCounts(500, 0, 0), CellCounts(0, 0, 0), 1.0, score, 0.3)
    return PairAlignment(first, second, pose, np.eye(6), agreement, refusal)


def _joined(num, pairs):
    return join_pairs(_empty_maps(num), pairs, AcceptLimits())


def test_a_chain_gives_every_robot_its_pose():
    team = _joined(4, [_pair(0, 1, 500), _pair(1, 2, 400), _pair(2, 3, 300)])
    assert team.components == ((0, 1, 2, 3),)
    assert team.parents == (None, 0, 1, 2)
    for T, frame in zip(team.T_component_map, FRAMES, strict=True):
        assert np.allclose(T, inverse(FRAMES[0]) @ frame)


def test_refused_pairs_join_nothing():
    team = _joined(4, [_pair(0, 1, 500), _pair(1, 2, 400, refusal="L"), _pair(2, 3, 300)])
    assert team.components == ((0, 1), (2, 3))
    assert team.parents == (None, 0, None, 2)
    assert np.allclose(team.T_component_map[3], inverse(FRAMES[2]) @ FRAMES[3])


def test_the_largest_component_comes_first_and_robots_alone_are_components():
    team = _joined(4, [_pair(1, 2, 500), _pair(2, 3, 500)])
    assert team.components == ((1, 2, 3), (0,))
    assert np.allclose(team.T_component_map[0], np.eye(4))


def test_a_pair_that_contradicts_better_ones_is_refused():
    wrong = FRAMES[2] @ upright_pose(0.5, 3.0, 0.0)
    team = _joined(3, [_pair(0, 1, 500), _pair(1, 2, 400), _pair(0, 2, 300, T=wrong)])
    assert team.components == ((0, 1, 2),)
    assert [pair.is_accepted for pair in team.pairs] == [True, True, False]
    assert "chain" in team.pairs[2].refusal


def test_the_order_of_the_pairs_does_not_matter():
    pairs = [_pair(0, 1, 500), _pair(1, 2, 400), _pair(0, 2, 450), _pair(2, 3, 300)]
    team, other = _joined(4, pairs), _joined(4, pairs[::-1])
    assert team.components == other.components
    assert team.parents == other.parents
    assert np.allclose(team.T_component_map, other.T_component_map)


@pytest.fixture(scope="module")
def three_maps():
    world = BlockWorld(3)
    centres = ((-3.0, -2.0), (3.0, -2.0), (0.0, 4.0))
    return [world.view(np.array(centre), 9.0, frame) for centre, frame in zip(centres, FRAMES, strict=False)]


def test_maps_give_the_frames_of_the_team(three_maps):
    team = align_team(three_maps)
    assert team.components == ((0, 1, 2),)
    for T, frame in zip(team.T_component_map, FRAMES, strict=False):
        shift, angle = pose_error(T, inverse(FRAMES[0]) @ frame)
        assert shift < 0.25
        assert angle < 1.0


@long
def test_components_that_contradict_each_other_are_not_joined(three_maps):
    """A pair's pose that puts a third robot's map into free space of another one is refused."""
    team = align_team(three_maps)
    by_robots = {(pair.first, pair.second): pair for pair in team.pairs}
    moved = by_robots[0, 1].T_first_second @ upright_pose(0.0, 2.0, 1.0)
    wrong = dataclasses.replace(by_robots[0, 1], T_first_second=moved)
    joined = join_pairs(three_maps, [wrong], AcceptLimits())
    assert joined.components == ((0,), (1,), (2,))
    assert "contradict" in joined.pairs[0].refusal
