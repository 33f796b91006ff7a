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
class MapFrame:
    """Map frame of a robot as its logs give it.

    Attributes
    ----------
    name : str or None
        The frame; None for a trajectory file without a configured ``map_frame``.
    pose_frame : str or None
        Frame that the poses are given in, at or below the map frame; None for a file.
    is_corrected : bool
        A transform between the two changes, as SLAM and localisation publish it.
    place : tuple of 16 float or None
        Transform by rows that the map frame's constant transforms give the frames below it; None without one.
    tree, body : frozenset of str
        Frames that TF joins to the map frame, and frames of the robot's body and sensor.
    """

    name: str | None
    pose_frame: str | None = None
    is_corrected: bool = False
    place: tuple[float, ...] | None = None
    tree: frozenset[str] = frozenset()
    body: frozenset[str] = frozenset()

    @property
    def origin(self) -> str:
        """Clause on the way of the poses to the map frame; empty where they are given in it."""
        if self.pose_frame in (None, self.name):
            return ""
        return f"poses in {self.pose_frame}, {'corrected' if self.is_corrected else 'placed'} by TF"


@dataclass(frozen=True)
class ResolvedRobot(RobotConfig):
    """Robot configuration with a sensor topic and a pose source.

    ``span_ns`` holds the stamps of the first and the last message of any topic in the robot's logs, without the clock
    offset; None where it is unknown or the logs hold no messages. ``frame`` is the map frame as found in the logs; None
    where it is unknown. ``frame_origin`` is a phrase on the origin of the robot's place in the team's
    frame. Raises ConfigError without a sensor topic or without a pose source.
    """

    span_ns: tuple[int, int] | None = field(default=None, kw_only=True)
    frame: MapFrame | None = field(default=None, kw_only=True)
    frame_origin: str = field(default="", kw_only=True, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.depth_topic or self.cloud_topic or self.sensors):
            raise ConfigError(f"robot '{self.robot_id}': needs a depth_topic or cloud_topic")
        if not self.has_poses:
            raise ConfigError(f"robot '{self.robot_id}': needs a pose_topic, pose_file or pose")

    @classmethod
    def from_config(cls, robot: RobotConfig, span_ns: tuple[int, int] | None, frame: MapFrame | None = None) -> Self:
        """Return the resolved robot of a configuration. Raises ConfigError without a sensor topic or a pose source."""
        return cls(**_values(robot, RobotConfig), span_ns=span_ns, frame=frame)

    def to_config(self) -> RobotConfig:
        """Return the plain configuration, which compares equal to one from a team file."""
        return RobotConfig(**_values(self, RobotConfig))

    @property
    def sensor_topic(self) -> str:
        """Topic that the map is made from: ``depth_topic`` or ``cloud_topic``, of several sensors the first one's."""
        first = self.sensors[0] if self.sensors else self
        return str(first.depth_topic or first.cloud_topic)

    @property
    def clock_offset_ns(self) -> int:
        """``clock_offset`` in nanoseconds."""
        return round(self.clock_offset * 1e9)

    @property
    def start_ns(self) -> int | None:
        """Stamp of the first message of any topic, clock offset applied; None where it is unknown."""
        return None if self.span_ns is None else self.span_ns[0] + self.clock_offset_ns

    @property
    def end_ns(self) -> int | None:
        """Stamp of the last message of any topic, clock offset applied; None where it is unknown."""
        return None if self.span_ns is None else self.span_ns[1] + self.clock_offset_ns


@dataclass(frozen=True)
class ResolvedRun(RunConfig):
    """Run configuration whose robots are resolved and whose class table is known.

    ``merge_classes`` and ``ignore_hits`` are empty: they are part of ``classes`` already. ``warnings`` are sentences on
    frames, clocks and classes that do not fit together. Changed parameters (``with_parameters``,
    ``dataclasses.replace``) keep the resolution.
    """

    robots: tuple[ResolvedRobot, ...]
    # Without field() the class would inherit the base class's default None.
    classes: ClassTable = field()
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.merge_classes or self.ignore_hits:
            raise ConfigError("merge_classes, ignore_hits: must be empty in a resolved run; edit its classes instead")

    @classmethod
    def from_config(
        cls, config: RunConfig, robots: Sequence[ResolvedRobot], classes: ClassTable, warnings: Sequence[str] = ()
    ) -> Self:
        """Return a run configuration with its robots and classes resolved."""
        resolved = {"robots": tuple(robots), "classes": classes, "merge_classes": (), "ignore_hits": ()}
        return cls(**{**_values(config, RunConfig), **resolved}, warnings=tuple(warnings))

    def to_config(self) -> RunConfig:
        """Return the plain configuration, which compares equal to the one that a result stores.

        Its sensor model has the rounded increments and clamps of the run.
        """
        robots = tuple(robot.to_config() for robot in self.robots)
        return RunConfig(**{**_values(self, RunConfig), "robots": robots, "sensor": self.effective_sensor})

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
