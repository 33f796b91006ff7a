"""``start`` and ``duration`` read only a part of a log and give the frames that reading all of it gives."""

from __future__ import annotations

import functools
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.team_bodies import BodyTrack
from octoreplay.io.sensors.labels import class_table_from_names
from support.log_factory import (
    IDENTITY,
    NAMES,
    OPTICAL,
    SECOND,
    Entry,
    Factory,
    foxglove_row,
    foxglove_transform,
    robot_entries,
    ros2,
    ros_row,
    write_bag,
    write_mcap,
    write_rosbag2,
    write_rows,
)  # fmt: skip
from support.long_suite import long, one_in

TABLE = class_table_from_names({"r": NAMES})
START = 100 * SECOND
DEPTH, LABELS, INFO = "/camera/depth/image_raw", "/camera/labels/image_raw", "/camera/depth/camera_info"
NUM_FRAMES = 160
"""Frames of the logs here, two a second."""


def robot_of(path: Path, **fields) -> ResolvedRobot:
    known = {"depth_topic": DEPTH, "label_topic": LABELS, "camera_info_topic": INFO, "pose_topic": "/odom"}
    return ResolvedRobot("r", (path,), **{**known, **fields})


@functools.cache
def _entries(**options) -> tuple[Entry, ...]:
    return tuple(robot_entries(num_frames=NUM_FRAMES, period_ns=SECOND // 2, **options))


def entries_of(**options) -> list[Entry]:
    return list(_entries(**options))


def delayed(entries: list[Entry], most_ns: int, seed: int = 0) -> list[Entry]:
    """Messages that were recorded up to ``most_ns`` after their stamps, so in another order."""
    rng = np.random.default_rng(seed)
    late = [e._replace(log_time_ns=e.log_time_ns + int(rng.integers(0, most_ns))) for e in entries]
    return sorted(late, key=lambda e: e.log_time_ns)


def read(robot: ResolvedRobot, time: TimeConfig, *, is_whole: bool = False, team_start_ns: int | None = None):
    """(frames, counts, number of messages read), with or without seeking."""
    num_read = 0
    original = RobotLog._until_sensor_ends

    def counted(self, messages):
        nonlocal num_read
        for message in original(self, messages):
            num_read += 1
            yield message

    with mock.patch.object(RobotLog, "_until_sensor_ends", counted), RobotLog(robot, time, TABLE) as log:
        if is_whole:
            with mock.patch.object(RobotLog, "_log_start_ns", return_value=None):
                return list(log.frames(team_start_ns)), log.counts, num_read
        return list(log.frames(team_start_ns)), log.counts, num_read


def assert_same_frames(robot: ResolvedRobot, time: TimeConfig, *, seeks: bool = True, **options) -> int:
    """Compare reading a part with reading all; the number of frames."""
    found, counts, num_read = read(robot, time, **options)
    expected, all_counts, num_all = read(robot, time, is_whole=True, **options)
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in expected]
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours.T_team_sensor, theirs.T_team_sensor)
        np.testing.assert_array_equal(ours.depth_image, theirs.depth_image)
        np.testing.assert_array_equal(ours.class_image, theirs.class_image)
    names = ("used", "no_label", "no_pose", "unknown_label_pixels")
    assert [getattr(counts, name) for name in names] == [getattr(all_counts, name) for name in names]
    assert num_read < num_all if seeks else num_read == num_all
    return len(found)


def write_as(container: str, folder: Path) -> Path:
    if container == "bag":
        return write_bag(folder / "r.bag", entries_of(factory=Factory(ros1=True)))
    if container == "mcap":
        return write_mcap(folder / "r.mcap", entries_of(), chunk_size=2000)
    return write_rosbag2(folder / "r", entries_of(), storage=container)


@pytest.mark.parametrize("container", ["mcap", "bag", "sqlite3"])
def test_a_part_has_the_frames_of_the_whole_log(tmp_path, container):
    robot = robot_of(write_as(container, tmp_path))
    assert assert_same_frames(robot, TimeConfig(start=40)) == 80
    assert assert_same_frames(robot, TimeConfig(start=40, duration=5)) == 10
    assert assert_same_frames(robot, TimeConfig(start=79.5)) == 1


PARTS = (
    {"start": 30, "duration": 10}, {"start": 30.3, "duration": 10, "every": 3}, {"start": 25, "rate_limit": 0.7},
    {"start": 33.7, "duration": 20, "rate_limit": 1.3, "every": 2}, {"start": 60, "pose_gap": 5},
    {"start": 50, "reorder_window": 3, "pair_tolerance": 0.3}, {"start": 0.5}, {"duration": 10},
)  # fmt: skip


@pytest.mark.parametrize(("most_delay", "time"), one_in(3, [0.05, 2.0, 9.0], PARTS))
def test_delays_and_thinning_give_the_same_frames(tmp_path, most_delay, time):
    robot = robot_of(write_mcap(tmp_path / "r.mcap", delayed(entries_of(), round(most_delay * SECOND))))
    config = TimeConfig(**{"reorder_window": most_delay, "pair_tolerance": 0.05, **time})
    seeks = time.get("start", 0) - config.pose_gap - config.reorder_window - 2 * config.pair_tolerance > 10
    assert assert_same_frames(robot, config, seeks=seeks) > 0


