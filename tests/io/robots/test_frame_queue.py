from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.io.robots.frame_queue import FrameQueue, Settled


class FakePoses:
    """Poses at every stamp up to ``known_to``."""

    def __init__(self, known_to: int = 10**9) -> None:
        self.known_to, self.forgotten = known_to, -1

    def is_known(self, stamp_ns: int) -> bool:
        return stamp_ns <= self.known_to

    def at(self, stamp_ns: int) -> np.ndarray | None:
        assert stamp_ns >= self.forgotten
        return np.eye(4) * stamp_ns if stamp_ns <= self.known_to else None

    def forget_before(self, stamp_ns: int) -> None:
        self.forgotten = stamp_ns


def make_queue(poses=None, *, window=100, tolerance=10, gap=50, has_labels=True) -> FrameQueue[str]:
    return FrameQueue(
        poses or FakePoses(), reorder_window_ns=window, pair_tolerance_ns=tolerance, pose_gap_ns=gap,
        has_labels=has_labels,
    )  # fmt: skip


def run(
    queue: FrameQueue[str], arrivals: list[tuple[str, int]], *, final_only=False
) -> tuple[list[Settled], list[int]]:
    """What a queue gives for messages in the order of arrival, and the stamps that were late."""
    settled, late = [], []

    def drain(*, final: bool) -> None:
        while (ready := queue.pop(final=final)) is not None:
            settled.append(ready)

    for kind, stamp in arrivals:
        if kind == "label":
            queue.add_label(stamp, f"label {stamp}")
        elif not queue.add_sensor(stamp, f"depth {stamp}"):
            late.append(stamp)
        if not final_only:
            drain(final=False)
    drain(final=True)
    return settled, late


@st.composite
def arrivals_within(draw, window: int):
    """Messages whose stamps are behind the newest sensor stamp by at most a window."""
    kinds = draw(st.lists(st.tuples(st.sampled_from(["depth", "label"]), st.integers(0, 400)), max_size=40))
    delays = draw(st.lists(st.integers(0, window), min_size=len(kinds), max_size=len(kinds)))
    order = sorted(range(len(kinds)), key=lambda i: (kinds[i][1] + delays[i], i))
    unique = dict.fromkeys(kinds[i] for i in order)
    return list(unique)


@given(arrivals_within(60), st.integers(0, 30))
def test_reading_in_a_window_gives_what_reading_everything_first_gives(arrivals, tolerance):
    streamed, late = run(make_queue(window=60, tolerance=tolerance), arrivals)
    at_once, _ = run(make_queue(window=10**6, tolerance=tolerance), arrivals, final_only=True)
    assert late == []
    assert [(s.stamp_ns, s.message, s.label) for s in streamed] == [(s.stamp_ns, s.message, s.label) for s in at_once]


@given(arrivals_within(60), st.integers(0, 30))
def test_pairs_are_unique_near_and_exact_where_they_can_be(arrivals, tolerance):
    settled, _ = run(make_queue(window=60, tolerance=tolerance), arrivals)
    depths = [stamp for kind, stamp in arrivals if kind == "depth"]
    labels = [stamp for kind, stamp in arrivals if kind == "label"]
    assert [s.stamp_ns for s in settled] == sorted(depths)
    partner = {s.stamp_ns: int(s.label.split()[1]) for s in settled if s.label is not None}
    assert len(set(partner.values())) == len(partner)
    for depth in depths:
        if depth in labels:
            assert partner[depth] == depth
        elif depth in partner:
            assert abs(partner[depth] - depth) <= tolerance
        else:
            # Every label in reach went to, or was nearer to, another depth image.
            for label in labels:
                if abs(label - depth) <= tolerance:
                    others = [other for other in depths if other != depth]
                    assert min(abs(label - other) for other in others) <= abs(label - depth)


@given(st.lists(st.integers(0, 300), max_size=30), st.integers(0, 100))
def test_late_is_more_than_the_window_behind_and_the_rest_comes_in_order(stamps, window):
    settled, late = run(make_queue(window=window, has_labels=False), [("depth", stamp) for stamp in stamps])
    expected = [stamp for i, stamp in enumerate(stamps) if stamp < max(stamps[:i], default=0) - window]
    assert late == expected
    kept = [s.stamp_ns for s in settled]
    assert kept == sorted(kept)
    assert sorted(kept + late) == sorted(stamps)


def test_the_nearer_depth_image_gets_the_label():
    settled, _ = run(make_queue(tolerance=20), [("depth", 0), ("label", 12), ("depth", 15), ("depth", 40)])
    assert [(s.stamp_ns, s.label) for s in settled] == [(0, None), (15, "label 12"), (40, None)]


def test_a_label_waits_for_the_nearer_image_that_comes_out_of_order():
    arrivals = [("depth", 0), ("label", 19), ("depth", 40), ("depth", 37)]
    settled, late = run(make_queue(window=10, tolerance=20), arrivals)
    assert late == []
    assert [(s.stamp_ns, s.label) for s in settled] == [(0, None), (37, "label 19"), (40, None)]


def test_a_message_waits_for_its_pose_but_not_for_ever():
    poses = FakePoses(known_to=90)
    queue = make_queue(poses, window=100, gap=50, has_labels=False)
    for stamp in (80, 100, 240):
        queue.add_sensor(stamp, str(stamp))
    assert queue.pop(final=False).stamp_ns == 80
    # 240 is more than the window past 100, whose pose may still come.
    assert queue.pop(final=False) is None
    queue.add_sensor(251, "251")
    ready = queue.pop(final=False)
    assert (ready.stamp_ns, ready.T_map_sensor) == (100, None)
    poses.known_to = 300
    queue.add_sensor(360, "360")
    np.testing.assert_array_equal(queue.pop(final=False).T_map_sensor, np.eye(4) * 240)


def test_what_is_held_does_not_grow_with_the_log():
    queue = make_queue(window=100)
    largest = 0
    for stamp in range(0, 20_000, 10):
        queue.add_label(stamp + 5, "label")
        queue.add_label(stamp - 1000, "late label")
        # The second half of the log holds labels only.
        if stamp < 10_000:
            queue.add_sensor(stamp, "depth")
        while queue.pop(final=False) is not None:
            pass
        largest = max(largest, len(queue._waiting) + len(queue._labels) + len(queue._label_stamps))
    assert largest < 100


def test_labels_that_no_message_can_have_are_dropped_in_order():
    queue = make_queue(window=10, tolerance=5)
    for stamp in (0, 3, 50, 52):
        queue.add_label(stamp, str(stamp))
    queue.add_sensor(51, "depth")
    assert queue.pop(final=True).label == "50"
    assert queue._label_stamps == [52]
    assert list(queue._labels) == [52]


@pytest.mark.parametrize("window", [0, 7])
def test_equal_stamps_keep_their_order_of_arrival(window):
    queue = make_queue(window=window, has_labels=False)
    for name in ("first", "second", "third"):
        queue.add_sensor(5, name)
    assert [queue.pop(final=True).message for _ in range(3)] == ["first", "second", "third"]
