"""Frames of one robot's log in stamp order, with paired labels and interpolated poses."""

from __future__ import annotations

import contextlib
import heapq
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from itertools import islice
from types import TracebackType
from typing import Self

import numpy as np

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import LogReader, RawMessage, first_whole_message
from octoreplay.io.containers.logs import open_log
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Kind, kind_of
from octoreplay.io.robots.body_box import body_box_at
from octoreplay.io.robots.frame_counts import LeadingFrames, count_topics
from octoreplay.io.robots.frame_maker import CloudFrameMaker, DepthFrameMaker, FrameMaker
from octoreplay.io.robots.frame_queue import Fate, FrameQueue, Settled
from octoreplay.io.robots.label_counts import check_labels
from octoreplay.io.robots.late_poses import PoseLookAhead, UnposedFrames
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.stamp_check import StampCheck
from octoreplay.io.robots.thinning import Thinning
from octoreplay.io.sensors.labels import LabelLookup
from octoreplay.records import BodyBox, ClassTable, Float64Array, Frame, FrameCounts
from octoreplay.transforms import transform_of

# Largest delay between the stamp of a message or pose and its log time.
_LOG_DELAY_NS = 10_000_000_000
# Number of a sensor's first messages that may be out of order.
_NUM_FIRST = 8
# Number of messages between two removals of poses that are not needed any more.
_FORGET_EVERY = 64
_STAMPED_KINDS = (Kind.IMAGE, Kind.COMPRESSED_IMAGE, Kind.CLOUD, Kind.SCAN)


