"""Contents of logs, and what they lack for a run."""

from __future__ import annotations

import pytest

from octoreplay.io.robots.describe import describe
from support.discovered_logs import (
    DEPTH,
    START,
    image_entry,
)
from support.log_factory import (
    NAMES,
    SECOND,
    depth_pixels,
    robot_entries,
    write_mcap,
)  # fmt: skip


def test_describe_gives_robots_topics_rates_and_overlap(tmp_path):
    first = write_mcap(tmp_path / "a.mcap", robot_entries(num_frames=9))
    second = write_mcap(tmp_path / "b.mcap", robot_entries(start_ns=START + SECOND, num_frames=9))
    description = describe([first, second])
    assert [summary.robot.robot_id for summary in description.robots] == ["a", "b"]
    assert all(summary.missing == () for summary in description.robots)
    assert description.overlap_ns == (START + SECOND, START + 2 * SECOND)
    assert description.class_table.names == tuple(NAMES.values())
    assert description.missing == ()
    log = description.logs[0]
    assert (log.path, log.num_messages, log.damage) == (first, len(robot_entries(num_frames=9)), None)
    assert (log.start_ns, log.end_ns) == (START, START + 2 * SECOND)
    topics = {topic.name: topic for topic in log.topics}
    assert topics[DEPTH].rate_hz == pytest.approx(4.0)
    assert topics[DEPTH].detail == "16UC1 12x8"
    assert topics["/odom"].rate_hz == pytest.approx(8.0)
    assert topics["/tf_static"].rate_hz is None
    far = write_mcap(tmp_path / "c.mcap", robot_entries(start_ns=START + 60 * SECOND))
    assert describe([first, far]).overlap_ns is None


def test_describe_lists_what_is_missing_instead_of_raising(tmp_path):
    entries = [*robot_entries(labels=False, poses="none"), image_entry("/rear/depth", depth_pixels(0), "16UC1")]
    no_frames = [e for e in robot_entries() if e.topic not in ("/tf_static", "/label_info")]
    paths = [write_mcap(tmp_path / "a.mcap", entries), write_mcap(tmp_path / "b.mcap", no_frames)]
    empty = write_mcap(tmp_path / "c.mcap", [])
    description = describe([*paths, empty])
    a, b, c = (summary.missing for summary in description.robots)
    assert any("has 2 depth images" in sentence for sentence in a)
    assert any("no poses" in sentence for sentence in a)
    assert any("no transform from 'camera' to 'base_link'" in sentence for sentence in b)
    assert any("the log holds no messages" in sentence for sentence in c)
    assert any("no LabelInfo names the labels" in sentence for sentence in description.missing)
    assert description.overlap_ns is not None
    description = describe([tmp_path / "missing.mcap", paths[0]])
    assert [log.error for log in description.logs] == [f"{tmp_path / 'missing.mcap'}: no such file", None]
    assert [summary.robot.robot_id for summary in description.robots] == ["a"]
