"""Sensor messages put in the order of their stamps and joined with their partners and poses."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Sequence
from enum import Enum
from operator import itemgetter
from typing import Generic, NamedTuple, Protocol, TypeVar

from octoreplay.records import Float64Array

Message = TypeVar("Message")


class Poses(Protocol):
    """Poses of the sensor, as the queue needs them."""

    def is_known(self, stamp_ns: int) -> bool:
        """True where the poses on both sides of a stamp are known."""

    def at(self, stamp_ns: int) -> Float64Array | None:
        """Pose at a stamp, (4, 4); None where there is none."""

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that no stamp from ``stamp_ns`` on needs."""


class Settled(NamedTuple, Generic[Message]):
    """Sensor message with one partner (or None) of each kind and its pose (or None)."""

    stamp_ns: int
    message: Message
    partners: tuple[Message | None, ...]
    T_map_sensor: Float64Array | None


class Fate(Enum):
    """Outcome of adding a sensor message."""

    WAITS = 1
    LATE = 2
    DUPLICATE = 3


class FrameQueue(Generic[Message]):
    """Holds sensor messages and their partners back until their order, partners and poses are settled.

    Partners are the labels and confidences that go with a sensor message, of ``num_partners`` kinds. The newest stamp
    is the largest of all messages so far.

    - Settled: the newest stamp is more than ``reorder_window_ns`` (with partners also twice ``pair_tolerance_ns``) past
      the message's own, and its pose is known or can no longer arrive.
    - Late: the newest stamp is already more than ``reorder_window_ns`` past the message's own when it is added.
    - Duplicate: an earlier message has the same stamp; the first one is kept.
    - A partner belongs to the nearest sensor message (the earlier of two) without a partner of its kind, within
      ``pair_tolerance_ns``. A sensor message takes the nearest of its partners of a kind.

    ``find_pose`` is called with the stamp of a message that would be settled before its pose is known. The number of
    messages held is bounded by the window, whatever the length of the log.
    """

    def __init__(
        self,
        poses: Poses,
        *,
        reorder_window_ns: int,
        pair_tolerance_ns: int,
        pose_gap_ns: int,
        num_partners: int,
        find_pose: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._poses = poses
        self._find_pose = find_pose
        self._window_ns = reorder_window_ns
        self._tolerance_ns = pair_tolerance_ns
        self._pose_gap_ns = pose_gap_ns
        # A partner may be one tolerance later, and a sensor message nearer to it one tolerance later still.
        self._hold_ns = reorder_window_ns + (2 * pair_tolerance_ns if num_partners else 0)
        self._newest_ns: int | None = None
        self._waiting: list[tuple[int, Message]] = []
        self._stamps: set[int] = set()
        self._popped_ns: int | None = None
        self._partners: list[_Partners[Message]] = [_Partners(pair_tolerance_ns) for _ in range(num_partners)]

    @property
    def newest_ns(self) -> int | None:
        """Largest stamp of all messages so far; None before the first."""
        return self._newest_ns

    def unused_partners(self, kind: int) -> tuple[int, int]:
        """Return the numbers of partners of a kind without a sensor message, and of those with a repeated stamp."""
        partners = self._partners[kind]
        return partners.num_dropped + len(partners), partners.num_repeated

    def needed_from_ns(self, first_ns: int) -> int:
        """Stamp from which poses are still needed; ``first_ns`` is the sensor's first stamp."""
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
        self._advance(stamp_ns)
        return Fate.WAITS

    def add_partner(self, kind: int, stamp_ns: int, message: Message) -> None:
        """Add a partner of a kind; of two with the same stamp the first is kept."""
        newest_ns = self._advance(stamp_ns)
        earliest_ns = min(newest_ns - self._window_ns, self._waiting[0][0] if self._waiting else newest_ns)
        self._partners[kind].add(stamp_ns, message)
        self._partners[kind].drop_before(earliest_ns - self._tolerance_ns)

    def pop(self, *, final: bool) -> Settled[Message] | None:
        """Return and remove the earliest message if it is settled, else None; ``final`` settles every message."""
        if not self._waiting or not (final or self._is_settled(self._waiting[0][0])):
            return None
        # No partner of the earliest message can be nearer to a message beyond this.
        end = bisect_right(self._waiting, self._waiting[0][0] + 2 * self._tolerance_ns, key=itemgetter(0))
        stamps = [stamp for stamp, _ in self._waiting[:end]]
        partners = tuple(partners.take(stamps) for partners in self._partners)
        stamp_ns, message = self._waiting.pop(0)
        # Earlier stamps are late from now on; without a window its own stamp may still arrive again.
        if self._popped_ns is not None and self._popped_ns != stamp_ns:
            self._stamps.discard(self._popped_ns)
        self._popped_ns = stamp_ns
        if not self._poses.is_known(stamp_ns):
            self._find_pose(stamp_ns)
        pose = self._poses.at(stamp_ns)
        self._poses.forget_before(stamp_ns)
        return Settled(stamp_ns, message, partners, pose)

    def _advance(self, stamp_ns: int) -> int:
        """Update the newest stamp and return it."""
        self._newest_ns = stamp_ns if self._newest_ns is None else max(self._newest_ns, stamp_ns)
        return self._newest_ns

    def _is_settled(self, stamp_ns: int) -> bool:
        """True where no earlier message, nearer partner or pose around the stamp can still arrive."""
        if self._newest_ns is None or self._newest_ns <= stamp_ns + self._hold_ns:
            return False
        is_overdue = self._newest_ns > stamp_ns + self._hold_ns + self._pose_gap_ns
        return is_overdue or self._poses.is_known(stamp_ns)


class _Partners(Generic[Message]):
    """Partners of one kind that no sensor message has taken yet."""

    def __init__(self, tolerance_ns: int) -> None:
        self.num_dropped = 0
        self.num_repeated = 0
        self._tolerance_ns = tolerance_ns
        self._stamps: list[int] = []
        self._messages: dict[int, Message] = {}

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, message: Message) -> None:
        """Add a partner; of two with the same stamp the first is kept."""
        if stamp_ns in self._messages:
            self.num_repeated += 1
            return
        self._messages[stamp_ns] = message
        insort(self._stamps, stamp_ns)

    def take(self, waiting: Sequence[int]) -> Message | None:
        """Return and remove the partner of the earliest of the waiting sensor messages, given by their stamps."""
        stamp_ns = waiting[0]
        first = bisect_left(self._stamps, stamp_ns - self._tolerance_ns)
        last = bisect_left(self._stamps, stamp_ns + self._tolerance_ns + 1)
        # Of two equally near sensor messages the earlier takes the partner, and this is the earliest.
        candidates = [
            partner
            for partner in self._stamps[first:last]
            if all(abs(partner - other) >= abs(partner - stamp_ns) for other in waiting)
        ]
        best = min(candidates, key=lambda partner: (abs(partner - stamp_ns), partner), default=None)
        self.drop_before(stamp_ns - self._tolerance_ns)
        if best is None:
            return None
        del self._stamps[bisect_left(self._stamps, best)]
        return self._messages.pop(best)

    def drop_before(self, stamp_ns: int) -> None:
        """Drop partners before a stamp; no waiting or future sensor message can take them."""
        end = bisect_left(self._stamps, stamp_ns)
        self.num_dropped += end
        for stamp in self._stamps[:end]:
            del self._messages[stamp]
        del self._stamps[:end]
