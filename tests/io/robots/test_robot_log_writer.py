"""Contents of a robot's log, read with mcap and rosbags alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from octoreplay.errors import InputError, OutputError
from octoreplay.io.robots.robot_log_writer import OPTICAL_IN_BODY, RobotLogWriter
from octoreplay.records import CameraModel, ClassTable, SemanticClass
from support.stored_messages import matrix, pixels, read_messages, stamp_ns

CAMERA = CameraModel(width=5, height=3, fx=4.0, fy=4.5, cx=2.25, cy=1.5)
CLASSES = ClassTable((SemanticClass(1, "road", (1, 2, 3), (7, 9)), SemanticClass(2, "tree", (4, 5, 6), (2,))), (255,))
START = 1_700_000_000_000_000_123


def camera_mount() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = OPTICAL_IN_BODY
    T[:3, 3] = 0.3, 0.0, 0.7
    return T


def body_pose() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.1, -0.2]).as_matrix()
    T[:3, 3] = 10.0, -4.0, 0.5
    return T


def write_log(path: Path, depth: np.ndarray, labels: np.ndarray | None, classes: ClassTable | None = CLASSES) -> Path:
    with RobotLogWriter(path, "r1", CAMERA, classes, T_body_sensor=camera_mount(), start_ns=START) as log:
        log.write_pose(START, body_pose(), speed=0.8, turn_rate=-0.25)
        log.write_frame(START + 50, depth, labels)
    return path


@pytest.fixture
def depth() -> np.ndarray:
    return np.arange(15, dtype=np.uint16).reshape(3, 5) * 4000


@pytest.fixture
def labels() -> np.ndarray:
    return np.array([[7, 9, 2, 2, 255]] * 3, dtype=np.uint8)


def test_rosbags_opens_the_log_and_finds_the_documented_topics(tmp_path, depth, labels):
    path = write_log(tmp_path / "r1.mcap", depth, labels)
    with AnyReader([path]) as reader:
        found = {connection.topic: connection.msgtype for connection in reader.connections}
        assert reader.message_count == 7
    assert found == {
        "/r1/camera/depth/image_raw": "sensor_msgs/msg/Image",
        "/r1/camera/depth/camera_info": "sensor_msgs/msg/CameraInfo",
        "/r1/camera/labels/image_raw": "sensor_msgs/msg/Image",
        "/r1/labels/label_info": "vision_msgs/msg/LabelInfo",
        "/r1/odom": "nav_msgs/msg/Odometry",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
    }


@pytest.mark.parametrize(
    ("depth_type", "depth_encoding", "label_type", "label_encoding"),
    [("<u2", "16UC1", "u1", "mono8"), ("<f4", "32FC1", "<u2", "mono16"), (">u2", "16UC1", ">u2", "mono16")],
)
def test_images_keep_every_pixel(tmp_path, depth, labels, depth_type, depth_encoding, label_type, label_encoding):
    path = write_log(tmp_path / "r1.mcap", depth.astype(depth_type), labels.astype(label_type))
    messages = read_messages(path)
    [(log_time, stored_depth)] = messages["/r1/camera/depth/image_raw"]
    [(_, stored_labels)] = messages["/r1/camera/labels/image_raw"]
    assert (stored_depth.encoding, stored_labels.encoding) == (depth_encoding, label_encoding)
    np.testing.assert_array_equal(pixels(stored_depth), depth)
    np.testing.assert_array_equal(pixels(stored_labels), labels)
    assert log_time == stamp_ns(stored_depth) == stamp_ns(stored_labels) == START + 50
    assert stored_depth.header.frame_id == stored_labels.header.frame_id == "r1/camera_optical_frame"


def test_a_view_that_is_not_contiguous_keeps_its_pixels(tmp_path, depth):
    path = write_log(tmp_path / "r1.mcap", depth[:, ::-1], None)
    [(_, stored)] = read_messages(path)["/r1/camera/depth/image_raw"]
    np.testing.assert_array_equal(pixels(stored), depth[:, ::-1])


def test_camera_info_holds_the_intrinsics(tmp_path, depth, labels):
    [(_, info)] = read_messages(write_log(tmp_path / "r1.mcap", depth, labels))["/r1/camera/depth/camera_info"]
    assert (info.width, info.height) == (5, 3)
    np.testing.assert_array_equal(info.k, [4.0, 0, 2.25, 0, 4.5, 1.5, 0, 0, 1])
    np.testing.assert_array_equal(np.reshape(info.p, (3, 4))[:, :3].ravel(), info.k)
    np.testing.assert_array_equal(info.d, np.zeros(5))


def test_label_info_names_every_raw_label(tmp_path, depth, labels):
    messages = read_messages(write_log(tmp_path / "r1.mcap", depth, labels))
    [(log_time, info)] = messages["/r1/labels/label_info"]
    assert [(c.class_id, c.class_name) for c in info.class_map] == [(7, "road"), (9, "road"), (2, "tree")]
    assert log_time == START


def test_a_log_without_labels_has_no_label_topics(tmp_path, depth):
    messages = read_messages(write_log(tmp_path / "r1.mcap", depth, None, classes=None))
    assert not [topic for topic in messages if "label" in topic]


def test_poses_are_the_given_transforms(tmp_path, depth, labels):
    messages = read_messages(write_log(tmp_path / "r1.mcap", depth, labels))
    [(_, odometry)] = messages["/r1/odom"]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "r1/base_link")
    pose = odometry.pose.pose
    np.testing.assert_allclose(matrix(pose.position, pose.orientation), body_pose(), atol=1e-12)
    assert (odometry.twist.twist.linear.x, odometry.twist.twist.angular.z) == (0.8, -0.25)
    for topic, expected, frames in (
        ("/tf", body_pose(), ("map", "r1/base_link")),
        ("/tf_static", camera_mount(), ("r1/base_link", "r1/camera_optical_frame")),
    ):
        [(_, tf)] = messages[topic]
        [transform] = tf.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == frames
        stored = matrix(transform.transform.translation, transform.transform.rotation)
        np.testing.assert_allclose(stored, expected, atol=1e-12)


def test_optical_frame_is_rep_103():
    # A point 2 m ahead, 1 m to the right and 0.5 m down.
    np.testing.assert_array_equal(OPTICAL_IN_BODY @ [1.0, 0.5, 2.0], [2.0, -1.0, -0.5])


@pytest.mark.parametrize(
    "image", [np.zeros((5, 3), np.uint16), np.zeros((3, 5), np.uint32), np.zeros((3, 5, 1), np.uint16)]
)
def test_an_image_that_does_not_fit_is_refused(tmp_path, image):
    with pytest.raises(InputError, match=r"r1\.mcap: topic '/r1/camera/depth/image_raw'.*does not fit"):
        write_log(tmp_path / "r1.mcap", image, None)


def test_a_path_that_cannot_be_written_is_one_sentence(tmp_path, depth):
    with pytest.raises(OutputError, match=r"r1\.mcap: cannot be written"):
        write_log(tmp_path / "missing" / "r1.mcap", depth, None)


def test_same_calls_give_the_same_bytes(tmp_path, depth, labels):
    first, second = (write_log(tmp_path / name, depth, labels) for name in ("a.mcap", "b.mcap"))
    assert first.read_bytes() == second.read_bytes()


# --- clouds -----------------------------------------------------------------------------------------------------------

POINTS = np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, np.nan], [7.0, 8.0, 9.0]])


def write_cloud(path: Path, points: np.ndarray = POINTS, **fields: np.ndarray) -> Path:
    with RobotLogWriter(path, "r1", None, CLASSES, T_body_sensor=camera_mount(), start_ns=START) as log:
        log.write_pose(START, body_pose())
        log.write_cloud(START + 50, points, **fields)
    return path


def test_a_lidar_log_holds_clouds_in_the_lidars_frame(tmp_path):
    messages = read_messages(write_cloud(tmp_path / "r1.mcap", labels=np.array([7, 9, 2], np.uint32)))
    assert set(messages) == {"/r1/lidar/points", "/r1/labels/label_info", "/r1/odom", "/tf", "/tf_static"}
    [(log_time, cloud)] = messages["/r1/lidar/points"]
    assert log_time == stamp_ns(cloud) == START + 50
    assert cloud.header.frame_id == "r1/lidar"
    [(_, tf)] = messages["/tf_static"]
    [transform] = tf.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("r1/base_link", "r1/lidar")


@pytest.mark.parametrize("label_type", ["<u2", ">u2", "<u4"])
def test_clouds_keep_every_field(tmp_path, label_type):
    fields = {
        "labels": np.array([7, 9, 65535], label_type), "rgb": np.array([0x102030, 0xFFFEFD, 0], np.uint32),
        "intensity": np.array([0.5, 0.25, 1.0]),
    }  # fmt: skip
    [(_, cloud)] = read_messages(write_cloud(tmp_path / "r1.mcap", **fields))["/r1/lidar/points"]
    label = (4, "<u2") if label_type[1:] == "u2" else (6, "<u4")
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("intensity", 12, 7, 1), ("rgb", 16, 7, 1),
        ("label", 20, label[0], 1),
    ]  # fmt: skip
    types = ["<f4"] * 4 + ["<u4", label[1]]
    names = ["x", "y", "z", "intensity", "rgb", "label"]
    stored = np.frombuffer(cloud.data.tobytes(), list(zip(names, types, strict=True)))
    assert (cloud.height, cloud.width, cloud.point_step) == (1, 3, stored.dtype.itemsize)
    assert cloud.row_step == len(cloud.data)
    assert (cloud.is_bigendian, cloud.is_dense) == (False, False)
    np.testing.assert_array_equal(np.stack([stored[name] for name in "xyz"], axis=1), POINTS)
    for name, field in (("label", "labels"), ("rgb", "rgb"), ("intensity", "intensity")):
        np.testing.assert_array_equal(stored[name], fields[field])


def test_a_cloud_needs_coordinates_only_and_may_be_empty(tmp_path):
    for points, is_dense in ((POINTS[:0], True), (POINTS[:1], True), (POINTS, False)):
        [(_, cloud)] = read_messages(write_cloud(tmp_path / f"{len(points)}.mcap", points))["/r1/lidar/points"]
        assert ([f.name for f in cloud.fields], cloud.width) == (["x", "y", "z"], len(points))
        assert cloud.is_dense == is_dense


@pytest.mark.parametrize(
    "fields",
    [{"labels": np.zeros(2, np.uint16)}, {"labels": np.zeros(3, np.int64)}, {"rgb": np.zeros(4, np.uint32)},
     {"intensity": np.zeros((3, 1))}],
)  # fmt: skip
def test_a_cloud_that_does_not_fit_is_refused(tmp_path, fields):
    with pytest.raises(
        InputError, match=r"r1\.mcap: topic '/r1/lidar/points': takes clouds in a lidar's log only; labels"
    ):
        write_cloud(tmp_path / "r1.mcap", **fields)


def test_a_log_is_a_cameras_or_a_lidars(tmp_path, depth):
    with (
        RobotLogWriter(tmp_path / "a.mcap", "r1", CAMERA, None, T_body_sensor=np.eye(4), start_ns=0) as log,
        pytest.raises(InputError, match="takes clouds in a lidar's log only"),
    ):
        log.write_cloud(0, POINTS)
    with (
        RobotLogWriter(tmp_path / "b.mcap", "r1", None, None, T_body_sensor=np.eye(4), start_ns=0) as log,
        pytest.raises(InputError, match="topic '/r1/camera/depth/image_raw': a lidar's log takes no images"),
    ):
        log.write_frame(0, depth)
