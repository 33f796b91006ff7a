from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.labels import class_table_from_names
from octoreplay.records import CameraModel, FrameCounts
from octoreplay.transforms import pose_matrix
from support.log_factory import (
    HEIGHT,
    IDENTITY,
    OPTICAL,
    SECOND,
    WIDTH,
    Entry,
    depth_pixels,
    label_pixels,
    robot_entries,
    ros2,
    write_mcap,
)  # fmt: skip
from support.read_logs import DEPTH, INFO, LABELS, START, TABLE, expected_pose, read, read_entries, robot_of, write_as


@pytest.mark.parametrize("container", ["mcap", "bag", "sqlite3"])
def test_frames_hold_what_was_recorded(tmp_path, container):
    frames, counts = read(robot_of(write_as(container, tmp_path)))
    assert counts == FrameCounts(used=6)
    for index, frame in enumerate(frames):
        assert (frame.robot_id, frame.stamp_ns) == ("r", START + index * SECOND // 4)
        np.testing.assert_array_equal(frame.depth_image, depth_pixels(index))
        assert frame.depth_image.dtype == np.uint16
        assert frame.depth_unit == 0.001
        # Raw labels 1, 2, 7 and 255 are the classes 1, 2, 3 and none.
        class_of = {1: 1, 2: 2, 7: 3, 255: 0}
        np.testing.assert_array_equal(frame.class_image, np.vectorize(class_of.get)(label_pixels(index)))
        assert frame.camera == CameraModel(WIDTH, HEIGHT, 50.0, 60.0, 5.5, 3.5)
        np.testing.assert_allclose(frame.T_team_sensor, expected_pose(index / 4), atol=1e-12)
        for array in (frame.depth_image, frame.class_image):
            assert array.flags.c_contiguous
            assert array.flags.aligned
            assert array.flags.writeable or container != "mcap"


def test_poses_are_interpolated_at_the_depth_stamp(tmp_path):
    entries = [e for e in robot_entries(labels=False) if e.topic != "/odom"]
    # Odometry at other times than the images: 0.1 s before the first, then every 0.3 s.
    for step in range(7):
        stamp = START - SECOND // 10 + step * 3 * SECOND // 10
        turn = (0.0, 0.0, np.sin(0.1 * step), np.cos(0.1 * step))
        odometry = ros2.odometry(stamp, (step * 0.3, 0, 0), turn)
        entries.append(Entry("/odom", "nav_msgs/msg/Odometry", odometry, stamp))
    frames, counts = read_entries(tmp_path, sorted(entries, key=lambda e: e.log_time_ns), label_topic=None)
    assert counts == FrameCounts(used=6)
    for index, frame in enumerate(frames):
        fraction = (index / 4 + 0.1) / 0.3
        turn = (0.0, 0.0, np.sin(0.1 * fraction), np.cos(0.1 * fraction))
        expected = pose_matrix((0.3 * fraction, 0, 0), turn) @ pose_matrix((0, 0, 0.5), OPTICAL)
        np.testing.assert_allclose(frame.T_team_sensor, expected, atol=1e-9)


@pytest.mark.parametrize("has_labels", [True, False])
def test_without_a_class_table_or_labels_there_are_no_classes(tmp_path, has_labels):
    frames, counts = read_entries(
        tmp_path, robot_entries(labels=has_labels), None, label_topic=LABELS if has_labels else None
    )
    assert counts.used == 6
    assert all(frame.class_image is None for frame in frames)


def test_offset_and_map_transform_are_applied(tmp_path):
    quarter = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    frames, _ = read_entries(tmp_path, robot_entries(), clock_offset=-1.5, T_team_map=(10.0, 20.0, 30.0, *quarter))
    assert frames[0].stamp_ns == START - 3 * SECOND // 2
    expected = pose_matrix((10, 20, 30), quarter) @ expected_pose(1.25)
    np.testing.assert_allclose(frames[5].T_team_sensor, expected, atol=1e-12)


def test_log_time_is_the_clock_where_it_is_chosen(tmp_path):
    entries = [e._replace(log_time_ns=e.log_time_ns + 7 * SECOND) for e in robot_entries()]
    frames, counts = read_entries(tmp_path, entries, time={"clock": "log"})
    assert counts.used == 6
    assert frames[2].stamp_ns == START + 7 * SECOND + SECOND // 2
    np.testing.assert_allclose(frames[2].T_team_sensor, expected_pose(0.5), atol=1e-12)
    assert read_entries(tmp_path, entries)[0][2].stamp_ns == START + SECOND // 2


def test_every_cause_is_counted_and_every_image_once(tmp_path):
    entries = robot_entries(num_frames=12)
    stamps = [START + i * SECOND // 4 for i in range(12)]

    def is_at(entry: Entry, topic: str, *indices: int) -> bool:
        return entry.topic == topic and entry.log_time_ns in [stamps[i] for i in indices]

    # No label for 2; no poses around 5 (a gap of 0.75 s); 7 cut short; 8 comes 1.5 s too late.
    kept = [e for e in entries if not is_at(e, LABELS, 2)]
    kept = [e for e in kept if not (e.topic == "/odom" and stamps[4] < e.log_time_ns < stamps[7])]
    cut = ros2.image(stamps[7], depth_pixels(7), "16UC1")
    cut.data = cut.data[:-1]
    kept = [e._replace(value=cut) if is_at(e, DEPTH, 7) else e for e in kept]
    late = [e._replace(log_time_ns=stamps[11] + SECOND) for e in kept if is_at(e, DEPTH, 8)]
    kept = [e for e in kept if not is_at(e, DEPTH, 8)]
    after = [
        Entry(
            DEPTH,
            "sensor_msgs/msg/Image",
            ros2.image(stamps[11] + SECOND, depth_pixels(0), "16UC1"),
            stamps[11] + SECOND - 1,
        ),
        *late,
    ]
    frames, counts = read_entries(tmp_path, kept + after)
    # 5 and 6 have no pose; the last image has neither label nor pose, and the label is checked first.
    what = f"{tmp_path / 'r.mcap'}: topic '{DEPTH}' with the stamp 102.000 s: 1.750 s before the newest stamp so far"
    assert counts == FrameCounts(used=7, no_label=2, no_pose=2, undecodable=1, late=1)
    assert counts.first_missing["late"] == what
    assert counts.used + counts.skipped == 13
    assert [frame.stamp_ns for frame in frames] == [stamps[i] for i in (0, 1, 3, 4, 9, 10, 11)]


def test_labels_pair_within_the_tolerance_only(tmp_path):
    ms = SECOND // 1000
    shifted = []
    for entry in robot_entries():
        if entry.topic == LABELS:
            index = (entry.log_time_ns - START) * 4 // SECOND
            stamp = entry.log_time_ns + (19 * ms if index % 2 else 21 * ms)
            entry = entry._replace(value=ros2.image(stamp, label_pixels(index), "mono8"))
        shifted.append(entry)
    frames, counts = read_entries(tmp_path, shifted)
    assert counts == FrameCounts(used=3, no_label=3)
    assert [(f.stamp_ns - START) * 4 // SECOND for f in frames] == [1, 3, 5]
    assert read_entries(tmp_path, shifted, time={"pair_tolerance": 0.021})[1].used == 6


def test_unknown_labels_are_counted_or_refused(tmp_path):
    table = class_table_from_names({"r": {1: "ground", 2: "tree"}})
    _, counts = read_entries(tmp_path, robot_entries(), table)
    assert counts.unknown_label_pixels == {7: 6 * WIDTH * HEIGHT // 4}
    with pytest.raises(
        InputError, match=r"r\.mcap: topic '/camera/labels/image_raw' at 100\.000 s: raw label 7 is not"
    ):
        read_entries(tmp_path, robot_entries(), table, {"strict_labels": True})


def test_reading_again_starts_again(tmp_path):
    table = class_table_from_names({"r": {1: "ground"}})
    with RobotLog(robot_of(write_mcap(tmp_path / "r.mcap", robot_entries())), TimeConfig(), table) as log:
        first = [frame.stamp_ns for frame in log.frames()]
        counts = log.counts
        assert [frame.stamp_ns for frame in log.frames()] == first
        assert log.counts == counts
        assert log.counts is not counts


def test_static_transforms_camera_and_classes_may_come_last(tmp_path):
    entries = robot_entries()
    late_topics = ("/tf_static", INFO, "/label_info")
    early = [e for e in entries if e.topic not in late_topics]
    late = [e._replace(log_time_ns=START + 60 * SECOND) for e in entries if e.topic in late_topics]
    frames, counts = read_entries(tmp_path, early + late)
    assert counts == FrameCounts(used=6)
    np.testing.assert_allclose(frames[3].T_team_sensor, expected_pose(0.75), atol=1e-12)


def test_poses_from_tf(tmp_path):
    entries = robot_entries(poses="tf")
    frames, counts = read_entries(tmp_path, entries, pose_topic="/tf", map_frame="map")
    assert counts == FrameCounts(used=6)
    np.testing.assert_allclose(frames[3].T_team_sensor, expected_pose(0.75), atol=1e-12)


def test_a_moving_camera_and_a_corrected_odometry_frame_are_chained(tmp_path):
    """map -> odom (moving TF), odom -> base_link (odometry), base_link -> mast (moving TF) -> camera (static)."""
    entries = [e for e in robot_entries() if e.topic != "/tf_static"]
    entries = [
        e._replace(value=ros2.odometry(e.log_time_ns, ((e.log_time_ns - START) / SECOND, 0, 0), frame_id="odom"))
        if e.topic == "/odom" else e
        for e in entries
    ]  # fmt: skip
    static = ros2.tf(("mast", "camera", START, (0, 0, 0.5), OPTICAL))
    entries.append(Entry("/tf_static", "tf2_msgs/msg/TFMessage", static, START))
    for step in range(20):
        stamp = START + step * SECOND // 10
        moving = ros2.tf(
            ("map", "odom", stamp, (0, step, 0), IDENTITY), ("base_link", "mast", stamp, (0, 0, step), IDENTITY)
        )
        entries.append(Entry("/tf", "tf2_msgs/msg/TFMessage", moving, stamp))
    entries.sort(key=lambda e: e.log_time_ns)
    frames, counts = read_entries(tmp_path, entries, map_frame="map")
    assert counts == FrameCounts(used=6)
    for index, frame in enumerate(frames):
        t = index / 4
        np.testing.assert_allclose(frame.T_team_sensor[:3, 3], (t, 10 * t, 10 * t + 0.5), atol=1e-9)


def test_poses_stamped_ahead_make_nothing_late(tmp_path):
    """Localisation stamps its transforms in the future, which must not make images late."""
    entries = [
        e._replace(value=ros2.tf(("map", "base_link", e.log_time_ns + 2 * SECOND, (1, 0, 0), IDENTITY)))
        if e.topic == "/tf" else e
        for e in robot_entries(poses="tf", num_frames=20)
    ]  # fmt: skip
    _, counts = read_entries(tmp_path, entries, pose_topic="/tf", map_frame="map")
    assert counts == FrameCounts(used=12, no_pose=8)


def test_given_transform_and_intrinsics_replace_those_of_the_log(tmp_path):
    entries = [e for e in robot_entries(camera_info=False) if e.topic != "/tf_static"]
    frames, _ = read_entries(
        tmp_path, entries, camera_info_topic=None, intrinsics=(9.0, 8.0, 4.0, 3.0), depth_unit=0.0002,
        T_body_sensor=(0.0, 0.0, 2.0, *OPTICAL),
    )  # fmt: skip
    assert frames[0].camera == CameraModel(WIDTH, HEIGHT, 9.0, 8.0, 4.0, 3.0)
    assert frames[0].depth_unit == 0.0002
    np.testing.assert_allclose(frames[4].T_team_sensor, pose_matrix((1, 0, 2), OPTICAL), atol=1e-12)


def test_stamped_poses_need_the_sensor_transform(tmp_path):
    entries = [
        Entry("/pose", "geometry_msgs/msg/PoseStamped", ros2.pose_stamped(e.log_time_ns, (5, 0, 0)), e.log_time_ns)
        if e.topic == "/odom" else e
        for e in robot_entries()
    ]  # fmt: skip
    with pytest.raises(
        InputError, match=r"topic '/pose' at 100\.000 s: the poses have no child frame; give T_body_sensor"
    ):
        read_entries(tmp_path, entries, pose_topic="/pose")
    frames, _ = read_entries(tmp_path, entries, pose_topic="/pose", T_body_sensor=(0.0, 0.0, 1.0, *IDENTITY))
    np.testing.assert_allclose(frames[0].T_team_sensor, pose_matrix((5, 0, 1), IDENTITY))


def test_a_sensor_that_stands_still_needs_no_poses_in_the_log(tmp_path):
    entries = [e for e in robot_entries() if e.topic not in ("/odom", "/tf_static")]
    frames, counts = read_entries(tmp_path, entries, pose_topic=None, pose=(1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8))
    assert counts == FrameCounts(used=len(frames))
    assert len(frames) == sum(e.topic == DEPTH for e in entries)
    for frame in frames:
        np.testing.assert_allclose(frame.T_team_sensor, pose_matrix((1, 2, 3), (0.0, 0.0, 0.6, 0.8)))
    mount = (0.0, 0.0, 1.0, *IDENTITY)
    (frame, *_), _ = read_entries(tmp_path, entries, pose_topic=None, pose=(5.0, 0, 0, *IDENTITY), T_body_sensor=mount)
    np.testing.assert_allclose(frame.T_team_sensor, pose_matrix((5, 0, 1), IDENTITY))


def test_clouds_with_labels(tmp_path):
    entries = [e for e in robot_entries(labels=False) if e.topic in ("/tf_static", "/odom")]
    for index in range(3):
        stamp = START + index * SECOND // 4
        points = {name: np.array([1.0, np.nan, 3.0], "f4") + index for name in "xyz"}
        cloud = ros2.cloud(stamp, {**points, "label": np.array([1, 2, 7], "u4")}, frame_id="camera")
        entries.append(Entry("/points", "sensor_msgs/msg/PointCloud2", cloud, stamp))
    entries.sort(key=lambda e: e.log_time_ns)
    fields = {"depth_topic": None, "label_topic": None, "camera_info_topic": None, "cloud_topic": "/points"}
    frames, counts = read_entries(tmp_path, entries, **fields)
    assert counts == FrameCounts(used=3)
    np.testing.assert_array_equal(frames[1].points, np.array([[2, 2, 2], [4, 4, 4]], np.float32))
    assert frames[1].class_ids.tolist() == [1, 3]
    np.testing.assert_allclose(frames[1].T_team_sensor, expected_pose(0.25), atol=1e-12)
    assert read_entries(tmp_path, entries, None, **fields)[0][0].class_ids is None
    assert read_entries(tmp_path, entries, **{**fields, "label_topic": ""})[0][0].class_ids is None


def test_several_logs_of_one_robot_are_one_stream(tmp_path):
    entries = robot_entries()
    halves = (
        [e for e in entries if e.log_time_ns < START + SECOND // 2],
        [e for e in entries if e.log_time_ns >= START + SECOND // 2],
    )
    paths = tuple(write_mcap(tmp_path / f"{i}.mcap", half) for i, half in enumerate(halves))
    frames, counts = read(replace(robot_of(paths[0]), logs=paths))
    assert counts == FrameCounts(used=6)
    assert [f.stamp_ns for f in frames] == [START + i * SECOND // 4 for i in range(6)]


def test_a_cut_log_is_used_and_reported(tmp_path):
    whole = write_mcap(tmp_path / "whole.mcap", robot_entries(num_frames=40), chunk_size=2000)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    frames, counts = read(robot_of(cut))
    all_frames, _ = read(robot_of(whole))
    (damage,) = counts.truncated_files
    assert re.fullmatch(
        re.escape(f"{cut}: cut before its end; everything else is used (log times 100.000 s to ") + r"10\d\.\d+ s\)",
        damage,
    )
    assert counts.lost_data
    assert 5 < len(frames) < 40
    for frame, reference in zip(frames, all_frames, strict=False):
        np.testing.assert_array_equal(frame.depth_image, reference.depth_image)
        np.testing.assert_array_equal(frame.class_image, reference.class_image)


def test_a_span_a_number_and_a_rate_thin_the_frames(tmp_path):
    entries = robot_entries(num_frames=12)

    def indices(**time):
        frames, counts = read_entries(tmp_path, entries, time=time)
        assert counts.used == len(frames)
        return [(frame.stamp_ns - START) * 4 // SECOND for frame in frames]

    assert indices(start=1.0) == list(range(4, 12))
    assert indices(start=1.0, duration=1.0) == [4, 5, 6, 7]
    assert indices(every=5) == [0, 5, 10]
    assert indices(rate_limit=1.0, start=0.5) == [2, 6, 10]


def test_the_span_is_on_the_teams_clock(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", robot_entries(num_frames=12))
    with RobotLog(robot_of(path, clock_offset=10.0), TimeConfig(start=1.0, duration=1.0), TABLE) as log:
        assert log.first_stamp_ns == START + 10 * SECOND
        frames = list(log.frames(team_start_ns=START + 9 * SECOND))
    assert [(frame.stamp_ns - START - 10 * SECOND) * 4 // SECOND for frame in frames] == [0, 1, 2, 3]


def test_a_span_ends_reading(tmp_path, monkeypatch):
    taken = []
    original = RobotLog._take
    monkeypatch.setattr(RobotLog, "_take", lambda self, *all_: taken.append(all_) or original(self, *all_))
    path = write_mcap(tmp_path / "r.mcap", robot_entries(num_frames=400))
    _, counts = read(robot_of(path), duration=2.0)
    assert counts.used == 8
    # 2 s, and 1.54 s for messages out of order, of 100 s with 16 messages each.
    assert len(taken) < 4 * 16 + 10
