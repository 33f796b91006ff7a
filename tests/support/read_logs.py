"""Frames of the robot of ``log_factory.robot_entries``, read from its log."""

from __future__ import annotations

import numpy as np

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.labels import class_table_from_names
from octoreplay.transforms import pose_matrix
from support.log_factory import (
    NAMES,
    OPTICAL,
    SECOND,
    Factory,
    robot_entries,
    write_bag,
    write_mcap,
    write_rosbag2,
)  # fmt: skip

TABLE = class_table_from_names({"r": NAMES})

START = 100 * SECOND

DEPTH, LABELS, INFO = "/camera/depth/image_raw", "/camera/labels/image_raw", "/camera/depth/camera_info"


def robot_of(path, **fields) -> ResolvedRobot:
    """The robot of ``robot_entries``."""
    known = {"depth_topic": DEPTH, "label_topic": LABELS, "camera_info_topic": INFO, "pose_topic": "/odom"}
    return ResolvedRobot("r", (path,), **{**known, **fields})


def read(robot: ResolvedRobot, table=TABLE, **time):
    """A robot's frames and counts; every message is accounted for."""
    with RobotLog(robot, TimeConfig(**time), table) as log:
        frames = list(log.frames())
        assert log.counts.unaccounted == {}
        return frames, log.counts


def read_entries(tmp_path, entries, table=TABLE, time=None, **fields):
    """The frames and counts of messages written as a log."""
    return read(robot_of(write_mcap(tmp_path / "r.mcap", entries), **fields), table, **(time or {}))


def expected_pose(x: float) -> np.ndarray:
    """Pose of the camera of ``robot_entries`` with the base at x."""
    return pose_matrix((x, 0.0, 0.5), OPTICAL)


def write_as(container: str, tmp_path):
    if container == "bag":
        return write_bag(tmp_path / "r.bag", robot_entries(factory=Factory(ros1=True)))
    if container == "mcap":
        return write_mcap(tmp_path / "r.mcap", robot_entries())
    return write_rosbag2(tmp_path / "r", robot_entries(), storage=container)
