"""Labelling of a log: pairs of sensor messages and colour images, their labels, and the labelled log."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from octoreplay import interrupts
from octoreplay.config.file_url import InputFile
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.fingerprint import fingerprint, log_files
from octoreplay.io.containers.log_reader import LogReader, RawMessage
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Cloud, CompressedImage, Image, Scan
from octoreplay.io.output_file import replacing
from octoreplay.io.robots.survey import LogSurveys, Survey
from octoreplay.io.sensors.clouds import Points, decode_cloud, decode_scan
from octoreplay.io.sensors.images import decode_color, decode_depth
from octoreplay.labelling.finished_frames import FinishedFrames, FrameLabels
from octoreplay.labelling.labelled_log import LabelledLogWriter
from octoreplay.labelling.network import MAX_LABEL, Labels, Network, NetworkOptions, as_text
from octoreplay.labelling.projection import depth_points
from octoreplay.labelling.streams import RobotStreams, StreamOptions, find_streams
from octoreplay.records import ClassTable, Float64Array, Int64Array

NO_LABEL = 65535
"""Raw label of pixels and points that no colour image shows."""

_NUM_FIRST = 20
"""Number of labelled messages after which one point at least must have been in an image."""

MAX_WAITING_BYTES = 1 << 30
"""Largest size of messages that wait for their partner [bytes]."""


@dataclass(frozen=True)
class LabelOptions:
    """Options of ``label_log``: streams, network, the largest distance of paired stamps [s], and every n-th message."""

    streams: StreamOptions = field(default_factory=StreamOptions)
    network: NetworkOptions = field(default_factory=NetworkOptions)
    pair_tolerance: float = 0.05
    every: int = 1

    def __post_init__(self) -> None:
        if not 0.0 <= self.pair_tolerance <= 10.0:
            raise ConfigError(f"pair_tolerance: {self.pair_tolerance:g} is not between 0 and 10")
        if self.every < 1:
            raise ConfigError(f"every: {self.every} is not at least 1")


@dataclass
class RobotLabels:
    """Numbers of one robot's sensor messages and pixels by outcome.

    ``sensor_topic``, ``colour_topic`` and ``alignment`` name its streams. ``num_without_image`` have no colour image
    within the tolerance, ``num_undecodable`` are damaged, or their images are. ``measured`` is the number of measured
    pixels or points, ``labelled`` that of those with a label; ``classes`` has their numbers by class name.
    """

    robot_id: str
    sensor_topic: str
    colour_topic: str
    alignment: str
    num_messages: int = 0
    num_labelled: int = 0
    num_without_image: int = 0
    num_undecodable: int = 0
    measured: int = 0
    labelled: int = 0
    classes: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class LabelSummary:
    """Outcome of a labelling: one entry for each robot, the number of resumed messages, and damage of the log."""

    robots: tuple[RobotLabels, ...]
    num_resumed: int
    damage: str | None


def label_log(
    log: InputFile,
    output: Path,
    model: Path,
    classes: ClassTable,
    options: LabelOptions,
    *,
    resume: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> LabelSummary:
    """Label the depth images or clouds of a log with a network that sees its colour images, and write a labelled log.

    The output holds what a run needs: the sensor's messages with labels, CameraInfo, poses, TF, position fixes and
    tags, and a LabelInfo. Finished labels are kept in ``unfinished_path(output)`` until the output is complete; with
    ``resume`` they are used again, and the output has the same bytes. ``progress`` is called with the finished share
    and a text. Raises InputError for a log or a model that cannot be used, ConfigError for options and classes that do
    not fit, OutputError where a file cannot be written.
    """
    with LogSurveys() as surveys:
        survey = surveys.of(log)
        robots = find_streams(survey, options.streams)
        network = Network(model, classes, options.network)
        plans = [_plan(survey.log, streams, options) for streams in robots]
        settings = _settings(log, model, classes, options, robots)
        with FinishedFrames(output, settings, continues=resume) as finished:
            labelling = _Labelling(survey.log, network, robots, plans, finished, progress or _ignore)
            labelling.label_all()
            interrupts.check()
            _write(survey, output, classes, robots, finished)
        for counts, streams in zip(labelling.counts, robots, strict=True):
            counts.classes = _names(labelling.labels_of[streams.robot.robot_id], classes)
        return LabelSummary(tuple(labelling.counts), finished.num_taken_over, survey.log.damage)


def _ignore(share: float, text: str) -> None:
    """Default progress callback."""


@dataclass(frozen=True, eq=False)
class _Plan:
    """Pairs of one robot: the number of the colour image by the number of the sensor message, in the log's order."""

    image_of: dict[int, int]
    num_messages: int
    num_undecodable: int


