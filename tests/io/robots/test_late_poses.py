"""Poses that arrive in the log after the frames that need them, and frames before the first mapped one."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.commands.progress import lost_data
from octoreplay.records import FrameCounts
from support.log_factory import SECOND, Entry, robot_entries, ros2
from support.read_logs import DEPTH, START, read_entries

NUM = 120


def delayed(entries: list[Entry], seconds: float, first: float = 0.0, last: float = 1e9) -> list[Entry]:
    """The messages, with odometry between two times (after the start [s]) recorded later."""
    moved = [
        entry._replace(log_time_ns=entry.log_time_ns + round(seconds * SECOND))
        if entry.topic == "/odom" and first <= (entry.log_time_ns - START) / SECOND <= last else entry
        for entry in entries
    ]  # fmt: skip
    return sorted(moved, key=lambda entry: entry.log_time_ns)


@pytest.mark.parametrize(
    ("seconds", "first", "last"),
    [(18.0, 0.0, 1e9), (18.0, 5.0, 9.0), (6.5, 12.0, 1e9), (2.0, 3.0, 3.6)],
)
def test_poses_that_come_in_order_but_late_are_read_ahead(tmp_path, seconds, first, last):
    entries = robot_entries(num_frames=NUM)
    # A burst ends with the poses after it, which would otherwise come before those of the burst.
    burst = [e for e in entries if e.topic == "/odom" and first <= (e.log_time_ns - START) / SECOND <= last + seconds]
    others = [e for e in entries if e not in burst]
    end_ns = START + round((last + seconds) * SECOND)
    late = [e._replace(log_time_ns=min(e.log_time_ns + round(seconds * SECOND), end_ns)) for e in burst]
    log = sorted([*others, *late], key=lambda entry: entry.log_time_ns)
    expected, counts_on_time = read_entries(tmp_path, entries)
    frames, counts = read_entries(tmp_path, log)
    assert counts == counts_on_time == FrameCounts(used=NUM)
    assert counts.unaccounted == {}
    assert counts.messages == counts_on_time.messages
    for frame, other in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.T_team_sensor, other.T_team_sensor)
    assert counts.first_missing == {}


def test_poses_with_equal_log_times_are_taken_once(tmp_path):
    entries = robot_entries(num_frames=NUM)
    # A receiver that records what it got once in three seconds.
    log = [
        e._replace(log_time_ns=START + ((e.log_time_ns - START) // (3 * SECOND) + 1) * 3 * SECOND)
        if e.topic == "/odom" else e
        for e in entries
    ]  # fmt: skip
    _, counts = read_entries(tmp_path, sorted(log, key=lambda e: e.log_time_ns))
    assert counts == FrameCounts(used=NUM)
    num_poses = sum(e.topic == "/odom" for e in entries)
    assert counts.messages["/odom"] == {"in_log": num_poses, "read": num_poses, "used": num_poses}


def test_poses_that_come_out_of_order_are_named(tmp_path):
    log = delayed(robot_entries(num_frames=NUM), 8.0, 5.0, 9.0)
    _, counts = read_entries(tmp_path, log)
    assert counts.no_pose > 8
    assert counts.unaccounted == {}
    late = f"{tmp_path / 'r.mcap'}: topic '/odom' with the stamp 105.000 s"
    assert counts.first_missing["late_pose"] == late
    assert f"r: poses arrived after the images or clouds that needed them, such as {late}; a larger --reorder-window waits for them, or name another pose source for that time" in list(lost_data({"r": counts}))  # fmt: skip  # noqa: E501
    _, counts = read_entries(tmp_path, log, time={"reorder_window": 12.0})
    assert counts == FrameCounts(used=NUM)


def test_a_hole_in_the_poses_is_no_late_pose(tmp_path):
    entries = [
        e for e in robot_entries(num_frames=NUM)
        if e.topic != "/odom" or not 5 < (e.log_time_ns - START) / SECOND < 20
    ]  # fmt: skip
    _, counts = read_entries(tmp_path, entries)
    assert counts.no_pose > 50
    assert set(counts.first_missing) == {"no_pose"}
    assert counts.unaccounted == {}


def test_poses_more_than_a_minute_late_are_not_waited_for(tmp_path):
    entries = robot_entries(num_frames=NUM)
    keep_open = ros2.image(START + 200 * SECOND, np.ones((8, 12), np.uint16), "16UC1", frame_id="camera")
    entries.append(Entry(DEPTH, "sensor_msgs/msg/Image", keep_open, START + 200 * SECOND))
    _, counts = read_entries(tmp_path, delayed(entries, 100.0), label_topic="")
    assert counts.no_pose > 0
    assert "late_pose" in counts.first_missing


def test_frames_before_the_first_mapped_one_are_described(tmp_path):
    entries = [e for e in robot_entries(num_frames=12) if e.topic != "/odom" or e.log_time_ns >= START + SECOND]
    frames, counts = read_entries(tmp_path, entries)
    first = frames[0].stamp_ns / SECOND
    assert counts.first_missing["leading"] == (
        f"{counts.no_pose} without a pose; the first one that is mapped has the stamp {first:.3f} s"
    )
    sentence = f"r: images or clouds before the first mapped one: {counts.no_pose} without a pose; "
    assert any(text.startswith(sentence) for text in lost_data({"r": counts}))
