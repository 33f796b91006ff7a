"""Logs with colour images whose labels are known: their colours are those of ``nearest_color_network``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from support.log_factory import HEIGHT, IDENTITY, SECOND, WIDTH, Entry, Factory, robot_entries, ros2
from support.networks import COLORS

CLASSES = "classes: [{name: red, raw_labels: [0]}, {name: green, raw_labels: [1]}, {name: blue, raw_labels: [2]}]\n"


def true_labels(index: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    """The label image with a number: raw labels 0 to 2."""
    return np.random.default_rng(index).integers(0, 3, shape)


def colour_entries(
    *, num_frames: int = 6, delay_ns: int = 0, topic: str = "/camera/color/image_raw", frame: str = "camera",
    factory: Factory = ros2, camera_info: bool = True, start_ns: int = 100 * SECOND,
) -> list[Entry]:  # fmt: skip
    """Colour images for the depth images of ``robot_entries``, each recorded ``delay_ns`` after its stamp."""
    entries = []
    for index in range(num_frames):
        stamp = start_ns + index * SECOND // 4
        pixels = COLORS[true_labels(index)].astype(np.uint8)
        image = factory.image(stamp, pixels, "rgb8", frame_id=frame)
        entries.append(Entry(topic, "sensor_msgs/msg/Image", image, stamp + delay_ns))
        if camera_info:
            info = factory.camera_info(stamp, (WIDTH, HEIGHT))
            place = topic.rsplit("/", 1)[0]
            entries.append(Entry(f"{place}/camera_info", "sensor_msgs/msg/CameraInfo", info, stamp + delay_ns))
    return entries


def coloured_robot(*, factory: Factory = ros2, depth: bool = True, num_frames: int = 6, **options) -> list[Entry]:
    """Messages of a robot with depth and colour images and no labels, in the order of log time."""
    robot = robot_entries(labels=False, factory=factory, num_frames=num_frames)
    robot = [entry for entry in robot if depth or "/depth/" not in entry.topic]
    return in_time(robot, colour_entries(factory=factory, num_frames=num_frames, **options))


def in_time(*parts: Sequence[Entry]) -> list[Entry]:
    """All messages in the order of log time."""
    return sorted((entry for part in parts for entry in part), key=lambda entry: entry.log_time_ns)


def static_transform(parent: str, child: str, position: Sequence[float]) -> Entry:
    """A static transform, recorded with the first message of ``robot_entries``."""
    stamp = 100 * SECOND
    return Entry("/tf_static", "tf2_msgs/msg/TFMessage", ros2.tf((parent, child, stamp, position, IDENTITY)), stamp)