def _plan(log: LogReader, streams: RobotStreams, options: LabelOptions) -> _Plan:
    """The nearest colour image of each sensor message, by stamp. Raises InputError where there is none at all."""
    stamps: dict[str, list[int]] = {streams.sensor_topic: [], streams.colour_topic: []}
    num_undecodable = 0
    for message in log.messages(stamps):
        try:
            stamp = message.header_stamp_ns()
            # A stamp of 0 is valid in a log that begins at time 0; elsewhere the header was not stamped.
            stamp = -1 if stamp == 0 and message.log_time_ns else stamp
        except DamagedMessageError:
            stamp = -1
            num_undecodable += message.topic == streams.sensor_topic
        stamps[message.topic].append(stamp)
    sensor, colour = (np.array(stamps[topic], np.int64) for topic in (streams.sensor_topic, streams.colour_topic))
    image_of = _nearest(sensor, colour, round(options.pair_tolerance * 1e9))
    chosen = [number for number in range(0, len(sensor), options.every) if number in image_of]
    if not chosen:
        raise InputError(_why_unpaired(log.path, streams, sensor, colour, options.pair_tolerance))
    return _Plan({number: image_of[number] for number in chosen}, len(sensor), num_undecodable)


def _nearest(sensor: Int64Array, colour: Int64Array, tolerance_ns: int) -> dict[int, int]:
    """Number of the colour image nearest in stamp to each sensor message; -1 marks unknown stamps."""
    order = np.argsort(colour, kind="stable")
    order = order[colour[order] >= 0]
    found = {}
    places = np.searchsorted(colour[order], sensor)
    for number, (stamp, place) in enumerate(zip(sensor.tolist(), places.tolist(), strict=True)):
        near = order[max(place - 1, 0) : place + 1]
        if stamp >= 0 and near.size:
            best = int(near[np.argmin(np.abs(colour[near] - stamp))])
            if abs(int(colour[best]) - stamp) <= tolerance_ns:
                found[number] = best
    return found


def _why_unpaired(
    path: InputFile, streams: RobotStreams, sensor: Int64Array, colour: Int64Array, tolerance: float
) -> str:
    """Sentence on a sensor and a camera without a common time."""
    spans = []
    for topic, stamps in ((streams.sensor_topic, sensor), (streams.colour_topic, colour)):
        good = stamps[stamps >= 0]
        span = f"from {good.min() / 1e9:.3f} s to {good.max() / 1e9:.3f} s" if good.size else "missing"
        spans.append(f"those of '{topic}' are {span}")
    return (
        f"{path}: no sensor message has a colour image within {tolerance:g} s: the stamps differ ({'; '.join(spans)}); "
        "give a larger --pair-tolerance or another --colour-topic"
    )


