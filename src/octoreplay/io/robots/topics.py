"""Topics and frames that a robot's configuration leaves out, found in its logs."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

from octoreplay.config.robot import RobotConfig
from octoreplay.config.robot_sensor import SENSOR_KEYS, RobotSensor
from octoreplay.errors import ConfigError, InputError, OctoreplayError, suggestion
from octoreplay.io.containers.log_reader import TopicInfo
from octoreplay.io.messages.decoders import ENCODINGS
from octoreplay.io.messages.sensor_messages import Kind, kind_of
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.robots.missing_poses import STILL_REMEDY, odometry_remedy
from octoreplay.io.robots.pose_frames import find_map_frame
from octoreplay.io.robots.pose_source import POSE_KINDS, moving_tf_names, tf_topics
from octoreplay.io.robots.survey import CLOUDS, IMAGES, PACKETS, TopicSample

# Poses that are commanded, not measured.
_NO_POSE_HINTS = ("goal", "initialpose", "initial_pose", "target", "setpoint")

# Fixes that a filter computed from the poses and other fixes.
_NO_FIX_HINTS = ("filtered", "odometry")

# Keys of a robot with several sensors that are found with each of them.
_SHARED_KEYS = ("pose_topic", "label_info_topic", "fix_topic", "tags_topic", "map_frame")

# Words by which the topics of a robot's sensors differ.
_MOUNT = re.compile(r"front|rear|back|left|right|top|bottom|center|centre|\d+")

_ROLE_KINDS: Mapping[str, tuple[tuple[Kind, ...], str]] = {
    "depth_topic": (IMAGES, "image"),
    "label_topic": (IMAGES, "image"),
    "confidence_topic": (IMAGES, "image"),
    "camera_info_topic": ((Kind.CAMERA_INFO,), "CameraInfo"),
    "cloud_topic": (CLOUDS, "point cloud or laser scan"),
    "pose_topic": (POSE_KINDS, "pose"),
    "label_info_topic": ((Kind.LABEL_INFO,), "LabelInfo"),
    "fix_topic": ((Kind.FIX,), "position fix"),
    "tags_topic": ((Kind.TAGS, Kind.TF), "tag"),
}

T = TypeVar("T")


def find_topics(robot: RobotConfig, group: LogGroup, problems: list[str] | None = None) -> RobotConfig:
    """Return the robot with its missing topics and frames filled from its logs.

    Raises ConfigError where several topics fit, InputError where a topic is missing or unfit. With ``problems`` such
    errors are appended to it instead and the topic is left out.
    """
    sensors = robot.sensors or attempt(lambda: _several_sensors(robot, group), problems) or ()
    if not sensors:
        return find_topics_of_one(robot, group, problems)
    robot = dataclasses.replace(robot, sensors=sensors)
    for index in range(len(sensors)):
        # The poses and frames that are found for the first sensor hold for the others too.
        view = find_topics_of_one(robot.views[index], group, problems)
        found = RobotSensor(**{name: getattr(view, name) for name in SENSOR_KEYS})
        shared = {name: getattr(view, name) for name in _SHARED_KEYS}
        others = robot.sensors[:index], robot.sensors[index + 1 :]
        robot = dataclasses.replace(robot, sensors=(*others[0], found, *others[1]), **shared)
    return robot


def other_sensors(robot: RobotConfig, group: LogGroup) -> list[str]:
    """Return the sensor topics in frames of their own that a robot with one sensor does not use, sorted."""
    samples = group.samples()
    own = samples.get(robot.depth_topic or robot.cloud_topic or "")
    if own is None or robot.sensors:
        return []
    named = (robot.label_topic, robot.confidence_topic)
    found = [name for name, sample in samples.items() if sample.is_sensor and name not in named]
    return [name for name in found if samples[name].frame_id not in ("", own.frame_id)]


def find_topics_of_one(robot: RobotConfig, group: LogGroup, problems: list[str] | None = None) -> RobotConfig:
    """Return the robot with one sensor, with its missing topics and frames filled from its logs.

    Errors are those of ``find_topics``; several sensors that fit are one of them.
    """
    attempt(lambda: _check_named_topics(robot, group), problems)
    found = _fill(robot, attempt(lambda: _find_sensor(robot, group), problems))
    attempt(lambda: _check_named_fields(found, group), problems)
    if found.depth_topic is not None:
        found = _fill(found, attempt(lambda: _find_labels(found, group), problems))
        found = _fill(found, attempt(lambda: _find_confidences(found, group), problems))
        found = _fill(found, attempt(lambda: _find_camera_info(found, group), problems))
    found = _fill(found, attempt(lambda: _find_label_info(found, group), problems))
    found = _fill(found, attempt(lambda: _find_pose(found, group), problems))
    if found.pose_topic is not None:
        found = _fill(found, attempt(lambda: _find_frames(found, group), problems))
    return _fill(found, _find_known_places(group))


def attempt(step: Callable[[], T], problems: list[str] | None) -> T | None:
    """Return a step's result; with ``problems`` an error of the step is appended to it, and the result is None."""
    try:
        return step()
    except OctoreplayError as error:
        if problems is None:
            raise
        problems.append(str(error))
        return None


