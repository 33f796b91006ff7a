"""Numbers of messages by topic and outcome: they add up to the messages that were read and to those in the log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octoreplay.commands.progress import lost_data
from octoreplay.config.time import TimeConfig
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import MIN_GAP_NS, FrameCounts
from octoreplay.replay.warnings import coverage_warnings
from support.command_line import octoreplay
from support.fixture_paths import PAIR_TEAM
from support.log_factory import IDENTITY, SECOND, Entry, depth_pixels, robot_entries, ros2, write_mcap
from support.read_logs import DEPTH, INFO, LABELS, START, TABLE, read_entries, robot_of

STAMPS = [START + index * SECOND // 4 for index in range(12)]


def at(entries: list[Entry], topic: str, index: int) -> Entry:
    """Message of a topic at the stamp of an image."""
    return next(e for e in entries if (e.topic, e.log_time_ns) == (topic, STAMPS[index]))


def test_every_outcome_is_counted_once_by_topic(tmp_path: Path) -> None:
    entries = robot_entries(num_frames=12)
    cut = ros2.image(STAMPS[7], depth_pixels(7), "16UC1")
    cut.data = cut.data[:-1]
    changes = {
        id(at(entries, LABELS, 2)): [],  # no label
        id(at(entries, LABELS, 3)): [at(entries, LABELS, 3)] * 2,  # a label with a repeated stamp
        id(at(entries, DEPTH, 5)): [],  # a label without an image
        id(at(entries, DEPTH, 7)): [at(entries, DEPTH, 7)._replace(value=cut)],  # undecodable
        id(at(entries, DEPTH, 9)): [at(entries, DEPTH, 9)] * 2,  # duplicate
        id(at(entries, "/odom", 1)): [
            at(entries, "/odom", 1),
            Entry("/odom", "nav_msgs/msg/Odometry", ros2.odometry(STAMPS[1], (np.nan, 0, 0)), STAMPS[1]),
            Entry("/odom", "sensor_msgs/msg/Image", cut, STAMPS[1]),
        ],
    }
    changed = [new for entry in entries for new in changes.get(id(entry), [entry])]
    late = at(entries, DEPTH, 0)._replace(log_time_ns=STAMPS[11] + 1)
    _, counts = read_entries(tmp_path, [*changed, late])
    assert counts.outcomes == {
        INFO: {"used": 1, "not_read": 11},
        DEPTH: {"used": 9, "no_label": 1, "undecodable": 1, "duplicate": 1, "late": 1},
        LABELS: {"used": 9, "unmapped": 1, "unpaired": 1, "duplicate": 1},
        "/odom": {"used": 23, "unusable": 1, "undecodable": 1},
        "/tf_static": {"used": 1},
    }
    assert counts.messages[DEPTH]["in_log"] == counts.messages[DEPTH]["read"] == 13
    assert counts.spans == {
        DEPTH: {
            "no_label": (STAMPS[2],) * 2, "undecodable": (STAMPS[7],) * 2, "duplicate": (STAMPS[9],) * 2,
            "late": (STAMPS[0],) * 2,
        },
        "/odom": {"unusable": (STAMPS[1],) * 2, "undecodable": (STAMPS[1],) * 2},
    }  # fmt: skip
    assert (counts.used, counts.no_label, counts.undecodable, counts.duplicate, counts.late) == (9, 1, 1, 1, 1)
    sentences = list(lost_data({"r": counts}))
    assert "r: 1 messages of '/odom' could not be read (log times 100.250 s to 100.250 s)" in sentences
    assert any("held no pose of finite numbers with a rotation" in sentence for sentence in sentences)
    assert any("no labels or confidences within --pair-tolerance (stamps 100.500 s to" in s for s in sentences)


def test_messages_outside_the_selection_are_counted(tmp_path: Path) -> None:
    entries = robot_entries(num_frames=100)
    _, counts = read_entries(tmp_path, entries, time={"start": 5.0, "duration": 5.0, "every": 2})
    assert counts.outcomes[DEPTH]["used"] == 10
    assert set(counts.outcomes[DEPTH]) == {"used", "not_selected", "not_read"}
    assert sum(counts.outcomes[DEPTH].values()) == 100
    assert sum(counts.outcomes["/odom"].values()) == 199


@pytest.mark.parametrize("poses", ["tf", "odometry"])
def test_transforms_and_static_transforms_are_counted(tmp_path: Path, poses: str) -> None:
    entries = robot_entries(poses=poses)
    nothing = Entry("/tf_static", "tf2_msgs/msg/TFMessage", ros2.tf(("a", "b", 0, (0, 0, 0), (0, 0, 0, 0))), START)
    broken = Entry(
        "/tf", "tf2_msgs/msg/TFMessage", ros2.tf(("map", "base_link", START, (np.nan, 0, 0), IDENTITY)), START
    )
    pose_topic = "/tf" if poses == "tf" else "/odom"
    _, counts = read_entries(
        tmp_path, [*entries, nothing, *[broken] * (poses == "tf")], pose_topic=pose_topic, map_frame="map"
    )
    assert counts.outcomes["/tf_static"] == {"used": 1, "unusable": 1}
    assert counts.outcomes[pose_topic] == {"used": 11, **({"unusable": 1} if poses == "tf" else {})}


def test_a_path_is_read_in_its_last_message(tmp_path: Path) -> None:
    entries = robot_entries(poses="none")
    poses = [ros2.pose_stamped(stamp, (0, 0, 0)) for stamp in STAMPS[:6]]
    paths = [Entry("/path", "nav_msgs/msg/Path", ros2.path(STAMPS[i], poses[: i + 1]), STAMPS[i]) for i in range(6)]
    _, counts = read_entries(
        tmp_path, [*entries, *paths], pose_topic="/path", T_body_sensor=(0, 0, 0, 0, 0, 0, 1), map_frame="map"
    )
    assert counts.outcomes["/path"] == {"used": 1, "superseded": 5}


def test_a_message_that_is_not_counted_is_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A defect in the counting, made on purpose, is named and ends a run with exit code 3."""
    settle, calls = FrameCounts.settle, []

    def forgetful(self, topic, outcome, stamp_ns=None, count=1):
        calls.append(outcome)
        if outcome != "used" or calls.count("used") != 20:
            settle(self, topic, outcome, stamp_ns, count)

    monkeypatch.setattr(FrameCounts, "settle", forgetful)
    path = write_mcap(tmp_path / "r.mcap", robot_entries(num_frames=12))
    with RobotLog(robot_of(path), TimeConfig(), TABLE) as log:
        list(log.frames())
        assert sum(log.counts.unaccounted.values()) == 1
        assert log.counts.lost_data
    calls.clear()
    done = octoreplay("run", PAIR_TEAM, "-o", tmp_path / "out.mcap", "--settle", 0)
    assert done.returncode == 3
    assert "1 messages of '/husky_" in done.stderr
    assert "are not accounted for; please report this as a defect of octoreplay" in done.stderr


