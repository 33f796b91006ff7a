"""Repair of drift from submaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from octoreplay.registration.drift import Correction, DriftModel, Repair, correction_of, repair_drift
from octoreplay.registration.rigid import moved, rotation_exps
from support.drifting_team import DriftingTeam, drifting_team
from support.long_suite import long

MODEL = DriftModel(percent=2.0, degrees=1.5, frame_shift=0.1, frame_angle=0.5)


@pytest.fixture(scope="module")
def team() -> DriftingTeam:
    return drifting_team()


@pytest.fixture(scope="module")
def repair(team: DriftingTeam) -> Repair:
    return repair_drift(team.submaps, team.tracks, MODEL)


def corrected_poses(team: DriftingTeam, repair: Repair) -> list[np.ndarray]:
    poses = []
    for robot, track in enumerate(team.tracks):
        correction = correction_of(robot, team.submaps, repair.poses)
        assert correction is not None
        poses.append(correction.corrected(track.stamps_ns, track.poses))
    return poses


@long
def test_drift_of_two_robots_is_repaired(team: DriftingTeam, repair: Repair) -> None:
    before = team.errors([track.poses for track in team.tracks])
    after = team.errors(corrected_poses(team, repair))
    assert before.mean() > 0.3
    assert after.mean() < 0.25 * before.mean()
    assert repair.groups == ((0, 1),)
    assert {team.submaps[e.first].robot != team.submaps[e.second].robot for e in repair.edges} == {True, False}


@long
def test_the_repair_moves_with_the_team_frame(team: DriftingTeam, repair: Repair) -> None:
    T_other = moved(np.eye(4)[None], np.array([[0.0, 0.0, 0.8, 20.0, -7.0, 2.0]]))[0]
    submaps = [replace(submap, T_team_anchor=T_other @ submap.T_team_anchor) for submap in team.submaps]
    tracks = [replace(track, poses=T_other @ track.poses) for track in team.tracks]
    there = repair_drift(submaps, tracks, MODEL)
    # The cells that decide on the overlap of submaps do not move with the frame.
    assert np.abs(there.poses - T_other @ repair.poses).max() < 0.1


@long
def test_poses_without_drift_stay() -> None:
    team = drifting_team(scale=0.0, turn=0.0)
    repair = repair_drift(team.submaps, team.tracks, MODEL)
    assert team.errors(corrected_poses(team, repair)).max() < 0.1


def test_one_robot_is_repaired_by_itself(team: DriftingTeam) -> None:
    own = [submap for submap in team.submaps if submap.robot == 0]
    repair = repair_drift(own, team.tracks[:1], MODEL)
    correction = correction_of(0, own, repair.poses)
    assert correction is not None
    after = correction.corrected(team.tracks[0].stamps_ns, team.tracks[0].poses)
    error = np.linalg.norm(after[:, :3, 3] - team.truth[0][:, :3, 3], axis=1)
    recorded = np.linalg.norm(team.tracks[0].poses[:, :3, 3] - team.truth[0][:, :3, 3], axis=1)
    assert repair.groups == ((0,),)
    assert error.mean() < 0.5 * recorded.mean()


def test_robots_far_apart_are_not_joined(team: DriftingTeam) -> None:
    far = np.eye(4)
    far[0, 3] = 500.0
    submaps = [
        replace(submap, T_team_anchor=far @ submap.T_team_anchor) if submap.robot == 1 else submap
        for submap in team.submaps
    ]
    tracks = [team.tracks[0], replace(team.tracks[1], poses=far @ team.tracks[1].poses)]
    assert repair_drift(submaps, tracks, MODEL).groups == ((0,), (1,))


def test_a_single_submap_stays(team: DriftingTeam) -> None:
    repair = repair_drift(team.submaps[:1], team.tracks[:1], MODEL)
    np.testing.assert_array_equal(repair.poses[0], team.submaps[0].T_team_anchor)
    assert (repair.edges, repair.groups) == ((), ())


def test_a_correction_is_exact_at_its_stamps_and_blended_between() -> None:
    turned = np.eye(4)
    turned[:3, :3] = rotation_exps(np.array([[0.0, 0.0, 0.2]]))[0]
    shifted = np.eye(4)
    shifted[0, 3] = 2.0
    correction = Correction(np.array([10, 20]), np.array([shifted, turned @ shifted]))
    poses = np.tile(np.eye(4), (5, 1, 1))
    corrected = correction.corrected(np.array([0, 10, 15, 20, 99]), poses)
    np.testing.assert_allclose(corrected[[0, 1]], [shifted, shifted])
    np.testing.assert_allclose(corrected[[3, 4]], [turned @ shifted, turned @ shifted], atol=1e-15)
    np.testing.assert_allclose(corrected[2, :3, 3], (corrected[1, :3, 3] + corrected[3, :3, 3]) / 2)
    np.testing.assert_allclose(corrected[2, :3, :3], rotation_exps(np.array([[0.0, 0.0, 0.1]]))[0])


def test_a_robot_without_submaps_has_no_correction(team: DriftingTeam, repair: Repair) -> None:
    assert correction_of(2, team.submaps, repair.poses) is None
