from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.time import TimeConfig
from octoreplay.io.robots.thinning import Thinning

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def kept(stamps: list[int], start_ns: int = START, **time) -> list[int]:
    """The kept ones of some stamps, in order."""
    thinning = Thinning(TimeConfig(**time), start_ns)
    return [stamp for stamp in stamps if thinning.keeps(stamp)]


def test_defaults_keep_every_message():
    stamps = [START - 10**15, START - 1, START, START + 1, START + 10**15]
    assert kept(stamps) == stamps
    assert kept(stamps, start=1e-9) == stamps[3:]


def test_a_span_is_half_open():
    stamps = [START + i * SECOND // 2 for i in range(20)]
    assert kept(stamps, start=2.0) == stamps[4:]
    assert kept(stamps, duration=2.0) == stamps[:4]
    assert kept(stamps, start=1.5, duration=2.0) == stamps[3:7]


def test_every_counts_from_the_first_message_of_the_span():
    stamps = [START + i * SECOND for i in range(20)]
    assert kept(stamps, every=3) == stamps[::3]
    assert kept(stamps, every=3, start=4.0, duration=10.0) == stamps[4:14:3]


def test_a_rate_keeps_the_first_message_of_every_period():
    stamps = [START + i * SECOND // 10 for i in range(40)]
    assert kept(stamps, rate_limit=2.0) == stamps[::5]
    assert kept(stamps, rate_limit=2.0, start=0.3) == stamps[3::5]
    # With both, the rate thins the messages that 'every' keeps.
    assert kept(stamps, rate_limit=2.0, every=3) == [stamps[i] for i in (0, 6, 12, 15, 21, 27, 30, 36)]
    assert kept(stamps, rate_limit=1000.0) == stamps
    assert kept(stamps, rate_limit=1e12) == stamps


@given(
    st.lists(st.floats(0.0, 0.3), min_size=1, max_size=120), st.floats(0.5, 30.0), st.floats(0.0, 3.0),
)  # fmt: skip
def test_jitter_does_not_change_the_rate(gaps, rate, start):
    stamps, now = [], START
    for gap in gaps:
        now += round(gap * SECOND)
        stamps.append(now)
    found = kept(stamps, rate_limit=rate, start=start)
    begin = START + round(start * SECOND)
    inside = [stamp for stamp in stamps if stamp >= begin]
    assert set(found) <= set(inside)
    period = round(SECOND / rate)
    assert {(stamp - begin) // period for stamp in found} == {(stamp - begin) // period for stamp in inside}
    for first in range(len(found)):
        span = (found[-1] - found[first]) / SECOND
        assert len(found) - first <= math.ceil(span * rate) + 1


@pytest.mark.parametrize(("duration", "is_over"), [(None, False), (1.0, True), (1000.0, False)])
def test_reading_ends_after_the_span(duration, is_over):
    thinning = Thinning(TimeConfig(duration=duration), START)
    assert thinning.is_over(START + 100 * SECOND) == is_over


def test_reading_ends_after_the_window_the_pairs_and_the_poses():
    time = TimeConfig(start=2.0, duration=3.0, reorder_window=1.0, pair_tolerance=0.25, pose_gap=0.5)
    thinning = Thinning(time, START)
    assert not thinning.is_over(START + 7 * SECOND)
    assert thinning.is_over(START + 7 * SECOND + 1)
