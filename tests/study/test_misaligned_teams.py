"""Teams with wrong frames: the errors of the frames, and an experiment on a small team."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.team_file import load_team_file
from octoreplay.records import Float64Array
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study.experiments import run_experiment
from octoreplay.study.misaligned_teams import CASES, ITSELF, ONE, OTHERS, MisalignedTeam
from octoreplay.study.questions import misalignment
from octoreplay.transforms import inverse, pose_difference, pose_matrix, transform_of
from support.long_suite import examples

ROBOTS = ("husky_1", "husky_2", "husky_3")


def true_frames(seed: int) -> dict[str, Float64Array]:
    """Random frames of three robots."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(3, 4))
    return {
        robot_id: pose_matrix(rng.uniform(-20.0, 20.0, 3).tolist(), (quaternion / np.linalg.norm(quaternion)).tolist())
        for robot_id, quaternion in zip(ROBOTS, quaternions, strict=True)
    }


def team(case: str, shift: float, angle: float, seed: int = 0) -> MisalignedTeam:
    """Three robots with wrong frames."""
    return MisalignedTeam(SimulationConfig(num_robots=3, seed=seed, own_frames=True), case, shift, angle)


@examples(50)
@given(st.integers(0, 1000), st.floats(0.0, 3.0), st.floats(0.0, 90.0))
def test_wrong_frames_have_an_error_of_the_given_size(seed: int, shift: float, angle: float) -> None:
    true = true_frames(seed)
    for case in CASES:
        wrong = team(case, shift, angle, seed)
        frames = wrong.frames(true)
        assert list(frames) == list(ROBOTS)
        for robot_id in wrong.judged:
            np.testing.assert_array_equal(frames[robot_id], true[robot_id])
        (own, *_), others = wrong.judged, [robot_id for robot_id in ROBOTS if robot_id not in wrong.judged]
        assert others
        for other in others:
            # The error of a frame is that between a right robot and a wrong one.
            pair = (own, other) if case != ITSELF else (other, own)
            given_pose, true_pose = (inverse(found[pair[0]]) @ found[pair[1]] for found in (frames, true))
            distance, turn = pose_difference(true_pose, given_pose)
            assert distance == pytest.approx(shift, abs=1e-9)
            assert turn == pytest.approx(math.radians(angle), abs=1e-6)
            # The wrong frame turns about its own vertical axis and stays level.
            error = inverse(true_pose) @ given_pose
            np.testing.assert_allclose(error[2], [0.0, 0.0, 1.0, 0.0], atol=1e-9)


def test_one_wrong_frame_is_the_same_error_in_the_frame_of_either_side() -> None:
    true = true_frames(4)
    seen_by_others, seen_by_itself = team(ONE, 0.7, 8.0).frames(true), team(ITSELF, 0.7, 8.0).frames(true)
    for first, second in itertools.permutations(ROBOTS, 2):
        here, there = (inverse(found[first]) @ found[second] for found in (seen_by_others, seen_by_itself))
        np.testing.assert_allclose(here, there, atol=1e-9)
    np.testing.assert_array_equal(seen_by_itself["husky_1"], true["husky_1"])
    assert team(ONE, 0.0, 0.0).judged == ROBOTS[1:]
    assert team(ITSELF, 0.0, 0.0).judged == team(OTHERS, 0.0, 0.0).judged == ROBOTS[:1]


def test_errors_of_other_robots_differ_and_larger_ones_have_the_same_direction() -> None:
    true = {robot_id: np.eye(4) for robot_id in ROBOTS}
    small, large = team(OTHERS, 0.1, 0.0).frames(true), team(OTHERS, 2.0, 0.0).frames(true)
    for robot_id in ROBOTS[1:]:
        np.testing.assert_allclose(20.0 * small[robot_id][:3, 3], large[robot_id][:3, 3], atol=1e-12)
    assert np.linalg.norm(large["husky_2"][:3, 3] - large["husky_3"][:3, 3]) > 0.1
    other_village = team(OTHERS, 2.0, 0.0, seed=1).frames(true)
    assert np.linalg.norm(large["husky_2"][:3, 3] - other_village["husky_2"][:3, 3]) > 0.1


@pytest.mark.long
def test_a_wrong_frame_makes_an_exchanged_map_worse(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    question = misalignment.experiment(6.0, 1)
    labels = ("shift_0_0_0", "shift_2_0_0", "shift_0_1_0", "shift_2_1_0")
    plan = dataclasses.replace(question.plans[0], teams=labels)
    rows = run_experiment(
        dataclasses.replace(question, teams={label: question.teams[label] for label in labels}, plans=(plan,)), tmp_path
    )["shifts"]
    assert [(row["frames"], row["shift"], row["angle"]) for row in rows] == [
        (ONE, 0.0, 0.0), (ONE, 2.0, 0.0), (ITSELF, 0.0, 0.0), (ITSELF, 2.0, 0.0),
    ]  # fmt: skip
    right, wrong, right_itself, itself = rows
    for row in rows:
        for region in ("whole", "own"):
            gain = row[f"{region}_together"] - row[f"{region}_alone"]
            assert row[f"{region}_gain"] == pytest.approx(gain, abs=1e-6)
    # Maps without exchange, and the cells that are counted, do not depend on the frames.
    assert right["whole_alone"] == wrong["whole_alone"]
    assert right["own_alone"] == wrong["own_alone"]
    assert right["whole_gain"] > 0.1
    assert wrong["whole_gain"] < right["whole_gain"]
    assert right_itself["own_alone"] == itself["own_alone"]
    assert itself["own_gain"] < right_itself["own_gain"]
    # The team file beside the logs has the wrong frame of one robot only.
    (folder,) = (tmp_path / "teams").iterdir()
    frames = [
        [transform_of(robot.T_team_map or ()) for robot in load_team_file(folder / f"{label}.yaml").robots]
        for label in labels[:2]
    ]
    shifts = [pose_difference(one, other)[0] for one, other in zip(*frames, strict=True)]
    assert shifts == pytest.approx([2.0, 0.0, 0.0, 0.0], abs=1e-6)
