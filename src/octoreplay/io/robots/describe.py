"""Contents of logs and what they lack for a run."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from octoreplay.config.class_tables.edits import edited
from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.config.time import TimeConfig
from octoreplay.io.messages.sensor_messages import kind_of
from octoreplay.io.robots.classes import check_labelled, has_labels, team_class_table
from octoreplay.io.robots.log_groups import LogGroup, groups_in
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.survey import LogSurveys, Survey
from octoreplay.io.robots.topics import attempt, find_topics
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

    path: Path
    start_ns: int | None
    end_ns: int | None
    num_messages: int
    topics: tuple[TopicSummary, ...]
    damage: str | None
    error: str | None = None


@dataclass(frozen=True)
class RobotSummary:
    """One robot in the logs: the topics that a run would use, its span in log time, and what a run would lack."""

    robot: RobotConfig
    start_ns: int | None
    end_ns: int | None
    missing: tuple[str, ...]


@dataclass(frozen=True)
class LogDescription:
    """Contents of a set of logs.

    ``overlap_ns`` is the (start, end) that all robots share, None without an overlap; ``missing`` is what the team as
    a whole lacks for a run.
    """

    logs: tuple[LogSummary, ...]
    robots: tuple[RobotSummary, ...]
    overlap_ns: tuple[int, int] | None
    class_table: ClassTable | None
    missing: tuple[str, ...]


def describe(logs: Sequence[Path]) -> LogDescription:
    """Return the contents of some logs and what they lack for a run.

    A log that cannot be opened has a summary with the reason.
    """
    with LogSurveys() as known:
        errors: dict[Path, list[str]] = {path: [] for path in logs}
        found = {path: attempt(functools.partial(known.of, path), errors[path]) for path in logs}
        surveys = [survey for survey in found.values() if survey is not None]
        missing: list[str] = []
        groups = (attempt(lambda: groups_in(surveys), missing) or []) if surveys else []
        robots = [_robot_summary(group) for group in groups]
        classes = _class_table([summary.robot for summary in robots], groups, missing)
    spans = [(r.start_ns, r.end_ns) for r in robots if r.start_ns is not None and r.end_ns is not None]
    start, end = max((s for s, _ in spans), default=0), min((e for _, e in spans), default=0)
    return LogDescription(
        logs=tuple(
            _log_summary(survey) if survey else LogSummary(path, None, None, 0, (), None, error=errors[path][0])
            for path, survey in found.items()
        ),
        robots=tuple(robots),
        overlap_ns=(start, end) if spans and start <= end else None,
        class_table=classes,
        missing=tuple(missing),
    )


def _class_table(robots: Sequence[RobotConfig], groups: Sequence[LogGroup], missing: list[str]) -> ClassTable | None:
    """The team's class table; None where it has none, with the reason in ``missing``."""
    if not robots:
        return None
    labelled = [has_labels(robot, group) for robot, group in zip(robots, groups, strict=True)]
    classes = attempt(lambda: edited(team_class_table(robots, groups, labelled), (), ()), missing)
    if classes is not None:
        attempt(functools.partial(check_labelled, classes, robots, labelled), missing)
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


def _robot_summary(group: LogGroup) -> RobotSummary:
    """The summary of one robot, with everything that a run would lack."""
    missing: list[str] = []
    robot = find_topics(group.blank_robot(), group, missing)
    if not missing:
        attempt(functools.partial(_check_readable, robot, group), missing)
    start_ns, end_ns = group.log_span_ns or (None, None)
    return RobotSummary(robot, start_ns, end_ns, tuple(missing))


def _check_readable(robot: RobotConfig, group: LogGroup) -> None:
    """Raise InputError where the robot's logs have no usable intrinsics, frames or poses."""
    resolved = ResolvedRobot.from_config(robot, group.log_span_ns)
    RobotLog(resolved, TimeConfig(), None, logs=[survey.log for survey in group.surveys])
