"""Position fixes of a robot and tags that it saw, with the robot's poses at these times."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.messages.sensor_messages import Kind, PositionFix, StampedTransform, Transforms, kind_of
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.poses import frame_name
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.sensor_logs import SensorLogs
from octoreplay.io.robots.thinning import Thinning
from octoreplay.records import Float64Array
from octoreplay.transforms import normalise, pose_matrix

_Stamped = TypeVar("_Stamped", PositionFix, StampedTransform)

# Frames of tags in TF: tag36h11:3 (apriltag_ros of ROS 2, isaac_ros_apriltag), tag_3 (apriltag_ros of ROS 1).
_TAG_FRAME = re.compile(r"(?P<tag>tag[A-Za-z0-9]+:\d+)|tag_(?P<id>\d+)")
# Poses this long before the first fix or tag are read.
_POSE_MARGIN_NS = 5_000_000_000


@dataclass(frozen=True, eq=False)
class Fixes:
    """Position fixes of one robot, with the antenna's position in the robot's map frame.

    - ``seconds`` (n,) float64: time since the first one [s].
    - ``geodetic`` (n, 3) float64: latitude, longitude [degree], height above the ellipsoid [m], in WGS 84.
    - ``sigmas`` (n, 2) float64: standard deviations [m] of a horizontal coordinate and of the height; NaN if unknown.
    - ``points_map`` (n, 3) float64: the antenna [m]. The sensor stands for an antenna whose place TF does not give.
    """

    seconds: Float64Array
    geodetic: Float64Array
    sigmas: Float64Array
    points_map: Float64Array

    def __len__(self) -> int:
        return len(self.seconds)


@dataclass(frozen=True, eq=False)
class Sightings:
    """Known places in one robot's logs.

    - ``fixes``: position fixes with a pose.
    - ``tags``: T_map_tag (n, 4, 4) float64 of each tag that was seen, by name.
    - ``notes``: sentences on fixes and tags that cannot be used.
    """

    fixes: Fixes
    tags: Mapping[str, Float64Array]
    notes: tuple[str, ...] = ()


_NO_FIXES = Fixes(np.empty(0), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 3)))


def read_sightings(log: RobotLog | SensorLogs, time: TimeConfig) -> Sightings:
    """Return the position fixes and the tags in the replayed part of a robot's logs.

    Fixes come from ``fix_topic``. Tags come from ``tags_topic``; without one from all moving transforms, as children
    with names such as ``tag36h11:3``. Invalid fixes, messages that cannot be decoded, and fixes and tags without a pose
    of the robot are left out.
    """
    robot, poses = log.robot, log.pose_source()
    fixes, tags, undecoded = _decoded(log, time, poses)
    valid = [fix for fix in fixes if fix.is_valid]
    T_map_sensors = _poses_at(log, poses, sorted({*(fix.stamp_ns for fix in valid), *(tag.stamp_ns for tag in tags)}))
    located = [fix for fix in valid if fix.stamp_ns in T_map_sensors]
    seen, unplaced = _seen_tags(tags, T_map_sensors, poses)
    notes = [
        f"none of the {number} messages of {robot.robot_id} on '{topic}' can be decoded"
        for topic, number in sorted(undecoded.items())
        if (topic == robot.fix_topic and not fixes) or (topic == robot.tags_topic and not tags)
    ]
    if fixes and not located:
        cause = (
            "have a pose at their time" if valid else "are valid: they have no fix, NaN, or latitude and longitude 0"
        )
        notes.append(f"none of the {len(fixes)} position fixes of {robot.robot_id} on '{robot.fix_topic}' {cause}")
    if tags and not seen and robot.tags_topic:
        cause = (
            f"no fixed transform in TF leads from their frame '{unplaced[0]}' to the sensor's"
            if unplaced
            else "there is no pose at their time"
        )
        notes.append(f"the tags of {robot.robot_id} on '{robot.tags_topic}' are not used: {cause}")
    return Sightings(_fixes(located, T_map_sensors, poses), seen, tuple(notes))


def _decoded(
    log: RobotLog | SensorLogs, time: TimeConfig, poses: PoseSource
) -> tuple[list[PositionFix], list[StampedTransform], Counter[str]]:
    """Fixes and detections in the span of ``time``, and the number of messages that cannot be decoded, by topic."""
    robot, fixes, tags, undecoded = log.robot, [], [], Counter[str]()
    tags_topics = poses.moving_tf if robot.tags_topic is None else (robot.tags_topic,)
    # A thinned log has the fixes and tags of its whole span.
    thinning = Thinning(replace(time, every=1, rate_limit=None), log.first_stamp_ns - robot.clock_offset_ns)

    def stamped(entry: _Stamped, message: RawMessage) -> _Stamped:
        return entry if time.clock == "header" else replace(entry, stamp_ns=message.log_time_ns)

    for message in log.messages([topic for topic in (robot.fix_topic, *tags_topics) if topic]):
        is_tf = kind_of(message.type_name) is Kind.TF
        # Most TF holds no tags and need not be decoded; every encoding stores names as they are.
        if is_tf and b"tag" not in bytes(message.data):
            continue
        try:
            found = message.sensor_message()
        except InputError:
            undecoded[message.topic] += 1
            continue
        if isinstance(found, PositionFix):
            fixes.append(stamped(found, message))
        elif isinstance(found, Transforms):
            tags += [stamped(tag, message) for tag in (_tags_of_tf(found) if is_tf else found.transforms)]
    return (
        [fix for fix in fixes if thinning.keeps(fix.stamp_ns)],
        [tag for tag in tags if thinning.keeps(tag.stamp_ns)],
        undecoded,
    )


def _tags_of_tf(found: Transforms) -> list[StampedTransform]:
    """Transforms to frames of tags, with the tag's name as child."""
    matches = ((tf, _TAG_FRAME.fullmatch(frame_name(tf.child).rsplit("/", 1)[-1])) for tf in found.transforms)
    return [replace(tf, child=match["tag"] or match["id"]) for tf, match in matches if match is not None]


