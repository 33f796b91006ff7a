"""Detection of damaged stamps."""

from __future__ import annotations

MAX_STAMP_NS = (1 << 31) * 1_000_000_000
"""Exclusive upper bound of stamps, in the year 2038: ROS 2 stores seconds in a signed 32-bit integer."""

MAX_JUMP_NS = 3_600 * 1_000_000_000
"""Largest change of the difference between stamp and log time from one message to the next: one hour."""


class StampCheck:
    """Check of the stamps of one robot, topic by topic; ``offset_ns`` is the robot's clock offset.

    A stamp is damaged where it is out of range, or where its difference to the log time differs by more than
    ``MAX_JUMP_NS`` both from that of the last good message of the topic and from that of the previous message. A clock
    that is set during the recording therefore loses one message per topic.
    """

    def __init__(self, offset_ns: int) -> None:
        self._offset_ns = offset_ns
        self._good: dict[str, int] = {}
        self._latest: dict[str, int] = {}

    def is_in_range(self, stamp_ns: int) -> bool:
        """True where a result can hold a stamp, given without the clock offset, once the offset is added."""
        return 0 <= stamp_ns + self._offset_ns < MAX_STAMP_NS

    def is_good(self, topic: str, stamp_ns: int, log_time_ns: int) -> bool:
        """True where the stamp of a topic's next message is not damaged."""
        if not self.is_in_range(stamp_ns):
            return False
        ahead_ns = stamp_ns - log_time_ns
        known = (self._good.get(topic, ahead_ns), self._latest.get(topic, ahead_ns))
        self._latest[topic] = ahead_ns
        if all(abs(ahead_ns - other) > MAX_JUMP_NS for other in known):
            return False
        self._good[topic] = ahead_ns
        return True
