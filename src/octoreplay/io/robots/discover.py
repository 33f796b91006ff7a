"""Robots and topics of logs, found by message type, image encoding, names and namespaces."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from octoreplay.config.class_tables.edits import edited
from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.run import RunConfig
from octoreplay.io.robots.classes import check_labelled, has_labels, team_class_table
from octoreplay.io.robots.log_groups import group_of, groups_in
from octoreplay.io.robots.survey import LogSurveys
from octoreplay.io.robots.team_check import TeamMember, check_team, team_frame_origins, team_member
from octoreplay.io.robots.topics import find_topics


def discover(logs: Sequence[Path], surveys: LogSurveys | None = None) -> tuple[ResolvedRobot, ...]:
    """Return the robots in some logs with their topics and frames, in the order of the logs.

    A log holds one robot, named by its file; or several, named by the first part of their topics, where at least two
    such namespaces hold a sensor and a pose each. Raises ConfigError where several topics fit (the message lists them
    as lines of a team file), InputError where a log has no depth image, point cloud or pose. Logs in ``surveys`` are
    not opened again.
    """
    with _shared(surveys) as known:
        groups = groups_in([known.of(path) for path in logs])
        return tuple(_resolved(team_member(find_topics(group.blank_robot(), group), group)) for group in groups)


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
    with _shared(surveys) as known:
        groups = [group_of(robot, tuple(known.of(path) for path in robot.logs)) for robot in config.robots]
        members = [
            team_member(find_topics(robot, group), group, use_log_time=config.time.clock == "log")
            for robot, group in zip(config.robots, groups, strict=True)
        ]
        robots = [_resolved(member) for member in members]
        labelled = [has_labels(robot, group) for robot, group in zip(robots, groups, strict=True)]
        classes = config.classes
        if classes is None:
            classes = edited(team_class_table(robots, groups, labelled), config.merge_classes, config.ignore_hits)
    check_labelled(classes, robots, labelled)
    on_air = config.alignment.is_on_air
    warnings = check_team(members, strict_frames=config.time.strict_frames, need_common_frame=not on_air)
    origins = team_frame_origins(members)
    robots = [dataclasses.replace(robot, frame_origin=origins[robot.robot_id]) for robot in robots]
    return ResolvedRun.from_config(config, robots, classes, warnings)


def _resolved(member: TeamMember) -> ResolvedRobot:
    """The resolved configuration of a robot."""
    span_ns = None if member.clock is None else member.clock.stamp_span_ns
    return ResolvedRobot.from_config(member.robot, span_ns, member.frame)


def _shared(surveys: LogSurveys | None) -> AbstractContextManager[LogSurveys]:
    """The given surveys, which stay open, or new ones."""
    return LogSurveys() if surveys is None else contextlib.nullcontext(surveys)
