"""Sources of the frames of a team's robots: their logs, read ahead in threads."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.io.robots.read_ahead import ReadAhead
from octoreplay.io.robots.sensor_logs import SensorLogs
from octoreplay.mapping.sensor import sensor_reach
from octoreplay.records import FrameCounts


class TeamSources:
    """Sources of the frames of a team's robots, in the order of ``config.robots``; a context manager.

    Raises InputError as ``RobotLog`` does.
    """

    def __init__(self, config: ResolvedRun) -> None:
        self._config = config
        self._reach = sensor_reach(config.sensor, config.map)
        self._logs: list[SensorLogs] = []
        self._sources: list[ReadAhead] = []
        # Each robot's log and its thread, which end before the robot is read again.
        self._opened = [ExitStack() for _ in config.robots]

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for opened in self._opened:
                stack.push(opened)
            for index, robot in enumerate(self._config.robots):
                self._logs.append(self._open(index, robot))
            self._start_ns = min(log.first_stamp_ns for log in self._logs)
            for index in range(len(self._logs)):
                self._sources.append(self._read(index))
            self._closing = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.close()

    @property
    def sources(self) -> tuple[ReadAhead, ...]:
        """The present source of each robot."""
        return tuple(self._sources)

    @property
    def counts(self) -> dict[str, FrameCounts]:
        """Messages of each robot by outcome, in the present source."""
        return {log.robot_id: log.counts for log in self._logs}

    def leave_out(self, num_frames_off: Sequence[Mapping[int, int]]) -> None:
        """Count frames of each robot as left out because it was off, by sensor; call it after the replay."""
        for log, num_off in zip(self._logs, num_frames_off, strict=True):
            log.leave_out(num_off)

    def reopen(self, index: int, T_team_map: tuple[float, ...]) -> ReadAhead:
        """Replace a robot's source by one that begins again, with another ``T_team_map`` (7 numbers)."""
        self._opened[index].close()
        robot = dataclasses.replace(
            self._config.robots[index], T_team_map=T_team_map, T_team_map_sigma=None, T_team_map_from=None
        )
        self._logs[index] = self._open(index, robot)
        self._sources[index] = self._read(index)
        return self._sources[index]

    def _open(self, index: int, robot: ResolvedRobot) -> SensorLogs:
        """Open a robot's log."""
        log = SensorLogs(robot, self._config.time, self._config.classes, reach=self._reach)
        return self._opened[index].enter_context(log)

    def _read(self, index: int) -> ReadAhead:
        """Start reading a robot's log."""
        return self._opened[index].enter_context(ReadAhead(self._logs[index], self._start_ns))
