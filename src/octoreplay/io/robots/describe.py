"""Contents of logs and what they lack for a run."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from octoreplay.config.class_tables.edits import edited
from octoreplay.config.file_url import InputFile
from octoreplay.config.resolved import MapFrame, ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.config.time import TimeConfig
from octoreplay.io.messages.sensor_messages import kind_of
from octoreplay.io.robots.classes import (
    LabelledSensor,
    check_labelled,
    label_info_warnings,
    labelled_sensors,
    team_class_table,
)
from octoreplay.io.robots.label_counts import LabelCounts, check_labels, count_labels
from octoreplay.io.robots.log_groups import LogGroup, groups_in
from octoreplay.io.robots.sensor_logs import SensorLogs
from octoreplay.io.robots.survey import LogSurveys, Survey
from octoreplay.io.robots.team_check import TeamMember, check_team, team_member
from octoreplay.io.robots.topics import attempt, find_topics, other_sensors
from octoreplay.records import ClassTable


@dataclass(frozen=True)
class TopicSummary:
    """One topic of a log, with its mean rate (None below two messages).

    ``detail`` is an image's encoding and size, or a cloud's size and fields; else empty.
    """

    name: str
    type_name: str
    encoding: str
    num_messages: int
    rate_hz: float | None
    detail: str


@dataclass(frozen=True)
class LogSummary:
    """One log: its span in log time (None in an empty log), its topics and its damage.

    ``error`` is the reason why it cannot be opened; None where it can.
    """

    path: InputFile
    start_ns: int | None
    end_ns: int | None
    num_messages: int
    topics: tuple[TopicSummary, ...]
    damage: str | None
    error: str | None = None


@dataclass(frozen=True)
class RobotSummary:
    """One robot in the logs: the topics that a run would use, and what a run would lack.

    ``frame`` is its map frame and ``span_ns`` the stamps of its first and last message, None where they are unknown.
    ``other_sensors`` are sensor topics in frames of their own that the robot does not use.
    """

    robot: RobotConfig
    frame: MapFrame | None
    span_ns: tuple[int, int] | None
    missing: tuple[str, ...]
    other_sensors: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on choices that the team file can change."""
        notes = []
        if self.frame is not None and self.frame.origin:
            notes.append(
                f"map_frame: {self.frame.origin}; map_frame: {self.frame.pose_frame} leaves these transforms out"
            )
        if self.other_sensors:
            topics = ", ".join(repr(topic) for topic in self.other_sensors)
            notes.append(f"sensors: not used: {topics}; a robot with several sensors has one entry in sensors for each")
        return tuple(notes)


@dataclass(frozen=True)
class LogDescription:
    """Contents of a set of logs.

    ``overlap_ns`` is the (start, end) that all robots share, None without an overlap; ``missing`` is what the team as
    a whole lacks for a run; ``warnings`` are sentences on frames, clocks and classes that do not fit together;
    ``labels`` are histograms of the raw labels of a sample of messages.
    """

    logs: tuple[LogSummary, ...]
    robots: tuple[RobotSummary, ...]
    overlap_ns: tuple[int, int] | None
    class_table: ClassTable | None
    missing: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    labels: tuple[LabelCounts, ...] = ()

    @property
    def is_ready(self) -> bool:
        """True where nothing is missing for a run."""
        return not self.missing and not any(robot.missing for robot in self.robots)


