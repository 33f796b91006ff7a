from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.robots.frame_maker import DepthFrameMaker
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.labels import class_table_from_names
from octoreplay.records import CameraModel, FrameCounts
from octoreplay.transforms import inverse, pose_matrix
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    HEIGHT,
    IDENTITY,
    NAMES,
    OPTICAL,
    SECOND,
    WIDTH,
    Entry,
    Factory,
    depth_pixels,
    foxglove_row,
    foxglove_stamp,
    foxglove_transform,
    label_pixels,
    robot_entries,
    ros2,
    ros_row,
    write_bag,
    write_mcap,
    write_rosbag2,
    write_rows,
)  # fmt: skip

TABLE = class_table_from_names({"r": NAMES})
START = 100 * SECOND
DEPTH, LABELS, INFO = "/camera/depth/image_raw", "/camera/labels/image_raw", "/camera/depth/camera_info"


def robot_of(path, **fields) -> ResolvedRobot:
    """The robot of ``robot_entries``."""
    known = {"depth_topic": DEPTH, "label_topic": LABELS, "camera_info_topic": INFO, "pose_topic": "/odom"}
    return ResolvedRobot("r", (path,), **{**known, **fields})


def read(robot: ResolvedRobot, table=TABLE, **time):
    """A robot's frames and counts."""
    with RobotLog(robot, TimeConfig(**time), table) as log:
        return list(log.frames()), log.counts


def read_entries(tmp_path, entries, table=TABLE, time=None, **fields):
    """The frames and counts of messages written as a log."""
    return read(robot_of(write_mcap(tmp_path / "r.mcap", entries), **fields), table, **(time or {}))


def expected_pose(x: float) -> np.ndarray:
    """Pose of the camera of ``robot_entries`` with the base at x."""
    return pose_matrix((x, 0.0, 0.5), OPTICAL)


def write_as(container: str, tmp_path):
    if container == "bag":
        return write_bag(tmp_path / "r.bag", robot_entries(factory=Factory(ros1=True)))
    if container == "mcap":
        return write_mcap(tmp_path / "r.mcap", robot_entries())
    return write_rosbag2(tmp_path / "r", robot_entries(), storage=container)


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
    what = f"{tmp_path / 'r.mcap'}: topic '{DEPTH}' at 103.750 s: 1.750 s before the newest stamp so far"
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
    assert counts.truncated_files == [f"{cut}: cut before its end; everything else is used"]
    assert counts.lost_data
    assert 5 < len(frames) < 40
    for frame, reference in zip(frames, all_frames, strict=False):
        np.testing.assert_array_equal(frame.depth_image, reference.depth_image)
        np.testing.assert_array_equal(frame.class_image, reference.class_image)


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
        (without("/tf_static"), {}, r"no transform from 'camera' to 'base_link': the log holds no TF; .*T_body_sensor"),
        (lambda e: e, {"sensor_frame": "lens"}, r"TF knows no frame 'lens'; its frames are base_link, camera"),
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
    with pytest.raises(InputError, match="'camera' hangs on 'base_link' and 'map' on 'map', and nothing joins the two"):
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
        f"{tmp_path / 'r.mcap'}: topic '{DEPTH}' at 102.750 s: 2.750 s before the newest stamp so far"
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
        f"{tmp_path / 'r.mcap'}: topic '{DEPTH}' at 102.000 s: 59.750 s before"
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


def png(pixels) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


CONFIDENCES = "/camera/labels/confidence"


def encoded_entries(*, skip_confidence: int | None = None) -> list[Entry]:
    """The robot with its images as compressedDepth and PNG, and an image of confidences."""
    entries = []
    for entry in robot_entries():
        stamp = entry.log_time_ns
        index = (stamp - START) * 4 // SECOND
        if entry.topic == DEPTH:
            data = b"\0" * 12 + png(depth_pixels(index))
            image = ros2.compressed_image(stamp, data, "16UC1; compressedDepth png")
            entry = Entry(DEPTH, "sensor_msgs/msg/CompressedImage", image, stamp)
        elif entry.topic == LABELS:
            image = ros2.compressed_image(stamp, png(label_pixels(index)), "png")
            entry = Entry(LABELS, "sensor_msgs/msg/CompressedImage", image, stamp)
            if index != skip_confidence:
                sure = ros2.image(stamp + 1000, np.full((HEIGHT, WIDTH), index / 5, np.float32), "32FC1")
                entries.append(Entry(CONFIDENCES, "sensor_msgs/msg/Image", sure, stamp))
        entries.append(entry)
    return entries


def test_encoded_depth_labels_and_confidences(tmp_path):
    frames, counts = read_entries(tmp_path, encoded_entries(skip_confidence=2), confidence_topic=CONFIDENCES)
    # An image without its confidences counts as one without labels.
    assert counts == FrameCounts(used=5, no_label=1)
    plain, _ = read_entries(tmp_path, robot_entries())
    del plain[2]
    for index, frame, reference in zip((0, 1, 3, 4, 5), frames, plain, strict=True):
        np.testing.assert_array_equal(frame.depth_image, reference.depth_image)
        np.testing.assert_array_equal(frame.class_image, reference.class_image)
        assert (frame.depth_unit, frame.camera) == (reference.depth_unit, reference.camera)
        assert reference.confidence_image is None
        np.testing.assert_array_equal(frame.confidence_image, np.full((HEIGHT, WIDTH), 51 * index))
    frames, _ = read_entries(tmp_path, encoded_entries(), None, confidence_topic=CONFIDENCES)
    assert all(frame.class_image is None and frame.confidence_image is None for frame in frames)