def _fill(robot: RobotConfig, found: Mapping[str, str | None] | None) -> RobotConfig:
    """The robot with its missing fields taken from ``found``."""
    missing: dict[str, Any] = {
        key: value for key, value in (found or {}).items() if getattr(robot, key) is None and value is not None
    }
    return dataclasses.replace(robot, **missing) if missing else robot


# --- named topics ----------------------------------------------------------------------------------------------------


def _check_named_topics(robot: RobotConfig, group: LogGroup) -> None:
    """Raise InputError where a topic that the robot names is not in its logs, or is of another type."""
    for role, (kinds, what) in _ROLE_KINDS.items():
        name = getattr(robot, role)
        if not name:
            continue
        infos = [topic for topic in group.topics if topic.name == name]
        alike = sorted({topic.name for topic in group.topics if kind_of(topic.type_name) in kinds})
        offer = f"{what} topics: {', '.join(repr(n) for n in alike)}" if alike else f"there are no {what} topics"
        if not infos:
            raise InputError(f"{group.paths}: topic '{name}' not found; {offer}{suggestion(name, alike)}")
        if not any(kind_of(info.type_name) in kinds for info in infos):
            raise InputError(
                f"{group.paths}: topic '{name}' is of type {infos[0].type_name} and cannot be the {role}; {offer}"
            )
        bad = next((info for info in infos if info.encoding not in ENCODINGS), None)
        if bad is not None:
            raise InputError(
                f"{group.paths}: topic '{name}' is encoded as {bad.encoding}; {', '.join(ENCODINGS)} can be read"
            )


def _check_named_fields(robot: RobotConfig, group: LogGroup) -> None:
    """Raise InputError where a field that the robot names is not in its clouds."""
    sample = group.samples().get(robot.cloud_topic or "")
    for name in (robot.label_field, robot.confidence_field):
        if name and sample is not None and sample.fields and name not in sample.fields:
            raise InputError(
                f"{group.paths}: the points of '{robot.cloud_topic}' have no field '{name}'; their fields are "
                f"{', '.join(sample.fields)}"
            )


# --- sensor ----------------------------------------------------------------------------------------------------------


def _find_sensor(robot: RobotConfig, group: LogGroup) -> dict[str, str | None]:
    """Topic that the map is made from: a depth image, else a point cloud, else a laser scan."""
    if robot.depth_topic or robot.cloud_topic:
        return {}
    role, topics, what = _sensor_candidates(group)
    return {role: _only(topics, role, what, robot, group)}


def _sensor_candidates(group: LogGroup) -> tuple[str, list[str], str]:
    """Key, topics and name of the preferred kind of sensor in a robot's logs. Raises InputError without any."""
    samples = group.samples()
    depths = [topic for topic, sample in samples.items() if sample.is_depth]
    if len(depths) > 1:
        # Depth images that are registered to the camera of the labels have their size and frame.
        label_images = {(sample.size, sample.frame_id) for sample in samples.values() if sample.is_label}
        registered = [topic for topic in depths if (samples[topic].size, samples[topic].frame_id) in label_images]
        depths = registered if len(registered) == 1 else depths
    if depths:
        return "depth_topic", depths, "depth images"
    for kind, what in ((Kind.CLOUD, "point clouds"), (Kind.SCAN, "laser scans")):
        clouds = [topic for topic, sample in samples.items() if sample.kind is kind]
        # The only cloud with labels is preferred to clouds without.
        labelled = [topic for topic in clouds if samples[topic].has_labels]
        if clouds:
            return "cloud_topic", labelled if len(labelled) == 1 else without_packets(clouds, samples), what
    raise group.no_sensor("no depth image, point cloud or laser scan to map")


