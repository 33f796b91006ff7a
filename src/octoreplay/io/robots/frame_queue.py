"""Sensor messages put in the order of their stamps and joined with their partners and poses."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Sequence
from enum import Enum
from operator import itemgetter
from typing import Generic, NamedTuple, Protocol, TypeVar

from octoreplay.records import Float64Array

Message = TypeVar("Message")


class Poses(Protocol):
    """What the queue needs to know about the sensor's poses."""

    def is_known(self, stamp_ns: int) -> bool:
        """True where the poses on both sides of a stamp have come."""

    def at(self, stamp_ns: int) -> Float64Array | None:
        """The pose at a stamp, (4, 4); None where there is none."""

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what no stamp from ``stamp_ns`` on needs."""


class Settled(NamedTuple, Generic[Message]):
    """A sensor message with everything that was found for it: a partner, or None, of each kind, and its pose."""

    stamp_ns: int
    message: Message
    partners: tuple[Message | None, ...]
    T_map_sensor: Float64Array | None


class Fate(Enum):
    """What became of a sensor message that was added."""

    WAITS = 1
    LATE = 2
    DUPLICATE = 3


class FrameQueue(Generic[Message]):
    """Holds sensor messages and their partners back until their order, partners and poses are settled.

    Partners are messages that go with a sensor message: labels, confidences; ``num_partners`` kinds of them. The newest
    stamp is that of all messages so far. A sensor message is settled when the newest is more than ``reorder_window_ns``
    (with partners also twice ``pair_tolerance_ns``) past its own, and its pose is known or can no longer come. One that
    comes when the newest is already more than ``reorder_window_ns`` past its own is late; of two with one stamp the
    first holds. A partner belongs to the sensor message that is nearest to it (of two, the earlier) among those still
    without one, and only within ``pair_tolerance_ns``; a sensor message takes the nearest of its partners of a kind.
    So what is held is bounded by the window, however long the log is.
    """

    def __init__(
        self, poses: Poses, *, reorder_window_ns: int, pair_tolerance_ns: int, pose_gap_ns: int, num_partners: int
    ) -> None:
        self._poses = poses
        self._window_ns = reorder_window_ns
        self._tolerance_ns = pair_tolerance_ns
        self._pose_gap_ns = pose_gap_ns
        # A partner may be one tolerance later, and the sensor message that is nearer to it one more.
        self._hold_ns = reorder_window_ns + (2 * pair_tolerance_ns if num_partners else 0)
        self._newest_ns: int | None = None
        self._waiting: list[tuple[int, Message]] = []
        self._stamps: set[int] = set()
        self._popped_ns: int | None = None
        self._partners: list[_Partners[Message]] = [_Partners(pair_tolerance_ns) for _ in range(num_partners)]

    @property
    def newest_ns(self) -> int | None:
        """The newest stamp of all messages so far."""
        return self._newest_ns

    def needed_from_ns(self, first_ns: int) -> int:
        """No pose before this stamp is needed any more; ``first_ns`` is the sensor's first stamp."""
        if self._newest_ns is None:
            return first_ns
        return self._waiting[0][0] if self._waiting else self._newest_ns - self._window_ns

    def add_sensor(self, stamp_ns: int, message: Message) -> Fate:
        """Add a sensor message, unless it is late or a duplicate."""
        if self._newest_ns is not None and stamp_ns < self._newest_ns - self._window_ns:
            return Fate.LATE
        if stamp_ns in self._stamps:
            return Fate.DUPLICATE
        self._stamps.add(stamp_ns)
        insort(self._waiting, (stamp_ns, message), key=itemgetter(0))
        self._see(stamp_ns)
        return Fate.WAITS

    def add_partner(self, kind: int, stamp_ns: int, message: Message) -> None:
        """Add a partner of a kind; of two with one stamp the first holds."""
        newest_ns = self._see(stamp_ns)
        earliest_ns = min(newest_ns - self._window_ns, self._waiting[0][0] if self._waiting else newest_ns)
        self._partners[kind].add(stamp_ns, message)
        self._partners[kind].drop_before(earliest_ns - self._tolerance_ns)

    def pop(self, *, final: bool) -> Settled[Message] | None:
        """The earliest message if it is settled, else None; with ``final`` nothing more can come, and all are."""
        if not self._waiting or not (final or self._is_settled(self._waiting[0][0])):
            return None
        # A partner is never nearer to a message that is further away than this.
        end = bisect_right(self._waiting, self._waiting[0][0] + 2 * self._tolerance_ns, key=itemgetter(0))
        stamps = [stamp for stamp, _ in self._waiting[:end]]
        partners = tuple(partners.take(stamps) for partners in self._partners)
        stamp_ns, message = self._waiting.pop(0)
        # Anything before it is late from now on; one with its own stamp may still come where there is no window.
        if self._popped_ns is not None and self._popped_ns != stamp_ns:
            self._stamps.discard(self._popped_ns)
        self._popped_ns = stamp_ns
        pose = self._poses.at(stamp_ns)
        self._poses.forget_before(stamp_ns)
        return Settled(stamp_ns, message, partners, pose)

    def _see(self, stamp_ns: int) -> int:
        """Move the newest stamp on, and give it."""
        self._newest_ns = stamp_ns if self._newest_ns is None else max(self._newest_ns, stamp_ns)
        return self._newest_ns

    def _is_settled(self, stamp_ns: int) -> bool:
        """True where neither an earlier message, nor a nearer partner, nor a pose around the stamp can still come."""
        if self._newest_ns is None or self._newest_ns <= stamp_ns + self._hold_ns:
            return False
        given_up = self._newest_ns > stamp_ns + self._hold_ns + self._pose_gap_ns
        return given_up or self._poses.is_known(stamp_ns)


class _Partners(Generic[Message]):
    """The partners of one kind that no sensor message has taken yet."""

    def __init__(self, tolerance_ns: int) -> None:
        self._tolerance_ns = tolerance_ns
        self._stamps: list[int] = []
        self._messages: dict[int, Message] = {}

    def add(self, stamp_ns: int, message: Message) -> None:
        """Add a partner; of two with one stamp the first holds."""
        if stamp_ns not in self._messages:
            self._messages[stamp_ns] = message
            insort(self._stamps, stamp_ns)

    def take(self, waiting: Sequence[int]) -> Message | None:
        """The partner of the earliest of the waiting sensor messages' stamps, removed."""
        stamp_ns = waiting[0]
        first = bisect_left(self._stamps, stamp_ns - self._tolerance_ns)
        last = bisect_left(self._stamps, stamp_ns + self._tolerance_ns + 1)
        # Of two sensor messages that are equally near, the earlier has it: the earliest of all is asked.
        mine = [
            partner
            for partner in self._stamps[first:last]
            if all(abs(partner - other) >= abs(partner - stamp_ns) for other in waiting)
        ]
        best = min(mine, key=lambda partner: (abs(partner - stamp_ns), partner), default=None)
        self.drop_before(stamp_ns - self._tolerance_ns)
        if best is None:
            return None
        del self._stamps[bisect_left(self._stamps, best)]
        return self._messages.pop(best)

    def drop_before(self, stamp_ns: int) -> None:
        """Drop the partners that no sensor message, waiting or still to come in time, can have."""
        end = bisect_left(self._stamps, stamp_ns)
        for stamp in self._stamps[:end]:
            del self._messages[stamp]
        del self._stamps[:end]