@pytest.mark.parametrize("topic", [DEPTH, LABELS, CONFIDENCES])
def test_a_damaged_compressed_image_loses_its_frame_only(tmp_path, topic):
    entries = encoded_entries()
    damaged = [e for e in entries if e.topic == topic][3]
    damaged.value.data = damaged.value.data[:-40]
    frames, counts = read_entries(tmp_path, entries, confidence_topic=CONFIDENCES)
    assert counts == FrameCounts(used=5, undecodable=1)
    assert (frames[3].stamp_ns - START) * 4 // SECOND == 4


def scan_entries() -> list[Entry]:
    entries = [e for e in robot_entries(labels=False) if e.topic in ("/tf_static", "/odom")]
    for index in range(3):
        stamp = START + index * SECOND // 4
        scan = ros2.scan(stamp, [1.0 + index, np.inf, 0.1, 2.0], limits=(0.5, 9.0), frame_id="camera")
        entries.append(Entry("/scan", "sensor_msgs/msg/LaserScan", scan, stamp))
    return sorted(entries, key=lambda e: e.log_time_ns)


CLOUD_FIELDS = {"depth_topic": None, "label_topic": None, "camera_info_topic": None, "cloud_topic": "/scan"}


def test_laser_scans_are_clouds(tmp_path):
    frames, counts = read_entries(tmp_path, scan_entries(), None, **CLOUD_FIELDS)
    assert counts == FrameCounts(used=3)
    for index, frame in enumerate(frames):
        expected = [[1.0 + index, 0, 0], [2 * np.cos(0.75), 2 * np.sin(0.75), 0]]
        np.testing.assert_allclose(frame.points, expected, atol=1e-9)
        assert (frame.class_ids, frame.confidences) == (None, None)
        np.testing.assert_allclose(frame.T_team_sensor, expected_pose(index / 4), atol=1e-12)


BOX = (-0.5, -0.4, 0.0, 0.5, 0.4, 0.6)


@pytest.mark.parametrize("fields", [{}, CLOUD_FIELDS])
def test_frames_hold_the_robots_own_box(tmp_path, fields):
    entries = scan_entries() if fields else robot_entries()
    turned = (1.0, 2.0, 3.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    frames, _ = read_entries(tmp_path, entries, body_box=BOX, T_team_map=turned, **fields)
    for index, frame in enumerate(frames):
        (box,) = frame.boxes
        assert box.is_own
        np.testing.assert_array_equal(np.concatenate([box.low, box.high]), BOX)
        # The box is in the frame of the odometry's poses, the base.
        T_team_base = pose_matrix(turned[:3], turned[3:]) @ pose_matrix((index / 4, 0, 0), IDENTITY)
        np.testing.assert_allclose(box.T_box_team, inverse(T_team_base), atol=1e-9)
    assert all(frame.boxes == () for frame in read_entries(tmp_path, entries, **fields)[0])


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


@pytest.mark.parametrize("encoding", FOXGLOVE_ENCODINGS)
def test_a_robot_with_foxglove_schemas(tmp_path, encoding):
    """The robot of ``robot_entries`` without LabelInfo, which exists in ROS alone."""
    rows = [foxglove_row("/mount", "FrameTransform", foxglove_transform("base", "camera", START, (0, 0, 0.5), OPTICAL),
                         START, encoding)]  # fmt: skip
    k = [50.0, 0, 5.5, 0, 60.0, 3.5, 0, 0, 1]
    for index in range(6):
        stamp = START + index * SECOND // 4
        head = {"timestamp": foxglove_stamp(stamp), "frame_id": "camera", "width": WIDTH, "height": HEIGHT}
        depth = {"encoding": "16UC1", "step": 2 * WIDTH, "data": depth_pixels(index).tobytes()}
        info = {"distortion_model": "", "D": [], "K": k, "R": np.eye(3).ravel().tolist(), "P": [0.0] * 12}
        labels = {
            "timestamp": foxglove_stamp(stamp),
            "frame_id": "camera",
            "data": png(label_pixels(index)),
            "format": "png",
        }
        pose = foxglove_transform("map", "base", stamp, (index / 4, 0, 0))
        rows += [
            foxglove_row(topic, name, fields, stamp, encoding)
            for topic, name, fields in (
                (INFO, "CameraCalibration", {**head, **info}), (DEPTH, "RawImage", {**head, **depth}),
                (LABELS, "CompressedImage", labels), ("/tf", "FrameTransforms", {"transforms": [pose]}),
            )
        ]  # fmt: skip
    path = write_rows(tmp_path / "r.mcap", rows)
    frames, counts = read(robot_of(path, pose_topic="/tf", map_frame="map"))
    plain, _ = read_entries(tmp_path, robot_entries(), map_frame="map")
    assert counts == FrameCounts(used=6)
    for frame, reference in zip(frames, plain, strict=True):
        assert frame.stamp_ns == reference.stamp_ns
        np.testing.assert_array_equal(frame.depth_image, reference.depth_image)
        np.testing.assert_array_equal(frame.class_image, reference.class_image)
        assert frame.camera == reference.camera
        np.testing.assert_allclose(frame.T_team_sensor, reference.T_team_sensor, atol=1e-12)
