from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover
from octoreplay.io.robots.robot_log import RobotLog
from support.log_factory import ROS1, SECOND, Entry, Factory, Row, robot_entries, ros_row, write_rows

ros1 = Factory(ros1=True)


def write_renamed(path: Path, entries: list[Entry], old: str, new: str) -> Path:
    """Write a ROS 1 bag with rosbags in which the definitions have another name in place of ``old``."""
    with Writer(path) as writer:
        connections = {}
        for topic, type_name, value, log_time_ns in entries:
            if topic not in connections:
                definition, digest = ROS1.generate_msgdef(type_name)
                assert old in definition or type_name == "tf2_msgs/msg/TFMessage"
                connections[topic] = writer.add_connection(
                    topic, type_name, msgdef=definition.replace(old, new), md5sum=digest
                )
            writer.write(connections[topic], log_time_ns, ROS1.serialize_ros1(value, type_name))
    return path


def test_headers_with_the_name_before_2011_are_decoded(tmp_path):
    entries = robot_entries(factory=ros1, labels=False)
    path = write_renamed(tmp_path / "old.bag", entries, "std_msgs/Header", "roslib/Header")
    (robot,) = discover([path])
    with RobotLog(robot, TimeConfig(), None) as log:
        frames = list(log.frames())
    assert len(frames) == 6
    np.testing.assert_allclose(frames[2].T_team_sensor[:3, 3], (0.5, 0, 0.5))
    assert log.counts.lost_data is False


@pytest.mark.parametrize("poses", ["odometry", "tf"])
def test_topics_without_a_decodable_message_are_named_with_the_first_cause(tmp_path, poses):
    entries = robot_entries(factory=ros1, labels=False, poses=poses)
    path = write_renamed(tmp_path / "r.bag", entries, "MSG: std_msgs/Header", "MSG: other_msgs/Header")
    topic = "/camera/depth/image_raw"
    sentence = (
        f"{path}: no depth image, point cloud or laser scan to map; no message of '{topic}' can be decoded: {path}: "
        f"topic '{topic}' at 100.000 s: the definition of type 'sensor_msgs/msg/Image' is unknown"
    )
    with pytest.raises(InputError) as caught:
        discover([path])
    assert str(caught.value) == sentence
    assert sentence in describe([path]).robots[0].missing


@pytest.mark.parametrize(
    ("type_name", "driver"),
    [("ouster_ros/msg/PacketMsg", "ouster-ros"), ("ouster_sensor_msgs/msg/PacketMsg", "ouster-ros")],
)
def test_raw_packets_of_a_lidar_name_their_driver(tmp_path, type_name, driver):
    packets = Row("/lidar/packets", type_name, "ros2msg", b"uint8[] buf\n", "cdr", b"\0\1\0\0\0\0\0\0", 100 * SECOND)
    rest = [ros_row(entry) for entry in robot_entries(labels=False) if "camera/" not in entry.topic]
    path = write_rows(tmp_path / "r.mcap", [packets, *rest])
    with pytest.raises(InputError) as caught:
        discover([path])
    assert str(caught.value) == (
        f"{path}: no depth image, point cloud or laser scan to map; '/lidar/packets' holds the raw packets of a lidar "
        f"({type_name}); play the log into the driver {driver}, and record its point clouds together with the other "
        "topics"
    )
