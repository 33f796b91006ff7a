"""Map frames of robots: the root of TF above the poses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.robot_log import RobotLog
from support.discovered_logs import START, run_of
from support.log_factory import IDENTITY, SECOND, Entry, robot_entries, ros2, write_mcap

TF = "tf2_msgs/msg/TFMessage"


def log_of(path, *edges, odometry="odom", num_frames=6, times=(0, 1, 2)):
    """Log of a robot with its odometry in a frame, and TF edges (parent, child, step of x) at some quarter seconds."""
    entries = robot_entries(num_frames=num_frames)
    for entry in entries:
        if entry.topic == "/odom":
            entry.value.header.frame_id = odometry
    for time, (parent, child, x, step) in itertools.product(times, edges):
        stamp = START + time * SECOND // 4
        tf = ros2.tf((parent, child, stamp, (x + time * step, 0, 0), IDENTITY))
        entries.append(Entry("/tf", TF, tf, stamp))
    return write_mcap(path, sorted(entries, key=lambda e: e.log_time_ns))


@pytest.mark.parametrize(
    ("edges", "name", "pose_frame", "is_corrected", "x"),
    [
        ([], "odom", "odom", False, None),
        ([("map", "odom", 5.0, 0.25)], "map", "odom", True, None),
        # Transforms that never change place the robot, also those of ROS 1 on /tf.
        ([("world", "odom", 5.0, 0.0)], "world", "odom", False, 5.0),
        ([("world", "r/map", 5.0, 0.0), ("r/map", "odom", 0.0, 0.25)], "world", "odom", True, 5.0),
        ([("map", "odom", 0.0, 0.0)], "map", "odom", False, 0.0),
        # The coordinates of an earth frame fit no map.
        ([("earth", "map", 6_371_000.0, 0.0), ("map", "odom", 5.0, 0.25)], "map", "odom", True, None),
        ([("utm", "odom", 450_000.0, 0.0)], "odom", "odom", False, None),
        # A frame with two parents, and a tree that runs through the body.
        ([("map", "odom", 5.0, 0.0), ("other", "odom", 5.0, 0.0)], "odom", "odom", False, None),
        ([("map", "base_link", 5.0, 0.1), ("base_link", "odom", 5.0, 0.1)], "odom", "odom", False, None),
        ([("odom", "x", 5.0, 0.1), ("x", "odom", 5.0, 0.1)], "odom", "odom", False, None),
    ],
)  # fmt: skip
def test_the_map_frame_is_the_root_above_the_poses(tmp_path, edges, name, pose_frame, is_corrected, x):
    path = log_of(tmp_path / "r.mcap", *edges)
    (robot,) = discover([path])
    frame = robot.frame
    assert (robot.map_frame, frame.name, frame.pose_frame, frame.is_corrected) == (name, name, pose_frame, is_corrected)
    assert (frame.place is None) == (x is None)
    if x is not None:
        assert np.reshape(frame.place, (4, 4))[0, 3] == x
    # A team file with the frame that was found gives the same robot.
    assert resolve(run_of(robot.to_config())).robots == (robot,)


def test_a_correction_is_used_by_default_and_can_be_turned_off(tmp_path):
    path = log_of(tmp_path / "r.mcap", ("map", "odom", 5.0, 1.0), times=range(6))

    def positions(**fields):
        config = resolve(run_of(RobotConfig("r", (path,), **fields)))
        with RobotLog(config.robots[0], config.time, config.classes) as log:
            return [frame.T_team_sensor[0, 3] for frame in log.frames()]

    assert positions() == pytest.approx([5.0 + 1.25 * i for i in range(6)])
    assert positions(map_frame="odom") == pytest.approx([0.25 * i for i in range(6)])


def test_a_correction_that_begins_late_is_found(tmp_path):
    """Localisation starts in the middle of the log, 20 s after its beginning."""
    path = log_of(tmp_path / "r.mcap", ("map", "odom", 5.0, 0.5), num_frames=160, times=range(80, 160, 4))
    (summary,) = describe([path]).robots
    assert summary.missing == ()
    assert summary.robot.map_frame == "map"
    assert summary.notes == ("map_frame: poses in odom, corrected by TF; map_frame: odom leaves these transforms out",)
    config = resolve(run_of(RobotConfig("r", (path,))))
    with RobotLog(config.robots[0], config.time, config.classes) as log:
        frames = list(log.frames())
    assert len(frames) == 160
    # The first correction, of time 80, applies from the beginning.
    assert frames[0].T_team_sensor[0, 3] == pytest.approx(45.0)
    assert frames[100].T_team_sensor[0, 3] == pytest.approx(5.0 + 50.0 + 25.0)
