"""Raw labels in a sample of a robot's messages: their histogram, and the check that classes are known for them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import LogReader, RawMessage
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Cloud, CompressedImage, Image
from octoreplay.io.sensors.clouds import decode_cloud
from octoreplay.io.sensors.images import LabelImage, decode_labels
from octoreplay.io.sensors.labels import LabelLookup
from octoreplay.records import NO_CLASS, ClassTable

NUM_SHOWN, NUM_CHECKED = 32, 8
"""Numbers of messages that a histogram and a check read, evenly spread over the log."""
LEAST_KNOWN = 0.01
"""Share of the labelled pixels from which a class table is taken to be that of the labels."""


@dataclass(frozen=True)
class RawLabel:
    """One raw label or colour (#rrggbb) with its number of pixels or points.

    ``class_name`` is empty for an ignored label, and None where the class table does not have it.
    """

    raw: str
    number: int
    class_name: str | None


@dataclass(frozen=True)
class LabelCounts:
    """Histogram of the labels in ``num_read`` of a topic's ``num_messages`` messages, most frequent first.

    Without ``has_table`` there was no class table, and no label has a class.
    """

    robot_id: str
    topic: str
    num_messages: int
    num_read: int
    labels: tuple[RawLabel, ...]
    has_table: bool = True

    @property
    def num_known(self) -> int:
        """Number of pixels or points with a class."""
        return sum(label.number for label in self.labels if label.class_name)

    @property
    def num_unknown(self) -> int:
        """Number of pixels or points with a label that the class table does not have."""
        return sum(label.number for label in self.labels if label.class_name is None)

    @property
    def warning(self) -> str | None:
        """Sentence on unknown labels; None without any."""
        if not self.num_unknown or not self.has_table:
            return None
        total = sum(label.number for label in self.labels)
        return (
            f"{self.robot_id}: {self.num_unknown / total:.1%} of the pixels or points in {self.num_read} of "
            f"{self.num_messages:,} messages of '{self.topic}' have labels without a class: {self.unknown}; "
            "--classes gives them one"
        )

    @property
    def unknown(self) -> str:
        """The most frequent unknown labels, as part of a sentence."""
        names = [label.raw for label in self.labels if label.class_name is None]
        return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def count_labels(
    robot: RobotConfig, logs: Sequence[LogReader], table: ClassTable | None, number: int = NUM_SHOWN
) -> LabelCounts | None:
    """Return the histogram of a robot's raw labels in about ``number`` messages; None for a robot without labels.

    Without a ``table`` no label has a class. Raises InputError for images and clouds that hold no labels.
    """
    topic = robot.label_topic if robot.depth_topic is not None else robot.cloud_topic
    if not topic or robot.label_field == "":
        return None
    totals: Counter[int] = Counter()
    is_color = is_lossy = False
    num_read = 0
    for message in _spread(logs, topic, number):
        try:
            found = _labels_in(message, robot)
        except DamagedMessageError:
            continue
        if found is None:
            return None
        num_read += 1
        is_color, is_lossy = found.is_color, found.is_lossy
        values = found.pixels.astype(np.int64)
        values = values @ np.array([1 << 16, 1 << 8, 1]) if is_color else values
        keys, counts = np.unique(values, return_counts=True)
        totals.update(dict(zip(keys.tolist(), counts.tolist(), strict=True)))
    num_messages = sum(info.num_messages for log in logs for info in log.topics if info.name == topic)
    labels = _rows(totals, table, is_color=is_color, is_lossy=is_lossy)
    return LabelCounts(robot.robot_id, topic, num_messages, num_read, labels, table is not None)


def check_labels(robot: RobotConfig, logs: Sequence[LogReader], table: ClassTable) -> None:
    """Raise InputError where fewer than LEAST_KNOWN of a robot's labelled pixels or points have a class."""
    counts = count_labels(robot, logs, table, NUM_CHECKED)
    if counts is not None and counts.num_known < LEAST_KNOWN * (counts.num_known + counts.num_unknown):
        raise InputError(
            f"{', '.join(str(log.path) for log in logs)}: fewer than {100 * LEAST_KNOWN:.0f} % of the labelled pixels"
            f" or points of '{counts.topic}' have a class in the class table, which does not have the labels"
            f" {counts.unknown}; name the right label_topic, or give the class table of these labels (--classes)"
        )


def _spread(logs: Sequence[LogReader], topic: str, number: int) -> Iterator[RawMessage]:
    """Messages of a topic, evenly spread over the logs' times; all of them where there are few."""
    for log in logs:
        num_messages = sum(info.num_messages for info in log.topics if info.name == topic)
        if num_messages <= number:
            yield from log.messages((topic,))
            continue
        start_ns, end_ns = log.start_ns or 0, log.end_ns or 0
        seen: set[int] = set()
        for step in range(number):
            message = next(log.messages((topic,), start_ns + (end_ns - start_ns) * step // number), None)
            if message is not None and message.log_time_ns not in seen:
                seen.add(message.log_time_ns)
                yield message


def _labels_in(message: RawMessage, robot: RobotConfig) -> LabelImage | None:
    """Labels of one message; None for a cloud without labels. Raises DamagedMessageError, InputError."""
    found = message.sensor_message()
    if isinstance(found, Image | CompressedImage):
        return decode_labels(found, message.where)
    if isinstance(found, Cloud):
        labels = decode_cloud(found, message.where, wanted_labels=robot.label_field).labels
        # One row of an image.
        return None if labels is None else LabelImage(labels[None])
    return None


def _rows(totals: Counter[int], table: ClassTable | None, *, is_color: bool, is_lossy: bool) -> tuple[RawLabel, ...]:
    """Rows of a histogram, most frequent first; equal numbers in the order of the labels."""
    ordered = sorted(totals.items(), key=lambda item: (-item[1], item[0]))
    keys = np.array([key for key, _ in ordered], dtype=np.int64)
    names = _class_names(keys, table, is_color=is_color, is_lossy=is_lossy)
    spelled = (f"#{key:06x}" if is_color else str(key) for key in keys.tolist())
    return tuple(RawLabel(raw, number, name) for raw, (_, number), name in zip(spelled, ordered, names, strict=True))


def _class_names(
    keys: npt.NDArray[np.int64], table: ClassTable | None, *, is_color: bool, is_lossy: bool
) -> list[str | None]:
    """Class name of each label, as RawLabel has it."""
    if table is None or not keys.size:
        return [None] * len(keys)
    lookup = LabelLookup(table)
    names: list[str | None] = []
    colors = np.stack([keys >> shift & 0xFF for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    ids = lookup.class_ids_of_colors(colors, "", is_lossy=is_lossy) if is_color else lookup.class_ids(keys, "")
    for key, class_id in zip(keys.tolist(), ids.tolist(), strict=True):
        unknown = lookup.unknown_colors if is_color else lookup.unknown
        is_unknown = (key & 0xF0F0F0 if is_lossy else key) in unknown and class_id == NO_CLASS
        names.append(None if is_unknown else "" if class_id == NO_CLASS else table.names[class_id - 1])
    return names
