"""Public recordings from the file to the map, and files that are not logs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.logs import open_log
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.robots.pose_frames import find_map_frame
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.survey import survey_log
from octoreplay.io.robots.trajectories import read_rows, trajectory
from support.log_factory import SECOND
from support.recordings import RECORDINGS, needs_recordings
from support.scan_maps import octree_of

pytestmark = needs_recordings

LOGS = (".mcap", ".bag", ".db3")


def test_other_files_are_refused_as_logs():
    others = [path for path in sorted(RECORDINGS.rglob("*")) if path.is_file() and path.suffix not in LOGS]
    assert len(others) > 300
    for path in others:
        with pytest.raises(InputError, match=r"not a log|the file is empty"):
            open_log(path)


def test_every_log_can_be_described_or_is_refused_in_one_sentence():
    logs = [path for path in sorted(RECORDINGS.rglob("*")) if path.is_file() and path.suffix in LOGS]
    refused = [path for path in logs if describe([path]).logs[0].error is not None]
    assert [path.name for path in refused] == ["foxglove_empty-file.bag"]


def frames_of(path: Path, **fields):
    """Frames of a recording with one robot; ``fields`` gives the topics that are not found."""
    robots = (RobotConfig("r", (path,), **fields),) if fields else discover([path])
    config = resolve(RunConfig(robots))
    with RobotLog(config.robots[0], config.time, config.classes) as log:
        return list(log.frames()), log.counts


def test_a_tilting_laser_maps_the_ground_and_the_walls_around_it():
    frames, counts = frames_of(RECORDINGS / "ros1" / "plotjuggler_tilt_laser.bag")
    assert (counts.used, counts.no_pose) == (177, 1)
    leaves = octree_of(frames[::8], 1).leaves(0.0, occupied_only=True)
    low, high = np.percentile(leaves.centers, [2, 98], axis=0)
    assert (high - low > [10, 10, 2]).all()
    # Most of the ground is one level.
    heights = leaves.centers[:, 2][np.abs(leaves.centers[:, 2]) < 1.0]
    assert np.histogram(heights, bins=10, range=(-1, 1))[0].max() > 0.3 * len(heights)


def test_a_lidar_that_does_not_move_has_its_poses_from_static_transforms():
    path = RECORDINGS / "mcap_other" / "pointcloudset_test.mcap"
    frames, counts = frames_of(path, pose_topic="/tf_static", map_frame="os1_sensor")
    assert counts.used == 2
    assert all(len(frame.points) > 40_000 for frame in frames)
    np.testing.assert_array_equal(frames[0].T_team_sensor, frames[1].T_team_sensor)


def test_trajectories_of_real_robots_are_read():
    found = read_rows(
        RECORDINGS / "multirobot" / "cu_multi" / "main_campus_robot1_ref.csv", origin=(477_000, 4_428_000, 1_600)
    )
    track = trajectory(found.stamps_ns, found)
    assert len(track.stamps_ns) == 19_998
    assert (np.diff(track.stamps_ns) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(track.rotations, axis=1), 1.0, atol=1e-9)


@pytest.mark.parametrize("pose_topic", ["/odom", "/tf"])
def test_the_corrected_odometry_of_a_real_robot_is_that_of_its_localisation(pose_topic):
    path = RECORDINGS / "mcap_ros2" / "evo_nav2_turtlebot.mcap"
    plain = RobotConfig("r", (path,), cloud_topic="/scan", pose_topic=pose_topic, sensor_frame="base_link")
    with open_log(path) as log:
        frame = find_map_frame(plain, LogGroup("r", (survey_log(log),), None))
        assert (frame.name, frame.pose_frame, frame.is_corrected) == ("map", "odom", True)
        robot = ResolvedRobot.from_config(dataclasses.replace(plain, map_frame=frame.name), None, frame)
        source = PoseSource(robot, [log], sensor_frame="base_link", pose_gap_ns=SECOND // 2, use_log_time=False)
        for message in log.messages(source.topics):
            source.take(message)
        estimates = [message.sensor_message().transforms[0] for message in log.messages(("/amcl_pose",))]
    poses = [(source.at(estimate.stamp_ns), estimate.translation) for estimate in estimates]
    errors = [np.hypot(*(T[:2, 3] - position[:2])) for T, position in poses if T is not None]
    assert len(poses) == 135
    # One estimate is in a gap of the odometry. Corrections are published up to 2.3 s apart.
    assert len(errors) == 134
    assert np.median(errors) < 0.05
    assert max(errors) < 0.2
