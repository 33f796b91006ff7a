from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.robots.read_ahead import NUM_AHEAD, ReadAhead
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.labels import class_table_from_names
from support.log_factory import NAMES, robot_entries, write_mcap

TABLE = class_table_from_names({"r": NAMES})


@pytest.fixture
def robot(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", robot_entries(num_frames=20))
    return ResolvedRobot(
        "r", (path,), depth_topic="/camera/depth/image_raw", label_topic="/camera/labels/image_raw",
        camera_info_topic="/camera/depth/camera_info", pose_topic="/odom",
    )  # fmt: skip


class CountedLog(RobotLog):
    """A log that counts the frames read, and fails after ``fails_after``."""

    num_read = 0
    fails_after = 1000

    def frames(self, team_start_ns=None, *, is_wanted):
        for frame in super().frames(team_start_ns, is_wanted=is_wanted):
            if self.num_read == self.fails_after:
                raise InputError("r.mcap: broken here")
            self.num_read += 1
            yield frame


def test_the_frames_are_the_logs_own(robot):
    with RobotLog(robot, TimeConfig(), TABLE) as log:
        expected = list(log.frames())
    with RobotLog(robot, TimeConfig(), TABLE) as log, ReadAhead(log) as source:
        frames = list(source.frames())
        assert log.counts.used == len(expected) == 20
    assert [frame.stamp_ns for frame in frames] == [frame.stamp_ns for frame in expected]
    for frame, other in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.depth_image, other.depth_image)
        np.testing.assert_array_equal(frame.T_team_sensor, other.T_team_sensor)


def test_only_a_few_frames_are_read_ahead_and_closing_ends_the_thread(robot):
    with CountedLog(robot, TimeConfig(), TABLE) as log:
        with ReadAhead(log) as source:
            frames = source.frames()
            next(frames)
            time.sleep(0.3)
            # One frame is taken, some are queued, and one waits for room.
            assert log.num_read == 1 + NUM_AHEAD + 1
        assert not any(thread.name == "read r" for thread in threading.enumerate())
        assert log.num_read == NUM_AHEAD + 2


def test_errors_of_the_thread_are_raised_by_the_iterator(robot):
    with CountedLog(robot, TimeConfig(), TABLE) as log, ReadAhead(log) as source:
        log.fails_after = 7
        taken = []
        with pytest.raises(InputError, match=r"r\.mcap: broken here"):
            taken.extend(iter(source.frames()))
    assert log.num_read == 7


def test_a_source_that_was_never_used_can_be_closed(robot):
    with RobotLog(robot, TimeConfig(), TABLE) as log, ReadAhead(log):
        pass


def test_closing_ends_a_read_without_frames(robot, monkeypatch):
    """Reading ends at the next message after closing, not at the end of the log."""
    seen = []

    def messages(self, topics, *_):
        for number in range(10**9):
            seen.append(number)
            yield from original(self, topics)

    original = RobotLog.messages
    time_config = TimeConfig(start=1e6)
    with RobotLog(robot, time_config, TABLE) as log:
        monkeypatch.setattr(RobotLog, "messages", messages)
        started = time.monotonic()
        with ReadAhead(log):
            time.sleep(0.2)
        assert time.monotonic() - started < 5
    assert len(seen) > 1
