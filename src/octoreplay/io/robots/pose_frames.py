"""Frame that a robot's poses are transformed to: the root of TF above them, else the frame that they are given in."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from contextlib import suppress

import numpy as np

from octoreplay.config.resolved import MapFrame
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import LogReader, RawMessage, TopicInfo, first_whole_message
from octoreplay.io.messages.sensor_messages import Kind, StampedTransform, Transforms, kind_of
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.robots.missing_poses import STILL_REMEDY, odometry_remedy
from octoreplay.io.robots.pose_source import POSE_KINDS, load_static_transforms, moving_tf_names, tf_topics
from octoreplay.io.robots.poses import FrameTree, frame_name

# Parts at the beginning and at the end of a log whose TF is read to find frames.
_TF_SAMPLE_NS = 5_000_000_000
_TF_SAMPLE_MESSAGES = 5_000
# Largest distance [m] of a map frame from the poses' frame: the coordinates of earth (ECEF) and utm frames fit no map.
_LARGEST_SHIFT = 10_000.0
# Frames that drift with a robot's odometry by REP 105: odom, camera_odom_frame, ...
_ODOMETRY_FRAME = re.compile(r"(^|_)odom(_|$)")


def find_map_frame(robot: RobotConfig, group: LogGroup) -> MapFrame:
    """Return the map frame of a robot whose topics are known: the configured one, else that of its logs.

    That of the logs is the highest frame that TF joins to the poses, in the first and the last seconds of the logs,
    with these exceptions: a frame more than 10 km away; a frame above one with two parents; and any frame above the
    poses' frame where the chain leads through the robot's own body or is a cycle. Raises InputError where the poses are
    TF and the sensor's frame is unknown or has no parent.
    """
    if robot.pose_topic is None:
        return MapFrame(robot.map_frame)
    sensor_frame = None if robot.sensor_frame is None else frame_name(robot.sensor_frame)
    tree = sampled_tree(robot.depth_topic or robot.cloud_topic or "", group)
    pose_frame: str | None
    is_tf = any(kind_of(topic.type_name) is Kind.TF for topic in group.topics if topic.name == robot.pose_topic)
    if is_tf:
        pose_frame, body = _tf_pose_frame(robot, sensor_frame, tree, group), {sensor_frame}
    else:
        pose = _first_pose(str(robot.pose_topic), group)
        pose_frame = frame_name(pose.parent) or None if pose else None
        body = {sensor_frame, frame_name(pose.child) if pose else None}
    if pose_frame is None:
        return MapFrame(robot.map_frame)
    own = frozenset(name for name in body if name)
    chain = _usable_chain(tree, pose_frame, own)
    name = chain[-1] if robot.map_frame is None else frame_name(robot.map_frame)
    if is_tf and name not in chain:
        # The poses are looked up from the configured frame on.
        pose_frame = name
    frames = frozenset(frame for frame in tree.frames if tree.is_connected(frame, name))
    place = _place(tree, name, pose_frame)
    return MapFrame(name, pose_frame, _is_corrected(tree, name, pose_frame), place, frames, own)


def sampled_tree(sensor_topic: str, group: LogGroup) -> FrameTree:
    """Return TF above a sensor: all static transforms, and the moving ones of the logs' first and last seconds."""
    topics = tf_topics([topic for topic in group.topics if topic.num_messages], sensor_topic)
    trees = group.surveys[0].frame_trees
    key = (tuple(survey.path for survey in group.surveys), tuple(topic.name for topic in topics))
    if key not in trees:
        tree = trees[key] = FrameTree(0)
        for survey in group.surveys:
            load_static_transforms(tree, [survey.log], topics)
            for message in _moving_sample(survey.log, topics):
                with suppress(InputError):
                    found = message.sensor_message()
                    if isinstance(found, Transforms):
                        tree.add_transforms(found, is_static=False)
    return trees[key]


def _moving_sample(log: LogReader, topics: Iterable[TopicInfo]) -> Iterable[RawMessage]:
    """Messages of moving transforms in the first and the last seconds of a log."""
    names, start_ns, end_ns = moving_tf_names(tuple(topics)), log.start_ns, log.end_ns
    if not names or start_ns is None or end_ns is None:
        return
    last_ns = max(end_ns - _TF_SAMPLE_NS, start_ns + _TF_SAMPLE_NS)
    for messages in (log.messages(names, start_ns, start_ns + _TF_SAMPLE_NS), log.messages(names, last_ns, None)):
        yield from itertools.islice(messages, _TF_SAMPLE_MESSAGES)


def _first_pose(topic: str, group: LogGroup) -> StampedTransform | None:
    """First pose of a topic; None without one."""
    for survey in group.surveys:
        message = first_whole_message(survey.log, topic, POSE_KINDS)
        found = None if message is None else message.sensor_message()
        if isinstance(found, Transforms) and found.transforms:
            return found.transforms[0]
    return None


def _tf_pose_frame(robot: RobotConfig, sensor_frame: str | None, tree: FrameTree, group: LogGroup) -> str:
    """Frame of the poses where they are TF: the odometry frame above the sensor, else the parent of what moves."""
    sensor_topic = robot.depth_topic or robot.cloud_topic
    if sensor_frame is None:
        raise InputError(f"{group.paths}: the messages of '{sensor_topic}' name no frame; give sensor_frame")
    above = list(tree.ancestors(sensor_frame))
    if robot.map_frame is None and len(above) == 1:
        known = ", ".join(tree.frames[:12]) or "none"
        raise InputError(
            f"{group.paths}: TF has no frame above the sensor's frame '{sensor_frame}'; frames in TF: {known}; give "
            f"sensor_frame, pose_file ({odometry_remedy(robot.logs)}), or {STILL_REMEDY}"
        )
    odometry = [frame for frame in above[1:] if _ODOMETRY_FRAME.search(frame.rsplit("/", 1)[-1])]
    if odometry:
        return odometry[-1]
    moving = [parent for child, parent in itertools.pairwise(above) if not tree.is_fixed(parent, child)]
    return moving[-1] if moving else above[-1]


def _usable_chain(tree: FrameTree, pose_frame: str, own: frozenset[str]) -> list[str]:
    """The poses' frame and the frames above it, as far as they can serve as map frame."""
    chain = list(tree.ancestors(pose_frame))
    if own.intersection(chain) or tree.is_cyclic(pose_frame):
        return [pose_frame]
    for number, child in enumerate(chain[:-1]):
        sample = tree.edge_sample(child)
        if sample is None or tree.has_two_parents(child) or np.abs(sample[0][:3, 3]).max() > _LARGEST_SHIFT:
            return chain[: number + 1]
    return chain


def _place(tree: FrameTree, name: str, pose_frame: str) -> tuple[float, ...] | None:
    """Product of the constant transforms that lead down from the map frame to the poses' frame, by rows."""
    chain = list(tree.ancestors(pose_frame))
    result, is_placed = np.eye(4), False
    for child in reversed(chain[: chain.index(name)] if name in chain else []):
        sample = tree.edge_sample(child)
        if sample is None or not sample[1]:
            break
        result, is_placed = result @ sample[0], True
    return tuple(result.ravel().tolist()) if is_placed else None


def _is_corrected(tree: FrameTree, name: str, pose_frame: str) -> bool:
    """True where a transform between the map frame and the poses' frame changes."""
    chain = list(tree.ancestors(pose_frame))
    if name not in chain:
        return tree.is_connected(name, pose_frame) and not tree.is_fixed(name, pose_frame)
    samples = [tree.edge_sample(child) for child in chain[: chain.index(name)]]
    return any(sample is None or not sample[1] for sample in samples)
