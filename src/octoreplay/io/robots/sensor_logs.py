"""Frames of one robot with one or several sensors, in stamp order."""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from operator import attrgetter
from types import TracebackType
from typing import Self

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.io.containers.log_reader import LogReader, RawMessage
from octoreplay.io.containers.logs import open_log
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import ClassTable, Float64Array, Frame, FrameCounts


@dataclass(frozen=True)
class SensorCounts:
    """Numbers of one robot's messages: ``sensors`` of each sensor, and ``used`` of the used messages of all sensors."""

    sensors: tuple[FrameCounts, ...]
    used: FrameCounts

    def total(self, num_off: Mapping[int, int]) -> FrameCounts:
        """Return the numbers of all sensors, with frames left out because the robot was off, by index of the sensor."""
        found = list(self.sensors)
        for index, number in num_off.items():
            messages = {topic: dict(numbers) for topic, numbers in found[index].messages.items()}
            found[index] = dataclasses.replace(found[index], messages=messages)
            found[index].leave_out(number)
        return found[0] if len(found) == 1 else _sum_of(found, self.used)


class SensorLogs:
    """Frames of one robot, read lazily, a ``RobotLog`` for each of its sensors; a context manager.

    The frames of several sensors are merged in the order of their stamps, equal stamps in the order of the sensors. The
    poses are those of the first sensor. Arguments and errors are those of ``RobotLog``.
    """

    def __init__(
        self,
        robot: ResolvedRobot,
        time: TimeConfig,
        class_table: ClassTable | None,
        *,
        reach: float = math.inf,
        logs: Sequence[LogReader] | None = None,
    ) -> None:
        self.robot = robot
        self._used = FrameCounts()
        self._num_off: Mapping[int, int] = {}
        with ExitStack() as stack:
            if logs is None:
                logs = [stack.enter_context(open_log(path)) for path in robot.logs]
            self._sensors = tuple(RobotLog(view, time, class_table, reach=reach, logs=logs) for view in robot.views)
            self._closing = stack.pop_all()
        self.first_stamp_ns = min(sensor.first_stamp_ns for sensor in self._sensors)
        """First stamp of any sensor, clock offset applied."""

    @property
    def robot_id(self) -> str:
        """Name of the robot in the team."""
        return self.robot.robot_id

    @property
    def T_team_map(self) -> Float64Array:
        """Transform from the robot's map frame to the team's frame, (4, 4)."""
        return self._sensors[0].T_team_map

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the logs; a second call does nothing."""
        self._closing.close()

    def frames(
        self, team_start_ns: int | None = None, *, is_wanted: Callable[[], bool] = lambda: True
    ) -> Iterator[Frame]:
        """Yield the robot's frames in stamp order; arguments and errors are those of ``RobotLog.frames``."""
        self._used, self._num_off = FrameCounts(), {}
        start_ns = self.first_stamp_ns if team_start_ns is None else team_start_ns
        streams = [_numbered(log.frames(start_ns, is_wanted=is_wanted), n) for n, log in enumerate(self._sensors)]
        # The merge is stable: equal stamps come in the order of the streams.
        for frame in heapq.merge(*streams, key=attrgetter("stamp_ns")) if len(streams) > 1 else streams[0]:
            self._used.use(frame.stamp_ns)
            yield frame

    @property
    def counts(self) -> FrameCounts:
        """Numbers of the messages of all sensors by outcome."""
        return self.sensor_counts.total(self._num_off)

    @property
    def sensor_counts(self) -> SensorCounts:
        """Numbers of the messages of each sensor by outcome."""
        return SensorCounts(tuple(log.counts for log in self._sensors), self._used)

    def leave_out(self, num_off: Mapping[int, int]) -> None:
        """Count frames as left out because the robot was off, by the index of the sensor; call it after the replay."""
        self._num_off = dict(num_off)

    def pose_source(self) -> PoseSource:
        """Return a new source of the poses of the robot's first sensor, before its first message."""
        return self._sensors[0].pose_source()

    def pose_messages(self, poses: PoseSource, needed_from_ns: int) -> Iterator[RawMessage]:
        """Pass the messages of a pose source to it and yield them, as ``RobotLog.pose_messages``."""
        return self._sensors[0].pose_messages(poses, needed_from_ns)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of some topics of all the robot's logs, in order of log time."""
        return self._sensors[0].messages(topics)


def _numbered(frames: Iterator[Frame], index: int) -> Iterator[Frame]:
    """Frames with the index of their sensor."""
    return (dataclasses.replace(frame, sensor_index=index) for frame in frames) if index else frames


def _sum_of(found: Sequence[FrameCounts], used: FrameCounts) -> FrameCounts:
    """Counts of all sensors, with the span and the gaps of ``used``.

    Topics that several sensors read, such as those of the poses, count once, for the sensor that read most of them.
    There is no single ``sensor_topic``.
    """
    total = FrameCounts(used_span=used.used_span, gaps=used.gaps)
    for counts in found:
        for name in ("used", "no_label", "no_pose", "late", "duplicate", "undecodable", "off"):
            setattr(total, name, getattr(total, name) + getattr(counts, name))
        for topic, numbers in counts.messages.items():
            if topic not in total.messages or numbers["read"] > total.messages[topic]["read"]:
                total.messages[topic] = numbers
                total.spans.pop(topic, None)
                if topic in counts.spans:
                    total.spans[topic] = counts.spans[topic]
        for cause, sentence in counts.first_missing.items():
            total.first_missing.setdefault(cause, sentence)
        for into, new in (
            (total.unknown_label_pixels, counts.unknown_label_pixels), (total.unknown_colors, counts.unknown_colors)
        ):  # fmt: skip
            for value, number in new.items():
                into[value] = into.get(value, 0) + number
        total.truncated_files = list(dict.fromkeys([*total.truncated_files, *counts.truncated_files]))
    return total
