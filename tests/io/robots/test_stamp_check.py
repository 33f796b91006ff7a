from __future__ import annotations

import random

import pytest

from octoreplay.io.robots.stamp_check import MAX_JUMP_NS, MAX_STAMP_NS, StampCheck
from support.log_factory import SECOND

START = 1_700_000_000 * SECOND


def judged(aheads, topics=None, offset_ns=0) -> list[bool]:
    """Result of the check, message by message, for stamps this far ahead of the log time."""
    check = StampCheck(offset_ns)
    times = [START + index * SECOND for index in range(len(aheads))]
    names = topics or ["/a"] * len(aheads)
    return [check.is_good(name, t + ahead, t) for name, t, ahead in zip(names, times, aheads, strict=True)]


def test_a_stamp_that_moves_by_more_than_an_hour_is_damage():
    hour = MAX_JUMP_NS
    assert judged([0, hour, 0, hour + 1, 0, -hour, 0, -hour - 1, 0]) == [True] * 3 + [False] + [True] * 3 + [
        False,
        True,
    ]


def test_setting_the_clock_loses_one_message():
    boot = 5 * SECOND - START
    assert judged([boot, boot, 0, 0, 0]) == [True, True, False, True, True]
    assert judged([boot, 0, 0]) == [True, False, True]


def test_topics_are_checked_independently():
    simulated = 10 * SECOND - START
    assert judged([0, simulated, 0, simulated], ["/a", "/b", "/a", "/b"]) == [True] * 4


def test_clocks_may_drift_without_limit():
    """A simulation that runs at a tenth of real time, over a month."""
    check = StampCheck(0)
    assert all(check.is_good("/a", i * 300 * SECOND, START + i * 3000 * SECOND) for i in range(1000))


@pytest.mark.parametrize("offset_ns", [0, 5 * SECOND, -5 * SECOND])
def test_the_range_is_that_of_ros_with_the_clock_offset_applied(offset_ns):
    check = StampCheck(offset_ns)
    for stamp, good in ((-1, False), (0, True), (MAX_STAMP_NS - 1, True), (MAX_STAMP_NS, False)):
        assert check.is_in_range(stamp - offset_ns) is good
        assert StampCheck(offset_ns).is_good("/a", stamp - offset_ns, START) is good


def test_exactly_the_damaged_stamps_are_found():
    rng = random.Random(3)
    aheads = [0, 0]
    while len(aheads) < 200:
        aheads += [rng.choice([-1, 1]) * rng.randrange(2 * MAX_JUMP_NS, START), 0] if rng.random() < 0.3 else [0]
    assert judged(aheads) == [ahead == 0 for ahead in aheads]
