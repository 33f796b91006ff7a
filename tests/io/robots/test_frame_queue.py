from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.io.robots.frame_queue import Fate, FrameQueue, Settled
from support.long_suite import examples


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


KINDS = ("label", "confidence")


def make_queue(poses=None, *, window=100, tolerance=10, gap=50, num_partners=1) -> FrameQueue[str]:
    return FrameQueue(
        poses or FakePoses(), reorder_window_ns=window, pair_tolerance_ns=tolerance, pose_gap_ns=gap,
        num_partners=num_partners,
    )  # fmt: skip


def run(
    queue: FrameQueue[str], arrivals: list[tuple[str, int]], *, final_only=False
) -> tuple[list[Settled], list[int]]:
    """Output of a queue for messages in order of arrival, and the late stamps."""
    settled, late = [], []

    def drain(*, final: bool) -> None:
        while (ready := queue.pop(final=final)) is not None:
            settled.append(ready)

    for kind, stamp in arrivals:
        if kind in KINDS:
            queue.add_partner(KINDS.index(kind), stamp, f"{kind} {stamp}")
        elif queue.add_sensor(stamp, f"depth {stamp}") is Fate.LATE:
            late.append(stamp)
        if not final_only:
            drain(final=False)
    drain(final=True)
    return settled, late


@st.composite
def arrivals_within(draw, window: int):
    """Messages without duplicates, with stamps behind the newest sensor stamp by at most a window."""
    kinds = draw(st.lists(st.tuples(st.sampled_from(["depth", *KINDS]), st.integers(0, 400)), max_size=40))
    delays = draw(st.lists(st.integers(0, window), min_size=len(kinds), max_size=len(kinds)))
    order = sorted(range(len(kinds)), key=lambda i: (kinds[i][1] + delays[i], i))
    unique = dict.fromkeys(kinds[i] for i in order)
    return list(unique)


@examples(100)
@given(arrivals_within(60), st.integers(0, 30))
def test_a_window_gives_the_result_of_reading_everything_first(arrivals, tolerance):
    streamed, late = run(make_queue(window=60, tolerance=tolerance, num_partners=2), arrivals)
    at_once, _ = run(make_queue(window=10**6, tolerance=tolerance, num_partners=2), arrivals, final_only=True)
    assert late == []
    assert [s[:3] for s in streamed] == [s[:3] for s in at_once]


@examples(100)
@given(arrivals_within(60), st.integers(0, 30), st.sampled_from([0, 1]))
def test_pairs_are_unique_and_within_the_tolerance_and_exact_where_possible(arrivals, tolerance, index):
    settled, _ = run(make_queue(window=60, tolerance=tolerance, num_partners=2), arrivals)
    depths = [stamp for kind, stamp in arrivals if kind == "depth"]
    labels = [stamp for kind, stamp in arrivals if kind == KINDS[index]]
    assert [s.stamp_ns for s in settled] == sorted(depths)
    found = {s.stamp_ns: s.partners[index] for s in settled if s.partners[index] is not None}
    assert all(name.startswith(KINDS[index]) for name in found.values())
    partner = {stamp: int(name.split()[1]) for stamp, name in found.items()}
    assert len(set(partner.values())) == len(partner)
    for depth in depths:
        if depth in labels:
            assert partner[depth] == depth
        elif depth in partner:
            assert abs(partner[depth] - depth) <= tolerance
        else:
            # Every label within the tolerance belongs to, or is nearer to, another depth image.
            for label in labels:
                if abs(label - depth) <= tolerance:
                    others = [other for other in depths if other != depth]
                    assert min(abs(label - other) for other in others) <= abs(label - depth)


@examples(100)
@given(st.lists(st.integers(0, 300), max_size=30), st.integers(0, 100))
def test_late_messages_are_dropped_and_the_others_come_in_order_and_once(stamps, window):
    queue, fates, settled = make_queue(window=window, num_partners=0), [], []
    for stamp in stamps:
        fates.append(queue.add_sensor(stamp, str(stamp)))
        while (ready := queue.pop(final=False)) is not None:
            settled.append(ready.stamp_ns)
    while (ready := queue.pop(final=True)) is not None:
        settled.append(ready.stamp_ns)
    for i, (stamp, fate) in enumerate(zip(stamps, fates, strict=True)):
        if stamp < max(stamps[:i], default=0) - window:
            assert fate is Fate.LATE
        else:
            assert fate is (Fate.DUPLICATE if stamp in stamps[:i] else Fate.WAITS)
    kept = [stamp for stamp, fate in zip(stamps, fates, strict=True) if fate is Fate.WAITS]
    assert settled == sorted(kept) == sorted(set(kept))