def describe(
    logs: Sequence[InputFile], *, strict_frames: bool = False, classes: ClassTable | None = None
) -> LogDescription:
    """Return the contents of some logs and what they lack for a run.

    ``classes`` is the class table of the run, by default that of the logs. A log that cannot be opened has a summary
    with the reason. Raises ConfigError with ``strict_frames`` where nothing relates the map frames of two robots.
    """
    with LogSurveys() as known:
        errors: dict[InputFile, list[str]] = {path: [] for path in logs}
        found = {path: attempt(functools.partial(known.of, path), errors[path]) for path in logs}
        surveys = [survey for survey in found.values() if survey is not None]
        missing: list[str] = []
        groups = (attempt(lambda: groups_in(surveys), missing) or []) if surveys else []
        problems: list[list[str]] = [[] for _ in groups]
        members = [_member(group, lacks) for group, lacks in zip(groups, problems, strict=True)]
        robots = [member.robot for member in members]
        warnings = check_team(members, strict_frames=strict_frames)
        if classes is None:
            classes = _class_table(robots, groups, missing)
        else:
            warnings += label_info_warnings(classes, labelled_sensors(robots, groups))
        labels = [
            _labels(sensor, lacks, classes)
            for robot, group, lacks in zip(robots, groups, problems, strict=True)
            for sensor in labelled_sensors([robot], [group])
        ]
    spans = [member.clock.span_ns for member in members if member.clock is not None]
    start, end = max((s for s, _ in spans), default=0), min((e for _, e in spans), default=0)
    return LogDescription(
        logs=tuple(
            _log_summary(survey) if survey else LogSummary(path, None, None, 0, (), None, error=errors[path][0])
            for path, survey in found.items()
        ),
        robots=tuple(
            RobotSummary(
                member.robot,
                member.frame,
                member.clock.span_ns if member.clock else None,
                tuple(lacks),
                tuple(other_sensors(member.robot, group)),
            )
            for member, lacks, group in zip(members, problems, groups, strict=True)
        ),
        overlap_ns=(start, end) if spans and start <= end else None,
        class_table=classes,
        missing=tuple(missing),
        warnings=(*warnings, *(found.warning for found in labels if found is not None and found.warning is not None)),
        labels=tuple(found for found in labels if found is not None),
    )


def _labels(sensor: LabelledSensor, lacks: list[str], classes: ClassTable | None) -> LabelCounts | None:
    """Histogram of a sensor's labels; what a run would refuse is appended to ``lacks``."""
    logs = [survey.log for survey in sensor.group.surveys]
    if not sensor.is_labelled:
        return None
    counts = attempt(lambda: count_labels(sensor.robot, logs, classes), lacks)
    if counts is not None and classes is not None:
        attempt(lambda: check_labels(sensor.robot, logs, classes), lacks)
    return counts


def _class_table(robots: Sequence[RobotConfig], groups: Sequence[LogGroup], missing: list[str]) -> ClassTable | None:
    """The team's class table; None where it has none, with the reason in ``missing``."""
    if not robots:
        return None
    sensors = labelled_sensors(robots, groups)
    classes = attempt(lambda: edited(team_class_table(sensors), (), ()), missing)
    if classes is not None:
        attempt(functools.partial(check_labelled, classes, sensors), missing)
    return classes


def _log_summary(survey: Survey) -> LogSummary:
    """The summary of one log."""
    span = 0.0 if survey.start_ns is None or survey.end_ns is None else (survey.end_ns - survey.start_ns) / 1e9
    topics = []
    for topic in survey.topics:
        sample = survey.samples.get(topic.name)
        rate = (topic.num_messages - 1) / span if topic.num_messages > 1 and span > 0 else None
        detail = sample.detail if sample is not None and kind_of(topic.type_name) is sample.kind else ""
        topics.append(TopicSummary(topic.name, topic.type_name, topic.encoding, topic.num_messages, rate, detail))
    return LogSummary(survey.path, survey.start_ns, survey.end_ns, survey.num_messages, tuple(topics), survey.damage)


def _member(group: LogGroup, missing: list[str]) -> TeamMember:
    """The robot of a group; everything that a run would lack is appended to ``missing``."""
    robot = find_topics(group.blank_robot(), group, missing)
    # An unknown frame is named by find_topics.
    member = attempt(lambda: team_member(robot, group), []) or TeamMember(robot, None, None)
    if not missing:
        attempt(functools.partial(_check_readable, member, group), missing)
    return member


def _check_readable(member: TeamMember, group: LogGroup) -> None:
    """Raise InputError where the robot's logs have no usable intrinsics, frames or poses."""
    resolved = ResolvedRobot.from_config(member.robot, None, member.frame)
    SensorLogs(resolved, TimeConfig(), None, logs=[survey.log for survey in group.surveys])
