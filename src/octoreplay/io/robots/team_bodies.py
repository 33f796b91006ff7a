"""Body boxes of the other robots of a team, whose points do not become part of a robot's map."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.robots.body_box import body_box_at
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import BodyBox, Frame

# Poses are read up to this much log time past the stamp that they are needed for.
_LOOK_AHEAD_NS = 10_000_000_000


class BodyTrack:
    """Box of one robot over time, with its own reader of the log's poses; a context manager."""

    def __init__(self, robot: ResolvedRobot, time: TimeConfig) -> None:
        # Every sensor of a robot gives the same poses of its body.
        self._robot = robot.views[0]
        self._log = RobotLog(self._robot, time, None)
        self._poses = self._log.pose_source()
        self._messages: Iterator[RawMessage] | None = None
        self._pose_gap_ns = round(time.pose_gap * 1e9)
        self._offset_ns = robot.clock_offset_ns

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._log.close()

    def advance(self, start_ns: int, end_ns: int) -> None:
        """Read the poses between two stamps and drop earlier ones."""
        start_ns, end_ns = start_ns - self._offset_ns, end_ns - self._offset_ns
        self._poses.forget_before(start_ns)
        if self._messages is None:
            self._messages = self._log.pose_messages(self._poses, start_ns - self._pose_gap_ns)
        while not self._poses.is_known(end_ns):
            message = next(self._messages, None)
            if message is None:
                return
            self._poses.forget_before(start_ns)
            elapsed_ns = end_ns - (self._log.first_stamp_ns - self._offset_ns)
            if message.log_time_ns - self._log.first_log_time_ns > max(elapsed_ns, 0) + _LOOK_AHEAD_NS:
                return

    def box_at(self, stamp_ns: int) -> BodyBox | None:
        """Return the robot's box at a stamp; None where its pose is not known."""
        stamp_ns -= self._offset_ns
        T_map_sensor = self._poses.at(stamp_ns)
        if T_map_sensor is None:
            return None
        return body_box_at(self._robot, self._poses, stamp_ns, self._log.T_team_map @ T_map_sensor, is_own=False)


class TeamBodies:
    """Boxes of all robots with a ``body_box``; a context manager.

    It opens the logs a second time: poses are needed up to the end of a tick before any robot's frames of it are given.
    ``advance`` is called for a span of time before the boxes in it are asked for, which threads may then do.
    """

    def __init__(self, robots: Sequence[ResolvedRobot], time: TimeConfig) -> None:
        with ExitStack() as stack:
            self._tracks = {
                index: stack.enter_context(BodyTrack(robot, time))
                for index, robot in enumerate(robots)
                if robot.body_box is not None
            }
            self._closing = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.close()

    def advance(self, start_ns: int, end_ns: int) -> None:
        """Read the robots' poses between two stamps."""
        for track in self._tracks.values():
            track.advance(start_ns, end_ns)

    def add_to(self, index: int, frame: Frame) -> Frame:
        """Return a robot's frame with the boxes of all other robots at its stamp added."""
        boxes = (track.box_at(frame.stamp_ns) for other, track in self._tracks.items() if other != index)
        return dataclasses.replace(frame, boxes=(*frame.boxes, *(box for box in boxes if box is not None)))
