"""Frames of a team on the shared clock, read lazily."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Generic, NamedTuple, Protocol, TypeAlias, TypeVar

from octoreplay.errors import InputError
from octoreplay.mapping.sensor import CastFrame
from octoreplay.records import Frame

Scan: TypeAlias = Frame | CastFrame
"""Frame of a sensor, or the cells that its rays touch."""


ScanT = TypeVar("ScanT", bound=Scan)
ScanT_co = TypeVar("ScanT_co", bound=Scan, covariant=True)


class FrameSource(Protocol[ScanT_co]):
    """Frames of one robot in the order of their stamps (``io.robots.robot_log.RobotLog``)."""

    def frames(self) -> Iterator[ScanT_co]:
        """Iterate over the frames from the beginning."""


class Bodies(Protocol):
    """Boxes of the robots' bodies over time (``io.robots.team_bodies.TeamBodies``)."""

    def advance(self, start_ns: int, end_ns: int) -> None:
        """Read the boxes between two stamps."""

    def add_to(self, index: int, frame: Frame) -> Frame:
        """Return a robot's frame with the boxes of all other robots at its stamp added."""


class Position(NamedTuple):
    """Frames of each robot (N,) that were taken: their number, and the stamp of the last one (None: none)."""

    num_taken: tuple[int, ...]
    last_ns: tuple[int | None, ...]


class Timeline(Generic[ScanT]):
    """Frames of all robots up to a common time. It holds one frame of each robot ahead.

    Frames of different robots may be taken in parallel threads.
    """

    def __init__(self, logs: Sequence[FrameSource[ScanT]]) -> None:
        self._streams = [log.frames() for log in logs]
        self._next: list[ScanT | None] = [next(stream, None) for stream in self._streams]
        self._num_taken = [0] * len(self._streams)
        self._last_ns: list[int | None] = [None] * len(self._streams)
        stamps = [frame.stamp_ns for frame in self._next if frame is not None]
        self.first_stamp_ns = min(stamps, default=None)
        """Stamp of the team's first frame; None without frames."""

    def rewind(self, robot_index: int, source: FrameSource[ScanT]) -> None:
        """Continue a robot with another source, from its first frame on."""
        self._streams[robot_index] = source.frames()
        self._next[robot_index] = next(self._streams[robot_index], None)
        self._num_taken[robot_index] = 0

    @property
    def position(self) -> Position:
        """The present position."""
        return Position(tuple(self._num_taken), tuple(self._last_ns))

    def skip_to(self, robot_index: int, position: Position) -> None:
        """Skip the frames of a robot up to a position. Raises InputError where the log holds fewer frames."""
        while self._num_taken[robot_index] < position.num_taken[robot_index]:
            if self._take(robot_index) is None:
                raise InputError(
                    f"the logs hold {self._num_taken[robot_index]} frames of a robot of which the interrupted run used"
                    f" {position.num_taken[robot_index]}; run with --restart to start from the beginning"
                )
        self._last_ns[robot_index] = position.last_ns[robot_index]

    @property
    def exhausted(self) -> bool:
        """True when all frames of all robots have been taken."""
        return all(frame is None for frame in self._next)

    @property
    def next_stamp_ns(self) -> int | None:
        """Stamp of the earliest frame that has not been taken; None at the end."""
        return min((frame.stamp_ns for frame in self._next if frame is not None), default=None)

    def active(self, leave_ns: int | None) -> list[bool]:
        """True for each robot (N,) that takes part, from its first frame on.

        With ``leave_ns`` robots whose last frame is before that stamp have left.
        """
        pairs = zip(self._next, self._last_ns, strict=True)
        return [
            last_ns is not None and (leave_ns is None or following is not None or last_ns >= leave_ns)
            for following, last_ns in pairs
        ]

    def frames_before(self, robot_index: int, stamp_ns: int) -> Iterator[ScanT]:
        """Remaining frames of a robot with stamps below ``stamp_ns``."""
        while (frame := self._next[robot_index]) is not None and frame.stamp_ns < stamp_ns:
            self._take(robot_index)
            yield frame

    def _take(self, robot_index: int) -> ScanT | None:
        """Take the next frame of a robot; None at the end."""
        frame = self._next[robot_index]
        if frame is not None:
            self._num_taken[robot_index] += 1
            self._last_ns[robot_index] = frame.stamp_ns
            self._next[robot_index] = next(self._streams[robot_index], None)
        return frame
