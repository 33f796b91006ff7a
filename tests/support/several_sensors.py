"""Log of a robot with a depth camera and two lidars, some of whose stamps are equal."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from octoreplay.config.robot import RobotConfig
from octoreplay.config.robot_sensor import RobotSensor
from support.log_factory import IDENTITY, SECOND, Entry, robot_entries, ros2, write_mcap

CLOUD = "sensor_msgs/msg/PointCloud2"
DEPTH, FRONT, REAR = "/camera/depth/image_raw", "/front/points", "/rear/points"
START = 100 * SECOND
BACKWARDS = (0.0, 0.0, 1.0, 0.0)
"""The turn by 180 degrees about z."""
SENSORS = (
    RobotSensor(depth_topic=DEPTH),
    RobotSensor(cloud_topic=FRONT, max_range=4.0),
    RobotSensor(cloud_topic=REAR, min_range=2.5, T_body_sensor=(-0.5, 0.0, 0.5, *BACKWARDS)),
)


def wall(seed: int, distance: float) -> dict[str, np.ndarray]:
    """A wall ahead, with noise."""
    rng = np.random.default_rng(seed)
    y, z = rng.uniform(-2, 2, 60), rng.uniform(-0.4, 1.0, 60)
    x = distance + rng.normal(0, 0.05, 60)
    return {name: values.astype("f4") for name, values in (("x", x), ("y", y), ("z", z))}


def entries(*, num_frames: int = 8) -> list[Entry]:
    """Messages in the order of their times; the clouds' stamps are those of every second image, and 50 ms later."""
    found = robot_entries(num_frames=num_frames, labels=False)
    tf = ros2.tf(
        ("base_link", "front", START, (0.5, 0.0, 0.5), IDENTITY),
        ("base_link", "rear", START, (-0.5, 0.0, 0.5), BACKWARDS),
    )
    found.append(Entry("/tf_static", "tf2_msgs/msg/TFMessage", tf, START))
    for index in range(num_frames // 2):
        stamp = START + index * SECOND // 2
        for topic, frame_id, late, distance in (
            (FRONT, "front", 0, 3.0),
            (REAR, "rear", 50_000_000 * (index % 2), 5.0),
        ):
            value = ros2.cloud(stamp + late, wall(index, distance + index % 3), frame_id=frame_id)
            found.append(Entry(topic, CLOUD, value, stamp + late))
    return sorted(found, key=lambda entry: entry.log_time_ns)


def robot_with_sensors(
    folder: Path, *, is_split: bool = False, sensors: tuple[RobotSensor, ...] = SENSORS
) -> RobotConfig:
    """The robot with its log, or with one log for each lidar and one for the rest."""
    topics = (FRONT, REAR) if is_split else ()
    logs = [write_mcap(folder / "r.mcap", [e for e in entries() if e.topic not in topics])]
    logs += [write_mcap(folder / f"r_{t[1:4]}.mcap", [e for e in entries() if e.topic == t]) for t in topics]
    return RobotConfig("r", tuple(logs), sensors=sensors)
