"""Places of robots in their team: chains of pairs, covariances, surveyed poses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octoreplay.registration.covariance import chained_frames
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.placing import place_robots
from octoreplay.registration.team import TeamAlignment
from octoreplay.registration.verify import verify
from octoreplay.transforms import inverse, pose_difference
from support.long_suite import long
from support.village_maps import T_village_map, empty_map, village_map


def pose(x=0.0, y=0.0, z=0.0, rotation=(0.0, 0.0, 0.0)):
    """Pose (4, 4) of a position [m] and a rotation vector [rad]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), (x, y, z)
    return T


def chain(poses, *, information=None, groups=None):
    """Alignment of robots with these poses, in which each is joined to the one before it in its group."""
    groups = groups or (tuple(range(len(poses))),)
    information = np.eye(6) if information is None else information
    nothing = verify(empty_map(), empty_map(), np.eye(4))
    pairs, parents, in_component = [], [None] * len(poses), list(poses)
    for group in groups:
        for i, j in itertools.pairwise(group):
            pairs.append(PairAlignment(i, j, inverse(poses[i]) @ poses[j], information, nothing, ""))
            parents[j] = i
        for index in group:
            in_component[index] = inverse(poses[group[0]]) @ poses[index]
    return TeamAlignment(tuple(pairs), groups, tuple(in_component), tuple(parents))


POSES = (pose(1, 2, 0), pose(6, 1, 0.5, (0, 0, 0.8)), pose(4, -7, 0.2, (0.02, 0.01, -2.0)))
INFORMATION = np.linalg.inv(np.diag([1e-4, 2e-4, 9e-4, 0.02, 0.01, 0.005]))


def moved(T, motion):
    """Pose after a small motion (rotation, translation) on its left."""
    return pose(*motion[3:], rotation=motion[:3]) @ T


@pytest.mark.parametrize("root", [0, 2])
def test_covariances_along_a_chain_are_those_of_sampled_errors(root):
    alignment = chain(POSES, information=INFORMATION)
    end = 2 - root
    frame = chained_frames(alignment, [root])[end]
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(800):
        motions = rng.multivariate_normal(np.zeros(6), np.linalg.inv(INFORMATION), size=2)
        first, second = (moved(p.T_first_second, m) for p, m in zip(alignment.pairs, motions, strict=True))
        T = first @ second if root == 0 else inverse(first @ second)
        rotation = Rotation.from_matrix(T[:3, :3] @ frame.T_root_map[:3, :3].T).as_rotvec()
        errors.append([*rotation, *(T[:3, 3] - frame.T_root_map[:3, 3])])
    sampled = np.cov(np.array(errors).T)
    assert np.sqrt(np.diag(frame.covariance)) == pytest.approx(np.sqrt(np.diag(sampled)), rel=0.12)
    assert frame.partner == 1
    assert pose_difference(frame.T_root_map, inverse(POSES[root]) @ POSES[end]) == pytest.approx((0, 0), abs=1e-6)


def test_a_direction_without_information_has_a_large_deviation():
    alignment = chain(POSES[:2], information=np.zeros((6, 6)))
    assert chained_frames(alignment, [0])[1].covariance[5, 5] >= 1e6 - 1


def test_without_survey_the_first_robot_of_a_component_gives_the_frame():
    alignment = chain((*POSES, pose(50), pose(52)), groups=((0, 1, 2), (3, 4)))
    placement = place_robots([empty_map()] * 5, alignment, {})
    assert [[robot.index for robot in team] for team in placement.teams] == [[0, 1, 2], [3, 4]]
    first, second = placement.teams
    assert first[2].T_team_map == pytest.approx(inverse(POSES[0]) @ POSES[2])
    assert second[1].T_team_map == pytest.approx(pose(2))
    assert (first[0].partner, first[2].partner, second[0].anchor) == (None, 1, 3)


def test_a_surveyed_pose_places_its_component_and_joins_components():
    alignment = chain((*POSES, pose(50)), groups=((0, 1, 2), (3,)))
    survey = {1: pose(10) @ POSES[1], 3: pose(10) @ pose(50)}
    (team,) = place_robots([empty_map()] * 4, alignment, survey).teams
    for robot, T in zip(team, (*POSES, pose(50)), strict=True):
        assert robot.T_team_map == pytest.approx(pose(10) @ T)
    assert [robot.anchor for robot in team] == [1, 1, 1, 3]


@pytest.mark.parametrize(("shift", "outcome"), [(0.1, "kept"), (0.8, "replaced"), (3.0, "refused")])
def test_a_second_surveyed_pose_is_kept_replaced_or_refused_by_its_distance(shift, outcome):
    survey = {0: POSES[0], 1: POSES[1], 2: pose(shift) @ POSES[2]}
    placement = place_robots([empty_map()] * 3, chain(POSES, information=np.diag([1e6] * 3 + [1e2] * 3)), survey)
    third = placement.teams[0][2]
    expected = survey[2] if outcome == "kept" else POSES[2]
    assert pose_difference(third.T_team_map, expected)[0] < 1e-6
    assert (third.partner is None) == (outcome == "kept")
    assert [(r.index, round(r.shift, 3)) for r in placement.refusals] == ([(2, 3.0)] if outcome == "refused" else [])


def test_the_surveyed_pose_that_most_others_confirm_places_the_team():
    survey = {0: pose(5) @ POSES[0], 1: POSES[1], 2: POSES[2]}
    placement = place_robots([empty_map()] * 3, chain(POSES), survey)
    assert [refusal.index for refusal in placement.refusals] == [0]
    assert pose_difference(placement.teams[0][0].T_team_map, POSES[0])[0] < 1e-6


@long
def test_a_component_whose_survey_contradicts_the_maps_is_a_team_of_its_own():
    center, radius = (-2.0, 0.0), 13.0
    maps = [village_map(center, radius), village_map(center, radius)]
    alignment = chain((np.eye(4), np.eye(4)), groups=((0,), (1,)))
    right = {index: T_village_map(center) for index in (0, 1)}
    assert len(place_robots(maps, alignment, right).teams) == 1
    wrong = place_robots(maps, alignment, right | {1: pose(1.5, rotation=(0, 0, 0.5)) @ right[1]})
    assert len(wrong.teams) == 2
    (refusal,) = wrong.refusals
    assert (refusal.index, refusal.other) == (1, 0)
    assert refusal.share_contra is not None
    assert refusal.share_contra > 0.1
