"""Logs without usable frames, damaged stamps, and poses out of reach."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.robots.frame_maker import DepthFrameMaker
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import FrameCounts
from support.log_factory import (
    IDENTITY,
    SECOND,
    Entry,
    depth_pixels,
    robot_entries,
    ros2,
    ros_row,
    write_mcap,
    write_rows,
)  # fmt: skip
from support.read_logs import DEPTH, INFO, LABELS, START, TABLE, read, read_entries, robot_of


def with_label_size(entries):
    return [
        e._replace(value=ros2.image(e.log_time_ns, np.ones((4, 4), np.uint8), "mono8")) if e.topic == LABELS else e
        for e in entries
    ]


def with_depth_encoding(entries):
    return [
        e._replace(value=ros2.image(e.log_time_ns, np.ones((4, 4), np.uint8), "bgr8")) if e.topic == DEPTH else e
        for e in entries
    ]


def with_camera_size(entries):
    return [e._replace(value=ros2.camera_info(0, (640, 480))) if e.topic == INFO else e for e in entries]


def without(topic):
    return lambda entries: [e for e in entries if e.topic != topic]


@pytest.mark.parametrize(
    ("change", "fields", "sentence"),
    [
        (with_label_size, {}, r"at 100\.000 s: the image is 4x4, but the depth image of '/.*raw' is 12x8"),
        (with_depth_encoding, {}, r"topic '/camera/.*' at 100\.000 s: image encoding 'bgr8' holds no depth"),
        (with_camera_size, {}, r"the image is 12x8, but its CameraInfo is for 640x480"),
        (without(INFO), {}, r"topic '/camera/depth/camera_info' holds no CameraInfo for .*give intrinsics"),
        (without(INFO), {"camera_info_topic": None}, r"there is no CameraInfo topic for '/camera/depth/image_raw'"),
        (without(DEPTH), {}, r"topic '/camera/depth/image_raw' holds no messages"),
        (without("/odom"), {}, r"topic '/odom' holds no poses for robot 'r'"),
        (without("/tf_static"), {}, r"no transform from 'camera' to 'base_link': the log has no TF; .*T_body_sensor"),
        (lambda e: e, {"sensor_frame": "lens"}, r"TF has no frame 'lens'; its frames are base_link, camera"),
        (lambda e: e, {"map_frame": "earth"}, r"no transform from 'map' to 'earth'"),
        (lambda e: e, {"pose_topic": "/tf_static"}, r"poses from TF need a map_frame"),
    ],
)  # fmt: skip
def test_logs_without_usable_frames_are_refused_in_one_sentence(tmp_path, change, fields, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        read_entries(tmp_path, change(robot_entries()), **fields)
    assert str(caught.value).startswith(str(tmp_path / "r.mcap"))
    assert "\n" not in str(caught.value)


def test_frames_that_tf_never_joins_are_named_at_the_end(tmp_path):
    entries = [
        e._replace(value=ros2.tf(("map", "other", e.log_time_ns, (1, 0, 0), IDENTITY))) if e.topic == "/tf" else e
        for e in robot_entries(poses="tf")
    ]
    with pytest.raises(
        InputError, match="the root of 'camera' is 'base_link', that of 'map' is 'map', and no transform joins them"
    ):
        read_entries(tmp_path, entries, pose_topic="/tf", map_frame="map")


def test_frames_are_read_as_they_are_taken(tmp_path, monkeypatch):
    """A frame is decoded when it is taken, and little is read ahead."""
    decoded = []
    original = DepthFrameMaker.make
    monkeypatch.setattr(
        DepthFrameMaker, "make", lambda self, settled, *more: decoded.append(settled) or original(self, settled, *more)
    )
    path = write_mcap(tmp_path / "r.mcap", robot_entries(num_frames=50), chunk_size=1000)
    with RobotLog(robot_of(path), TimeConfig(), TABLE) as log:
        frames = log.frames()
        for _ in range(3):
            next(frames)
        assert len(decoded) == 3
        frames.close()


def shuffled(entries, *indices: int):
    """The depth images with some numbers, recorded again at the end of the log."""
    again = [e for e in entries if e.topic == DEPTH]
    return [*entries, *(again[i]._replace(log_time_ns=entries[-1].log_time_ns + 1 + i) for i in indices)]


def test_duplicate_images_are_counted_and_are_no_loss(tmp_path):
    # The last three are within the window of 1 s, the first one is not.
    entries = shuffled(robot_entries(num_frames=12), 9, 10, 11)
    frames, counts = read_entries(tmp_path, entries)
    assert counts == FrameCounts(used=12, duplicate=3)
    assert (counts.skipped, counts.lost_data) == (0, False)
    assert [f.stamp_ns for f in frames] == [START + i * SECOND // 4 for i in range(12)]
    _, counts = read_entries(tmp_path, shuffled(robot_entries(num_frames=12), 0, 1, 11))
    assert (counts.used, counts.duplicate, counts.late, counts.lost_data) == (12, 1, 2, True)
    assert counts.first_missing["late"] == (
        f"{tmp_path / 'r.mcap'}: topic '{DEPTH}' with the stamp 100.000 s: 2.750 s before the newest stamp so far"
    )


def test_stamps_that_jump_back_are_late(tmp_path):
    """After a clock is set back by a minute, images are late, and the first is described."""
    entries = robot_entries(num_frames=12)
    moved = []
    for entry in entries:
        if entry.topic == DEPTH and entry.log_time_ns >= START + 2 * SECOND:
            index = (entry.log_time_ns - START) * 4 // SECOND
            image = ros2.image(entry.log_time_ns - 60 * SECOND, depth_pixels(index), "16UC1", frame_id="camera")
            entry = entry._replace(value=image)
        moved.append(entry)
    _, counts = read_entries(tmp_path, moved)
    assert (counts.used, counts.late) == (8, 4)
    assert counts.first_missing["late"].startswith(
        f"{tmp_path / 'r.mcap'}: topic '{DEPTH}' with the stamp 42.000 s: 59.750 s before"
    )


def test_zero_stamps_are_refused_unless_the_log_is_the_clock(tmp_path):
    entries = []
    for entry in robot_entries():
        if entry.topic in (DEPTH, LABELS):
            entry.value.header = ros2.header(0, "camera")
        entries.append(entry)
    with pytest.raises(
        InputError, match=r"'/camera/depth/image_raw' at 100\.000 s: the header's stamp is 0; give clock: log"
    ):
        read_entries(tmp_path, entries)
    frames, counts = read_entries(tmp_path, entries, time={"clock": "log"})
    assert counts == FrameCounts(used=6)
    np.testing.assert_array_equal(frames[4].depth_image, depth_pixels(4))


def test_a_damaged_stamp_loses_one_message_only(tmp_path):
    """A stamp years ahead is damage, in an image or its labels; later messages are not late."""
    far = START + 10**9 * SECOND
    entries = robot_entries(num_frames=12)
    for entry, topic, index in ((e, *case) for e in entries for case in ((DEPTH, 4), (LABELS, 7))):
        if entry.topic == topic and entry.log_time_ns == START + index * SECOND // 4:
            entry.value.header = ros2.header(far, "camera")
    frames, counts = read_entries(tmp_path, entries)
    assert counts == FrameCounts(used=10, undecodable=1, no_label=1)
    assert [(f.stamp_ns - START) * 4 // SECOND for f in frames] == [0, 1, 2, 3, 5, 6, 8, 9, 10, 11]


@pytest.mark.parametrize("clock_offset", [-110.0, 3e9])
def test_stamps_that_no_result_can_hold_are_refused(tmp_path, clock_offset):
    with pytest.raises(InputError, match=rf"'{DEPTH}' at 100\.000 s: the stamp 100 s with the clock_offset .* 2038"):
        read_entries(tmp_path, robot_entries(), clock_offset=clock_offset)


def far_odometry(*indices: int, x: float) -> list[Entry]:
    """The robot's messages, with the poses of some of its images at x."""
    stamps = [START + index * SECOND // 4 for index in indices]
    return [
        e._replace(value=ros2.odometry(e.log_time_ns, (x, 0, 0)))
        if e.topic == "/odom" and e.log_time_ns in stamps else e
        for e in robot_entries(num_frames=12)
    ]  # fmt: skip


@pytest.mark.parametrize("x", [1001.0, -1e9, 1e300])
def test_a_pose_out_of_reach_counts_as_missing(tmp_path, x):
    path = write_mcap(tmp_path / "r.mcap", far_odometry(3, x=x))
    with RobotLog(robot_of(path), TimeConfig(), TABLE, reach=1000.0) as log:
        frames = list(log.frames())
        assert log.counts == FrameCounts(used=11, no_pose=1)
        assert all(np.abs(frame.T_team_sensor[:3, 3]).max() < 10.0 for frame in frames)
    with RobotLog(robot_of(path), TimeConfig(), TABLE) as log:
        assert len(list(log.frames())) == 12


def test_poses_that_are_all_out_of_reach_end_with_the_remedy(tmp_path):
    robot = robot_of(write_mcap(tmp_path / "r.mcap", robot_entries()), T_team_map=(5e5, 4e6, 0, *IDENTITY))
    with RobotLog(robot, TimeConfig(), TABLE, reach=1000.0) as log:
        with pytest.raises(InputError, match=r"all poses of robot 'r' are outside the map.* 1000 m .*T_team_map"):
            list(log.frames())
        assert log.counts == FrameCounts(no_pose=6)


def test_a_message_of_another_type_on_the_sensors_topic_is_counted(tmp_path):
    entries = robot_entries()
    cloud = ros2.cloud(START + 5, {name: np.ones(2, "f4") for name in "xyz"})
    rows = [*map(ros_row, entries), ros_row(Entry(DEPTH, "sensor_msgs/msg/PointCloud2", cloud, START + 6))]
    rows.append(ros_row(Entry(LABELS, "sensor_msgs/msg/PointCloud2", cloud, START + 6)))
    path = write_rows(tmp_path / "r.mcap", sorted(rows, key=lambda row: row.log_time_ns))
    _, counts = read(robot_of(path))
    assert counts == FrameCounts(used=6, undecodable=1)


@pytest.mark.parametrize("topic", [DEPTH, LABELS, INFO])
def test_a_message_of_a_type_without_a_stamp_does_not_move_the_clock(tmp_path, topic):
    """Read as a stamp, its first bytes would be a time in the far future; it may even be the first message."""
    text = ros2.make("std_msgs/msg/String", data="\x7f" * 40)
    rows = [ros_row(Entry(topic, "std_msgs/msg/String", text, START + i * SECOND)) for i in (-1, 1)]
    rows = sorted([*rows, *map(ros_row, robot_entries())], key=lambda row: row.log_time_ns)
    frames, counts = read(robot_of(write_rows(tmp_path / "r.mcap", rows)), start=0.5)
    assert counts == FrameCounts(used=4, undecodable=2 * (topic == DEPTH))
    assert frames[0].stamp_ns == START + SECOND // 2
