"""One robot's log as a stream of frames: depth and labels paired, poses interpolated, in the order of their stamps."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from octoreplay.config import RobotConfig, TimeConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.log_reader import DamagedMessageError, LogReader, RawMessage, first_message
from octoreplay.io.containers.logs import open_log
from octoreplay.io.robots.frame_queue import FrameQueue, Settled
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.poses import transform_of
from octoreplay.io.sensors.clouds import decode_cloud
from octoreplay.io.sensors.images import camera_model, check_same_size, decode_depth, decode_labels
from octoreplay.io.sensors.labels import LabelLookup
from octoreplay.records import (
    CameraModel,
    ClassTable,
    CloudFrame,
    DepthFrame,
    Float64Array,
    Frame,
    FrameCounts,
    UInt8Array,
)


class RobotLog:
    """The frames of one robot, read lazily; a context manager.

    ``robot`` names its topics (``discover.resolve`` fills those that a team file leaves out). With a ``class_table``
    raw labels become class ids; without one, or without labels in the log, frames carry no classes. An empty
    ``label_topic`` means that labels in the log, also those in a point cloud, are not used.
    A frame's stamp is that of its depth image or point cloud plus the robot's clock offset; its pose is in the team's
    frame. A stamp is settled, and its frame given, once the sensor's stream is ``reorder_window`` further.
    Raises InputError where a log cannot be opened or lacks intrinsics, frames or poses altogether.
    """

    def __init__(self, robot: RobotConfig, time: TimeConfig, class_table: ClassTable | None) -> None:
        self.robot = robot
        self.counts = FrameCounts()
        self._time = time
        self._use_log_time = time.clock == "log"
        self._offset_ns = round(robot.clock_offset * 1e9)
        self._T_team_map = transform_of(robot.T_team_map)
        is_labelled = class_table is not None and robot.label_topic != ""
        self._labels = LabelLookup(class_table, strict=time.strict_labels) if class_table and is_labelled else None
        sensor_topic = robot.depth_topic or robot.cloud_topic
        if sensor_topic is None or robot.pose_topic is None:
            missing = "depth_topic or cloud_topic" if sensor_topic is None else "pose_topic"
            raise ConfigError(f"robot '{robot.robot_id}': needs a {missing}")
        self._sensor_topic = sensor_topic
        self._label_topic = robot.label_topic if robot.depth_topic and self._labels else None
        with ExitStack() as stack:
            self._logs: list[LogReader] = [stack.enter_context(open_log(path)) for path in robot.logs]
            first = self._first_of(sensor_topic)
            if first is None:
                raise InputError(f"{self._name}: topic '{sensor_topic}' holds no messages")
            self._sensor_frame = first.header_frame_id()
            self._camera = self._read_camera()
            # Fails here rather than after a long run where poses cannot come about.
            self._pose_source()
            self._closing = stack.pop_all()

    @property
    def robot_id(self) -> str:
        """The robot's name in the team."""
        return self.robot.robot_id

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message of any topic, clock offset applied; None in a log without messages."""
        starts = [log.start_ns for log in self._logs if log.start_ns is not None]
        return min(starts) + self._offset_ns if starts else None

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message of any topic, clock offset applied; None in a log without messages."""
        ends = [log.end_ns for log in self._logs if log.end_ns is not None]
        return max(ends) + self._offset_ns if ends else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the logs; a second call does nothing."""
        self._closing.close()

    def frames(self) -> Iterator[Frame]:
        """The robot's frames in order of stamp, decoded as they are taken; ``counts`` says what became of the rest.

        Every call starts from the beginning, with fresh counts. Raises InputError with file, topic and time for an
        encoding that holds no depth or no labels, for images whose sizes differ, and for frames that TF never joins.
        """
        self.counts = FrameCounts(truncated_files=self._damaged_files())
        if self._labels is not None:
            self._labels.unknown = self.counts.unknown_label_pixels
        poses = self._pose_source()
        queue: FrameQueue[RawMessage] = FrameQueue(
            poses,
            reorder_window_ns=round(self._time.reorder_window * 1e9),
            pair_tolerance_ns=round(self._time.pair_tolerance * 1e9),
            pose_gap_ns=round(self._time.pose_gap * 1e9),
            has_labels=self._label_topic is not None,
        )
        topics = {self._sensor_topic, *poses.topics, *([self._label_topic] if self._label_topic else [])}
        for message in heapq.merge(*(log.messages(topics) for log in self._logs), key=lambda m: m.log_time_ns):
            self._take(message, queue, poses)
            while (ready := queue.pop(final=False)) is not None:
                yield from self._frame(ready)
        while (ready := queue.pop(final=True)) is not None:
            yield from self._frame(ready)
        # Reading on may have come upon more damage than opening did.
        self.counts.truncated_files = self._damaged_files()
        if self.counts.used == 0 and self.counts.no_pose > 0:
            poses.check_connected()

    @property
    def _name(self) -> str:
        """The robot's logs, as errors begin."""
        return ", ".join(str(path) for path in self.robot.logs)

    def _damaged_files(self) -> list[str]:
        """The logs that are cut or damaged, as far as they have been read."""
        return [str(log.path) for log in self._logs if log.damage is not None]

    def _first_of(self, topic: str) -> RawMessage | None:
        """The first message of a topic in the logs, in their order."""
        return next((m for log in self._logs if (m := first_message(log, topic)) is not None), None)

    def _read_camera(self) -> CameraModel | None:
        """The camera of a depth robot from its CameraInfo; None where the team file gives intrinsics, or for clouds."""
        if self.robot.depth_topic is None or self.robot.intrinsics is not None:
            return None
        topic = self.robot.camera_info_topic
        message = None if topic is None else self._first_of(topic)
        if message is None:
            missing = f"topic '{topic}' holds no CameraInfo" if topic else "there is no CameraInfo topic"
            raise InputError(f"{self._name}: {missing} for '{self._sensor_topic}'; give intrinsics: [fx, fy, cx, cy]")
        return camera_model(message.decode(), message.where)

    def _pose_source(self) -> PoseSource:
        """A new source of poses, at the beginning of the logs."""
        return PoseSource(
            self.robot,
            self._logs,
            sensor_topic=self._sensor_topic,
            sensor_frame=self._sensor_frame,
            pose_gap_ns=round(self._time.pose_gap * 1e9),
            use_log_time=self._use_log_time,
        )

    def _take(self, message: RawMessage, queue: FrameQueue[RawMessage], poses: PoseSource) -> None:
        """Put one message where it belongs."""
        if message.topic not in (self._sensor_topic, self._label_topic):
            try:
                poses.take(message)
            except DamagedMessageError:
                # Frames that miss this pose are counted as frames without one.
                return
            return
        try:
            stamp = message.log_time_ns if self._use_log_time else message.header_stamp_ns()
        except DamagedMessageError:
            self.counts.undecodable += message.topic == self._sensor_topic
            return
        if message.topic == self._label_topic:
            queue.add_label(stamp, message)
        elif not queue.add_sensor(stamp, message):
            self.counts.late += 1

    def _frame(self, settled: Settled[RawMessage]) -> Iterator[Frame]:
        """The frame of a settled sensor message, or nothing where a part is missing (which is counted)."""
        if self._label_topic is not None and settled.label is None:
            self.counts.no_label += 1
        elif settled.T_map_sensor is None:
            self.counts.no_pose += 1
        else:
            try:
                frame = self._decode(settled, self._T_team_map @ settled.T_map_sensor)
            except DamagedMessageError:
                self.counts.undecodable += 1
                return
            self.counts.used += 1
            yield frame

    def _decode(self, settled: Settled[RawMessage], T_team_sensor: Float64Array) -> Frame:
        """The frame of a sensor message with its labels and pose."""
        message, stamp = settled.message, settled.stamp_ns + self._offset_ns
        if self.robot.depth_topic is None:
            points, raw = decode_cloud(message.decode(), message.where)
            class_ids = None
            if raw is not None and self._labels is not None:
                class_ids = self._labels.class_ids(raw, message.where)
            return CloudFrame(self.robot_id, stamp, points, class_ids, T_team_sensor)
        image, unit = decode_depth(message.decode(), message.where)
        if self._camera is None:
            fx, fy, cx, cy = self.robot.intrinsics or (0.0, 0.0, 0.0, 0.0)
            self._camera = CameraModel(image.shape[1], image.shape[0], fx, fy, cx, cy)
        check_same_size(image, self._camera, message.where)
        class_image = None if settled.label is None else self._class_image(settled.label, image.shape, message)
        unit = unit if self.robot.depth_unit is None else self.robot.depth_unit
        return DepthFrame(self.robot_id, stamp, image, unit, class_image, self._camera, T_team_sensor)

    def _class_image(self, label: RawMessage, shape: tuple[int, ...], depth: RawMessage) -> UInt8Array | None:
        """The class ids of a label image, which must have the depth image's size."""
        if self._labels is None:
            return None
        raw = decode_labels(label.decode(), label.where)
        if raw.shape != shape:
            raise InputError(
                f"{label.where}: the label image is {raw.shape[1]}x{raw.shape[0]}, but the depth image of "
                f"'{depth.topic}' is {shape[1]}x{shape[0]}; name topics of one size"
            )
        return self._labels.class_ids(raw, label.where)