class _Labelling:
    """Labels of every planned sensor message, made in one pass over the log."""

    def __init__(
        self,
        log: LogReader,
        network: Network,
        robots: Sequence[RobotStreams],
        plans: Sequence[_Plan],
        finished: FinishedFrames,
        progress: Callable[[float, str], None],
    ) -> None:
        self._log, self._network, self._finished, self._progress = log, network, finished, progress
        self._robots, self._plans = robots, plans
        self.counts = [
            RobotLabels(
                s.robot.robot_id, s.sensor_topic, s.colour_topic, s.note, plan.num_messages,
                num_without_image=plan.num_messages - len(plan.image_of) - plan.num_undecodable,
                num_undecodable=plan.num_undecodable,
            )
            for s, plan in zip(robots, plans, strict=True)
        ]  # fmt: skip
        self.labels_of: dict[str, Counter[int]] = {s.robot.robot_id: Counter() for s in robots}
        self._total = sum(len(plan.image_of) for plan in plans)
        self._num_done = 0

    def label_all(self) -> None:
        """Label every planned message that is not finished yet. Raises InputError where none could be labelled."""
        for index, (streams, plan) in enumerate(zip(self._robots, self._plans, strict=True)):
            for message, image, number in self._pairs(streams, plan):
                if (index, number) not in self._finished:
                    labels = self._labels_of(streams, message, image)
                    if labels is not None:
                        self._finished.put(index, number, labels)
                self._count(index, streams, message, number)
                if self.counts[index].num_labelled == _NUM_FIRST:
                    self._check_view(index, streams)
                self._num_done += 1
                self._progress(self._num_done / self._total, f"{self._num_done:,} of {self._total:,} images")
                interrupts.check()
            if not self.counts[index].num_labelled:
                raise InputError(
                    f"{self._log.path}: none of the {len(plan.image_of):,} pairs of '{streams.sensor_topic}' and "
                    f"'{streams.colour_topic}' can be decoded"
                )
            self._check_view(index, streams)

    def _check_view(self, index: int, streams: RobotStreams) -> None:
        """Raise InputError where no point of a robot's messages so far is in an image."""
        if not self.counts[index].labelled:
            self._finished.forget()
            raise InputError(
                f"{self._log.path}: no point of '{streams.sensor_topic}' is in an image of '{streams.colour_topic}' "
                f"({streams.note}); check the extrinsics"
            )

    def _pairs(self, streams: RobotStreams, plan: _Plan) -> Iterator[tuple[RawMessage, RawMessage, int]]:
        """Sensor messages with their colour images and numbers, each as soon as both were read."""
        users: dict[int, set[int]] = {}
        for number, image in plan.image_of.items():
            users.setdefault(image, set()).add(number)
        numbers = Counter[str]()
        sensors: dict[int, RawMessage] = {}
        images: dict[int, RawMessage] = {}
        for message in self._log.messages((streams.sensor_topic, streams.colour_topic)):
            number = numbers[message.topic]
            numbers[message.topic] += 1
            if message.topic == streams.sensor_topic:
                if number not in plan.image_of:
                    continue
                sensors[number] = message
                ready, image = [number], plan.image_of[number]
            elif number in users:
                images[number] = message
                image, ready = number, sorted(users[number] & sensors.keys())
            else:
                continue
            for number in ready if image in images else ():
                yield sensors.pop(number), images[image], number
                users[image].discard(number)
            if not users[image]:
                images.pop(image, None)
            if sum(len(m.data) for m in (*sensors.values(), *images.values())) > MAX_WAITING_BYTES:
                raise InputError(
                    f"{message.where}: the messages of '{streams.sensor_topic}' and '{streams.colour_topic}' with "
                    "equal stamps are too far apart in the log; record them in the order of time"
                )

    def _labels_of(self, streams: RobotStreams, message: RawMessage, image: RawMessage) -> FrameLabels | None:
        """Labels of one sensor message; None where it or its image is damaged."""
        try:
            colours = decode_color(_image(image), image.where)
            points = decode_points(message) if streams.is_cloud else None
            depth = None if streams.is_cloud else _depth(message)
        except DamagedMessageError:
            return None
        labels = self._network.label(colours, image.where)
        if depth is not None and streams.projection is None:
            if depth.shape != labels.raw.shape:
                raise InputError(
                    f"{message.where}: the depth image has {depth.shape[1]}x{depth.shape[0]} pixels, its colour image "
                    f"{labels.raw.shape[1]}x{labels.raw.shape[0]}"
                )
            return _sampled(labels, depth > 0)
        return self._projected(streams, depth, points, labels, message)

    def _projected(
        self,
        streams: RobotStreams,
        depth: Float64Array | None,
        points: Points | None,
        labels: Labels,
        message: RawMessage,
    ) -> FrameLabels:
        """Labels of points that are projected into the colour image."""
        projection, T = streams.projection, streams.T_colour_sensor
        assert projection is not None
        assert T is not None
        if labels.raw.shape != (projection.height, projection.width):
            raise InputError(f"{message.where}: its colour image has another size than the first one")
        spacing: float | None = None
        if depth is not None:
            camera = streams.depth_camera
            assert camera is not None
            if depth.shape != (camera.height, camera.width):
                raise InputError(f"{message.where}: the depth image has another size than its CameraInfo")
            found, shape = depth_points(depth, camera), depth.shape
            spacing = projection.matrix[0, 0] / camera.fx
        else:
            assert points is not None
            found = points.points.astype(np.float64)
            shape = (1, len(found))
        pixels, is_seen = projection.visible_pixels(found, T, spacing)
        sampled = Labels(
            labels.raw[pixels[:, 1], pixels[:, 0]].reshape(shape),
            None if labels.confidences is None else labels.confidences[pixels[:, 1], pixels[:, 0]].reshape(shape),
        )
        return _sampled(sampled, is_seen.reshape(shape))

    def _count(self, index: int, streams: RobotStreams, message: RawMessage, number: int) -> None:
        """Count a sensor message and its labels."""
        counts = self.counts[index]
        if (index, number) not in self._finished:
            counts.num_undecodable += 1
            return
        raw = self._finished.get(index, number).raw
        counts.num_labelled += 1
        counts.measured += raw.size if streams.is_cloud else int((_depth(message) > 0).sum())
        values, numbers = np.unique(raw[raw != NO_LABEL], return_counts=True)
        counts.labelled += int(numbers.sum())
        self.labels_of[counts.robot_id].update(dict(zip(values.tolist(), numbers.tolist(), strict=True)))


