"""Robots and topics of other schemas, encodings and sensors."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from octoreplay.config.class_file import class_table
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from support.discovered_logs import (
    COLORS,
    DEPTH,
    INFO,
    LABELS,
    START,
    cloud_entries,
    compressed,
    count_frames,
    foxglove_rows,
    image_entry,
    png,
    replaced,
    run_of,
)
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    HEIGHT,
    IDENTITY,
    SECOND,
    WIDTH,
    Entry,
    depth_pixels,
    label_pixels,
    robot_entries,
    ros2,
    ros_row,
    write_mcap,
    write_rows,
)  # fmt: skip


def test_encoded_depth_and_labels_are_found(tmp_path):
    depth = compressed("/camera/depth/compressedDepth", b"\0" * 12 + png(depth_pixels(0)), "16UC1; compressedDepth png")
    labels = compressed("/camera/labels/compressed", png(label_pixels(0)), "png")
    color = compressed("/camera/color/compressed", cv2.imencode(".jpg", COLORS)[1].tobytes(), "jpeg")
    path = write_mcap(tmp_path / "r.mcap", replaced(depth, labels, color))
    (robot,) = discover([path])
    assert (robot.depth_topic, robot.label_topic, robot.camera_info_topic) == (depth.topic, labels.topic, INFO)
    assert count_frames(robot, resolve(run_of(robot)).classes) == 1
    (log,) = describe([path]).logs
    details = {topic.name: topic.detail for topic in log.topics}
    assert [details[e.topic] for e in (depth, labels, color)] == ["16UC1 12x8", "8UC1 12x8", "jpeg rgb8 12x8"]


@pytest.mark.parametrize(
    "data", [png(label_pixels(0)), png(COLORS), cv2.imencode(".jpg", COLORS)[1].tobytes()], ids=["ids", "png", "jpeg"]
)
def test_compressed_images_are_labels_by_their_name(tmp_path, data):
    (robot,) = discover([write_mcap(tmp_path / "a.mcap", replaced(compressed("/front/semantics", data, "")))])
    assert robot.label_topic == "/front/semantics"
    other = compressed("/front/rgb", data, "")
    entries = [e for e in robot_entries() if e.topic != LABELS]
    (robot,) = discover([write_mcap(tmp_path / "b.mcap", [*entries, other])])
    assert robot.label_topic is None


@pytest.mark.parametrize("form", ["rgb8", "bgr8", "png", "jpeg"])
def test_ids_are_preferred_to_colours(tmp_path, form):
    topic = "/camera/labels/colored"
    if form in ("rgb8", "bgr8"):
        entry = image_entry(topic, COLORS.reshape(HEIGHT, -1), form)
        entry.value.width = WIDTH
    else:
        entry = compressed(topic, cv2.imencode(".jpg" if form == "jpeg" else ".png", COLORS)[1].tobytes(), form)
    (robot,) = discover([write_mcap(tmp_path / "a.mcap", [*robot_entries(), entry])])
    assert robot.label_topic == LABELS
    entries = [e for e in robot_entries() if e.topic != LABELS]
    (robot,) = discover([write_mcap(tmp_path / "b.mcap", [*entries, entry])])
    assert robot.label_topic == topic


def test_confidences_go_with_labels_of_their_size(tmp_path):
    sure = image_entry("/camera/labels/confidence", label_pixels(0), "mono8")
    small = image_entry("/camera/labels/small/confidence", np.ones((3, 4), np.float32), "32FC1")
    depth = image_entry("/camera/depth/confidence", label_pixels(0), "mono8")
    entries = [*robot_entries(), sure, small, depth]
    (robot,) = discover([write_mcap(tmp_path / "a.mcap", entries)])
    assert (robot.depth_topic, robot.label_topic, robot.confidence_topic) == (DEPTH, LABELS, sure.topic)
    (robot,) = discover([write_mcap(tmp_path / "b.mcap", [e for e in entries if e.topic != LABELS])])
    assert (robot.label_topic, robot.confidence_topic) == (None, None)


def test_laser_scans_are_used_without_depth_and_clouds(tmp_path):
    def log(name: str, *topics: str, cloud: bool):
        scans = [
            Entry(topic, "sensor_msgs/msg/LaserScan", ros2.scan(START, [1.0, 2.0], frame_id="camera"), START)
            for topic in topics
        ]
        entries = cloud_entries(with_label=False)
        return write_mcap(tmp_path / name, [*(entries if cloud else entries[:-1]), *scans])

    path = log("a.mcap", "/scan", cloud=False)
    (robot,) = discover([path])
    assert (robot.depth_topic, robot.cloud_topic, robot.sensor_frame) == (None, "/scan", "camera")
    assert count_frames(robot) == 1
    assert resolve(run_of(robot)).classes.names == ("occupied",)
    details = {topic.name: topic.detail for topic in describe([path]).logs[0].topics}
    assert details["/scan"] == "2 ranges"
    (robot,) = discover([log("b.mcap", "/scan", cloud=True)])
    assert robot.cloud_topic == "/points"
    with pytest.raises(ConfigError, match=r"2 laser scans.*\n    cloud_topic: /front\n    cloud_topic: /rear"):
        discover([log("c.mcap", "/front", "/rear", cloud=False)])
    named = RobotConfig("b", (tmp_path / "b.mcap",), cloud_topic="/scan")
    assert resolve(run_of(named)).robots[0].cloud_topic == "/scan"


def test_a_cloud_with_labels_is_preferred_and_a_field_can_be_named(tmp_path):
    plain = cloud_entries(with_label=False)[-1]._replace(topic="/raw")
    path = write_mcap(tmp_path / "r.mcap", [*cloud_entries(with_label=True), plain])
    (robot,) = discover([path])
    assert robot.cloud_topic == "/points"
    table = class_table([{"name": "a", "raw_labels": [1]}, {"name": "b", "raw_labels": [2]}])
    given = RobotConfig("r", (path,), cloud_topic="/raw", label_field="x")
    assert resolve(run_of(given, classes=table)).classes == table
    with pytest.raises(ConfigError, match="robot 'r' has no labels, but the team has 2 classes"):
        resolve(run_of(replace(given, label_field=None), classes=table))


def test_transforms_are_poses_like_odometry(tmp_path):
    vicon = [
        Entry("/vicon", "geometry_msgs/msg/TransformStamped",
              ros2.tf(("world", "base_link", stamp, (1, 2, 3), IDENTITY)).transforms[0], stamp)
        for stamp in (START, START + SECOND // 4)
    ]  # fmt: skip
    (robot,) = discover([write_mcap(tmp_path / "r.mcap", [*robot_entries(poses="none"), *vicon])])
    assert (robot.pose_topic, robot.map_frame) == ("/vicon", "world")
    assert count_frames(robot) == 2


def test_a_path_is_a_pose_topic_even_where_it_is_empty_at_first(tmp_path):
    poses = [ros2.pose_stamped(START, (1, 2, 3)), ros2.pose_stamped(START + SECOND // 4, (1, 2, 3))]
    paths = [
        Entry("/path", "nav_msgs/msg/Path", ros2.path(START + i, poses[:i], frame_id="world"), START + i)
        for i in range(3)
    ]
    path = write_mcap(tmp_path / "r.mcap", [*robot_entries(poses="none"), *paths])
    (robot,) = resolve(run_of(RobotConfig("r", (path,), T_body_sensor=(0.0, 0.0, 0.0, *IDENTITY)))).robots
    assert robot.pose_topic == "/path"
    assert count_frames(robot) == 2


def test_a_pose_file_replaces_pose_topics(tmp_path):
    trajectory = tmp_path / "tum.txt"
    trajectory.write_text("100 1 2 3 0 0 0 1\n100.25 1 2 3 0 0 0 1\n")
    path = write_mcap(tmp_path / "r.mcap", robot_entries(poses="none"))
    (robot,) = resolve(run_of(RobotConfig("r", (path,), pose_file=trajectory))).robots
    assert (robot.pose_topic, robot.depth_topic) == (None, DEPTH)
    assert count_frames(robot) == 2


@pytest.mark.parametrize("encoding", FOXGLOVE_ENCODINGS)
def test_a_robot_with_foxglove_schemas_is_found(tmp_path, encoding):
    path = write_rows(tmp_path / "r.mcap", foxglove_rows(encoding))
    (robot,) = discover([path])
    assert robot.to_config() == RobotConfig(
        "r", (path,), depth_topic="/camera/depth", label_topic="/camera/labels",
        camera_info_topic="/camera/calibration", pose_topic="/camera/tf", map_frame="map", sensor_frame="camera",
    )  # fmt: skip
    assert count_frames(robot) == 1
    (log,) = describe([path]).logs
    details = {topic.name: topic.detail for topic in log.topics}
    assert (details["/camera/depth"], details["/camera/labels"]) == ("16UC1 12x8", "8UC1 12x8")


def test_a_wrong_name_lists_the_topics_of_every_schema(tmp_path):
    entry = compressed("/rear/depth", b"\0" * 12 + png(depth_pixels(0)), "16UC1; compressedDepth png")
    rows = [*foxglove_rows("protobuf"), *map(ros_row, [*robot_entries(), entry])]
    path = write_rows(tmp_path / "r.mcap", rows)
    for role, sentence in (
        ("depth_topic", f"image topics: '{DEPTH}', '{LABELS}', '/camera/depth', '/camera/labels', '/rear/depth'"),
        ("confidence_topic", f"image topics: '{DEPTH}', '{LABELS}', '/camera/depth', '/camera/labels', '/rear/depth'"),
        ("camera_info_topic", f"CameraInfo topics: '/camera/calibration', '{INFO}'"),
        ("pose_topic", "pose topics: '/camera/mount', '/camera/tf', '/odom', '/tf_static'"),
    ):
        with pytest.raises(InputError) as caught:
            resolve(run_of(RobotConfig("r", (path,), **{role: "/wrong"})))
        names = str(caught.value).split("topics: ")[1].split(", ")
        assert str(caught.value).startswith(f"{path}: topic '/wrong' not found; ")
        assert sorted(names) == sorted(sentence.split("topics: ")[1].split(", "))
