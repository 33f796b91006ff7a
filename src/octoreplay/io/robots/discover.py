"""Finding robots and topics in logs: by message type, image encoding, names and namespaces."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from octoreplay.config import RobotConfig, RunConfig, TimeConfig
from octoreplay.errors import ConfigError, InputError, OctoreplayError
from octoreplay.io.containers.log_reader import DECODABLE_ENCODINGS, LogReader, TopicInfo, first_message
from octoreplay.io.containers.logs import open_log
from octoreplay.io.robots.pose_source import (
    ODOMETRY,
    POSE_TYPES,
    STAMPED_POSES,
    TF_TYPES,
    is_static_tf,
    load_static_transforms,
    tf_topics,
)
from octoreplay.io.robots.poses import FrameTree, frame_name
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.clouds import label_field
from octoreplay.io.sensors.images import DEPTH_ENCODINGS, LABEL_ENCODINGS
from octoreplay.io.sensors.labels import OCCUPIED, class_table_from_names, label_names
from octoreplay.records import ClassTable

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
CLOUD = "sensor_msgs/msg/PointCloud2"
LABEL_INFO = "vision_msgs/msg/LabelInfo"

_DEPTH_HINTS = ("depth", "range", "disparity_z")
_LABEL_HINTS = ("label", "semantic", "segment", "class")
# Poses that are wished for, not measured.
_NO_POSE_HINTS = ("goal", "initialpose", "initial_pose", "target", "setpoint")
# How much of TF is read to find the root of a robot's frames.
_TF_SAMPLE_NS = 5_000_000_000
_TF_SAMPLE_MESSAGES = 5_000

_ROLE_TYPES: Mapping[str, tuple[tuple[str, ...], str]] = {
    "depth_topic": ((IMAGE,), "image"),
    "label_topic": ((IMAGE,), "image"),
    "camera_info_topic": ((CAMERA_INFO,), "CameraInfo"),
    "cloud_topic": ((CLOUD,), "point cloud"),
    "pose_topic": (POSE_TYPES, "pose"),
    "label_info_topic": ((LABEL_INFO,), "LabelInfo"),
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
    """One log: its span in log time (None where it is empty), its topics, and what is damaged."""

    path: Path
    start_ns: int | None
    end_ns: int | None
    num_messages: int
    topics: tuple[TopicSummary, ...]
    damage: str | None


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
class _Look:
    """What the first message of an image or cloud topic shows."""

    encoding: str
    size: tuple[int, int]
    frame_id: str
    has_labels: bool
    detail: str


@dataclass(frozen=True)
class _Survey:
    """One log's topics and what its sensor topics look like."""

    path: Path
    start_ns: int | None
    end_ns: int | None
    num_messages: int
    topics: tuple[TopicInfo, ...]
    looks: Mapping[str, _Look]
    damage: str | None


@dataclass(frozen=True)
class _Group:
    """One robot to be: its logs, and the namespace that is its own where a log holds several robots."""

    robot_id: str
    surveys: tuple[_Survey, ...]
    namespace: str | None


# --- public ----------------------------------------------------------------------------------------------------------


def discover(logs: Sequence[Path]) -> tuple[RobotConfig, ...]:
    """The robots in some logs, with their topics and frames, in the order of the logs.

    A log holds one robot, named by its file; or several, named by the first part of their topics, where at least two
    such namespaces hold a sensor and a pose each. Raises ConfigError where several topics could be meant (its text
    lists them as lines of a team file), InputError where a log has no depth image, point cloud or pose.
    """
    return tuple(_find(_blank(group), group) for group in _groups([_survey(path) for path in logs]))


def resolve(config: RunConfig) -> RunConfig:
    """The configuration with every topic and frame that a robot leaves out, and the class table, filled from the logs.

    The class table is the configured one; else that of the logs' LabelInfo, united by name over the robots; else, where
    no robot has labels, the single class 'occupied'. Raises InputError where a named topic is missing or of another
    type, ConfigError as ``discover`` does, and where there are labels without a class table or for some robots only.
    """
    surveys = {path: _survey(path) for path in dict.fromkeys(itertools.chain(*(r.logs for r in config.robots)))}
    robots, labelled = [], []
    for robot in config.robots:
        group = _group_of(robot, tuple(surveys[path] for path in robot.logs))
        robots.append(_find(robot, group))
        labelled.append(_has_labels(robots[-1], group))
    classes = config.classes or _class_table(robots, labelled)
    if classes.num_classes > 1 and not all(labelled):
        without = robots[labelled.index(False)].robot_id
        raise ConfigError(
            f"robot '{without}' has no labels, but the team has {classes.num_classes} classes; name its label_topic, "
            f"or map all robots without labels (label_topic: '' and one class)"
        )
    return dataclasses.replace(config, robots=tuple(robots), classes=classes)


