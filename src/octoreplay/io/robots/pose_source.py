"""Pose of a robot's sensor over time, from a pose topic or a trajectory file and TF, from TF alone, or fixed."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import Self, TypeAlias

import numpy as np

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import LogReader, RawMessage, TopicInfo
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Kind, Transforms, kind_of
from octoreplay.io.robots.poses import FrameTree, PoseTrack, frame_name
from octoreplay.io.robots.trajectories import Trajectory, TrajectoryRows, read_rows, read_times, trajectory
from octoreplay.records import Float64Array
from octoreplay.transforms import normalise, transform_of

Link: TypeAlias = tuple[str, str]
"""Transform that TF must give: (target frame, source frame)."""

_USED, _UNUSABLE, _UNDECODABLE = "used", "unusable", "undecodable"

POSE_KINDS = (Kind.ODOMETRY, Kind.POSE, Kind.PATH, Kind.TF)
"""Kinds of messages that a pose topic can carry."""


def is_static_tf(topic: TopicInfo) -> bool:
    """True for a topic of fixed transforms: by its name, or a Foxglove topic with a single message."""
    return "static" in topic.name.rsplit("/", 1)[-1] or (
        topic.type_name.startswith("foxglove") and topic.num_messages == 1
    )


def tf_topics(topics: Collection[TopicInfo], sensor_topic: str) -> tuple[TopicInfo, ...]:
    """Return the TF topics that concern a sensor topic: those in a namespace above it, else all."""
    tf = sorted((topic for topic in topics if kind_of(topic.type_name) is Kind.TF), key=lambda topic: topic.name)
    above = [topic for topic in tf if f"/{sensor_topic.lstrip('/')}".startswith(_folder(topic.name))]
    return tuple(above or tf)


def moving_tf_names(topics: Collection[TopicInfo]) -> tuple[str, ...]:
    """Return the names of the topics of moving transforms, without repetition."""
    return tuple(dict.fromkeys(topic.name for topic in topics if not is_static_tf(topic)))


def load_static_transforms(
    tree: FrameTree, logs: Sequence[LogReader], topics: Collection[TopicInfo]
) -> dict[str, Counter[str]]:
    """Add every static transform of the logs to a tree, wherever in the files it is.

    Returns the numbers of messages by topic and outcome, as ``PoseSource.take`` gives it.
    """
    static = {topic.name for topic in topics if is_static_tf(topic)}
    outcomes: dict[str, Counter[str]] = {name: Counter() for name in sorted(static)}
    for log in logs:
        for message in log.messages(static):
            try:
                outcome = _USED if tree.add_transforms(_transforms(message), is_static=True) else _UNUSABLE
            except DamagedMessageError:
                outcome = _UNDECODABLE
            outcomes[message.topic][outcome] += 1
    return outcomes


class PoseSource:
    """The pose of one robot's sensor in its map frame over time.

    A pose is the product T_map_origin T_origin_body T_body_sensor. The middle one comes from the pose topic or file,
    the others from TF unless they are the identity or configured. Where the pose topic is TF, the whole pose comes from
    TF. A configured ``pose`` holds at all times. The messages of ``topics`` must be passed to ``take`` in the order of
    the log.

    T_map_origin is the correction of the poses. It is interpolated like every transform, but between two values that
    are more than ``pose_gap_ns`` apart the earlier one applies, before its first value the first, and after its last
    value the last.

    ``known`` is an earlier source of the same robot, whose trajectory and first correction are used again. Raises
    InputError where the log gives no pose at any time.
    """

    def __init__(
        self,
        robot: ResolvedRobot,
        logs: Sequence[LogReader],
        *,
        sensor_frame: str,
        pose_gap_ns: int,
        use_log_time: bool,
        known: Self | None = None,
    ) -> None:
        self._robot = robot
        self._logs = logs
        self._use_log_time = use_log_time
        self._pose_gap_ns = pose_gap_ns
        self._sensor_frame = frame_name(robot.sensor_frame or sensor_frame)
        infos = [topic for log in logs for topic in log.topics]
        self._tf = tf_topics(infos, robot.sensor_topic)
        self._tree = FrameTree(pose_gap_ns)
        self._T_given = None if robot.T_body_sensor is None else transform_of(robot.T_body_sensor)
        self.static_outcomes = load_static_transforms(self._tree, logs, self._tf)
        """Numbers of messages of the static TF topics by topic and outcome."""
        kinds = {kind_of(topic.type_name) for topic in infos if topic.name == robot.pose_topic}
        self.trajectory: Trajectory | None = known.trajectory if known else self._whole_trajectory(Kind.PATH in kinds)
        """Poses from a file or a path, known from the beginning; else None."""
        self._T_still = None if robot.pose is None else transform_of(robot.pose)
        has_track = self.trajectory is None and self._T_still is None and Kind.TF not in kinds
        self._track = PoseTrack(pose_gap_ns) if has_track else None
        self._whole: Link | None = None
        self._after: Link | None = None
        if Kind.TF in kinds:
            self._before, self._whole = self._tf_links()
        else:
            self._before, self._after = self._links_of_poses()
        self._body = self._body_link()
        links = (self._before, self._whole, self._after, self._body)
        self._links = [link for link in links if link is not None]
        self._moving_links = [link for link in self._links if not self._tree.is_fixed(*link)]
        moving_topics = moving_tf_names(self._tf) if self._moving_links else ()
        self.topics = moving_topics if self._track is None else (str(robot.pose_topic), *moving_topics)
        if not moving_topics:
            self.check_connected()
        self.first_correction: Float64Array | None = None
        """First value of a correction that moves, (4, 4); else None."""
        if self._before is not None and self._before in self._moving_links:
            self.first_correction = known.first_correction if known else self._read_first(self._before)

    def is_known(self, stamp_ns: int) -> bool:
        """True where the poses on both sides of a stamp are known; always for a sensor that does not move."""
        stamps = [] if self._track is None else [self._track.last_ns]
        stamps += [self._tree.last_ns(*link) for link in self._moving_links]
        return all(stamp is not None and stamp >= stamp_ns for stamp in stamps)

    def take(self, message: RawMessage) -> str:
        """Take a message of one of the topics and return its outcome.

        It is 'used', 'undecodable', or 'unusable' where no pose in it is finite with a rotation. A message that is not
        used leads to frames without a pose.
        """
        try:
            found = _transforms(message)
        except DamagedMessageError:
            return _UNDECODABLE
        stamp = message.log_time_ns if self._use_log_time else None
        if kind_of(message.type_name) is Kind.TF:
            is_used = self._tree.add_transforms(found, is_static=False, stamp_ns=stamp)
        else:
            is_used = self._add_to_track(found, stamp)
        return _USED if is_used else _UNUSABLE

    def _add_to_track(self, found: Transforms, stamp_ns: int | None) -> bool:
        """Add the poses of a message to the track, if there is one; return False if none was added."""
        num_added = 0
        if self._track is not None:
            for pose in found.transforms:
                stamp = pose.stamp_ns if stamp_ns is None else stamp_ns
                num_added += self._track.add(stamp, pose.translation, pose.rotation)
        return num_added > 0

    def at(self, stamp_ns: int) -> Float64Array | None:
        """T_map_sensor at a stamp, (4, 4) float64; None where the poses around it are missing or too far apart."""
        result = np.eye(4)
        for part in (self._correction_at(stamp_ns), self._pose_at(stamp_ns), self._sensor_at(stamp_ns)):
            if part is None:
                return None
            result = result @ part
        return result

    def T_body_sensor_at(self, stamp_ns: int) -> Float64Array | None:
        """Transform from the sensor to the frame of ``body_box`` at a stamp, (4, 4) float64; None where TF has none."""
        return self._sensor_at(stamp_ns) if self._body is None else self._link_at(self._body, stamp_ns)

    @property
    def moving_tf(self) -> tuple[str, ...]:
        """Topics of the moving transforms that concern the robot."""
        return moving_tf_names(self._tf)

    def T_sensor_frame(self, frame: str) -> Float64Array | None:
        """Fixed transform from another frame of the robot to the sensor, (4, 4) float64; None where TF has none."""
        if not self._tree.is_fixed(self._sensor_frame, frame):
            return None
        with suppress(InputError):
            return self._tree.T_a_b(self._sensor_frame, frame, 0)
        return None

    @property
    def sensor_frame(self) -> str:
        """Frame of the sensor, without the leading slash of ROS 1."""
        return self._sensor_frame

    @property
    def body_frame(self) -> str:
        """Highest frame that fixed transforms join to the sensor; the sensor's own frame without any."""
        fixed = [f for f in self._tree.ancestors(self._sensor_frame) if self._tree.is_fixed(f, self._sensor_frame)]
        return fixed[-1]

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that no stamp from ``stamp_ns`` on needs."""
        self._tree.forget_before(stamp_ns)
        if self._track is not None:
            self._track.forget_before(stamp_ns)

    def check_connected(self) -> None:
        """Raise InputError where the TF messages so far do not join the frames of every link."""
        for link in self._links:
            if not self._tree.is_connected(*link):
                raise InputError(f"{self._name}: {self._tree.why_not_connected(*link)}; {self._remedy(link)}")

    @property
    def _name(self) -> str:
        """Paths of the robot's logs, as an error begins."""
        return ", ".join(str(log.path) for log in self._logs)

    def is_corrected_between(self, start_ns: int, stop_ns: int, stamp_ns: int) -> bool:
        """True where the correction, if there is one, has a value up to a stamp in [start_ns, stop_ns) of log time."""
        if self.first_correction is None or self._before is None:
            return True
        first_ns = self._read_correction(self._before, start_ns, stop_ns).first_ns(*self._before)
        return first_ns is not None and first_ns <= stamp_ns

    # --- the three parts of a pose ------------------------------------------------------------------------------------

    def _correction_at(self, stamp_ns: int) -> Float64Array | None:
        """T_map_origin at a stamp, as the class describes it."""
        if self._before is None:
            return np.eye(4)
        if self._tree.is_connected(*self._before):
            found = self._tree.T_a_b(*self._before, stamp_ns, hold=True)
            return self.first_correction if found is None else found
        return self.first_correction

    def _pose_at(self, stamp_ns: int) -> Float64Array | None:
        """T_origin_body at a stamp, where the body is the sensor if the whole pose comes from TF."""
        if self._T_still is not None:
            return self._T_still
        if self.trajectory is not None:
            return self.trajectory.matrix_at(stamp_ns, self._pose_gap_ns)
        return self._link_at(self._whole, stamp_ns) if self._track is None else self._track.matrix_at(stamp_ns)

    def _sensor_at(self, stamp_ns: int) -> Float64Array | None:
        """T_body_sensor at a stamp."""
        return self._link_at(self._after, stamp_ns) if self._T_given is None else self._T_given

    def _link_at(self, link: Link | None, stamp_ns: int) -> Float64Array | None:
        """Transform of a TF link at a stamp; None also where its frames are not joined yet."""
        if link is None:
            return np.eye(4)
        return self._tree.T_a_b(*link, stamp_ns) if self._tree.is_connected(*link) else None

    def _remedy(self, link: Link) -> str:
        """Remedy in the team file where TF does not join a link's frames."""
        if link in (self._before, self._whole):
            return "name another map_frame, sensor_frame or pose_topic"
        if link == self._body:
            return "name another body_frame"
        return "name the sensor_frame, or give T_body_sensor: [x, y, z, qx, qy, qz, qw]"

    # --- links and trajectory -----------------------------------------------------------------------------------------

    def _read_first(self, link: Link) -> Float64Array | None:
        """First value of the correction in the logs; None without one. Raises InputError where TF never joins it."""
        tree = self._read_correction(link)
        if not tree.is_connected(*link):
            raise InputError(f"{self._name}: {tree.why_not_connected(*link)}; {self._remedy(link)}")
        return tree.T_a_b(*link, 0, hold=True)

    def _read_correction(self, link: Link, start_ns: int | None = None, stop_ns: int | None = None) -> FrameTree:
        """TF in a range of log time, up to the first value of every transform of a link."""
        tree = FrameTree(self._pose_gap_ns)
        load_static_transforms(tree, self._logs, self._tf)
        streams = (log.messages(moving_tf_names(self._tf), start_ns, stop_ns) for log in self._logs)
        for message in heapq.merge(*streams, key=lambda message: message.log_time_ns):
            stamp = message.log_time_ns if self._use_log_time else None
            with suppress(DamagedMessageError):
                tree.add_transforms(_transforms(message), is_static=False, stamp_ns=stamp)
            if tree.is_connected(*link) and tree.T_a_b(*link, 0, hold=True) is not None:
                break
        return tree

    def _tf_links(self) -> tuple[Link | None, Link]:
        """Links of the correction and of the poses where the whole pose comes from TF."""
        if self._robot.map_frame is None:
            raise InputError(f"{self._name}: poses from TF need a map_frame for robot '{self._robot.robot_id}'")
        map_frame, frame = frame_name(self._robot.map_frame), self._robot.frame
        if frame is None or frame.pose_frame in (None, map_frame):
            return None, (map_frame, self._sensor_frame)
        return (map_frame, str(frame.pose_frame)), (str(frame.pose_frame), self._sensor_frame)

    def _body_link(self) -> Link | None:
        """Link from the sensor to ``body_frame``; None where the box is in the frame of the poses."""
        frame = self._robot.body_frame
        return None if frame is None or self._robot.body_box is None else (frame_name(frame), self._sensor_frame)

    def _links_of_poses(self) -> tuple[Link | None, Link | None]:
        """Links before and after the poses, by the first pose's parent and child frames."""
        if self._robot.pose_topic is None:
            # Configured poses name no frames: they are of the sensor, or of the body where T_body_sensor is given.
            return None, None
        topic = str(self._robot.pose_topic)
        # The first messages of a growing path are empty.
        messages = (message for log in self._logs for message in log.messages((topic,)))
        first = next((message for message in messages if _holds_poses(message)), None)
        if first is None:
            raise InputError(f"{self._name}: topic '{topic}' holds no poses for robot '{self._robot.robot_id}'")
        pose = _transforms(first).transforms[0]
        origin, body = frame_name(pose.parent), frame_name(pose.child)
        map_frame = frame_name(self._robot.map_frame or "")
        before = (map_frame, origin) if map_frame and origin and map_frame != origin else None
        if self._T_given is not None or body == self._sensor_frame:
            return before, None
        if not body:
            raise InputError(
                f"{first.where}: the poses have no child frame; "
                f"give T_body_sensor: [x, y, z, qx, qy, qz, qw] ([0, 0, 0, 0, 0, 0, 1] for the sensor's own poses)"
            )
        return before, (body, self._sensor_frame)

    def _whole_trajectory(self, is_path: bool) -> Trajectory | None:
        """Trajectory of a pose file or of the last Path message; None for another pose topic."""
        if self._robot.pose_file is not None:
            return self._file_trajectory(
                read_rows(self._robot.pose_file, self._robot.pose_format, self._robot.pose_origin)
            )
        if not is_path:
            return None
        if self._use_log_time:
            raise InputError(
                f"{self._name}: the path '{self._robot.pose_topic}' has its own stamps, which clock: log cannot "
                f"replace; use clock: header, or give pose_file"
            )
        last: RawMessage | None = None
        for log in self._logs:
            for message in log.messages((str(self._robot.pose_topic),)):
                last = message
        poses = [] if last is None else _finite(_transforms(last))
        if not poses:
            raise InputError(f"{self._name}: topic '{self._robot.pose_topic}' holds no poses")
        stamps = np.array([stamp for stamp, _, _ in poses], dtype=np.int64)
        rows = TrajectoryRows(stamps, np.array([p for _, p, _ in poses]), np.array([q for _, _, q in poses]))
        return trajectory(stamps, rows)

    def _file_trajectory(self, rows: TrajectoryRows) -> Trajectory:
        """Trajectory of a file's poses with their stamps."""
        path, times = self._robot.pose_file, self._robot.pose_times
        if times is not None and rows.stamps_ns is not None:
            raise InputError(f"{path}: its rows have times; remove pose_times")
        if times is not None:
            stamps = read_times(times)
        elif rows.stamps_ns is not None:
            return trajectory(rows.stamps_ns, rows)
        else:
            messages = (message for log in self._logs for message in log.messages((self._robot.sensor_topic,)))
            stamps = np.sort(
                np.array([m.log_time_ns if self._use_log_time else m.header_stamp_ns() for m in messages], np.int64)
            )
        if stamps.size != len(rows.positions):
            found = (
                f"{times} has {stamps.size} times" if times else f"'{self._robot.sensor_topic}' {stamps.size} messages"
            )
            raise InputError(
                f"{path}: has {len(rows.positions)} poses, but {found}; give pose_times: a file with the time [s] "
                f"of each pose"
            )
        return trajectory(stamps, rows)


def _transforms(message: RawMessage) -> Transforms:
    """The transforms in a message. Raises DamagedMessageError for a message of another type on the topic."""
    found = message.sensor_message()
    if not isinstance(found, Transforms):
        raise DamagedMessageError(f"{message.where}: is of type {message.type_name}, not a pose")
    return found


def _holds_poses(message: RawMessage) -> bool:
    """True where a message can be decoded and has a pose."""
    with suppress(DamagedMessageError):
        return bool(_transforms(message).transforms)
    return False


def _finite(found: Transforms) -> list[tuple[int, tuple[float, float, float], tuple[float, float, float, float]]]:
    """Stamps, positions and unit quaternions of the poses that are finite."""
    poses = [(pose.stamp_ns, pose.translation, normalise(pose.rotation)) for pose in found.transforms]
    return [(stamp, p, q) for stamp, p, q in poses if q is not None and all(map(math.isfinite, p))]


def _folder(topic: str) -> str:
    """The namespace of a topic with slashes at both ends."""
    return "/" + "/".join([*topic.strip("/").split("/")[:-1], ""])
