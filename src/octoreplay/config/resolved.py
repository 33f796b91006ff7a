"""Resolved run configuration: every topic and frame is named, and the class table is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable


@dataclass(frozen=True)
class ResolvedRobot(RobotConfig):
    """Robot configuration with a sensor topic and a pose source.

    ``log_span_ns`` holds the log times of the first and the last message of any topic in the robot's logs, without the
    clock offset; None where it is unknown or the logs hold no messages. Raises ConfigError without a sensor topic or
    without a pose source.
    """

    log_span_ns: tuple[int, int] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.depth_topic or self.cloud_topic):
            raise ConfigError(f"robot '{self.robot_id}': needs a depth_topic or cloud_topic")
        if not (self.pose_topic or self.pose_file):
            raise ConfigError(f"robot '{self.robot_id}': needs a pose_topic or pose_file")

    @classmethod
    def from_config(cls, robot: RobotConfig, log_span_ns: tuple[int, int] | None) -> Self:
        """Return the resolved robot of a configuration. Raises ConfigError without a sensor topic or a pose source."""
        return cls(**_values(robot, RobotConfig), log_span_ns=log_span_ns)

    def to_config(self) -> RobotConfig:
        """Return the plain configuration, which compares equal to one from a team file."""
        return RobotConfig(**_values(self, RobotConfig))

    @property
    def sensor_topic(self) -> str:
        """Topic that the map is made from: ``depth_topic`` or ``cloud_topic``."""
        return str(self.depth_topic or self.cloud_topic)

    @property
    def clock_offset_ns(self) -> int:
        """``clock_offset`` in nanoseconds."""
        return round(self.clock_offset * 1e9)

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message of any topic, clock offset applied; None where it is unknown."""
        return None if self.log_span_ns is None else self.log_span_ns[0] + self.clock_offset_ns

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message of any topic, clock offset applied; None where it is unknown."""
        return None if self.log_span_ns is None else self.log_span_ns[1] + self.clock_offset_ns


@dataclass(frozen=True)
class ResolvedRun(RunConfig):
    """Run configuration whose robots are resolved and whose class table is known.

    ``merge_classes`` and ``ignore_hits`` are empty: they are part of ``classes`` already. Changed parameters
    (``with_parameters``, ``dataclasses.replace``) keep the resolution.
    """

    robots: tuple[ResolvedRobot, ...]
    # Without field() the class would inherit the base class's default None.
    classes: ClassTable = field()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.merge_classes or self.ignore_hits:
            raise ConfigError("merge_classes, ignore_hits: must be empty in a resolved run; edit its classes instead")

    @classmethod
    def from_config(cls, config: RunConfig, robots: Sequence[ResolvedRobot], classes: ClassTable) -> Self:
        """Return a run configuration with its robots and classes resolved."""
        resolved = {"robots": tuple(robots), "classes": classes, "merge_classes": (), "ignore_hits": ()}
        return cls(**{**_values(config, RunConfig), **resolved})

    def to_config(self) -> RunConfig:
        """Return the plain configuration, which compares equal to the one that a result stores."""
        robots = tuple(robot.to_config() for robot in self.robots)
        return RunConfig(**{**_values(self, RunConfig), "robots": robots})

    @property
    def total_ns(self) -> int | None:
        """Length of the replayed part of the logs; None where the logs' spans are unknown."""
        starts = [robot.start_ns for robot in self.robots if robot.start_ns is not None]
        ends = [robot.end_ns for robot in self.robots if robot.end_ns is not None]
        if not starts or not ends:
            return None
        length = max(ends) - min(starts) - round(self.time.start * 1e9)
        if self.time.duration is not None:
            length = min(length, round(self.time.duration * 1e9))
        return max(length, 0)


def _values(config: RobotConfig | RunConfig, fields_of: type[RobotConfig | RunConfig]) -> dict[str, Any]:
    """Field values by name, of the fields that a class declares."""
    return {item.name: getattr(config, item.name) for item in dataclasses.fields(fields_of)}
