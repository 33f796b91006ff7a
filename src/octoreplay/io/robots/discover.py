"""Finding robots and topics in logs: by message type, image encoding, names and namespaces."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from octoreplay.config.class_tables.edits import edited
from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError, OctoreplayError, suggestion
from octoreplay.io.containers.log_reader import TopicInfo, first_whole_message
from octoreplay.io.messages.decoders import ENCODINGS, DamagedMessageError
from octoreplay.io.messages.sensor_messages import Kind, LabelNames, Transforms, kind_of
from octoreplay.io.robots.pose_source import (
    POSE_KINDS,
    load_static_transforms,
    moving_tf_names,
    tf_topics,
)
from octoreplay.io.robots.poses import FrameTree, frame_name
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.survey import CLOUDS, IMAGES, LogSurveys, Look, Survey
from octoreplay.io.sensors.labels import OCCUPIED, class_table_from_names
from octoreplay.records import ClassTable

# Poses that are wished for, not measured.
_NO_POSE_HINTS = ("goal", "initialpose", "initial_pose", "target", "setpoint")
# How much of TF is read to find the root of a robot's frames.
_TF_SAMPLE_NS = 5_000_000_000
_TF_SAMPLE_MESSAGES = 5_000

_ROLE_KINDS: Mapping[str, tuple[tuple[Kind, ...], str]] = {
    "depth_topic": (IMAGES, "image"),
    "label_topic": (IMAGES, "image"),
    "confidence_topic": (IMAGES, "image"),
    "camera_info_topic": ((Kind.CAMERA_INFO,), "CameraInfo"),
    "cloud_topic": (CLOUDS, "point cloud or laser scan"),
    "pose_topic": (POSE_KINDS, "pose"),
    "label_info_topic": ((Kind.LABEL_INFO,), "LabelInfo"),
}

T = TypeVar("T")


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
    """One log: its span in log time (None where it is empty), its topics, and what is damaged.

    ``error`` says why it cannot be opened; None where it can.
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
    """One robot that was found: its topics as a run would take them, and what a run would still miss."""

    robot: RobotConfig
    start_ns: int | None
    end_ns: int | None
    missing: tuple[str, ...]


@dataclass(frozen=True)
class LogDescription:
    """What a set of logs holds.

    ``overlap_ns`` is the (start, end) that all robots share, None where there is none; ``missing`` is what the team as
    a whole lacks for a run.
    """

    logs: tuple[LogSummary, ...]
    robots: tuple[RobotSummary, ...]
    overlap_ns: tuple[int, int] | None
    class_table: ClassTable | None
    missing: tuple[str, ...]


@dataclass(frozen=True)
class _Group:
    """One robot to be: its logs, and the name that its topics are known by where a log holds several robots."""

    robot_id: str
    surveys: tuple[Survey, ...]
    namespace: str | None


# --- public ----------------------------------------------------------------------------------------------------------


def discover(logs: Sequence[Path], surveys: LogSurveys | None = None) -> tuple[ResolvedRobot, ...]:
    """The robots in some logs, with their topics and frames, in the order of the logs.

    A log holds one robot, named by its file; or several, named by the first part of their topics, where at least two
    such namespaces hold a sensor and a pose each. Raises ConfigError where several topics could be meant (its text
    lists them as lines of a team file), InputError where a log has no depth image, point cloud or pose. ``surveys``
    holds the logs that are surveyed already.
    """
    with _shared(surveys) as known:
        return tuple(_resolved(_blank(group), group) for group in _groups([known.of(path) for path in logs]))


def resolve(config: RunConfig, surveys: LogSurveys | None = None) -> ResolvedRun:
    """The configuration with every topic and frame that a robot leaves out, and the class table, filled from the logs.

    The class table is the configured one; else that of the logs' LabelInfo, united by name over the robots, merged and
    ignored as configured; else, where no robot has labels, the single class 'occupied'. Raises InputError where a named
    topic is missing or of another type, ConfigError as ``discover`` does, and where there are labels without a class
    table or for some robots only. A configuration that is resolved already is returned as it is. ``surveys`` holds the
    logs that are surveyed already.
    """
    if isinstance(config, ResolvedRun):
        return config
    with _shared(surveys) as known:
        groups = [_group_of(robot, tuple(known.of(path) for path in robot.logs)) for robot in config.robots]
        robots = [_resolved(robot, group) for robot, group in zip(config.robots, groups, strict=True)]
        labelled = [_has_labels(robot, group) for robot, group in zip(robots, groups, strict=True)]
        classes = config.classes
        if classes is None:
            classes = edited(_class_table(robots, groups, labelled), config.merge_classes, config.ignore_hits)
    _check_labelled(classes, robots, labelled)
    return ResolvedRun.from_config(config, robots, classes)


