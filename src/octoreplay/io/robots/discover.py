"""Robots and topics of logs, found by message type, image encoding, names and namespaces."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

from octoreplay.config.class_tables.edits import edited
from octoreplay.config.file_url import FileUrl, input_file
from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.io.containers.open_files import allow_open_files
from octoreplay.io.robots.classes import check_labelled, label_info_warnings, labelled_sensors, team_class_table
from octoreplay.io.robots.log_groups import group_of, groups_in
from octoreplay.io.robots.survey import LogSurveys
from octoreplay.io.robots.team_check import TeamMember, check_team, team_frame_origins, team_member
from octoreplay.io.robots.topics import find_topics
from octoreplay.records import FilePath


def discover(
    logs: Sequence[FilePath | FileUrl],
    surveys: LogSurveys | None = None,
    *,
    edit: Callable[[Sequence[RobotConfig]], Sequence[RobotConfig]] = list,
) -> tuple[ResolvedRobot, ...]:
    """Return the robots in some logs with their topics and frames, in the order of the logs.

    A log holds one robot, named by its file; or several, named by the first part of their topics, where at least two
    such namespaces hold a sensor and a pose each. ``edit`` sets fields of the robots before the others are found. Logs
    in ``surveys`` are not opened again. Raises ConfigError where several topics fit (the message lists them as lines of
    a team file), InputError where a log has no depth image, point cloud or pose.
    """
    with _shared(surveys) as known:
        groups = groups_in([known.of(input_file(path)) for path in logs])
        robots = edit([group.blank_robot() for group in groups])
        return tuple(
            _resolved(team_member(find_topics(robot, group), group))
            for robot, group in zip(robots, groups, strict=True)
        )


def resolve(config: RunConfig, surveys: LogSurveys | None = None) -> ResolvedRun:
    """Return the configuration with the missing topics, frames and class table filled from the logs.

    The class table is the configured one; else that of the logs' LabelInfo, united by name over the robots, merged and
    ignored as configured; else, where no robot has labels, the single class 'occupied'. Raises InputError where a named
    topic is missing or of another type, ConfigError as ``discover`` does, and where there are labels without a class
    table or for some robots only, and with ``strict_frames`` where nothing relates the frames of two robots. A
    configuration that is resolved already is returned unchanged. Logs in ``surveys`` are not opened again.
    """
    if isinstance(config, ResolvedRun):
        return config
    allow_open_files([path for robot in config.robots for path in robot.logs])
    with _shared(surveys) as known:
        groups = [group_of(robot, tuple(known.of(path) for path in robot.logs)) for robot in config.robots]
        members = [
            team_member(find_topics(robot, group), group, use_log_time=config.time.clock == "log")
            for robot, group in zip(config.robots, groups, strict=True)
        ]
        robots = [_resolved(member) for member in members]
        sensors = labelled_sensors(robots, groups)
        classes, contradictions = config.classes, tuple[str, ...]()
        if classes is not None:
            contradictions = label_info_warnings(classes, sensors)
        else:
            classes = edited(team_class_table(sensors), config.merge_classes, config.ignore_hits)
    check_labelled(classes, sensors)
    on_air = config.alignment.is_on_air
    warnings = check_team(members, strict_frames=config.time.strict_frames, need_common_frame=not on_air)
    origins = team_frame_origins(members)
    robots = [dataclasses.replace(robot, frame_origin=origins[robot.robot_id]) for robot in robots]
    return ResolvedRun.from_config(config, robots, classes, (*warnings, *contradictions))


def _resolved(member: TeamMember) -> ResolvedRobot:
    """The resolved configuration of a robot."""
    span_ns = None if member.clock is None else member.clock.stamp_span_ns
    return ResolvedRobot.from_config(member.robot, span_ns, member.frame)


def _shared(surveys: LogSurveys | None) -> AbstractContextManager[LogSurveys]:
    """The given surveys, which stay open, or new ones."""
    return LogSurveys() if surveys is None else contextlib.nullcontext(surveys)