def describe(logs: Sequence[Path]) -> LogDescription:
    """What is in some logs, and what they lack for a run. Raises InputError where a log cannot be opened."""
    surveys = [_survey(path) for path in logs]
    missing: list[str] = []
    groups = _attempt(lambda: _groups(surveys), missing) or []
    robots = [_robot_summary(group) for group in groups]
    spans = [(r.start_ns, r.end_ns) for r in robots if r.start_ns is not None and r.end_ns is not None]
    start, end = max((s for s, _ in spans), default=0), min((e for _, e in spans), default=0)
    configs = [summary.robot for summary in robots]
    labelled = [_has_labels(config, group) for config, group in zip(configs, groups, strict=True)]
    classes = _attempt(lambda: _class_table(configs, labelled), missing) if configs else None
    return LogDescription(
        logs=tuple(_log_summary(survey) for survey in surveys),
        robots=tuple(robots),
        overlap_ns=(start, end) if spans and start <= end else None,
        class_table=classes,
        missing=tuple(missing),
    )


# --- surveying logs --------------------------------------------------------------------------------------------------


def _survey(path: Path) -> _Survey:
    """A log's topics; of each image and cloud topic the first message is looked at."""
    with open_log(path) as log:
        looks = {}
        for topic in log.topics:
            if topic.type_name in (IMAGE, CLOUD) and topic.encoding in DECODABLE_ENCODINGS and topic.num_messages:
                look = _look(log, topic)
                if look is not None:
                    looks[topic.name] = look
        return _Survey(path, log.start_ns, log.end_ns, log.message_count, log.topics, looks, log.damage)


def _look(log: LogReader, topic: TopicInfo) -> _Look | None:
    """What a topic's first message shows; None where it cannot be decoded."""
    message = first_message(log, topic.name)
    if message is None or message.type_name not in (IMAGE, CLOUD):
        return None
    try:
        value = message.decode()
    except InputError:
        return None
    size = (int(value.width), int(value.height))
    frame_id = frame_name(value.header.frame_id)
    if message.type_name == IMAGE:
        return _Look(value.encoding, size, frame_id, False, f"{value.encoding} {size[0]}x{size[1]}")
    fields = ", ".join(field.name for field in value.fields)
    return _Look("", size, frame_id, label_field(value) is not None, f"{size[0]}x{size[1]}: {fields}")


def _log_summary(survey: _Survey) -> LogSummary:
    """A survey as the user sees it."""
    span = 0.0 if survey.start_ns is None or survey.end_ns is None else (survey.end_ns - survey.start_ns) / 1e9
    topics = []
    for topic in survey.topics:
        look = survey.looks.get(topic.name)
        rate = (topic.num_messages - 1) / span if topic.num_messages > 1 and span > 0 else None
        detail = look.detail if look is not None and topic.type_name in (IMAGE, CLOUD) else ""
        topics.append(TopicSummary(topic.name, topic.type_name, topic.encoding, topic.num_messages, rate, detail))
    return LogSummary(survey.path, survey.start_ns, survey.end_ns, survey.num_messages, tuple(topics), survey.damage)


def _robot_summary(group: _Group) -> RobotSummary:
    """A robot as far as it can be found, with everything that a run would miss."""
    missing: list[str] = []
    robot = _find(_blank(group), group, missing)
    if not missing:
        _attempt(lambda: RobotLog(robot, TimeConfig(), None).close(), missing)
    starts = [s.start_ns for s in group.surveys if s.start_ns is not None]
    ends = [s.end_ns for s in group.surveys if s.end_ns is not None]
    return RobotSummary(robot, min(starts, default=None), max(ends, default=None), tuple(missing))


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