def describe(logs: Sequence[Path]) -> LogDescription:
    """What is in some logs, and what they lack for a run; a log that cannot be opened says why in its summary."""
    with LogSurveys() as known:
        errors: dict[Path, list[str]] = {path: [] for path in logs}
        found = {path: _attempt(functools.partial(known.of, path), errors[path]) for path in logs}
        surveys = [survey for survey in found.values() if survey is not None]
        missing: list[str] = []
        groups = (_attempt(lambda: _groups(surveys), missing) or []) if surveys else []
        robots = [_robot_summary(group) for group in groups]
        configs = [summary.robot for summary in robots]
        labelled = [_has_labels(config, group) for config, group in zip(configs, groups, strict=True)]
        classes = None
        if configs:
            classes = _attempt(lambda: edited(_class_table(configs, groups, labelled), (), ()), missing)
        if classes is not None:
            _attempt(functools.partial(_check_labelled, classes, configs, labelled), missing)
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


def _shared(surveys: LogSurveys | None) -> AbstractContextManager[LogSurveys]:
    """The given surveys, which stay open, or new ones."""
    return LogSurveys() if surveys is None else contextlib.nullcontext(surveys)


# --- what is there ---------------------------------------------------------------------------------------------------


def _log_summary(found: Survey) -> LogSummary:
    """A survey as the user sees it."""
    span = 0.0 if found.start_ns is None or found.end_ns is None else (found.end_ns - found.start_ns) / 1e9
    topics = []
    for topic in found.topics:
        look = found.looks.get(topic.name)
        rate = (topic.num_messages - 1) / span if topic.num_messages > 1 and span > 0 else None
        detail = look.detail if look is not None and kind_of(topic.type_name) is look.kind else ""
        topics.append(TopicSummary(topic.name, topic.type_name, topic.encoding, topic.num_messages, rate, detail))
    return LogSummary(found.path, found.start_ns, found.end_ns, found.num_messages, tuple(topics), found.damage)


def _robot_summary(group: _Group) -> RobotSummary:
    """A robot as far as it can be found, with everything that a run would miss."""
    missing: list[str] = []
    robot = _find(_blank(group), group, missing)
    if not missing:
        _attempt(functools.partial(_check_readable, robot, group), missing)
    start_ns, end_ns = _log_span(group) or (None, None)
    return RobotSummary(robot, start_ns, end_ns, tuple(missing))


def _check_readable(robot: RobotConfig, group: _Group) -> None:
    """Raise InputError where the robot's log has no usable intrinsics, frames or poses."""
    RobotLog(
        ResolvedRobot.from_config(robot, _log_span(group)), TimeConfig(), None, logs=[s.log for s in group.surveys]
    )


def _attempt(step: Callable[[], T], problems: list[str] | None) -> T | None:
    """A step's result; an error is raised where ``problems`` is None, else noted in it."""
    try:
        return step()
    except OctoreplayError as error:
        if problems is None:
            raise
        problems.append(str(error))
        return None


# --- robots ----------------------------------------------------------------------------------------------------------


def _blank(group: _Group) -> RobotConfig:
    """A robot of which nothing is known but its logs."""
    return RobotConfig(group.robot_id, tuple(survey.path for survey in group.surveys))


def _groups(surveys: Sequence[Survey]) -> list[_Group]:
    """The robots of some logs: several of one log by namespace, each of the others by its file."""
    if not surveys:
        raise ConfigError("no logs given")
    shared: dict[str, list[Survey]] = {}
    groups: list[_Group] = []
    names = _file_names([survey.path for survey in surveys if not survey.robots])
    for survey in surveys:
        namespaces = survey.robots
        for namespace in namespaces:
            shared.setdefault(namespace, []).append(survey)
        if not namespaces:
            groups.append(_Group(names[survey.path], (survey,), None))
    groups += [_Group(name, tuple(found), name) for name, found in shared.items()]
    return groups


def _file_names(paths: Sequence[Path]) -> dict[Path, str]:
    """A robot's name for each file: its stem, or its folder's name where stems repeat."""
    for names in ([path.stem for path in paths], [path.resolve().parent.name for path in paths]):
        if len(set(names)) == len(names) and all(names):
            return dict(zip(paths, names, strict=True))
    repeated = next(path for path in paths if [p.stem for p in paths].count(path.stem) > 1)
    raise ConfigError(f"{repeated}: two logs would both be robot '{repeated.stem}'; name the robots in a team file")