def test_frames_of_a_robot_that_is_off_are_counted(tmp_path: Path) -> None:
    schedule = tmp_path / "schedule.yaml"
    schedule.write_text("- {from: 1, to: 3, robots_off: [husky_2]}\n")
    done = octoreplay("run", PAIR_TEAM, "-o", tmp_path / "out.mcap", "--schedule", schedule, "--rule", "local")
    assert done.returncode == 0, done.stderr
    row = next(line.split() for line in done.stdout.splitlines() if "/husky_2/camera/depth/image_raw" in line)
    assert row[2:5] == ["16", "8", "8"]


# --- parts of a run without images -----------------------------------------------------------------------------------


def counts_of(*stamps_s: float) -> FrameCounts:
    """Counts with used images at some times [s]."""
    counts = FrameCounts()
    for stamp in stamps_s:
        counts.use(round(stamp * SECOND))
    return counts


def test_long_parts_without_images_are_named() -> None:
    whole = counts_of(*np.arange(0, 100.5, 0.5))
    late_and_cut = counts_of(*np.arange(20, 60.5, 0.5))
    interrupted = counts_of(*np.arange(0, 30, 0.5), *np.arange(41, 60, 0.5), *np.arange(75, 100.5, 0.5))
    never, slow = FrameCounts(), counts_of(*range(0, 101, 20))
    robots = {"a": whole, "b": late_and_cut, "c": interrupted, "d": never, "e": slow}
    missing = "no image or cloud was mapped for"
    remedy = "compare the counts of its messages with 'octoreplay info'"
    assert coverage_warnings(robots) == (
        f"b: {missing} 60.0 s, in 2 parts of the run: stamps 0.000 s to 20.000 s, 60.000 s to 100.000 s; {remedy}",
        f"c: {missing} 27.0 s, in 2 parts of the run: stamps 29.500 s to 41.000 s, 59.500 s to 75.000 s; {remedy}",
        f"d: {missing} 100.0 s, in 1 part of the run: stamps 0.000 s to 100.000 s; {remedy}",
    )
    assert coverage_warnings({"a": whole}) == ()
    assert coverage_warnings({"d": never}) == ()


def test_a_gap_is_noted_from_its_least_length_on() -> None:
    counts = FrameCounts()
    for stamp_ns in (0, MIN_GAP_NS - 1, 2 * MIN_GAP_NS - 1):
        counts.use(stamp_ns)
    assert counts.gaps == [(MIN_GAP_NS - 1, 2 * MIN_GAP_NS - 1)]
    assert counts.used_span == (0, 2 * MIN_GAP_NS - 1)
