"""Body boxes of other robots in maps."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.run import RunConfig
from octoreplay.io.robots.read_ahead import ReadAhead
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.team_bodies import TeamBodies
from octoreplay.records import ClassTable, SemanticClass
from octoreplay.replay.run import replay_team
from octoreplay.replay.session import Session
from support.interrupted import resumed
from support.log_factory import robot_entries, write_mcap
from support.long_suite import long

CLASSES = ClassTable((SemanticClass(1, "occupied", (1, 2, 3), ()),))


def robot_of(tmp_path, name, **fields):
    """Robot that drives along x with a wall 1 m in front of its camera in every image."""
    path = write_mcap(tmp_path / f"{name}.mcap", robot_entries(num_frames=10, labels=False))
    return ResolvedRobot(
        name, (path,), depth_topic="/camera/depth/image_raw", camera_info_topic="/camera/depth/camera_info",
        pose_topic="/odom", label_topic="", **fields,
    )  # fmt: skip


@pytest.fixture
def config(tmp_path):
    """Team in which robot b drives 1 m in front of robot a: a observes b, and b observes a wall."""
    robots = (
        robot_of(tmp_path, "a"),
        robot_of(
            tmp_path, "b", T_team_map=(1.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), body_box=(-0.4, -0.6, 0.0, 0.4, 0.6, 1.0)
        ),
    )
    return RunConfig(robots, classes=CLASSES).with_parameters({"rule": "local", "resolution": 0.1})


def num_occupied(config, *, hides):
    """Return the number of occupied leaves of each robot's last map."""
    with ExitStack() as stack:
        logs = [stack.enter_context(RobotLog(robot, config.time, CLASSES)) for robot in config.robots]
        sources = [stack.enter_context(ReadAhead(log)) for log in logs]
        bodies = stack.enter_context(TeamBodies(config.robots, config.time)) if hides else None
        *_, last = Session(config, sources, ThreadPoolExecutor(2), bodies=bodies).ticks()
        return [int(np.count_nonzero(octree.leaves(0.0).log_odds[:, 0] > 0)) for octree in last.maps]


def test_body_boxes_of_other_robots_are_not_mapped(config):
    seen, hidden = num_occupied(config, hides=False), num_occupied(config, hides=True)
    assert seen[0] > 10
    # Robot b frees the cells that it drives through, and its body box hides nothing from itself.
    assert hidden[0] == 0
    assert hidden[1] == seen[1] > 10


def test_hide_robots_changes_the_map_of_the_robot_behind(config):
    volumes = {}
    for hides in (False, True):
        summary = replay_team(config.with_parameters({"hide_robots": hides}), None)
        volumes[hides] = [robot.entropy_bits for robot in summary.last.robots]
    assert volumes[True][0] != volumes[False][0]
    assert volumes[True][1] == volumes[False][1]


@long
def test_a_resumed_run_with_hidden_robots_ends_with_the_same_bytes(config, tmp_path):
    team = config.with_parameters({"hide_robots": True, "publish_period": 0.2})
    replay_team(team, tmp_path / "whole.mcap")
    resumed(team, tmp_path / "resumed.mcap", 1, 3)
    assert (tmp_path / "resumed.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()