def _sampled(labels: Labels, is_seen: npt.NDArray[np.bool_]) -> FrameLabels:
    """Labels where ``is_seen``, and NO_LABEL with confidence 0 elsewhere; ignored labels out of range are NO_LABEL."""
    usable = is_seen & (labels.raw >= 0) & (labels.raw <= MAX_LABEL)
    raw = np.where(usable, labels.raw, NO_LABEL).astype(np.uint16)
    confidences = labels.confidences
    return FrameLabels(raw, None if confidences is None else np.where(usable, confidences, 0).astype(np.uint8))


def decode_points(message: RawMessage) -> Points:
    """Return the points of a cloud or a scan in the frame of its header. Raises InputError, DamagedMessageError."""
    found = message.sensor_message()
    if not isinstance(found, Cloud | Scan):
        raise DamagedMessageError(f"{message.where}: is of type {message.type_name}, not a point cloud")
    pose = found.T_frame_cloud if isinstance(found, Cloud) else found.T_frame_scan
    if pose is not None:
        raise InputError(f"{message.where}: clouds with a pose of their own in the frame are not supported by label")
    points = decode_cloud(found, message.where) if isinstance(found, Cloud) else decode_scan(found)
    return Points(points.points)


def _image(message: RawMessage) -> Image | CompressedImage:
    """The image in a message. Raises DamagedMessageError for a message of another type on the topic."""
    found = message.sensor_message()
    if not isinstance(found, Image | CompressedImage):
        raise DamagedMessageError(f"{message.where}: is of type {message.type_name}, not an image")
    return found


def _depth(message: RawMessage) -> Float64Array:
    """Depth image (H, W) [m]; 0 without a measurement."""
    pixels, unit = decode_depth(_image(message), message.where)
    depth = pixels.astype(np.float64) * unit
    # The largest value of an integer type marks a missing measurement too.
    is_missing = ~np.isfinite(depth) if pixels.dtype.kind == "f" else pixels == np.iinfo(pixels.dtype).max
    depth[is_missing | (depth < 0)] = 0.0
    return depth


def _write(
    survey: Survey, output: Path, classes: ClassTable, robots: Sequence[RobotStreams], finished: FinishedFrames
) -> None:
    """Write the labelled log."""
    with replacing(output) as temporary, LabelledLogWriter(temporary, survey, classes, robots) as writer:
        numbers = Counter[str]()
        index_of = {streams.sensor_topic: index for index, streams in enumerate(robots)}
        for message in survey.log.messages({*writer.copied_topics, *index_of}):
            index = index_of.get(message.topic)
            if index is None:
                writer.copy(message)
                continue
            key = index, numbers[message.topic]
            numbers[message.topic] += 1
            if key not in finished:
                continue
            if robots[index].is_cloud:
                writer.write_cloud(index, message, decode_points(message).points, finished.get(*key))
            else:
                writer.copy(message)
                writer.write_image(index, message, finished.get(*key))
        interrupts.check()


def _settings(
    log: InputFile, model: Path, classes: ClassTable, options: LabelOptions, robots: Sequence[RobotStreams]
) -> str:
    """Text that names everything that labels depend on."""
    prints = [fingerprint(file) for file in log_files(log)]
    return json.dumps(
        {
            "log": [(entry.size, entry.value) for entry in prints],
            "model": fingerprint(model, whole=True).value,
            "classes": hashlib.sha256(repr(classes).encode()).hexdigest(),
            "network": as_text(options.network),
            "pairs": (options.pair_tolerance, options.every),
            "streams": [
                (s.sensor_topic, s.colour_topic, None if s.T_colour_sensor is None else s.T_colour_sensor.tolist(),
                 None if s.projection is None else s.projection.matrix.tolist())
                for s in robots
            ],
        },
        sort_keys=True,
    )  # fmt: skip


def _names(labels: Counter[int], classes: ClassTable) -> dict[str, int]:
    """Number of pixels or points by class name, in the order of the table; ignored ones are '(ignored)'."""
    class_of = {raw: item.name for item in classes.classes for raw in item.raw_labels}
    totals = Counter[str]()
    for raw, number in labels.items():
        totals[class_of.get(raw, "(ignored)")] += number
    return {name: totals[name] for name in (*classes.names, "(ignored)") if totals[name]}
