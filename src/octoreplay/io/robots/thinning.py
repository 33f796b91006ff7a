"""Selection of a sensor's messages by time span, by number and by rate."""

from __future__ import annotations

import itertools

from octoreplay.config.time import TimeConfig


class Thinning:
    """Selection of messages, which are passed in stamp order; stamps and ``team_start_ns`` are of the same clock.

    ``every`` counts the messages within the span, beginning with its first. ``rate_limit`` keeps the first message of
    each period since the span's start, so that jitter does not change the mean rate.
    """

    def __init__(self, time: TimeConfig, team_start_ns: int) -> None:
        self._start_ns = team_start_ns + round(time.start * 1e9)
        self._has_start = time.start > 0
        self._end_ns = None if time.duration is None else self._start_ns + round(time.duration * 1e9)
        self._hold_ns = round((time.reorder_window + 2 * time.pair_tolerance + time.pose_gap) * 1e9)
        self._every = time.every
        self._period_ns = None if time.rate_limit is None else max(round(1e9 / time.rate_limit), 1)
        self._numbers = itertools.count()
        self._last_period: int | None = None

    @property
    def needed_from_ns(self) -> int | None:
        """Stamp before which no message or pose affects a frame that is used; None without a start."""
        return self._start_ns - self._hold_ns if self._has_start else None

    def keeps(self, stamp_ns: int) -> bool:
        """True where the next message, with this stamp, is used."""
        # Without a start, messages before the first stamp are used too.
        if (self._has_start and stamp_ns < self._start_ns) or (self._end_ns is not None and stamp_ns >= self._end_ns):
            return False
        if next(self._numbers) % self._every:
            return False
        if self._period_ns is not None:
            period = (stamp_ns - self._start_ns) // self._period_ns
            if period == self._last_period:
                return False
            self._last_period = period
        return True

    def is_over(self, now_ns: int) -> bool:
        """True once no message of the span can still arrive; ``now_ns`` is the newest stamp."""
        return self._end_ns is not None and now_ns > self._end_ns + self._hold_ns
