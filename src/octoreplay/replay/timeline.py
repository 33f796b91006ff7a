"""The frames of a team on one clock: the robots' streams merged by stamp, read as they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from octoreplay.records import Frame


class FrameSource(Protocol):
    """A robot's frames in the order of their stamps (``io.robot_log.RobotLog``)."""

    def frames(self) -> Iterator[Frame]:
        """The frames from the beginning."""


class Timeline:
    """Merges robots' frames by (stamp, index of the robot); holds one frame of each robot ahead."""

    def __init__(self, logs: Sequence[FrameSource]) -> None:
        self._streams = [log.frames() for log in logs]
        self._next: list[Frame | None] = [next(stream, None) for stream in self._streams]
        self._last_ns: list[int | None] = [None] * len(self._streams)
        stamps = [frame.stamp_ns for frame in self._next if frame is not None]
        self.first_stamp_ns = min(stamps, default=None)
        """Stamp of the team's first frame; None where no robot has one."""

    @property
    def exhausted(self) -> bool:
        """True when every frame of every robot has been given."""
        return all(frame is None for frame in self._next)

    def has_ended(self, robot_index: int) -> bool:
        """True when a robot's last frame has been given (at once for a robot without any)."""
        return self._next[robot_index] is None

    def last_stamp_ns(self, robot_index: int) -> int | None:
        """Stamp of the latest frame that a robot has given; None before its first."""
        return self._last_ns[robot_index]

    def frames_before(self, stamp_ns: int) -> Iterator[Frame]:
        """The frames not given yet with stamps below ``stamp_ns``, by (stamp, robot index)."""
        while (index := self._earliest()) is not None:
            frame = self._next[index]
            if frame is None or frame.stamp_ns >= stamp_ns:
                return
            self._last_ns[index] = frame.stamp_ns
            self._next[index] = next(self._streams[index], None)
            yield frame

    def _earliest(self) -> int | None:
        """The index of the robot whose next frame is the earliest of all."""
        waiting = [(frame.stamp_ns, index) for index, frame in enumerate(self._next) if frame is not None]
        return min(waiting)[1] if waiting else None
