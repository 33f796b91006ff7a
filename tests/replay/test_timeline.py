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
def test_frames_come_once_each_by_stamp_then_robot(stamps_of_robots, ticks):
    timeline = Timeline([FakeLog(str(i), stamps) for i, stamps in enumerate(stamps_of_robots)])
    expected = sorted((stamp, i) for i, stamps in enumerate(stamps_of_robots) for stamp in stamps)
    assert timeline.first_stamp_ns == (expected[0][0] if expected else None)
    given_so_far: list[tuple[int, int]] = []
    for tick in (*ticks, 10**9):
        given_so_far += [(f.stamp_ns, int(f.robot_id)) for f in timeline.frames_before(tick)]
        assert given_so_far == [entry for entry in expected if entry[0] < tick]
        rest = expected[len(given_so_far) :]
        assert timeline.exhausted == (not rest)
        for index, stamps in enumerate(stamps_of_robots):
            seen = [stamp for stamp in stamps if stamp < tick]
            assert timeline.has_ended(index) == (len(seen) == len(stamps))
            assert timeline.last_stamp_ns(index) == (seen[-1] if seen else None)


def test_no_log_is_read_more_than_one_frame_ahead():
    logs = [FakeLog("a", list(range(0, 100, 10))), FakeLog("b", list(range(5, 100, 10)))]
    timeline = Timeline(logs)
    assert [log.num_taken for log in logs] == [1, 1]
    assert len(list(timeline.frames_before(21))) == 5
    assert [log.num_taken for log in logs] == [4, 3]


def test_a_loop_that_stops_early_loses_nothing():
    timeline = Timeline([FakeLog("a", [1, 2, 3])])
    next(iter(timeline.frames_before(10)))
    assert [frame.stamp_ns for frame in timeline.frames_before(10)] == [2, 3]
