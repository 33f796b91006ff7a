"""Frame that a robot's poses are given in: named by the first pose, or the root of TF above the sensor."""

from __future__ import annotations

import itertools

from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import first_whole_message
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Transforms
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.robots.pose_source import POSE_KINDS, load_static_transforms, moving_tf_names, tf_topics
from octoreplay.io.robots.poses import FrameTree, frame_name

# Part of TF that is read to find the root of a robot's frames.
_TF_SAMPLE_NS = 5_000_000_000
_TF_SAMPLE_MESSAGES = 5_000


def first_pose_frame(topic: str, group: LogGroup) -> str | None:
    """Return the frame that the first pose of a topic is given in; None where it names none."""
    for survey in group.surveys:
        message = first_whole_message(survey.log, topic, POSE_KINDS)
        if message is not None:
            poses = message.sensor_message()
            parents = [pose.parent for pose in poses.transforms] if isinstance(poses, Transforms) else []
            return frame_name(parents[0]) or None if parents else None
    return None


def root_frame(sensor_topic: str, sensor_frame: str | None, group: LogGroup) -> str:
    """Return the root of TF above a sensor, from the static transforms and the first seconds of the others.

    Raises InputError where the sensor's frame is unknown or has no parent.
    """
    if sensor_frame is None:
        raise InputError(f"{group.paths}: the messages of '{sensor_topic}' name no frame; give sensor_frame")
    tree = FrameTree(0)
    for log in (survey.log for survey in group.surveys):
        topics = tf_topics(log.topics, sensor_topic)
        load_static_transforms(tree, [log], topics)
        end_ns = (log.start_ns or 0) + _TF_SAMPLE_NS
        for message in itertools.islice(log.messages(moving_tf_names(topics)), _TF_SAMPLE_MESSAGES):
            if message.log_time_ns > end_ns:
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
            f"{group.paths}: TF has no frame above the sensor's frame '{sensor_frame}'; frames in TF: {known}"
        )
    return root
