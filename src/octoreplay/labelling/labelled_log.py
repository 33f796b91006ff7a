"""Writer of a labelled log: the messages that a run needs, with labels of a network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.decoders import ENCODINGS
from octoreplay.io.messages.sensor_messages import Kind, kind_of
from octoreplay.io.robots.pose_source import POSE_KINDS
from octoreplay.io.robots.robot_log_writer import cloud_message, image_message, label_info_message
from octoreplay.io.robots.survey import Survey
from octoreplay.io.sensors.labels import UNLABELLED
from octoreplay.labelling.finished_frames import FrameLabels
from octoreplay.labelling.streams import RobotStreams
from octoreplay.records import ClassTable, SemanticClass

_COPIED_KINDS = (*POSE_KINDS, Kind.FIX, Kind.TAGS)
_IGNORED_NAME = "unlabelled"
"""Name of ignored raw labels in a LabelInfo; readers ignore classes of this name."""
_BYTE_LABELS = 255


class LabelledLogWriter:
    """Writes a labelled log as MCAP; a context manager that finishes the file.

    Poses, TF, fixes, tags and the CameraInfo of the depth images are copied as they are. Of a depth topic T the labels
    are on ``T/labels`` (mono8, or mono16 for raw labels from 255 on) and the confidences on ``T/label_confidence``
    (mono8). A cloud topic T becomes ``T/labelled``, with x, y, z and the fields label and label_confidence.
    ``T/label_info`` names the classes. Raises OutputError where the file cannot be written.
    """

    def __init__(self, path: Path, survey: Survey, classes: ClassTable, robots: Sequence[RobotStreams]) -> None:
        self._robots = tuple(robots)
        info_topics = {s.camera_info_topic for s in self._robots}
        copied = [
            topic for topic in survey.topics
            if topic.encoding in ENCODINGS and (kind_of(topic.type_name) in _COPIED_KINDS or topic.name in info_topics)
        ]  # fmt: skip
        self.copied_topics = {topic.name for topic in copied}
        sensors = [topic for topic in survey.topics if topic.name in {s.sensor_topic for s in self._robots}]
        is_ros2 = all(topic.encoding == "cdr" for topic in (*copied, *sensors))
        self._writer = RosMcapWriter(path, profile="ros2" if is_ros2 else "")
        table = _with_ignored(classes)
        largest = max((raw for item in table.classes for raw in item.raw_labels), default=0)
        self._is_wide = largest >= _BYTE_LABELS
        for streams in self._robots:
            topic = f"{streams.sensor_topic}/label_info"
            start_ns = survey.start_ns or 0
            value = label_info_message(table, start_ns, survey.samples[streams.sensor_topic].frame_id)
            self._writer.write(topic, "vision_msgs/msg/LabelInfo", value, start_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()

    def copy(self, message: RawMessage) -> None:
        """Append a message of the log as it is."""
        self._writer.copy_raw(message)

    def write_image(self, index: int, message: RawMessage, labels: FrameLabels) -> None:
        """Append the labels and confidences of a depth image of robot ``index``."""
        topic, stamp_ns, frame = self._robots[index].sensor_topic, message.header_stamp_ns(), message.header_frame_id()
        raw: npt.NDArray[Any] = labels.raw if self._is_wide else np.minimum(labels.raw, 255).astype(np.uint8)
        for name, pixels, encoding in (
            ("labels", raw, "mono16" if self._is_wide else "mono8"),
            ("label_confidence", labels.confidences, "mono8"),
        ):
            if pixels is not None:
                value = image_message(pixels, encoding, stamp_ns, frame)
                self._writer.write(f"{topic}/{name}", "sensor_msgs/msg/Image", value, message.log_time_ns)

    def write_cloud(self, index: int, message: RawMessage, points: npt.NDArray[Any], labels: FrameLabels) -> None:
        """Append the cloud of a message of robot ``index`` with labels and confidences."""
        columns: dict[str, npt.NDArray[Any]] = {name: points[:, axis].astype("<f4") for axis, name in enumerate("xyz")}
        columns["label"] = labels.raw.reshape(-1)
        if labels.confidences is not None:
            columns["label_confidence"] = labels.confidences.reshape(-1)
        value = cloud_message(columns, message.header_stamp_ns(), message.header_frame_id())
        topic = f"{self._robots[index].sensor_topic}/labelled"
        self._writer.write(topic, "sensor_msgs/msg/PointCloud2", value, message.log_time_ns)


def _with_ignored(classes: ClassTable) -> ClassTable:
    """The table with its ignored raw labels as a class that readers ignore, without labels that no image can hold."""
    known = {raw for item in classes.classes for raw in item.raw_labels}
    # 255 and 65535 are ignored by every reader unless a class has them.
    candidates = sorted(set(classes.ignored_raw_labels) - known - set(UNLABELLED))
    ignored = tuple(raw for raw in candidates if 0 <= raw < 65535)
    rows = [
        SemanticClass(item.class_id, item.name, item.color, tuple(r for r in item.raw_labels if 0 <= r < 65535))
        for item in classes.classes
    ]
    if ignored:
        rows.append(SemanticClass(len(rows) + 1, _IGNORED_NAME, (0, 0, 0), ignored))
    return ClassTable(tuple(rows))