def test_the_nearer_depth_image_gets_the_label():
    settled, _ = run(make_queue(tolerance=20), [("depth", 0), ("label", 12), ("depth", 15), ("depth", 40)])
    assert [(s.stamp_ns, s.partners) for s in settled] == [(0, (None,)), (15, ("label 12",)), (40, (None,))]


def test_a_label_waits_for_the_nearer_image_that_comes_out_of_order():
    arrivals = [("depth", 0), ("label", 19), ("depth", 40), ("depth", 37)]
    settled, late = run(make_queue(window=10, tolerance=20), arrivals)
    assert late == []
    assert [(s.stamp_ns, s.partners) for s in settled] == [(0, (None,)), (37, ("label 19",)), (40, (None,))]


def test_a_message_waits_for_its_pose_up_to_the_pose_gap():
    poses = FakePoses(known_to=90)
    queue = make_queue(poses, window=100, gap=50, num_partners=0)
    for stamp in (80, 100, 240):
        queue.add_sensor(stamp, str(stamp))
    assert queue.pop(final=False).stamp_ns == 80
    # 240 is more than the window past 100, but the pose of 100 may still arrive.
    assert queue.pop(final=False) is None
    queue.add_sensor(251, "251")
    ready = queue.pop(final=False)
    assert (ready.stamp_ns, ready.T_map_sensor) == (100, None)
    poses.known_to = 300
    queue.add_sensor(360, "360")
    np.testing.assert_array_equal(queue.pop(final=False).T_map_sensor, np.eye(4) * 240)


def test_the_number_of_held_messages_does_not_grow_with_the_log():
    queue = make_queue(window=100, num_partners=2)
    largest = 0
    for stamp in range(0, 20_000, 10):
        for kind in (0, 1):
            queue.add_partner(kind, stamp + 5, "label")
            queue.add_partner(kind, stamp - 1000, "late label")
        # The second half of the log holds labels only.
        if stamp < 10_000:
            queue.add_sensor(stamp, "depth")
        while queue.pop(final=False) is not None:
            pass
        held = [len(partners._stamps) + len(partners._messages) for partners in queue._partners]
        largest = max(largest, len(queue._waiting), len(queue._stamps), *held)
    assert largest < 50


def test_labels_out_of_reach_of_every_message_are_dropped():
    queue = make_queue(window=10, tolerance=5)
    for stamp in (0, 3, 50, 52):
        queue.add_partner(0, stamp, str(stamp))
    queue.add_sensor(51, "depth")
    assert queue.pop(final=True).partners == ("50",)
    assert queue._partners[0]._stamps == [52]
    assert list(queue._partners[0]._messages) == [52]


@pytest.mark.parametrize("window", [0, 7])
def test_the_first_of_equal_stamps_is_kept_even_after_it_was_popped(window):
    queue = make_queue(window=window, num_partners=0)
    fates = [queue.add_sensor(5, name) for name in ("first", "second", "third")]
    assert fates == [Fate.WAITS, Fate.DUPLICATE, Fate.DUPLICATE]
    assert queue.pop(final=True).message == "first"
    assert queue.add_sensor(5, "fourth") is Fate.DUPLICATE
    assert queue.pop(final=True) is None


def test_the_first_of_partners_with_equal_stamps_is_kept():
    queue = make_queue()
    for name in ("first", "second"):
        queue.add_partner(0, 5, name)
    queue.add_sensor(5, "depth")
    assert queue.pop(final=True).partners == ("first",)


def test_a_confidence_does_not_take_the_place_of_a_label():
    queue = make_queue(num_partners=2)
    queue.add_sensor(5, "depth")
    queue.add_partner(1, 6, "confidence")
    assert queue.pop(final=True).partners == (None, "confidence")


def test_late_messages_do_not_move_the_newest_stamp():
    queue = make_queue(window=10)
    assert queue.newest_ns is None
    queue.add_sensor(100, "a")
    assert queue.add_sensor(89, "b") is Fate.LATE
    assert queue.add_sensor(90, "c") is Fate.WAITS
    assert queue.newest_ns == 100
    queue.add_partner(0, 120, "label")
    assert queue.newest_ns == 120


def test_many_messages_in_one_window_take_linear_time():
    """20,000 messages within the window of a slow clock wait for the end."""
    queue = FrameQueue(FakePoses(), reorder_window_ns=10**9, pair_tolerance_ns=100, pose_gap_ns=0, num_partners=1)
    started = time.process_time()
    for index in range(20_000):
        queue.add_sensor(index * 1000, index)
        queue.add_partner(0, index * 1000 + 1, index)
    popped = 0
    while (settled := queue.pop(final=True)) is not None:
        assert settled.partners == (settled.message,)
        popped += 1
    assert popped == 20_000
    assert time.process_time() - started < 3.0