def _group_of(robot: RobotConfig, surveys: tuple[Survey, ...]) -> _Group:
    """The part of its logs in which a robot's missing topics are looked for."""
    namespaces = set(itertools.chain(*(survey.robots for survey in surveys)))
    named = robot.depth_topic or robot.cloud_topic
    owners = {topic: owner for survey in surveys for topic, owner in survey.owners.items()}
    if named and named not in owners:
        # A sensor that is none of theirs; what else the robot has must be named too.
        return _Group(robot.robot_id, surveys, None)
    namespace = owners[named] if named else robot.robot_id
    if namespaces and namespace not in namespaces:
        raise ConfigError(
            f"robot '{robot.robot_id}': {surveys[0].path} holds the robots {', '.join(sorted(namespaces))}; "
            f"use one of these names as id, or give its depth_topic"
        )
    return _Group(robot.robot_id, surveys, namespace if namespaces else None)


# --- topics ----------------------------------------------------------------------------------------------------------


def _find(robot: RobotConfig, group: _Group, problems: list[str] | None = None) -> RobotConfig:
    """The robot with its missing topics and frames filled; problems are raised, or noted and stepped over."""
    _attempt(lambda: _check_named_topics(robot, group), problems)
    found = _fill(robot, _attempt(lambda: _find_sensor(robot, group), problems))
    _attempt(lambda: _check_named_fields(found, group), problems)
    if found.depth_topic is not None:
        found = _fill(found, _attempt(lambda: _find_labels(found, group), problems))
        found = _fill(found, _attempt(lambda: _find_confidences(found, group), problems))
        found = _fill(found, _attempt(lambda: _find_camera_info(found, group), problems))
    found = _fill(found, _attempt(lambda: _find_label_info(found, group), problems))
    found = _fill(found, _attempt(lambda: _find_pose(found, group), problems))
    if found.pose_topic is not None and (found.depth_topic or found.cloud_topic) is not None:
        found = _fill(found, _attempt(lambda: _find_frames(found, group), problems))
    return found


def _resolved(robot: RobotConfig, group: _Group) -> ResolvedRobot:
    """The robot with its missing topics and frames filled and its logs' span."""
    return ResolvedRobot.from_config(_find(robot, group), _log_span(group))


def _log_span(group: _Group) -> tuple[int, int] | None:
    """Log times of the first and the last message in a robot's logs; None where they hold no messages."""
    starts = [survey.start_ns for survey in group.surveys if survey.start_ns is not None]
    ends = [survey.end_ns for survey in group.surveys if survey.end_ns is not None]
    return (min(starts), max(ends)) if starts and ends else None


def _fill(robot: RobotConfig, found: Mapping[str, str | None] | None) -> RobotConfig:
    """The robot with what it leaves out taken from ``found``."""
    missing: dict[str, Any] = {
        key: value for key, value in (found or {}).items() if getattr(robot, key) is None and value is not None
    }
    return dataclasses.replace(robot, **missing) if missing else robot


def _check_named_topics(robot: RobotConfig, group: _Group) -> None:
    """Raise InputError where a topic that the robot names is not in its logs, or is of another type."""
    for role, (kinds, what) in _ROLE_KINDS.items():
        name = getattr(robot, role)
        if not name:
            continue
        infos = [topic for survey in group.surveys for topic in survey.topics if topic.name == name]
        alike = sorted({t.name for survey in group.surveys for t in survey.topics if kind_of(t.type_name) in kinds})
        offer = f"{what} topics: {', '.join(repr(n) for n in alike)}" if alike else f"there are no {what} topics"
        if not infos:
            raise InputError(f"{_paths(group)}: topic '{name}' not found; {offer}{suggestion(name, alike)}")
        if not any(kind_of(info.type_name) in kinds for info in infos):
            raise InputError(f"{_paths(group)}: topic '{name}' is of type {infos[0].type_name}, no {role}; {offer}")
        bad = next((info for info in infos if info.encoding not in ENCODINGS), None)
        if bad is not None:
            raise InputError(
                f"{_paths(group)}: topic '{name}' is encoded as {bad.encoding}; {', '.join(ENCODINGS)} can be read"
            )


