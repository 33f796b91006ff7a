"""Where a robot's sensor is at a stamp: from a pose topic and TF, or from TF alone."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, TypeAlias

import numpy as np

from octoreplay.config import RobotConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import LogReader, RawMessage, TopicInfo, first_message
from octoreplay.io.messages.ros_types import stamp_to_ns
from octoreplay.io.robots.poses import FrameTree, PoseTrack, frame_name, transform_of
from octoreplay.records import Float64Array

ODOMETRY = "nav_msgs/msg/Odometry"
STAMPED_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
Link: TypeAlias = tuple[str, str]
"""A transform that TF must give: its target frame and its source frame."""

POSE_TYPES = (ODOMETRY, *STAMPED_POSES, *TF_TYPES)
"""Message types that a pose topic can have."""


def is_static_tf(topic: str) -> bool:
    """True for the topic of transforms that never change."""
    return topic.rsplit("/", 1)[-1] == "tf_static"


def tf_topics(topics: Collection[TopicInfo], sensor_topic: str) -> tuple[str, ...]:
    """The TF topics that concern a sensor topic: those in a namespace above it, else all."""
    names = sorted({topic.name for topic in topics if topic.type_name in TF_TYPES})
    above = [name for name in names if f"/{sensor_topic.lstrip('/')}".startswith(_folder(name))]
    return tuple(above or names)


def load_static_transforms(tree: FrameTree, logs: Sequence[LogReader], topics: Collection[str]) -> None:
    """Put every static transform of the logs into a tree, wherever in the files it stands."""
    static = [topic for topic in topics if is_static_tf(topic)]
    for log in logs:
        for message in log.messages(static):
            tree.add_message(message.decode(), is_static=True)


class PoseSource:
    """The pose of one robot's sensor in its map frame over time.

    ``topics`` are those whose messages it must be given through ``take``, in the order of the log. A pose is the
    product T_map_origin T_origin_body T_body_sensor: the middle one from the pose topic, the others from TF where they
    are not the identity or given; without a pose topic the whole of it comes from TF.
    Raises InputError where the log cannot give such a pose at any time.
    """

    def __init__(
        self,
        robot: RobotConfig,
        logs: Sequence[LogReader],
        *,
        sensor_topic: str,
        sensor_frame: str,
        pose_gap_ns: int,
        use_log_time: bool,
    ) -> None:
        self._robot = robot
        self._logs = logs
        self._use_log_time = use_log_time
        self._sensor_frame = frame_name(robot.sensor_frame or sensor_frame)
        infos = [topic for log in logs for topic in log.topics]
        tf = tf_topics(infos, sensor_topic)
        self._tree = FrameTree(pose_gap_ns)
        self._T_given = None if robot.T_body_sensor is None else transform_of(robot.T_body_sensor)
        load_static_transforms(self._tree, logs, tf)
        is_tf = any(topic.name == robot.pose_topic and topic.type_name in TF_TYPES for topic in infos)
        self._track = None if is_tf else PoseTrack(pose_gap_ns)
        self._before, self._after = self._tf_link() if is_tf else self._links_of_pose_topic()
        self._links = [link for link in (self._before, self._after) if link is not None]
        self._moving_links = [link for link in self._links if not self._tree.is_fixed(*link)]
        moving_topics = tuple(topic for topic in tf if not is_static_tf(topic)) if self._moving_links else ()
        self.topics = moving_topics if self._track is None else (str(robot.pose_topic), *moving_topics)
        if not moving_topics:
            self.check_connected()

    def is_known(self, stamp_ns: int) -> bool:
        """True where the poses on both sides of a stamp have come; always for a sensor that stands still."""
        stamps = [] if self._track is None else [self._track.last_ns]
        stamps += [self._tree.last_ns(*link) for link in self._moving_links]
        return all(stamp is not None and stamp >= stamp_ns for stamp in stamps)

    def take(self, message: RawMessage) -> None:
        """Take a message of one of the topics. Raises DamagedMessageError where it cannot be decoded."""
        value = message.decode()
        if message.type_name in TF_TYPES:
            stamp = message.log_time_ns if self._use_log_time else None
            self._tree.add_message(value, is_static=False, stamp_ns=stamp)
        elif self._track is not None:
            stamp = message.log_time_ns if self._use_log_time else stamp_to_ns(value.header.stamp)
            pose = _pose_of(value)
            p, q = pose.position, pose.orientation
            self._track.add(stamp, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))

    def at(self, stamp_ns: int) -> Float64Array | None:
        """T_map_sensor at a stamp, (4, 4) float64; None where the poses around it are missing or too far apart."""
        result = np.eye(4)
        for link in (self._before, self._track, self._after):
            if link is None:
                continue
            part = link.matrix_at(stamp_ns) if isinstance(link, PoseTrack) else self._link_at(link, stamp_ns)
            if part is None:
                return None
            result = result @ part
        return result if self._T_given is None else result @ self._T_given

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what no stamp from ``stamp_ns`` on needs."""
        self._tree.forget_before(stamp_ns)
        if self._track is not None:
            self._track.forget_before(stamp_ns)

    def check_connected(self) -> None:
        """Raise InputError with both frames' names where the TF taken so far does not join what it has to."""
        for link in self._links:
            if not self._tree.is_connected(*link):
                raise InputError(f"{self._name}: {self._tree.why_not_connected(*link)}; {self._remedy(link)}")

    @property
    def _name(self) -> str:
        """The robot's logs, as errors begin."""
        return ", ".join(str(log.path) for log in self._logs)

    def _link_at(self, link: Link, stamp_ns: int) -> Float64Array | None:
        """The transform of a TF link at a stamp; None also where nothing joins its frames yet."""
        return self._tree.T_a_b(*link, stamp_ns) if self._tree.is_connected(*link) else None

    def _remedy(self, link: Link) -> str:
        """What to put into a team file where a link cannot be made."""
        if link == self._before:
            return "name another map_frame, sensor_frame or pose_topic"
        return "name the sensor_frame, or give T_body_sensor: [x, y, z, qx, qy, qz, qw]"

    def _tf_link(self) -> tuple[Link | None, Link | None]:
        """What to take from TF where the whole pose comes from it."""
        if self._robot.map_frame is None:
            raise InputError(f"{self._name}: poses from TF need a map_frame for robot '{self._robot.robot_id}'")
        return (frame_name(self._robot.map_frame), self._sensor_frame), None

    def _links_of_pose_topic(self) -> tuple[Link | None, Link | None]:
        """What to take from TF before and after the pose topic's poses, by the frames that these are in and of."""
        topic = str(self._robot.pose_topic)
        found = [message for log in self._logs if (message := first_message(log, topic)) is not None]
        if not found:
            raise InputError(f"{self._name}: topic '{topic}' holds no poses for robot '{self._robot.robot_id}'")
        value = found[0].decode()
        origin = frame_name(value.header.frame_id)
        body = frame_name(getattr(value, "child_frame_id", ""))
        map_frame = frame_name(self._robot.map_frame or "")
        before = (map_frame, origin) if map_frame and origin and map_frame != origin else None
        if self._T_given is not None or body == self._sensor_frame:
            return before, None
        if not body:
            raise InputError(
                f"{found[0].where}: the poses do not name the frame they are of; "
                f"give T_body_sensor: [x, y, z, qx, qy, qz, qw] ([0, 0, 0, 0, 0, 0, 1] for the sensor's own poses)"
            )
        return before, (body, self._sensor_frame)


def _folder(topic: str) -> str:
    """The namespace of a topic with slashes at both ends."""
    return "/" + "/".join([*topic.strip("/").split("/")[:-1], ""])


def _pose_of(value: Any) -> Any:
    """The geometry_msgs/Pose in an Odometry, PoseStamped or PoseWithCovarianceStamped."""
    return value.pose.pose if hasattr(value.pose, "pose") else value.pose
