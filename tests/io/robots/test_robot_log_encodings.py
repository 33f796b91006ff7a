"""Compressed images, laser scans, body boxes and Foxglove's schemas."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from octoreplay.records import FrameCounts
from octoreplay.transforms import inverse, pose_matrix
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    HEIGHT,
    IDENTITY,
    OPTICAL,
    SECOND,
    WIDTH,
    Entry,
    depth_pixels,
    foxglove_row,
    foxglove_stamp,
    foxglove_transform,
    label_pixels,
    robot_entries,
    ros2,
    write_rows,
)  # fmt: skip
from support.read_logs import DEPTH, INFO, LABELS, START, expected_pose, read, read_entries, robot_of


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
