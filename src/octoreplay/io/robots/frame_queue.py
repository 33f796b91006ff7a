"""Sensor messages put in the order of their stamps and joined with their labels and poses."""

from __future__ import annotations

import heapq
from bisect import bisect_left, insort
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
    """A sensor message with everything that was found for it."""

    stamp_ns: int
    message: Message
    label: Message | None
    T_map_sensor: Float64Array | None


class FrameQueue(Generic[Message]):
    """Holds sensor messages and labels back until their order, partners and poses are settled.

    The newest stamp is that of all messages and labels so far. A message is settled when the newest is more than
    ``reorder_window_ns`` (with labels also twice ``pair_tolerance_ns``) past its own, and its pose is known or can no
    longer come. One that comes when the newest is already more than ``reorder_window_ns`` past its own is late.
    A label belongs to the sensor message that is nearest to it (of two, the earlier) among those still without one, and
    only within ``pair_tolerance_ns``; a sensor message takes the nearest of its labels.
    So what is held is bounded by the window, however long the log is.
    """

    def __init__(
        self, poses: Poses, *, reorder_window_ns: int, pair_tolerance_ns: int, pose_gap_ns: int, has_labels: bool
    ) -> None:
        self._poses = poses
        self._window_ns = reorder_window_ns
        self._tolerance_ns = pair_tolerance_ns
        self._pose_gap_ns = pose_gap_ns
        # A label may be one tolerance later, and the sensor message that is nearer to it one more.
        self._hold_ns = reorder_window_ns + (2 * pair_tolerance_ns if has_labels else 0)
        self._newest_ns: int | None = None
        self._waiting: list[tuple[int, int, Message]] = []
        self._num_added = 0
        self._label_stamps: list[int] = []
        self._labels: dict[int, Message] = {}

    def add_sensor(self, stamp_ns: int, message: Message) -> bool:
        """Add a sensor message; False, and nothing added, where it is late."""
        if self._newest_ns is not None and stamp_ns < self._newest_ns - self._window_ns:
            return False
        heapq.heappush(self._waiting, (stamp_ns, self._num_added, message))
        self._num_added += 1
        self._see(stamp_ns)
        return True

    def add_label(self, stamp_ns: int, message: Message) -> None:
        """Add a label; of two with one stamp the first holds."""
        if stamp_ns in self._labels:
            return
        self._labels[stamp_ns] = message
        insort(self._label_stamps, stamp_ns)
        newest_ns = self._see(stamp_ns)
        earliest_ns = min(newest_ns - self._window_ns, self._waiting[0][0] if self._waiting else newest_ns)
        self._drop_labels_before(earliest_ns - self._tolerance_ns)

    def pop(self, *, final: bool) -> Settled[Message] | None:
        """The earliest message if it is settled, else None; with ``final`` nothing more can come, and all are."""
        if not self._waiting or not (final or self._is_settled(self._waiting[0][0])):
            return None
        stamp_ns, _, message = self._waiting[0]
        label = self._take_label(stamp_ns)
        heapq.heappop(self._waiting)
        pose = self._poses.at(stamp_ns)
        self._poses.forget_before(stamp_ns)
        return Settled(stamp_ns, message, label, pose)

    def _see(self, stamp_ns: int) -> int:
        """Move the newest stamp on, and give it."""
        self._newest_ns = stamp_ns if self._newest_ns is None else max(self._newest_ns, stamp_ns)
        return self._newest_ns

    def _is_settled(self, stamp_ns: int) -> bool:
        """True where neither an earlier message, nor a nearer label, nor a pose around the stamp can still come."""
        if self._newest_ns is None or self._newest_ns <= stamp_ns + self._hold_ns:
            return False
        given_up = self._newest_ns > stamp_ns + self._hold_ns + self._pose_gap_ns
        return given_up or self._poses.is_known(stamp_ns)

    def _take_label(self, stamp_ns: int) -> Message | None:
        """The label of the earliest waiting message, removed."""
        first = bisect_left(self._label_stamps, stamp_ns - self._tolerance_ns)
        last = bisect_left(self._label_stamps, stamp_ns + self._tolerance_ns + 1)
        mine = [label for label in self._label_stamps[first:last] if self._is_nearest(stamp_ns, label)]
        best = min(mine, key=lambda label: (abs(label - stamp_ns), label), default=None)
        self._drop_labels_before(stamp_ns - self._tolerance_ns)
        if best is None:
            return None
        del self._label_stamps[bisect_left(self._label_stamps, best)]
        return self._labels.pop(best)

    def _drop_labels_before(self, stamp_ns: int) -> None:
        """Drop the labels that no message, waiting or still to come in time, can have."""
        end = bisect_left(self._label_stamps, stamp_ns)
        for label in self._label_stamps[:end]:
            del self._labels[label]
        del self._label_stamps[:end]

    def _is_nearest(self, stamp_ns: int, label_ns: int) -> bool:
        """True where no waiting message is nearer to a label than the earliest one is."""
        distance = abs(label_ns - stamp_ns)
        return distance == 0 or all(abs(label_ns - other) >= distance for other, _, _ in self._waiting)
