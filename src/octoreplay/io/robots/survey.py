"""Survey of a log: its topics, a sample of each sensor topic, and the robots that share the log."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from octoreplay.config.file_url import InputFile
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.log_reader import LogReader, TopicInfo, first_whole_message
from octoreplay.io.containers.logs import open_log
from octoreplay.io.messages import velodyne
from octoreplay.io.messages.decoders import ENCODINGS
from octoreplay.io.messages.sensor_messages import (
    Cloud,
    CompressedImage,
    Image,
    Kind,
    Scan,
    Transforms,
    kind_of,
)
from octoreplay.io.robots.pose_source import POSE_KINDS
from octoreplay.io.robots.poses import FrameTree, frame_name
from octoreplay.io.sensors.clouds import label_field
from octoreplay.io.sensors.images import (
    COLOR_ENCODINGS,
    COLOR_IMAGE_ENCODINGS,
    DEPTH_ENCODINGS,
    LABEL_ENCODINGS,
    encoding_and_size,
)

IMAGES = (Kind.IMAGE, Kind.COMPRESSED_IMAGE)
CLOUDS = (Kind.CLOUD, Kind.SCAN)
SENSORS = (*IMAGES, *CLOUDS)

PACKETS = "packets"
"""Encoding of the sample of a cloud that is recorded as packets of the lidar."""

_DEPTH_HINTS = ("depth", "range", "disparity_z")
_LABEL_HINTS = ("label", "semantic", "segment", "class")
_CONFIDENCE_HINTS = ("confidence", "probability", "uncertainty")


@dataclass(frozen=True)
class TopicSample:
    """Properties of the first message of an image, cloud or scan topic.

    ``encoding`` is that of an image, PACKETS for a cloud that is recorded as packets, and otherwise ''; ``fields`` is
    empty except for clouds; ``size`` is (width, height) in pixels or points.
    """

    topic: str
    kind: Kind
    encoding: str
    size: tuple[int, int]
    frame_id: str
    fields: tuple[str, ...]
    detail: str

    @property
    def has_labels(self) -> bool:
        """True for a cloud with a field of labels."""
        return label_field(self.fields) is not None

    @property
    def is_depth(self) -> bool:
        """True for a depth image, by its encoding and, where other images share the encoding, by its topic's name."""
        subject = self._subject
        if self.encoding not in DEPTH_ENCODINGS or subject in (_LABEL_HINTS, _CONFIDENCE_HINTS):
            return False
        return self.encoding in ("32FC1", "16UC1") or subject is _DEPTH_HINTS

    @property
    def is_label(self) -> bool:
        """True for a label image, by an encoding of labels alone or a shared encoding and the topic's name."""
        subject = self._subject
        if self.encoding not in (*LABEL_ENCODINGS, "palette", "jpeg rgb8") or subject is _CONFIDENCE_HINTS:
            return False
        return self.encoding in ("16SC1", "32SC1") or subject is _LABEL_HINTS

    @property
    def is_color(self) -> bool:
        """True where the image's pixels are colours."""
        return self.encoding in COLOR_ENCODINGS or self.encoding == "jpeg rgb8"

    @property
    def has_colors(self) -> bool:
        """True for an image of three colours, recorded as such or as the pattern of its sensor."""
        return self.encoding in COLOR_IMAGE_ENCODINGS and not self.encoding.endswith(("mono8", "8UC1"))

    @property
    def is_confidence(self) -> bool:
        """True for an image of label confidences: the topic's name holds hints of both."""
        has_both = self._subject is _CONFIDENCE_HINTS and self._end_of(_LABEL_HINTS) >= 0
        return has_both and self.encoding in ("mono8", "8UC1", "mono16", "16UC1", "32FC1")

    @property
    def is_sensor(self) -> bool:
        """True where a map can be made from the topic."""
        return self.is_depth or self.kind in CLOUDS

    @property
    def _subject(self) -> tuple[str, ...] | None:
        """Hints that occur last in the topic's name; a namespace before them may hold other hints."""
        last = max((_DEPTH_HINTS, _LABEL_HINTS, _CONFIDENCE_HINTS), key=self._end_of)
        return last if self._end_of(last) >= 0 else None

    def _end_of(self, hints: tuple[str, ...]) -> int:
        """Position in the topic's name at which the last of some hints ends; -1 without any."""
        name = self.topic.lower()
        return max(name.rfind(hint) + len(hint) if hint in name else -1 for hint in hints)