def _groups(surveys: Sequence[_Survey]) -> list[_Group]:
    """The robots of some logs: several of one log by namespace, each of the others by its file."""
    if not surveys:
        raise ConfigError("no logs given")
    shared: dict[str, list[_Survey]] = {}
    groups: list[_Group] = []
    names = _file_names([survey.path for survey in surveys if not _namespaces(survey)])
    for survey in surveys:
        namespaces = _namespaces(survey)
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


def _namespaces(survey: _Survey) -> tuple[str, ...]:
    """The namespaces of a log's robots where it holds several, else nothing."""
    found = []
    for namespace in dict.fromkeys(_first_part(topic) for topic in _sensor_topics(survey)):
        has_pose = any(
            _first_part(topic.name) == namespace and topic.name.count("/") > 1 and topic.type_name in POSE_TYPES
            for topic in survey.topics
        )
        has_frame = any(
            look.frame_id.startswith(f"{namespace}/")
            for topic, look in survey.looks.items()
            if _first_part(topic) == namespace
        )
        if has_pose or has_frame:
            found.append(namespace)
    return tuple(found) if len(found) > 1 else ()


def _sensor_topics(survey: _Survey) -> list[str]:
    """The topics of a log that a map can be made from."""
    return [topic for topic, look in survey.looks.items() if _is_depth(topic, look) or not look.encoding]


def _group_of(robot: RobotConfig, surveys: tuple[_Survey, ...]) -> _Group:
    """The part of its logs in which a robot's missing topics are looked for."""
    namespaces = set(itertools.chain(*(_namespaces(survey) for survey in surveys)))
    named = robot.depth_topic or robot.cloud_topic
    namespace = _first_part(named) if named else robot.robot_id
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
    if found.depth_topic is not None:
        found = _fill(found, _attempt(lambda: _find_labels(found, group), problems))
        found = _fill(found, _attempt(lambda: _find_camera_info(found, group), problems))
    found = _fill(found, _attempt(lambda: _find_label_info(found, group), problems))
    found = _fill(found, _attempt(lambda: _find_pose(found, group), problems))
    if found.pose_topic is not None and (found.depth_topic or found.cloud_topic) is not None:
        found = _fill(found, _attempt(lambda: _find_frames(found, group), problems))
    return found


def _fill(robot: RobotConfig, found: Mapping[str, str | None] | None) -> RobotConfig:
    """The robot with what it leaves out taken from ``found``."""
    missing: dict[str, Any] = {
        key: value for key, value in (found or {}).items() if getattr(robot, key) is None and value is not None
    }
    return dataclasses.replace(robot, **missing) if missing else robot


def _check_named_topics(robot: RobotConfig, group: _Group) -> None:
    """Raise InputError where a topic that the robot names is not in its logs, or is of another type."""
    for role, (types, what) in _ROLE_TYPES.items():
        name = getattr(robot, role)
        if not name:
            continue
        infos = [topic for survey in group.surveys for topic in survey.topics if topic.name == name]
        alike = sorted({t.name for survey in group.surveys for t in survey.topics if t.type_name in types})
        offer = f"{what} topics: {', '.join(repr(n) for n in alike)}" if alike else f"there are no {what} topics"
        if not infos:
            raise InputError(f"{_paths(group)}: topic '{name}' not found; {offer}")
        if not any(info.type_name in types for info in infos):
            raise InputError(f"{_paths(group)}: topic '{name}' is of type {infos[0].type_name}, no {role}; {offer}")
        bad = next((info for info in infos if info.encoding not in DECODABLE_ENCODINGS), None)
        if bad is not None:
            raise InputError(
                f"{_paths(group)}: topic '{name}' is encoded as {bad.encoding}; only ROS messages are read"
            )