def _poses_at(log: RobotLog | SensorLogs, poses: PoseSource, stamps: Sequence[int]) -> dict[int, Float64Array]:
    """T_map_sensor (4, 4) at those of some ascending stamps that have a pose."""
    if not stamps:
        return {}
    for _ in log.pose_messages(poses, stamps[0] - _POSE_MARGIN_NS):
        if poses.is_known(stamps[-1]):
            break
    found = ((stamp, poses.at(stamp)) for stamp in stamps)
    return {stamp: T_map_sensor for stamp, T_map_sensor in found if T_map_sensor is not None}


def _fixes(fixes: Sequence[PositionFix], T_map_sensors: Mapping[int, Float64Array], poses: PoseSource) -> Fixes:
    """Fixes with the antenna's position in the map frame."""
    if not fixes:
        return _NO_FIXES
    mounts = {frame_id: poses.T_sensor_frame(frame_id) for frame_id in {fix.frame_id for fix in fixes}}

    def antenna(fix: PositionFix) -> Float64Array:
        T_map_sensor, T_sensor_antenna = T_map_sensors[fix.stamp_ns], mounts[fix.frame_id]
        T_map_antenna = T_map_sensor if T_sensor_antenna is None else T_map_sensor @ T_sensor_antenna
        return np.asarray(T_map_antenna[:3, 3])

    stamps = np.array([fix.stamp_ns for fix in fixes], np.int64)
    return Fixes(
        (stamps - stamps.min()) / 1e9,
        np.array([(fix.latitude, fix.longitude, fix.altitude) for fix in fixes]),
        np.array([(fix.sigma, fix.height_sigma) for fix in fixes]),
        np.array([antenna(fix) for fix in fixes]),
    )


def _seen_tags(
    tags: Sequence[StampedTransform], T_map_sensors: Mapping[int, Float64Array], poses: PoseSource
) -> tuple[dict[str, Float64Array], list[str]]:
    """T_map_tag (n, 4, 4) by tag, and the frames of tags that no fixed transform joins to the sensor."""
    mounts = {parent: poses.T_sensor_frame(parent) for parent in sorted({tag.parent for tag in tags})}
    seen: dict[str, list[Float64Array]] = {}
    for tag in tags:
        T_map_sensor, T_sensor_parent = T_map_sensors.get(tag.stamp_ns), mounts[tag.parent]
        rotation = normalise(tag.rotation)
        if T_map_sensor is None or T_sensor_parent is None or rotation is None:
            continue
        if all(map(math.isfinite, tag.translation)):
            T_map_tag = T_map_sensor @ T_sensor_parent @ pose_matrix(tag.translation, rotation)
            seen.setdefault(tag.child, []).append(T_map_tag)
    unplaced = [parent for parent, mount in mounts.items() if mount is None]
    return {name: np.array(seen[name]) for name in sorted(seen)}, unplaced