@dataclass(frozen=True, eq=False)
class Survey:
    """Topics of one open log, and samples of its sensor topics by name.

    ``unreadable`` has the first cause for each sensor topic of which no message can be decoded, a ConfigError where a
    package is missing. ``owners`` maps topics to robots where the log holds several robots; it is empty where it holds
    one. ``frame_trees`` caches TF for the robots that share the log.
    """

    log: LogReader
    start_ns: int | None
    end_ns: int | None
    num_messages: int
    topics: tuple[TopicInfo, ...]
    samples: Mapping[str, TopicSample]
    owners: Mapping[str, str]
    damage: str | None
    unreadable: Mapping[str, InputError | ConfigError] = field(default_factory=dict)
    frame_trees: dict[Hashable, FrameTree] = field(default_factory=dict)

    @property
    def path(self) -> InputFile:
        """Path or URL of the log."""
        return self.log.path

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots that share the log, in the order of their sensor topics; empty where it holds one."""
        sensors = (topic for topic, sample in self.samples.items() if sample.is_sensor)
        return tuple(dict.fromkeys(self.owners[topic] for topic in sensors if topic in self.owners))


_RESULT_TYPE = "octoreplay_msgs/msg/TickMetrics"
"""Type of messages that every result has, and no log."""


class LogSurveys:
    """Surveys of logs, each of which is opened and surveyed once; a context manager that closes the logs."""

    def __init__(self) -> None:
        self._surveys: dict[InputFile, Survey] = {}
        self._closing = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.close()

    def of(self, path: InputFile) -> Survey:
        """Return the survey of a log, opened at the first call.

        Raises InputError where it cannot be opened, and for a result.
        """
        if path not in self._surveys:
            log = self._closing.enter_context(open_log(path))
            if any(topic.type_name == _RESULT_TYPE for topic in log.topics):
                raise InputError(
                    f"{path}: is a result of octoreplay, not a log; give its logs, or repeat its run with"
                    f" 'octoreplay run --config-from {path}'"
                )
            self._surveys[path] = survey_log(log)
        return self._surveys[path]


def survey_log(log: LogReader) -> Survey:
    """Return the survey of an open log; the first message of each image, cloud and scan topic is decoded."""
    samples: dict[str, TopicSample] = {}
    unreadable: dict[str, InputError | ConfigError] = {}
    for topic in log.topics:
        if kind_of(topic.type_name) in SENSORS and topic.encoding in ENCODINGS and topic.num_messages:
            try:
                sample = _sample(log, topic)
            except (InputError, ConfigError) as error:
                unreadable.setdefault(topic.name, error)
                continue
            if sample is not None:
                samples[topic.name] = sample
    owners = _owners_by_name(log.topics, samples) or _owners_by_frame(log, samples)
    return Survey(log, log.start_ns, log.end_ns, log.message_count, log.topics, samples, owners, log.damage, unreadable)


def first_part(topic: str) -> str:
    """Return the first part of a topic's name."""
    return topic.strip("/").split("/", 1)[0]


def _sample(log: LogReader, topic: TopicInfo) -> TopicSample | None:
    """Sample of a topic's first message; None without one of a sensor. Raises the errors of ``sensor_message``."""
    message = first_whole_message(log, topic.name, SENSORS)
    kind = None if message is None else kind_of(message.type_name)
    if message is None or kind not in SENSORS:
        return None
    found = message.sensor_message()
    if isinstance(found, Image | CompressedImage):
        encoding, size = encoding_and_size(found, message.where)
        detail = f"{encoding} {size[0]}x{size[1]}"
        return TopicSample(topic.name, kind, encoding, size, frame_name(found.frame_id), (), detail)
    if isinstance(found, Cloud):
        names = [field.name for field in found.fields]
        size, detail = (found.width, found.height), f"{found.width}x{found.height}: {', '.join(names)}"
        encoding = PACKETS if message.type_name == velodyne.TYPE else ""
        return TopicSample(topic.name, kind, encoding, size, frame_name(found.frame_id), tuple(names), detail)
    if isinstance(found, Scan):
        size = (found.ranges.size, 1)
        return TopicSample(topic.name, kind, "", size, frame_name(found.frame_id), (), f"{size[0]} ranges")
    return None


def _owners_by_name(topics: tuple[TopicInfo, ...], samples: Mapping[str, TopicSample]) -> dict[str, str]:
    """Robot of each topic by the first part of its name, where two or more such parts have a sensor and a pose."""
    found = []
    for name in dict.fromkeys(first_part(topic) for topic, sample in samples.items() if sample.is_sensor):
        own = [topic for topic in topics if first_part(topic.name) == name and "/" in topic.name.strip("/")]
        has_pose = any(kind_of(topic.type_name) in POSE_KINDS for topic in own)
        # TF gives the pose of a sensor whose frame has the same first part.
        frames = [sample.frame_id for topic, sample in samples.items() if first_part(topic) == name]
        if has_pose or any(frame.startswith(f"{name}/") for frame in frames):
            found.append(name)
    if len(found) < 2:
        return {}
    return {topic.name: first_part(topic.name) for topic in topics if first_part(topic.name) in found}


def _owners_by_frame(log: LogReader, samples: Mapping[str, TopicSample]) -> dict[str, str]:
    """Robot of each topic by the first part of its frame, where the sensors have at least two such parts."""
    owners = {topic: first_part(sample.frame_id) for topic, sample in samples.items() if "/" in sample.frame_id}
    if len({owners[topic] for topic, sample in samples.items() if sample.is_sensor and topic in owners}) < 2:
        return {}
    for topic in log.topics:
        if kind_of(topic.type_name) not in (None, Kind.TF) and topic.name not in samples and topic.num_messages:
            frame = _frame(log, topic.name)
            if "/" in frame:
                owners[topic.name] = first_part(frame)
    return owners


def _frame(log: LogReader, topic: str) -> str:
    """Frame of a topic's first message, for a pose its child frame where it has one; '' without a frame."""
    message = first_whole_message(log, topic, tuple(Kind))
    if message is None:
        return ""
    try:
        found = message.sensor_message() if kind_of(message.type_name) in POSE_KINDS else None
        if isinstance(found, Transforms):
            return next((frame_name(pose.child or pose.parent) for pose in found.transforms), "")
        return frame_name(message.header_frame_id())
    except InputError:
        return ""
