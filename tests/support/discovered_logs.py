"""Logs and helpers of the tests that find robots and topics in logs."""

from __future__ import annotations

import cv2
import numpy as np

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.io.robots.robot_log import RobotLog
from support.log_factory import (
    HEIGHT,
    SECOND,
    WIDTH,
    Entry,
    Row,
    depth_pixels,
    foxglove_row,
    foxglove_stamp,
    foxglove_transform,
    label_pixels,
    robot_entries,
    ros2,
)  # fmt: skip

START = 100 * SECOND

DEPTH, LABELS, INFO = "/camera/depth/image_raw", "/camera/labels/image_raw", "/camera/depth/camera_info"


def run_of(*robots: RobotConfig, **fields) -> RunConfig:
    return RunConfig(robots=robots, **fields)


def count_frames(robot: ResolvedRobot, table=None) -> int:
    with RobotLog(robot, TimeConfig(), table) as log:
        return len(list(log.frames()))


def image_entry(topic: str, pixels: np.ndarray, encoding: str, frame_id: str = "camera", stamp: int = START) -> Entry:
    return Entry(topic, "sensor_msgs/msg/Image", ros2.image(stamp, pixels, encoding, frame_id=frame_id), stamp)


def cloud_entries(*, with_label: bool) -> list[Entry]:
    columns = {name: np.ones(4, "f4") for name in "xyz"}
    if with_label:
        columns["label"] = np.ones(4, "u2")
    entries = [e for e in robot_entries(labels=False) if e.topic in ("/tf_static", "/odom")]
    cloud = ros2.cloud(START, columns, frame_id="camera")
    return [*entries, Entry("/points", "sensor_msgs/msg/PointCloud2", cloud, START)]


def png(pixels) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def compressed(topic: str, data: bytes, form: str) -> Entry:
    return Entry(topic, "sensor_msgs/msg/CompressedImage", ros2.compressed_image(START, data, form), START)


def replaced(*entries: Entry, **fields) -> list[Entry]:
    """A robot's messages, with those of the given messages' topics replaced."""
    hints = {DEPTH: ("depth",), LABELS: ("label", "semantic")}
    drop = {topic for topic in hints if any(hint in entry.topic for entry in entries for hint in hints[topic])}
    return [*(e for e in robot_entries(**fields) if e.topic not in drop), *entries]


COLORS = np.arange(WIDTH * HEIGHT * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)


def foxglove_rows(encoding: str, namespace: str = "") -> list[Row]:
    """One frame of a robot with Foxglove's schemas."""
    camera, base = f"{namespace}camera", f"{namespace}base"
    head = {"timestamp": foxglove_stamp(START), "frame_id": camera}
    size = {"width": WIDTH, "height": HEIGHT}
    image = {"encoding": "16UC1", "step": 2 * WIDTH, "data": depth_pixels(0).tobytes()}
    matrices = {"D": [], "K": [50.0, 0, 5.5, 0, 60.0, 3.5, 0, 0, 1], "R": [1.0] * 9, "P": [0.0] * 12}
    labels = {"data": png(label_pixels(0)), "format": "png"}
    move = [foxglove_transform("map", base, START + i, (i, 0, 0)) for i in range(2)]
    mount = foxglove_transform(base, camera, START, (0, 0, 0.5))
    root = f"/{namespace}camera"
    return [
        foxglove_row(topic, name, fields, START, encoding)
        for topic, name, fields in (
            (f"{root}/mount", "FrameTransform", mount), (f"{root}/tf", "FrameTransforms", {"transforms": move[:1]}),
            (f"{root}/tf", "FrameTransforms", {"transforms": move[1:]}),
            (f"{root}/depth", "RawImage", {**head, **size, **image}),
            (f"{root}/calibration", "CameraCalibration", {**head, **size, "distortion_model": "", **matrices}),
            (f"{root}/labels", "CompressedImage", {**head, **labels}),
        )
    ]  # fmt: skip