class RobotLog:
    """Frames of one robot, read lazily; a context manager.

    - Classes: ``class_table`` maps raw labels to class ids. Frames have no classes without it, without labels in the
      log, and with an empty ``label_topic`` or ``label_field``.
    - Stamps: a frame's stamp is that of its image or point cloud plus the robot's clock offset. Its frame is given once
      the sensor's stream is ``reorder_window`` further. A message with a damaged stamp (``StampCheck``) is undecodable.
    - Poses: they are in the team's frame. A sensor that is further than ``reach`` [m] from the team's origin along an
      axis has no pose.
    - Open ``logs`` of the robot are used as they are and stay open.
    - ``depth_maker`` and ``cloud_maker`` make the decoder of the sensor's messages.

    Raises InputError where a log cannot be opened or has no intrinsics, frames or poses, and where the class table has
    none of the labels (``check_labels``).
    """

    def __init__(
        self,
        robot: ResolvedRobot,
        time: TimeConfig,
        class_table: ClassTable | None,
        *,
        reach: float = math.inf,
        logs: Sequence[LogReader] | None = None,
        depth_maker: Callable[[RobotConfig, LabelLookup | None, RawMessage | None], FrameMaker] = DepthFrameMaker,
        cloud_maker: Callable[[RobotConfig, LabelLookup | None], FrameMaker] = CloudFrameMaker,
    ) -> None:
        self.robot = robot
        self.counts = FrameCounts()
        self._time = time
        self._reach = reach
        self._num_out_of_reach = 0
        self._depth_maker, self._cloud_maker = depth_maker, cloud_maker
        self._use_log_time = time.clock == "log"
        self._offset_ns = robot.clock_offset_ns
        self._stamp_check = StampCheck(self._offset_ns)
        self.T_team_map = transform_of(robot.T_team_map_or_identity)
        is_labelled = class_table is not None and "" not in (robot.label_topic, robot.label_field)
        self._labels = LabelLookup(class_table, strict=time.strict_labels) if class_table and is_labelled else None
        self.sensor_topic = robot.sensor_topic
        self._known_poses: PoseSource | None = None
        with ExitStack() as stack:
            if logs is None:
                logs = [stack.enter_context(open_log(path)) for path in robot.logs]
            self._logs = tuple(logs)
            first = self._first_of(self.sensor_topic, _STAMPED_KINDS)
            if first is None:
                raise InputError(f"{self._name}: topic '{self.sensor_topic}' holds no messages")
            self._sensor_frame = first.header_frame_id()
            self.first_log_time_ns = first.log_time_ns
            """Log time of the sensor's first message, without the clock offset."""
            self.first_stamp_ns = self._first_stamp(first)
            """First stamp of the sensor, clock offset applied."""
            self._maker = self._frame_maker()
            if self._labels is not None and class_table is not None:
                check_labels(robot, self._logs, class_table)
            # Fails before the run where the log can give no pose.
            self.pose_source()
            self._closing = stack.pop_all()

    @property
    def robot_id(self) -> str:
        """Name of the robot in the team."""
        return self.robot.robot_id

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the logs; a second call does nothing."""
        self._closing.close()

    def frames(
        self, team_start_ns: int | None = None, *, is_wanted: Callable[[], bool] = lambda: True
    ) -> Iterator[Frame]:
        """Yield the robot's frames in stamp order, decoded on demand; ``counts`` has the frames that are not given.

        ``start`` and ``duration`` count from ``team_start_ns`` (default: the robot's first stamp). With a ``start``,
        reading begins some seconds before it; late, duplicate, undecodable and damaged messages before that are not
        counted. The logs are read from their beginning where the delay between stamps and log times changes by more
        than 10 s, where the poses have no correction within 10 s before the start, and with Foxglove's transforms,
        which hold from their first message on. Reading ends when ``is_wanted``, which is called for every message,
        returns false. Every call starts with new counts; their sums agree after the last frame. Raises InputError for
        an encoding without depth or labels, for images of different sizes, and for frames that TF does not join.
        """
        self.counts = FrameCounts(sensor_topic=self.sensor_topic, truncated_files=self._damage())
        if self._labels is not None:
            self._labels.unknown = self.counts.unknown_label_pixels
            self._labels.unknown_colors = self.counts.unknown_colors
        start_ns = self.first_stamp_ns if team_start_ns is None else team_start_ns
        self._stamp_check, self._num_out_of_reach = StampCheck(self._offset_ns), 0
        self._leading = LeadingFrames()
        thinning = Thinning(self._time, start_ns - self._offset_ns)
        poses = self.pose_source()
        count_topics(self.counts, self.robot, self._logs, self._maker.partner_topics, poses)
        log_start_ns = self._log_start_ns(thinning.needed_from_ns, poses)
        if log_start_ns is not None:
            self._check_first_stamps()
        for settled in self._settled(poses, thinning, log_start_ns, is_wanted):
            made = self._make(settled, poses) if thinning.keeps(settled.stamp_ns) else "not_selected"
            self._count(settled, made if isinstance(made, str) else "used")
            if not isinstance(made, str):
                yield made
        # Reading may have found more damage than opening.
        self.counts.truncated_files = self._damage()
        if self.counts.used == 0 and self.counts.no_pose > 0:
            if log_start_ns is not None:
                # Transforms in the part that was not read may connect the frames.
                for message in self.messages(poses.topics, None, log_start_ns):
                    poses.take(message)
            poses.check_connected()
            self._check_within_reach()

    def pose_source(self) -> PoseSource:
        """Return a new source of the robot's poses, before its first message."""
        self._known_poses = PoseSource(
            self.robot,
            self._logs,
            sensor_frame=self._sensor_frame,
            pose_gap_ns=round(self._time.pose_gap * 1e9),
            use_log_time=self._use_log_time,
            known=self._known_poses,
        )
        return self._known_poses

    def pose_messages(self, poses: PoseSource, needed_from_ns: int) -> Iterator[RawMessage]:
        """Pass the messages of a pose source to it one by one, and yield each of them afterwards.

        Messages that no pose from the stamp ``needed_from_ns`` (without the clock offset) on needs may be left out.
        """
        for message in self.messages(poses.topics, self._log_start_ns(needed_from_ns, poses)):
            poses.take(message)
            yield message

    def _settled(
        self, poses: PoseSource, thinning: Thinning, log_start_ns: int | None, is_wanted: Callable[[], bool]
    ) -> Iterator[Settled[RawMessage]]:
        """Sensor messages in stamp order, with their partners and poses."""
        partner_topics = self._maker.partner_topics
        look_ahead = PoseLookAhead(
            poses,
            lambda log_time_ns: self.messages(poses.topics, log_start_ns if log_time_ns is None else log_time_ns),
            lambda message: self._take_pose(message, poses),
        )
        self._unposed = UnposedFrames(round(self._time.pose_gap * 1e9))
        queue: FrameQueue[RawMessage] = FrameQueue(
            poses,
            reorder_window_ns=round(self._time.reorder_window * 1e9),
            pair_tolerance_ns=round(self._time.pair_tolerance * 1e9),
            pose_gap_ns=round(self._time.pose_gap * 1e9),
            num_partners=len(partner_topics),
            find_pose=look_ahead.find,
        )
        topics = {self.sensor_topic, *poses.topics, *partner_topics}
        for number, message in enumerate(self._until_sensor_ends(self.messages(topics, log_start_ns))):
            if not is_wanted():
                return
            if self._is_over(thinning, queue.newest_ns, message.log_time_ns):
                break
            look_ahead.log_time_ns = message.log_time_ns
            if message.topic not in poses.topics:
                self._take(message, queue, partner_topics)
            elif look_ahead.is_new(message):
                self._take_pose(message, poses)
            while (ready := queue.pop(final=False)) is not None:
                yield ready
            if number % _FORGET_EVERY == 0:
                # Poses without images would accumulate.
                poses.forget_before(queue.needed_from_ns(self.first_stamp_ns - self._offset_ns))
        while (ready := queue.pop(final=True)) is not None:
            yield ready
        for kind, topic in enumerate(partner_topics):
            if topic not in partner_topics[:kind]:
                num_unpaired, num_repeated = queue.unused_partners(kind)
                self.counts.settle(topic, "unpaired", count=num_unpaired)
                self.counts.settle(topic, "duplicate", count=num_repeated)

    def _until_sensor_ends(self, messages: Iterator[RawMessage]) -> Iterator[RawMessage]:
        """Messages up to ``_LOG_DELAY_NS`` after the last one of the sensor."""
        end_ns: int | None = None
        for message in messages:
            if message.topic == self.sensor_topic:
                end_ns = message.log_time_ns + _LOG_DELAY_NS
            elif end_ns is not None and message.log_time_ns > end_ns:
                following = next(self.messages((self.sensor_topic,), message.log_time_ns), None)
                if following is None:
                    return
                end_ns = following.log_time_ns
            yield message

    def _log_start_ns(self, needed_from_ns: int | None, poses: PoseSource) -> int | None:
        """Log time from which to read for stamps from ``needed_from_ns`` on; None for the log's beginning."""
        if needed_from_ns is None:
            return None
        # Delays are assumed to differ from that of the first message by at most _LOG_DELAY_NS.
        delay_ns = self.first_log_time_ns - (self.first_stamp_ns - self._offset_ns)
        log_start_ns = needed_from_ns + delay_ns - _LOG_DELAY_NS
        if log_start_ns <= self.first_log_time_ns or self._has_holding_transforms(poses):
            return None
        # The delay here reveals a clock that was set or that runs at another rate than the log times.
        try:
            delays = [
                message.log_time_ns - self._stamp_of(message, StampCheck(self._offset_ns))
                for message in islice(self.messages((self.sensor_topic,), log_start_ns), _NUM_FIRST)
            ]
        except DamagedMessageError:
            return None
        is_steady = bool(delays) and all(abs(delay - delay_ns) <= _LOG_DELAY_NS for delay in delays)
        # A correction that applies since before this part of the log would be missing.
        needed_log_ns = needed_from_ns + delay_ns
        is_steady = is_steady and poses.is_corrected_between(log_start_ns, needed_log_ns, needed_from_ns)
        return log_start_ns if is_steady else None

    def _has_holding_transforms(self, poses: PoseSource) -> bool:
        """True where a pose topic has Foxglove's transforms, which hold from their first message on."""
        types = {topic.type_name for log in self._logs for topic in log.topics if topic.name in poses.topics}
        return any(kind_of(name) is Kind.TF and name.startswith("foxglove") for name in types)

    def _check_first_stamps(self) -> None:
        """Pass each topic's first stamps to the stamp check, which compares later stamps with them."""
        for topic in (self.sensor_topic, *self._maker.partner_topics):
            for message in islice(self.messages((topic,)), _NUM_FIRST):
                with contextlib.suppress(DamagedMessageError):
                    self._stamp_of(message, self._stamp_check)

    def _is_over(self, thinning: Thinning, newest_ns: int | None, log_time_ns: int) -> bool:
        """True once the span is over by the stamps and by the log time, since one stamp may be wrong."""
        # Stamps may be of another clock than the log times, with the same rate.
        elapsed_ns = log_time_ns - self.first_log_time_ns
        by_log_ns = self.first_stamp_ns - self._offset_ns + elapsed_ns
        return newest_ns is not None and thinning.is_over(newest_ns) and thinning.is_over(by_log_ns)

    @property
    def _name(self) -> str:
        """Paths of the robot's logs, as an error begins."""
        return ", ".join(str(path) for path in self.robot.logs)

    def _damage(self) -> list[str]:
        """One sentence for each log with damage found so far."""
        return [log.damage for log in self._logs if log.damage is not None]

    def _first_of(self, topic: str, kinds: Collection[Kind]) -> RawMessage | None:
        """First whole message of a topic, of some kinds, in all the robot's logs."""
        found = [first_whole_message(log, topic, kinds) for log in self._logs]
        return min((m for m in found if m is not None), key=lambda message: message.log_time_ns, default=None)

    def _first_stamp(self, first: RawMessage) -> int:
        """Smallest of the sensor's first stamps within ``reorder_window`` that is not late."""
        # A stamp of 0 is valid in a log that begins at time 0; elsewhere the header was not stamped.
        if not self._use_log_time and first.header_stamp_ns() == 0 and first.log_time_ns != 0:
            raise InputError(f"{first.where}: the header's stamp is 0; give clock: log to use the log's times")
        window_ns = round(self._time.reorder_window * 1e9)
        stamps, check = [], StampCheck(self._offset_ns)
        for message in islice(self.messages((self.sensor_topic,)), _NUM_FIRST):
            if message.log_time_ns > first.log_time_ns + window_ns:
                break
            with contextlib.suppress(DamagedMessageError):
                stamps.append(self._stamp_of(message, check))
        stamp_ns = min((stamp for stamp in stamps if stamp >= max(stamps) - window_ns), default=None)
        if stamp_ns is None:
            stamp_ns = first.log_time_ns if self._use_log_time else first.header_stamp_ns()
            raise InputError(
                f"{first.where}: the stamp {stamp_ns / 1e9:.6g} s with the clock_offset {self.robot.clock_offset:g} s "
                f"is outside 0 to 2^31 s (1970 - 2038); give another clock_offset or clock"
            )
        return stamp_ns + self._offset_ns

    def _stamp_of(self, message: RawMessage, check: StampCheck) -> int:
        """A message's stamp, without the clock offset. Raises DamagedMessageError where it is missing or damaged."""
        if kind_of(message.type_name) not in _STAMPED_KINDS:
            # A message of another type does not begin with a stamp.
            raise DamagedMessageError(f"{message.where}: is of type {message.type_name}")
        stamp = message.log_time_ns if self._use_log_time else message.header_stamp_ns()
        if not check.is_good(message.topic, stamp, message.log_time_ns):
            raise DamagedMessageError(f"{message.where}: the stamp {stamp} ns is damaged")
        return stamp

    def _check_within_reach(self) -> None:
        """Raise InputError where every frame had a pose out of reach."""
        if self._num_out_of_reach == self.counts.no_pose:
            raise InputError(
                f"{self._name}: all poses of robot '{self.robot_id}' are outside the map, which reaches "
                f"{self._reach:g} m from the origin; check the poses, or give T_team_map or a coarser resolution"
            )

    def _frame_maker(self) -> FrameMaker:
        """Decoder of the sensor's messages."""
        if self.robot.depth_topic is None:
            return self._cloud_maker(self.robot, self._labels)
        if self.robot.intrinsics is not None:
            return self._depth_maker(self.robot, self._labels, None)
        topic = self.robot.camera_info_topic
        message = None if topic is None else self._first_of(topic, (Kind.CAMERA_INFO,))
        if message is None:
            missing = f"topic '{topic}' holds no CameraInfo" if topic else "there is no CameraInfo topic"
            raise InputError(f"{self._name}: {missing} for '{self.sensor_topic}'; give intrinsics: [fx, fy, cx, cy]")
        return self._depth_maker(self.robot, self._labels, message)

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Messages of some topics of all the robot's logs in [start_ns, stop_ns) of log time, in order of log time."""
        streams = (log.messages(topics, start_ns, stop_ns) for log in self._logs)
        return heapq.merge(*streams, key=lambda message: message.log_time_ns)

    def _take_pose(self, message: RawMessage, poses: PoseSource) -> None:
        """Pass a message to the poses, and note one that comes after a frame that needed it."""
        self.counts.settle(message.topic, "read")
        outcome = poses.take(message)
        self.counts.settle(message.topic, outcome, None if outcome == "used" else message.log_time_ns)
        is_noted = self._use_log_time or "late_pose" in self.counts.first_missing
        if outcome == "used" and not is_noted and self._unposed.has_frame_of(message):
            self.counts.first_missing["late_pose"] = self._described(message, message.header_stamp_ns())

    def _described(self, message: RawMessage, stamp_ns: int) -> str:
        """File, topic and stamp of a message, on the team's clock."""
        return f"{message.log}: topic '{message.topic}' with the stamp {(stamp_ns + self._offset_ns) / 1e9:.3f} s"

    def _take(self, message: RawMessage, queue: FrameQueue[RawMessage], partner_topics: tuple[str, ...]) -> None:
        """Pass a message of the sensor or a partner to the queue, or count it as unused."""
        self.counts.settle(message.topic, "read")
        try:
            stamp = self._stamp_of(message, self._stamp_check)
        except DamagedMessageError:
            self.counts.undecodable += message.topic == self.sensor_topic
            self.counts.settle(message.topic, "undecodable", message.log_time_ns)
            return
        for kind in (kind for kind, topic in enumerate(partner_topics) if topic == message.topic):
            queue.add_partner(kind, stamp, message)
        if message.topic != self.sensor_topic:
            return
        newest_ns = queue.newest_ns
        fate = queue.add_sensor(stamp, message)
        if fate is not Fate.WAITS:
            self.counts.settle(message.topic, fate.name.lower(), stamp + self._offset_ns)
        if fate is Fate.LATE:
            self.counts.late += 1
            back = ((newest_ns or stamp) - stamp) / 1e9
            self.counts.first_missing.setdefault(
                "late", f"{self._described(message, stamp)}: {back:.3f} s before the newest stamp so far"
            )
        elif fate is Fate.DUPLICATE:
            self.counts.duplicate += 1

    def _make(self, settled: Settled[RawMessage], poses: PoseSource) -> Frame | str:
        """The frame of a settled sensor message, or the name of the part that is missing."""
        if None in settled.partners:
            return "no_label"
        if settled.T_map_sensor is None:
            return "no_pose"
        T_team_sensor = self.T_team_map @ settled.T_map_sensor
        boxes = self._own_boxes(poses, settled.stamp_ns, T_team_sensor)
        if boxes is None:
            return "no_pose"
        if not (np.abs(T_team_sensor[:3, 3]) <= self._reach).all():
            # A single pose may be wrong, so the frame alone is skipped.
            self._num_out_of_reach += 1
            return "no_pose"
        try:
            frame = self._maker.make(settled, settled.stamp_ns + self._offset_ns, T_team_sensor, boxes)
        except DamagedMessageError:
            return "undecodable"
        return "no_label" if frame is None else frame

    def _count(self, settled: Settled[RawMessage], outcome: str) -> None:
        """Count a settled sensor message and its partners by outcome, and remember the first of each cause."""
        counts, stamp_ns = self.counts, settled.stamp_ns + self._offset_ns
        if outcome == "used":
            counts.use(stamp_ns)
            counts.settle(self.sensor_topic, outcome)
        else:
            has_stamp = outcome != "undecodable"
            counts.settle(self.sensor_topic, outcome, stamp_ns if has_stamp else settled.message.log_time_ns)
        if outcome in ("no_label", "no_pose", "undecodable"):
            setattr(counts, outcome, getattr(counts, outcome) + 1)
        if outcome in ("no_label", "no_pose"):
            counts.first_missing.setdefault(outcome, self._described(settled.message, settled.stamp_ns))
        if outcome == "no_pose":
            self._unposed.add(settled.stamp_ns)
        self._leading.note(counts, outcome, stamp_ns)
        partners = {partner.topic: partner for partner in reversed(settled.partners) if partner is not None}
        for topic in partners:
            counts.settle(topic, "used" if outcome == "used" else "unmapped")

    def _own_boxes(self, poses: PoseSource, stamp_ns: int, T_team_sensor: Float64Array) -> tuple[BodyBox, ...] | None:
        """The robot's own box at a stamp, empty without one; None where TF does not give it."""
        if self.robot.body_box is None:
            return ()
        box = body_box_at(self.robot, poses, stamp_ns, T_team_sensor, is_own=True)
        return None if box is None else (box,)
