"""Poses that arrive in a log later than the frames that need them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator
from typing import Protocol

from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.messages.sensor_messages import Kind, kind_of

# Largest time in the log that a pose may arrive after a frame that needs it.
_LATEST_NS = 60_000_000_000
# Number of frames without a pose that late poses are compared with.
_MAX_UNPOSED = 10_000


class _Poses(Protocol):
    """Poses of the sensor."""

    def is_known(self, stamp_ns: int) -> bool:
        """True where the poses on both sides of a stamp are known."""


class PoseLookAhead:
    """Reading of pose messages ahead of the sensor's messages, where a frame would be settled without its pose.

    A radio can deliver poses many seconds after the scans. The log has them all, so a second pass over the pose topics
    alone gives them. ``read`` gives the pose messages from a log time on, in the order of the log, and ``take`` passes
    one on. ``is_new`` must be called for every pose message of the first pass. At most 60 s of the log are read ahead.
    """

    def __init__(
        self, poses: _Poses, read: Callable[[int | None], Iterator[RawMessage]], take: Callable[[RawMessage], None]
    ) -> None:
        self._poses, self._read, self._take = poses, read, take
        self._ahead: Iterator[RawMessage] | None = None
        self._next: RawMessage | None = None
        self._num_ahead = 0
        self._last_ns: int | None = None
        self._num_last = 0
        self.log_time_ns = 0
        """Log time of the last message of the first pass, to be set with every message."""

    def is_new(self, message: RawMessage) -> bool:
        """Return False for a pose message of the first pass that was read ahead."""
        self._num_last = self._num_last + 1 if message.log_time_ns == self._last_ns else 1
        self._last_ns = message.log_time_ns
        if self._num_ahead > 0:
            self._num_ahead -= 1
            return False
        # The second pass would give this message again.
        self._ahead = self._next = None
        return True

    def find(self, stamp_ns: int) -> None:
        """Read ahead until the poses on both sides of a stamp are known, or the log holds no such poses in time."""
        if self._ahead is None:
            self._ahead = self._read(self._last_ns)
            # The second pass begins with the last pose messages of the first.
            for _ in range(self._num_last):
                next(self._ahead, None)
            self._next = next(self._ahead, None)
        while self._next is not None and not self._poses.is_known(stamp_ns):
            if self._next.log_time_ns > self.log_time_ns + _LATEST_NS:
                return
            self._take(self._next)
            self._num_ahead += 1
            self._next = next(self._ahead, None)


class UnposedFrames:
    """Stamps of the frames without a pose, in ascending order, to detect poses that come after their frames."""

    def __init__(self, pose_gap_ns: int) -> None:
        self._pose_gap_ns = pose_gap_ns
        self._stamps: list[int] = []

    def add(self, stamp_ns: int) -> None:
        """Add the stamp of a frame without a pose."""
        if len(self._stamps) < _MAX_UNPOSED:
            self._stamps.append(stamp_ns)

    def has_frame_of(self, message: RawMessage) -> bool:
        """True where a pose message has a stamp within the largest gap of a frame without a pose.

        Messages of TF have no stamp of their own and are not compared.
        """
        if not self._stamps or kind_of(message.type_name) not in (Kind.ODOMETRY, Kind.POSE):
            return False
        stamp_ns = message.header_stamp_ns()
        index = bisect_left(self._stamps, stamp_ns - self._pose_gap_ns)
        return index < len(self._stamps) and self._stamps[index] <= stamp_ns + self._pose_gap_ns