@pytest.mark.parametrize("poses", ["odometry", "tf"])
def test_poses_around_the_start_are_known(tmp_path, poses):
    # Poses are 1.9 s apart and come 1 s late: the one before the start is needed to interpolate.
    slow = SECOND * 19 // 10
    is_pose = {"/odom", "/tf"}
    entries = [e for e in entries_of(poses=poses) if e.topic not in is_pose]
    for stamp in range(START, START + 80 * SECOND, slow):
        x = (stamp - START) / SECOND
        pose = (
            Entry("/odom", "nav_msgs/msg/Odometry", ros2.odometry(stamp, (x, 0, 0)), stamp)
            if poses == "odometry"
            else Entry(
                "/tf", "tf2_msgs/msg/TFMessage", ros2.tf(("map", "base_link", stamp, (x, 0, 0), IDENTITY)), stamp
            )
        )
        entries.append(pose._replace(log_time_ns=stamp + SECOND))
    entries.sort(key=lambda e: e.log_time_ns)
    given = {"pose_topic": "/odom"} if poses == "odometry" else {"pose_topic": "/tf", "map_frame": "map"}
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries), **given)
    assert assert_same_frames(robot, TimeConfig(start=40, duration=10, pose_gap=2.0)) == 20


@pytest.mark.parametrize(("period", "seeks"), [(1, True), (25, False)])
def test_corrections_from_before_the_start_are_known(tmp_path, period, seeks):
    """The last correction before the start applies; one that is too old for the part makes the whole log be read."""
    entries = entries_of()
    for entry in entries:
        if entry.topic == "/odom":
            entry.value.header.frame_id = "odom"
    for second in range(0, 80, period):
        stamp = START + second * SECOND
        tf = ros2.tf(("map", "odom", stamp, (0, second, 0), IDENTITY))
        entries.append(Entry("/tf", "tf2_msgs/msg/TFMessage", tf, stamp))
    entries.sort(key=lambda e: e.log_time_ns)
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries), map_frame="map")
    assert assert_same_frames(robot, TimeConfig(start=45, duration=10), seeks=seeks) == 20


@pytest.mark.parametrize("clock_offset", [0.0, 37.5, -20.25])
def test_the_clock_offset_and_the_team_start_shift_the_part(tmp_path, clock_offset):
    # The robot's clock is 1000 s off that of the log.
    entries = [e._replace(log_time_ns=e.log_time_ns + 1000 * SECOND) for e in entries_of()]
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries), clock_offset=clock_offset)
    team_start_ns = START + round(clock_offset * SECOND) - 7 * SECOND
    time = TimeConfig(start=40, duration=10)
    assert assert_same_frames(robot, time) == 20
    assert assert_same_frames(robot, time, team_start_ns=team_start_ns) == 20
    assert assert_same_frames(robot, TimeConfig(start=40, duration=10, clock="log")) == 20


def test_files_one_after_the_other_are_one_log(tmp_path):
    entries = entries_of()
    paths = [write_mcap(tmp_path / f"{i}.mcap", entries[i::2]) for i in range(2)]
    halves = [write_mcap(tmp_path / "a.mcap", entries[:400]), write_mcap(tmp_path / "b.mcap", entries[400:])]
    for logs in (paths, halves):
        robot = robot_of(tmp_path)
        robot = ResolvedRobot("r", tuple(logs), robot.depth_topic, label_topic=LABELS, camera_info_topic=INFO,
                            pose_topic="/odom")  # fmt: skip
        assert assert_same_frames(robot, TimeConfig(start=45, duration=20)) == 40


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_stamps_that_run_at_another_speed_than_the_log(tmp_path, speed):
    entries = [e._replace(log_time_ns=START + round((e.log_time_ns - START) * speed)) for e in entries_of()]
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries))
    assert assert_same_frames(robot, TimeConfig(start=60, duration=5), seeks=False) == 10


def test_a_clock_that_was_set_makes_the_whole_log_be_read(tmp_path):
    entries = [
        e._replace(log_time_ns=e.log_time_ns - (60 * SECOND if e.log_time_ns > START + 10 * SECOND else 0))
        for e in entries_of()
    ]
    robot = robot_of(write_mcap(tmp_path / "r.mcap", sorted(entries, key=lambda e: e.log_time_ns)))
    assert_same_frames(robot, TimeConfig(start=60, duration=5, reorder_window=100), seeks=False)


