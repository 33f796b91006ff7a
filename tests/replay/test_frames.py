"""Frames of a team's robots and their components."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.resolved import MapFrame, ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.records import ClassTable, SemanticClass
from octoreplay.replay.frames import TeamFrames, without_computed_frames
from octoreplay.transforms import inverse, pose_matrix, transform_of

CLASSES = ClassTable((SemanticClass(1, "thing", (1, 2, 3), (1,)),))
T_0_1 = pose_matrix((1.0, 2.0, 0.0), (0.0, 0.0, 1.0, 0.0))
T_2_3 = pose_matrix((0.0, 0.0, 3.0), (0.0, 0.0, 0.6, 0.8))
T_1_2 = pose_matrix((-4.0, 0.5, 0.0), (0.0, 0.0, 0.8, 0.6))


def team(placed=None, frames=(), **keys) -> ResolvedRun:
    robots = [
        ResolvedRobot.from_config(
            RobotConfig(f"r{i}", (Path(f"log_{i}.mcap"),), depth_topic="/depth", pose_topic="/odom",
                        T_team_map=(placed or {}).get(i), **(keys if i in (placed or {}) else {})),
            None, MapFrame(frames[i]) if frames else None,
        )
        for i in range(4)
    ]  # fmt: skip
    return ResolvedRun.from_config(RunConfig(tuple(robots)), robots, CLASSES)


def test_robots_begin_in_their_own_frames():
    frames = TeamFrames(team(frames=["odom"] * 4))
    assert frames.components == ((0,), (1,), (2,), (3,))
    assert [frames.frame_id(i) for i in range(4)] == ["r0/map", "r1/map", "r2/map", "r3/map"]
    np.testing.assert_array_equal(frames.in_one_frame, np.eye(4, dtype=bool))


def test_robots_that_the_logs_relate_begin_in_one_frame():
    frames = TeamFrames(team(frames=["odom", "map", "odom", "map"]))
    assert frames.components == ((1, 3), (0,), (2,))
    assert frames.frame_id(3) == "r1/map"


def test_poses_chain_and_the_smaller_component_changes_its_frame():
    frames = TeamFrames(team())
    assert frames.join(0, 1, T_0_1) == (1,)
    assert frames.join(2, 3, T_2_3) == (3,)
    # Of two components of equal size that with the first robot keeps its frame.
    assert frames.join(1, 2, inverse(T_0_1) @ T_0_1 @ T_1_2) == (2, 3)
    assert frames.components == ((0, 1, 2, 3),)
    np.testing.assert_allclose(transform_of(frames.T_frame_map(3)), T_1_2 @ T_2_3, atol=1e-12)


def test_a_pair_joins_in_either_direction():
    one, other = TeamFrames(team()), TeamFrames(team())
    one.join(0, 1, T_0_1)
    other.join(1, 0, inverse(T_0_1))
    np.testing.assert_allclose(one.T_frame_map(1), other.T_frame_map(1), atol=1e-12)
    assert one.components == other.components


def test_the_frame_of_given_poses_is_kept_by_a_smaller_component():
    frames = TeamFrames(team(placed={3: (1.0, 0, 0, 0, 0, 0, 1.0)}))
    assert frames.frame_id(3) == "team"
    frames.join(0, 1, T_0_1)
    assert frames.join(0, 3, T_1_2) == (0, 1)
    assert {place.frame_id for place in frames.places} == {"team", "r2/map"}
    np.testing.assert_allclose(transform_of(frames.T_frame_map(0)), inverse(T_1_2), atol=1e-12)


@pytest.mark.parametrize(("origin", "num"), [(None, 2), ("aligned with r0, L 400", 0)])
def test_computed_frames_are_found_again(origin, num):
    keys = {} if origin is None else {"T_team_map_from": origin}
    config = without_computed_frames(team({0: (0, 0, 0, 0, 0, 0, 1.0), 1: (1.0, 0, 0, 0, 0, 0, 1.0)}, **keys))
    assert sum(robot.T_team_map is not None for robot in config.robots) == num