def without_packets(clouds: list[str], samples: Mapping[str, TopicSample]) -> list[str]:
    """Return the topics of clouds without those of packets, which a driver may have decoded; packets if alone."""
    return [topic for topic in clouds if samples[topic].encoding != PACKETS] or clouds


def _several_sensors(robot: RobotConfig, group: LogGroup) -> tuple[RobotSensor, ...]:
    """Sensors in frames of their own whose topics differ by a mount or a number; empty where one is configured."""
    if any(getattr(robot, name) is not None for name in SENSOR_KEYS) or not any(
        sample.is_sensor for sample in group.samples().values()
    ):
        return ()
    role, topics, _ = _sensor_candidates(group)
    frames = {group.samples()[topic].frame_id for topic in topics}
    # Other topics may be the same measurements in another frame, such as registered images and clouds.
    is_alike = len({_MOUNT.sub("", topic.lower()) for topic in topics}) == 1
    if len(topics) < 2 or len(frames) < len(topics) or "" in frames or not is_alike:
        return ()
    if role == "depth_topic":
        return tuple(RobotSensor(depth_topic=topic) for topic in topics)
    return tuple(RobotSensor(cloud_topic=topic) for topic in topics)


def _find_labels(robot: RobotConfig, group: LogGroup) -> dict[str, str | None]:
    """Label image that goes with the depth image; None where the log has none."""
    if robot.label_topic is not None:
        return {}
    samples = group.samples()
    labels = [topic for topic, sample in samples.items() if topic != robot.depth_topic and sample.is_label]
    depth = samples.get(robot.depth_topic or "")
    alike = [topic for topic in labels if depth is not None and samples[topic].size == depth.size]
    # Images of ids are preferred: a class may have no colour of its own.
    ids = [topic for topic in alike or labels if not samples[topic].is_color]
    nearest = nearest_topics(ids or alike or labels, str(robot.depth_topic))
    return {"label_topic": _only(nearest, "label_topic", "label images", robot, group) if nearest else None}


def _find_confidences(robot: RobotConfig, group: LogGroup) -> dict[str, str | None]:
    """Confidence image that goes with the label image; empty where the log has none."""
    if robot.confidence_topic is not None or not robot.label_topic:
        return {}
    samples = group.samples()
    depth = samples.get(robot.depth_topic or "")
    alike = [topic for topic, sample in samples.items() if sample.is_confidence and depth and sample.size == depth.size]
    nearest = nearest_topics(alike, robot.label_topic)
    return (
        {"confidence_topic": _only(nearest, "confidence_topic", "confidence images", robot, group)} if nearest else {}
    )


def _find_camera_info(robot: RobotConfig, group: LogGroup) -> dict[str, str | None]:
    """CameraInfo nearest to the depth image in name."""
    if robot.camera_info_topic is not None or robot.intrinsics is not None:
        return {}
    infos = nearest_topics(group.topics_of((Kind.CAMERA_INFO,)), str(robot.depth_topic))
    if not infos:
        raise InputError(
            f"{group.paths}: there is no CameraInfo for '{robot.depth_topic}'; "
            f"give intrinsics: [fx, fy, cx, cy] in the team file"
        )
    return {"camera_info_topic": _only(infos, "camera_info_topic", "CameraInfo topics", robot, group)}


def _find_label_info(robot: RobotConfig, group: LogGroup) -> dict[str, str | None]:
    """LabelInfo that goes with the labels; None where the log has none."""
    if robot.label_info_topic is not None or not (robot.label_topic or robot.cloud_topic):
        return {}
    # A LabelInfo for all robots of a log is owned by none of them.
    present = group.topics_of((Kind.LABEL_INFO,)) or group.unowned_topics(Kind.LABEL_INFO)
    infos = nearest_topics(present, str(robot.label_topic or robot.cloud_topic))
    return {"label_info_topic": _only(infos, "label_info_topic", "LabelInfo topics", robot, group) if infos else None}