def _find_sensor(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The topic that the map is made from: a depth image, else a point cloud."""
    if robot.depth_topic or robot.cloud_topic:
        return {}
    looks = _looks(group)
    depths = [topic for topic, look in looks.items() if _is_depth(topic, look)]
    if len(depths) > 1:
        # Depth that is registered to the camera of the labels has their size and frame.
        label_looks = {(look.size, look.frame_id) for topic, look in looks.items() if _is_label(topic, look)}
        registered = [topic for topic in depths if (looks[topic].size, looks[topic].frame_id) in label_looks]
        depths = registered if len(registered) == 1 else depths
    if depths:
        return {"depth_topic": _only(depths, "depth_topic", "depth images", robot, group)}
    clouds = [topic for topic, look in looks.items() if not look.encoding]
    if clouds:
        return {"cloud_topic": _only(clouds, "cloud_topic", "point clouds", robot, group)}
    raise InputError(f"{_paths(group)}: no depth image and no point cloud to map; {_contents(group)}")


def _find_labels(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The label image that goes with the depth image; nothing where the log has none."""
    if robot.label_topic is not None:
        return {}
    looks = _looks(group)
    labels = [t for t, look in looks.items() if t != robot.depth_topic and _is_label(t, look)]
    depth = looks.get(robot.depth_topic or "")
    alike = [topic for topic in labels if depth is not None and looks[topic].size == depth.size]
    nearest = _nearest(alike or labels, str(robot.depth_topic))
    return {"label_topic": _only(nearest, "label_topic", "label images", robot, group) if nearest else None}


def _find_camera_info(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The CameraInfo nearest to the depth image in name."""
    if robot.camera_info_topic is not None or robot.intrinsics is not None:
        return {}
    infos = _nearest(_topics_of(group, (CAMERA_INFO,)), str(robot.depth_topic))
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
    infos = _nearest(_topics_of(group, (LABEL_INFO,)), str(robot.label_topic or robot.cloud_topic))
    return {"label_info_topic": _only(infos, "label_info_topic", "LabelInfo topics", robot, group) if infos else None}


def _find_pose(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """Where the poses come from: odometry, else stamped poses that can be used, else TF."""
    if robot.pose_topic is not None:
        return {}
    odometry = _topics_of(group, (ODOMETRY,))
    if odometry:
        return {"pose_topic": _only(odometry, "pose_topic", "odometry topics", robot, group)}
    stamped = [t for t in _topics_of(group, STAMPED_POSES) if not any(hint in t.lower() for hint in _NO_POSE_HINTS)]
    moving = [topic for topic in _tf_of(robot, group) if not is_static_tf(topic)]
    # A stamped pose does not say what it is the pose of, so TF is better unless the team file says it.
    if stamped and (robot.T_body_sensor is not None or not moving):
        return {"pose_topic": _only(stamped, "pose_topic", "pose topics", robot, group)}
    if moving:
        return {"pose_topic": moving[0]}
    still = "; if the sensor stands still, give pose_topic: /tf_static" if _tf_of(robot, group) else ""
    raise InputError(f"{_paths(group)}: no poses (Odometry, PoseStamped or /tf) for robot '{robot.robot_id}'{still}")


def _find_frames(robot: RobotConfig, group: _Group) -> dict[str, str | None]:
    """The sensor's frame, and the frame that the poses are in."""
    look = _looks(group).get(robot.depth_topic or robot.cloud_topic or "")
    sensor_frame = robot.sensor_frame or (look.frame_id if look is not None and look.frame_id else None)
    found = {"sensor_frame": sensor_frame}
    if robot.map_frame is not None:
        return found
    paths = [survey.path for survey in group.surveys]
    is_tf = any(t.name == robot.pose_topic and t.type_name in TF_TYPES for s in group.surveys for t in s.topics)
    found["map_frame"] = _root_frame(robot, paths, sensor_frame) if is_tf else _pose_frame(paths, str(robot.pose_topic))
    return found


def _pose_frame(paths: Sequence[Path], topic: str) -> str | None:
    """The frame that a pose topic's poses are in."""
    for path in paths:
        with open_log(path) as log:
            message = first_message(log, topic)
            if message is not None:
                return frame_name(message.header_frame_id()) or None
    return None


def _root_frame(robot: RobotConfig, paths: Sequence[Path], sensor_frame: str | None) -> str:
    """The frame at the top of TF above the sensor, from the static transforms and the first seconds of the others."""
    if sensor_frame is None:
        raise InputError(
            f"{paths[0]}: the messages of '{robot.depth_topic or robot.cloud_topic}' name no frame; give sensor_frame"
        )
    tree = FrameTree(0)
    sensor_topic = str(robot.depth_topic or robot.cloud_topic)
    for path in paths:
        with open_log(path) as log:
            topics = tf_topics(log.topics, sensor_topic)
            load_static_transforms(tree, [log], topics)
            moving = [topic for topic in topics if not is_static_tf(topic)]
            end = (log.start_ns or 0) + _TF_SAMPLE_NS
            for message in itertools.islice(log.messages(moving), _TF_SAMPLE_MESSAGES):
                if message.log_time_ns > end:
                    break
                tree.add_message(message.decode(), is_static=False)
    root = tree.root_of(sensor_frame)
    if root == sensor_frame:
        known = ", ".join(tree.frames[:12]) or "none"
        raise InputError(f"{paths[0]}: TF knows no frame above the sensor's frame '{sensor_frame}'; frames: {known}")
    return root


# --- classes ---------------------------------------------------------------------------------------------------------


def _has_labels(robot: RobotConfig, group: _Group) -> bool:
    """True where the robot's log gives labels."""
    if robot.cloud_topic is not None and robot.label_topic is None:
        look = _looks(group).get(robot.cloud_topic)
        return look is not None and look.has_labels
    return bool(robot.label_topic)


def _class_table(robots: Sequence[RobotConfig], labelled: Sequence[bool]) -> ClassTable:
    """The team's class table from the LabelInfo of the robots with labels; 'occupied' where none has labels."""
    if not any(labelled):
        return OCCUPIED
    names: dict[str, Mapping[int, str]] = {}
    for robot in itertools.compress(robots, labelled):
        message = _label_info(robot)
        if message is not None:
            names[robot.robot_id] = label_names(message)
    if not names:
        topics = [str(robot.label_topic or robot.cloud_topic) for robot in itertools.compress(robots, labelled)]
        raise ConfigError(
            f"labels on '{topics[0]}' but no LabelInfo says what they mean; give 'classes' in the team file, "
            f"such as classes: [{{name: ground, raw_labels: [1]}}, {{name: tree, raw_labels: [2]}}]"
        )
    return class_table_from_names(names)


def _label_info(robot: RobotConfig) -> Any | None:
    """The robot's first LabelInfo message, from anywhere in its logs."""
    if robot.label_info_topic is None:
        return None
    for path in robot.logs:
        with open_log(path) as log:
            message = first_message(log, robot.label_info_topic)
            if message is not None:
                return message.decode()
    return None


# --- names -----------------------------------------------------------------------------------------------------------


def _is_depth(topic: str, look: _Look) -> bool:
    """True for a depth image, by its encoding and, where labels and thermal images share that, by its name."""
    name = topic.lower()
    if look.encoding not in DEPTH_ENCODINGS or any(hint in name for hint in _LABEL_HINTS):
        return False
    return look.encoding in ("32FC1", "16UC1") or any(hint in name for hint in _DEPTH_HINTS)


def _is_label(topic: str, look: _Look) -> bool:
    """True for a label image: an encoding that only labels have, or one that they share and a name that says so."""
    if look.encoding not in LABEL_ENCODINGS:
        return False
    return look.encoding in ("16SC1", "32SC1") or any(hint in topic.lower() for hint in _LABEL_HINTS)


def _looks(group: _Group) -> dict[str, _Look]:
    """The sensor topics of a robot, sorted by name."""
    looks = {topic: look for survey in reversed(group.surveys) for topic, look in survey.looks.items()}
    return {topic: looks[topic] for topic in sorted(looks) if _is_own(topic, group)}


def _topics_of(group: _Group, types: Collection[str]) -> list[str]:
    """The names of a robot's topics of some types that hold messages that can be read, sorted."""
    return sorted(
        {
            topic.name
            for survey in group.surveys
            for topic in survey.topics
            if topic.type_name in types and topic.num_messages and topic.encoding in DECODABLE_ENCODINGS
            if _is_own(topic.name, group)
        }
    )


def _tf_of(robot: RobotConfig, group: _Group) -> tuple[str, ...]:
    """The TF topics that concern a robot."""
    infos = [topic for survey in group.surveys for topic in survey.topics if topic.num_messages]
    return tf_topics(infos, str(robot.depth_topic or robot.cloud_topic))


def _is_own(topic: str, group: _Group) -> bool:
    """True where a topic belongs to the robot's namespace, or the log to it alone."""
    return group.namespace is None or _first_part(topic) == group.namespace


def _first_part(topic: str) -> str:
    """The first part of a topic's name."""
    return topic.strip("/").split("/", 1)[0]


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
    if encodings.isdisjoint(DECODABLE_ENCODINGS):
        return f"its messages are encoded as {', '.join(sorted(encodings))}, and only ROS messages are read"
    names = sorted({topic.type_name for topic in topics})
    return f"its messages are {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"
