"""Telling stamps that a clock gave from damaged ones, before these move the clock of a whole log."""

from __future__ import annotations

MAX_STAMP_NS = (1 << 31) * 1_000_000_000
"""Stamps are from 0 up to this, in the year 2038: ROS 2 writes seconds in 32 bits with a sign."""

MAX_JUMP_NS = 3_600 * 1_000_000_000
"""From one message to the next a stamp may move against the time of the log by an hour; most clocks move by nothing."""


class StampCheck:
    """Judges the stamps of one log, topic by topic; ``offset_ns`` is the robot's clock offset.

    A stamp is damage where it is out of range, or more than ``MAX_JUMP_NS`` further from the log's time, or nearer to
    it, than that of the last good message of its topic and that of the message before it. So a damaged stamp is found
    whatever it is, and a clock that is set while recording costs one message of each topic.
    """

    def __init__(self, offset_ns: int) -> None:
        self._offset_ns = offset_ns
        self._good: dict[str, int] = {}
        self._latest: dict[str, int] = {}

    def is_in_range(self, stamp_ns: int) -> bool:
        """True where a stamp, before the clock offset is applied, is one that a result can hold."""
        return 0 <= stamp_ns + self._offset_ns < MAX_STAMP_NS

    def is_good(self, topic: str, stamp_ns: int, log_time_ns: int) -> bool:
        """True where the stamp of the next message of a topic can be believed."""
        if not self.is_in_range(stamp_ns):
            return False
        ahead_ns = stamp_ns - log_time_ns
        known = (self._good.get(topic, ahead_ns), self._latest.get(topic, ahead_ns))
        self._latest[topic] = ahead_ns
        if all(abs(ahead_ns - other) > MAX_JUMP_NS for other in known):
            return False
        self._good[topic] = ahead_ns
        return True