def _find_known_places(group: LogGroup) -> dict[str, str | None]:
    """First topics, by name, of position fixes and of detected tags; None where the log has none."""
    fixes = [topic for topic in group.topics_of((Kind.FIX,)) if not any(hint in topic for hint in _NO_FIX_HINTS)]
    return {"fix_topic": next(iter(fixes), None), "tags_topic": next(iter(group.topics_of((Kind.TAGS,))), None)}


# --- poses and frames ------------------------------------------------------------------------------------------------


def _find_pose(robot: RobotConfig, group: LogGroup) -> dict[str, str | None]:
    """Source of the poses: odometry, else stamped poses that can be used, else TF."""
    if robot.has_poses:
        return {}
    odometry = group.topics_of((Kind.ODOMETRY,))
    if odometry:
        return {"pose_topic": _only(odometry, "pose_topic", "odometry topics", robot, group)}
    stamped = [
        t for t in group.topics_of((Kind.POSE, Kind.PATH)) if not any(hint in t.lower() for hint in _NO_POSE_HINTS)
    ]
    tf = _tf_of(robot, group)
    moving = moving_tf_names(tf)
    # A stamped pose does not name the frame that it locates, so TF is preferred unless T_body_sensor is given.
    if stamped and (robot.T_body_sensor is not None or not moving):
        return {"pose_topic": _only(stamped, "pose_topic", "pose topics", robot, group)}
    if moving:
        return {"pose_topic": moving[0]}
    static = ", or pose_topic: /tf_static if TF has that pose" if tf else ""
    raise InputError(
        f"{group.paths}: no poses (odometry, stamped poses, a path or TF) for robot '{robot.robot_id}'; "
        f"{odometry_remedy(robot.logs)}; or give pose_file: a trajectory file, or "
        f"{STILL_REMEDY}{static}"
    )


def _find_frames(robot: RobotConfig, group: LogGroup) -> dict[str, str | None]:
    """Frame of the sensor, and map frame."""
    sample = group.samples().get(robot.depth_topic or robot.cloud_topic or "")
    sensor_frame = robot.sensor_frame or (sample.frame_id if sample is not None and sample.frame_id else None)
    kinds = {kind_of(topic.type_name) for topic in group.topics if topic.name == robot.pose_topic}
    # Without a sensor, which is missed elsewhere, TF has no frame to begin with.
    if robot.map_frame is not None or (sample is None and Kind.TF in kinds):
        return {"sensor_frame": sensor_frame}
    frame = find_map_frame(dataclasses.replace(robot, sensor_frame=sensor_frame), group)
    return {"sensor_frame": sensor_frame, "map_frame": frame.name}


def _tf_of(robot: RobotConfig, group: LogGroup) -> tuple[TopicInfo, ...]:
    """TF topics that concern a robot."""
    infos = [topic for topic in group.topics if topic.num_messages]
    return tf_topics(infos, str(robot.depth_topic or robot.cloud_topic))


# --- names -----------------------------------------------------------------------------------------------------------


def nearest_topics(topics: Iterable[str], to: str) -> list[str]:
    """Return the topics whose names share the most leading parts with another topic's."""
    target = to.strip("/").split("/")

    def num_shared(topic: str) -> int:
        pairs = zip(topic.strip("/").split("/"), target, strict=False)
        return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))

    names = list(topics)
    best = max(map(num_shared, names), default=0)
    return [topic for topic in names if num_shared(topic) == best]


def _only(topics: Sequence[str], role: str, what: str, robot: RobotConfig, group: LogGroup) -> str:
    """The only topic of a list. Raises ConfigError with lines for a team file where there are several."""
    if len(topics) == 1:
        return topics[0]
    lines = "".join(f"\n    {role}: {topic}" for topic in topics)
    several = ", or each into an entry of its sensors" if role in ("depth_topic", "cloud_topic") else ""
    raise ConfigError(
        f"{group.paths}: robot '{robot.robot_id}' has {len(topics)} {what}; put one of these lines into its entry of "
        f"a team file{several}:{lines}"
    )