@long
def test_a_damaged_stamp_at_the_place_where_reading_starts(tmp_path):
    entries = entries_of()
    for index in (40, 41, 57, 58):
        stamp = START + index * SECOND // 2
        where = next(i for i, e in enumerate(entries) if e.topic == DEPTH and e.log_time_ns == stamp)
        broken = ros2.image(stamp + index * 10**15, np.zeros((8, 12), np.uint16), "16UC1", frame_id="camera")
        entries[where] = entries[where]._replace(value=broken)
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries))
    for start in np.arange(30, 45, 0.5):
        is_at_damage = read(robot, TimeConfig(start=start, duration=3))[2] > 200
        assert assert_same_frames(robot, TimeConfig(start=start, duration=3), seeks=not is_at_damage) == 6


def test_labels_with_a_damaged_first_stamp(tmp_path):
    entries = entries_of()
    time = TimeConfig(start=40, duration=5)
    hold = time.reorder_window + time.pose_gap + 2 * time.pair_tolerance
    # The first label that is read has a stamp that is hours too late.
    first = next(
        i for i, e in enumerate(entries) if e.topic == LABELS and e.log_time_ns >= START + (30 - hold) * SECOND
    )
    broken = ros2.image(entries[first].log_time_ns + 10**16, np.zeros((8, 12), np.uint8), "mono8", frame_id="camera")
    entries[first] = entries[first]._replace(value=broken)
    assert assert_same_frames(robot_of(write_mcap(tmp_path / "r.mcap", entries)), time) == 10


def test_transforms_that_hold_from_their_first_message_on_are_read_from_the_beginning(tmp_path):
    mount = foxglove_transform("base_link", "camera", START, (0.0, 0.0, 0.5), OPTICAL)
    rows = [foxglove_row("/transforms", "FrameTransform", mount, START, "protobuf")]
    other = foxglove_transform("base_link", "lidar", START, (0.0, 0.0, 0.5))
    rows.append(foxglove_row("/transforms", "FrameTransform", other, START, "protobuf"))
    rows += [ros_row(entry) for entry in entries_of() if entry.topic != "/tf_static"]
    robot = robot_of(write_rows(tmp_path / "r.mcap", rows), pose_topic="/odom")
    assert assert_same_frames(robot, TimeConfig(start=40, duration=5), seeks=False) == 10


def test_frames_that_nothing_joins_are_refused_also_in_a_part(tmp_path):
    entries = [e for e in entries_of(poses="tf") if e.topic != "/tf_static"]
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries), pose_topic="/tf", map_frame="map")
    for is_whole in (True, False):
        with pytest.raises(InputError, match="no transform from 'camera' to 'map'"):
            read(robot, TimeConfig(start=40, duration=5), is_whole=is_whole)
    # Joined by a moving transform, but only at the beginning: no poses, and no error.
    mount = ros2.tf(("base_link", "camera", START, (0, 0, 0.5), OPTICAL))
    entries.insert(0, Entry("/tf", "tf2_msgs/msg/TFMessage", mount, START))
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries), pose_topic="/tf", map_frame="map")
    assert assert_same_frames(robot, TimeConfig(start=40, duration=5)) == 0


def test_a_start_after_the_end_gives_no_frames(tmp_path):
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries_of()))
    assert assert_same_frames(robot, TimeConfig(start=300), seeks=False) == 0


def test_reading_ends_with_the_sensor(tmp_path):
    """Poses go on for an hour after the last image, and images pause for a minute before it."""
    entries = [e for e in entries_of() if e.topic == "/odom" or not 20 < (e.log_time_ns - START) / SECOND < 78]
    entries += [
        Entry("/odom", "nav_msgs/msg/Odometry", ros2.odometry(stamp, (80, 0, 0)), stamp)
        for stamp in range(START + 81 * SECOND, START + 3600 * SECOND, SECOND)
    ]
    robot = robot_of(write_mcap(tmp_path / "r.mcap", entries))
    for time in (TimeConfig(), TimeConfig(start=40)):
        frames, counts, num_read = read(robot, time)
        assert counts.no_pose == 0
        assert frames[-1].stamp_ns == START + (NUM_FRAMES - 1) * SECOND // 2
        assert num_read < 600


def test_bodies_are_found_from_the_first_time_on_that_is_asked_for(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", entries_of())
    robot = robot_of(path, body_box=(-0.3, -0.3, 0.0, 0.3, 0.3, 0.6), body_frame="base_link")
    boxes = {}
    for is_whole in (True, False):
        with (
            BodyTrack(robot, TimeConfig()) as track,
            mock.patch.object(RobotLog, "_log_start_ns", (lambda *_: None) if is_whole else RobotLog._log_start_ns),
        ):
            track.advance(START + 60 * SECOND, START + 61 * SECOND)
            boxes[is_whole] = [track.box_at(START + 60 * SECOND + i * SECOND // 10) for i in range(10)]
            assert len(track._poses._track) < 10
            assert track._poses._track.num_added > 200 if is_whole else track._poses._track.num_added < 100
    assert len(boxes[True]) == 10
    for ours, theirs in zip(boxes[False], boxes[True], strict=True):
        np.testing.assert_array_equal(ours.T_box_team, theirs.T_box_team)