def _check_named_fields(robot: RobotConfig, group: _Group) -> None:
    """Raise InputError where a field that the robot names is not in its clouds."""
    look = _looks(group).get(robot.cloud_topic or "")
    for name in (robot.label_field, robot.confidence_field):
        if name and look is not None and look.fields and name not in look.fields:
            raise InputError(
                f"{_paths(group)}: the points of '{robot.cloud_topic}' have no field '{name}'; their fields are "
                f"{', '.join(look.fields)}"
            )


def _find_sensor(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The topic that the map is made from: a depth image, else a point cloud."""
    if robot.depth_topic or robot.cloud_topic:
        return {}
    looks = _looks(group)
    depths = [topic for topic, look in looks.items() if look.is_depth]
    if len(depths) > 1:
        # Depth that is registered to the camera of the labels has their size and frame.
        label_looks = {(look.size, look.frame_id) for look in looks.values() if look.is_label}
        registered = [topic for topic in depths if (looks[topic].size, looks[topic].frame_id) in label_looks]
        depths = registered if len(registered) == 1 else depths
    if depths:
        return {"depth_topic": _only(depths, "depth_topic", "depth images", robot, group)}
    for kind, what in ((Kind.CLOUD, "point clouds"), (Kind.SCAN, "laser scans")):
        clouds = [topic for topic, look in looks.items() if look.kind is kind]
        # Of several clouds the one with labels is the one to map.
        labelled = [topic for topic in clouds if looks[topic].has_labels]
        if clouds:
            return {"cloud_topic": _only(labelled if len(labelled) == 1 else clouds, "cloud_topic", what, robot, group)}
    raise InputError(f"{_paths(group)}: no depth image, point cloud or laser scan to map; {_contents(group)}")


def _find_labels(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The label image that goes with the depth image; nothing where the log has none."""
    if robot.label_topic is not None:
        return {}
    looks = _looks(group)
    labels = [topic for topic, look in looks.items() if topic != robot.depth_topic and look.is_label]
    depth = looks.get(robot.depth_topic or "")
    alike = [topic for topic in labels if depth is not None and looks[topic].size == depth.size]
    # Labels as ids say more than their picture in colours.
    ids = [topic for topic in alike or labels if not looks[topic].is_color]
    nearest = _nearest(ids or alike or labels, str(robot.depth_topic))
    return {"label_topic": _only(nearest, "label_topic", "label images", robot, group) if nearest else None}


def _find_confidences(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The image that says how sure the labels are; nothing where the log has none."""
    if robot.confidence_topic is not None or not robot.label_topic:
        return {}
    looks = _looks(group)
    depth = looks.get(robot.depth_topic or "")
    alike = [topic for topic, look in looks.items() if look.is_confidence and depth and look.size == depth.size]
    nearest = _nearest(alike, robot.label_topic)
    return (
        {"confidence_topic": _only(nearest, "confidence_topic", "confidence images", robot, group)} if nearest else {}
    )


def _find_camera_info(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The CameraInfo nearest to the depth image in name."""
    if robot.camera_info_topic is not None or robot.intrinsics is not None:
        return {}
    infos = _nearest(_topics_of(group, (Kind.CAMERA_INFO,)), str(robot.depth_topic))
    if not infos:
        raise InputError(
            f"{_paths(group)}: there is no CameraInfo for '{robot.depth_topic}'; "
            f"give intrinsics: [fx, fy, cx, cy] in the team file"
        )
    return {"camera_info_topic": _only(infos, "camera_info_topic", "CameraInfo topics", robot, group)}


def _find_label_info(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The LabelInfo that goes with the labels; nothing where the log has none."""
    if robot.label_info_topic is not None or not (robot.label_topic or robot.cloud_topic):
        return {}
    # One for all robots of a log belongs to none of them.
    there = _topics_of(group, (Kind.LABEL_INFO,)) or _topics_of_nobody(group, Kind.LABEL_INFO)
    infos = _nearest(there, str(robot.label_topic or robot.cloud_topic))
    return {"label_info_topic": _only(infos, "label_info_topic", "LabelInfo topics", robot, group) if infos else None}


def _find_pose(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """Where the poses come from: odometry, else stamped poses that can be used, else TF."""
    if robot.pose_topic is not None or robot.pose_file is not None:
        return {}
    odometry = _topics_of(group, (Kind.ODOMETRY,))
    if odometry:
        return {"pose_topic": _only(odometry, "pose_topic", "odometry topics", robot, group)}
    stamped = [
        t for t in _topics_of(group, (Kind.POSE, Kind.PATH)) if not any(hint in t.lower() for hint in _NO_POSE_HINTS)
    ]
    moving = moving_tf_names(_tf_of(robot, group))
    # A stamped pose does not say what it is the pose of, so TF is better unless the team file says it.
    if stamped and (robot.T_body_sensor is not None or not moving):
        return {"pose_topic": _only(stamped, "pose_topic", "pose topics", robot, group)}
    if moving:
        return {"pose_topic": moving[0]}
    still = ", or, if the sensor stands still, pose_topic: /tf_static" if _tf_of(robot, group) else ""
    raise InputError(
        f"{_paths(group)}: no poses (odometry, stamped poses, a path or TF) for robot '{robot.robot_id}'; give "
        f"pose_file: a trajectory in TUM's or KITTI's format{still}"
    )


def _find_frames(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The sensor's frame, and the frame that the poses are in."""
    look = _looks(group).get(robot.depth_topic or robot.cloud_topic or "")
    sensor_frame = robot.sensor_frame or (look.frame_id if look is not None and look.frame_id else None)
    found = {"sensor_frame": sensor_frame}
    if robot.map_frame is not None:
        return found
    infos = [topic for survey in group.surveys for topic in survey.topics if topic.name == robot.pose_topic]
    is_tf = any(kind_of(topic.type_name) is Kind.TF for topic in infos)
    if is_tf:
        found["map_frame"] = _root_frame(robot, group, sensor_frame)
    else:
        found["map_frame"] = _pose_frame(group.surveys, str(robot.pose_topic))
    return found


def _pose_frame(surveys: Sequence[Survey], topic: str) -> str | None:
    """The frame that a pose topic's poses are in."""
    for survey in surveys:
        message = first_whole_message(survey.log, topic, POSE_KINDS)
        if message is not None:
            poses = message.sensor_message()
            parents = [pose.parent for pose in poses.transforms] if isinstance(poses, Transforms) else []
            return frame_name(parents[0]) or None if parents else None
    return None


def _root_frame(robot: RobotConfig, group: _Group, sensor_frame: str | None) -> str:
    """The frame at the top of TF above the sensor, from the static transforms and the first seconds of the others."""
    if sensor_frame is None:
        raise InputError(
            f"{_paths(group)}: the messages of '{robot.depth_topic or robot.cloud_topic}' name no frame; "
            f"give sensor_frame"
        )
    tree = FrameTree(0)
    sensor_topic = str(robot.depth_topic or robot.cloud_topic)
    for log in (survey.log for survey in group.surveys):
        topics = tf_topics(log.topics, sensor_topic)
        load_static_transforms(tree, [log], topics)
        moving = moving_tf_names(topics)
        end = (log.start_ns or 0) + _TF_SAMPLE_NS
        for message in itertools.islice(log.messages(moving), _TF_SAMPLE_MESSAGES):
            if message.log_time_ns > end:
                break
            try:
                found = message.sensor_message()
            except DamagedMessageError:
                continue
            if isinstance(found, Transforms):
                tree.add_transforms(found, is_static=False)
    root = tree.root_of(sensor_frame)
    if root == sensor_frame:
        known = ", ".join(tree.frames[:12]) or "none"
        raise InputError(
            f"{_paths(group)}: TF knows no frame above the sensor's frame '{sensor_frame}'; frames: {known}"
        )
    return root


# --- classes ---------------------------------------------------------------------------------------------------------


def _has_labels(robot: RobotConfig, group: _Group) -> bool:
    """True where the robot's log gives labels."""
    if robot.cloud_topic is not None and robot.label_topic is None:
        look = _looks(group).get(robot.cloud_topic)
        if robot.label_field is not None:
            return robot.label_field != ""
        return look is not None and look.has_labels
    return bool(robot.label_topic)


def _class_table(robots: Sequence[RobotConfig], groups: Sequence[_Group], labelled: Sequence[bool]) -> ClassTable:
    """The team's class table from the LabelInfo of the robots with labels; 'occupied' where none has labels."""
    if not any(labelled):
        return OCCUPIED
    names: dict[str, Mapping[int, str]] = {}
    for robot, group in itertools.compress(zip(robots, groups, strict=True), labelled):
        found = _label_info(robot, group)
        if found is not None:
            names[robot.robot_id] = found.names
    if not names:
        topics = [str(robot.label_topic or robot.cloud_topic) for robot in itertools.compress(robots, labelled)]
        raise ConfigError(
            f"labels on '{topics[0]}' but no LabelInfo says what they mean; give 'classes' in the team file, "
            f"such as classes: [{{name: ground, raw_labels: [1]}}, {{name: tree, raw_labels: [2]}}], or --classes"
        )
    return class_table_from_names(names)


def _check_labelled(classes: ClassTable, robots: Sequence[RobotConfig], labelled: Sequence[bool]) -> None:
    """Raise ConfigError where only some robots have labels."""
    if classes.num_classes > 1 and not all(labelled):
        without = robots[labelled.index(False)].robot_id
        raise ConfigError(
            f"robot '{without}' has no labels, but the team has {classes.num_classes} classes; name its label_topic, "
            f"or map all robots without labels (label_topic: '' and one class)"
        )


def _label_info(robot: RobotConfig, group: _Group) -> LabelNames | None:
    """The robot's first LabelInfo message, from anywhere in its logs."""
    if robot.label_info_topic is None:
        return None
    for survey in group.surveys:
        message = first_whole_message(survey.log, robot.label_info_topic, (Kind.LABEL_INFO,))
        found = None if message is None else message.sensor_message()
        if isinstance(found, LabelNames):
            return found
    return None


# --- names -----------------------------------------------------------------------------------------------------------


def _looks(group: _Group) -> dict[str, Look]:
    """The sensor topics of a robot, sorted by name."""
    looks = {topic: look for survey in reversed(group.surveys) for topic, look in survey.looks.items()}
    return {topic: looks[topic] for topic in sorted(looks) if _is_own(topic, group)}


def _topics_of(group: _Group, kinds: Collection[Kind]) -> list[str]:
    """The names of a robot's topics of some kinds that hold messages that can be read, sorted."""
    return sorted(
        {
            topic.name
            for survey in group.surveys
            for topic in survey.topics
            if kind_of(topic.type_name) in kinds and _is_readable(topic)
            if _is_own(topic.name, group)
        }
    )


def _is_readable(topic: TopicInfo) -> bool:
    """True for a topic with messages that can be decoded."""
    return topic.num_messages > 0 and topic.encoding in ENCODINGS


def _topics_of_nobody(group: _Group, kind: Kind) -> list[str]:
    """The names of topics of a kind that belong to none of the robots that share the logs, sorted."""
    shared = (topic for survey in group.surveys for topic in survey.topics if topic.name not in survey.owners)
    return sorted(
        {t.name for t in shared if kind_of(t.type_name) is kind and t.num_messages and t.encoding in ENCODINGS}
    )


def _tf_of(robot: RobotConfig, group: _Group) -> tuple[TopicInfo, ...]:
    """The TF topics that concern a robot."""
    infos = [topic for survey in group.surveys for topic in survey.topics if topic.num_messages]
    return tf_topics(infos, str(robot.depth_topic or robot.cloud_topic))


def _is_own(topic: str, group: _Group) -> bool:
    """True where a topic belongs to the robot, or the log to it alone."""
    return group.namespace is None or any(s.owners.get(topic) == group.namespace for s in group.surveys)


def _nearest(topics: Iterable[str], to: str) -> list[str]:
    """The topics whose names share the most leading parts with another's."""
    target = to.strip("/").split("/")

    def shared(topic: str) -> int:
        pairs = zip(topic.strip("/").split("/"), target, strict=False)
        return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))

    names = list(topics)
    best = max(map(shared, names), default=0)
    return [topic for topic in names if shared(topic) == best]


def _only(topics: Sequence[str], role: str, what: str, robot: RobotConfig, group: _Group) -> str:
    """The only topic of a list. Raises ConfigError with lines for a team file where there are several."""
    if len(topics) == 1:
        return topics[0]
    lines = "".join(f"\n    {role}: {topic}" for topic in topics)
    raise ConfigError(
        f"{_paths(group)}: robot '{robot.robot_id}' has {len(topics)} {what}; put one of these lines into its entry of "
        f"a team file:{lines}"
    )


def _paths(group: _Group) -> str:
    """The robot's logs, as errors begin."""
    return ", ".join(str(survey.path) for survey in group.surveys)


def _contents(group: _Group) -> str:
    """What is in the logs instead, in short."""
    topics = [topic for survey in group.surveys for topic in survey.topics if topic.num_messages]
    if not topics:
        return "the log holds no messages"
    encodings = {topic.encoding for topic in topics}
    if encodings.isdisjoint(ENCODINGS):
        return f"its messages are encoded as {', '.join(sorted(encodings))}; {', '.join(ENCODINGS)} can be read"
    names = sorted({topic.type_name for topic in topics})
    return f"its messages are {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"
