"""Frames of all robots in the order of time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.records import CloudFrame
from octoreplay.replay.timeline import Timeline


class FakeLog:
    """Frames at given stamps; counts how many were taken."""

    def __init__(self, robot_id: str, stamps: list[int]) -> None:
        self.robot_id, self.stamps, self.num_taken = robot_id, stamps, 0

    def frames(self) -> Iterator[CloudFrame]:
        for stamp in self.stamps:
            self.num_taken += 1
            yield CloudFrame(self.robot_id, stamp, np.zeros((0, 3)), None, np.eye(4))


@given(
    st.lists(st.lists(st.integers(0, 50), max_size=8).map(sorted), max_size=4),
    st.lists(st.integers(0, 60), max_size=6).map(sorted),
)
def test_frames_of_each_robot_come_once_and_in_order(stamps_of_robots, ticks):
    timeline = Timeline([FakeLog(str(i), stamps) for i, stamps in enumerate(stamps_of_robots)])
    assert timeline.first_stamp_ns == min((stamps[0] for stamps in stamps_of_robots if stamps), default=None)
    given_so_far: list[list[int]] = [[] for _ in stamps_of_robots]
    for tick in (*ticks, 10**9):
        for index, stamps in enumerate(stamps_of_robots):
            frames = list(timeline.frames_before(index, tick))
            assert {frame.robot_id for frame in frames} <= {str(index)}
            given_so_far[index] += [frame.stamp_ns for frame in frames]
            assert given_so_far[index] == [stamp for stamp in stamps if stamp < tick]
        assert timeline.exhausted == (given_so_far == stamps_of_robots)
        assert timeline.active(None) == [bool(given) for given in given_so_far]
        for leave_ns in (tick - 5, tick):
            pairs = zip(given_so_far, stamps_of_robots, strict=True)
            expected = [bool(given) and (given != stamps or given[-1] >= leave_ns) for given, stamps in pairs]
            assert timeline.active(leave_ns) == expected


def test_no_log_is_read_more_than_one_frame_ahead():
    logs = [FakeLog("a", list(range(0, 100, 10))), FakeLog("b", list(range(5, 100, 10)))]
    timeline = Timeline(logs)
    assert [log.num_taken for log in logs] == [1, 1]
    assert len(list(timeline.frames_before(0, 21))) == 3
    assert [log.num_taken for log in logs] == [4, 1]


def test_a_loop_that_stops_early_loses_no_frame():
    timeline = Timeline([FakeLog("a", [1, 2, 3])])
    next(iter(timeline.frames_before(0, 10)))
    assert [frame.stamp_ns for frame in timeline.frames_before(0, 10)] == [2, 3]


def test_the_next_stamp_is_the_earliest_pending_one():
    timeline = Timeline([FakeLog("a", [5, 9]), FakeLog("b", [7]), FakeLog("c", [])])
    assert timeline.next_stamp_ns == 5
    list(timeline.frames_before(0, 8))
    assert timeline.next_stamp_ns == 7
    list(timeline.frames_before(1, 8))
    list(timeline.frames_before(0, 10))
    assert timeline.next_stamp_ns is None
