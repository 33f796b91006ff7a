"""Irregular logs: first messages that are damaged, out of order, shared or wrongly stamped."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.team_bodies import TeamBodies
from octoreplay.io.sensors.labels import class_table_from_names
from octoreplay.records import CloudFrame, FrameCounts
from support.log_factory import (
    IDENTITY,
    NAMES,
    SECOND,
    Entry,
    foxglove_row,
    foxglove_transform,
    robot_entries,
    ros2,
    ros_row,
    write_mcap,
    write_rows,
)  # fmt: skip

TABLE = class_table_from_names({"r": NAMES})
START = 100 * SECOND
DEPTH, LABELS, INFO = "/camera/depth/image_raw", "/camera/labels/image_raw", "/camera/depth/camera_info"


def robot_of(*paths, **fields) -> ResolvedRobot:
    known = {"depth_topic": DEPTH, "label_topic": LABELS, "camera_info_topic": INFO, "pose_topic": "/odom"}
    return ResolvedRobot("r", paths, **{**known, **fields})


def read(robot: ResolvedRobot, **time):
    with RobotLog(robot, TimeConfig(**time), TABLE) as log:
        return [(frame.stamp_ns - START) / SECOND for frame in log.frames()], log.counts


def test_the_order_of_files_and_of_the_first_images_does_not_matter(tmp_path):
    entries = robot_entries(num_frames=6)
    early = [e for e in entries if e.log_time_ns < START + SECOND * 3 // 4]
    late = [e for e in entries if e not in early]
    paths = write_mcap(tmp_path / "late.mcap", late), write_mcap(tmp_path / "early.mcap", early)
    expected = [0.0, 0.25, 0.5, 0.75, 1.0, 1.25]
    assert read(robot_of(*paths)) == (expected, FrameCounts(used=6))
    assert read(robot_of(*paths), duration=0.6)[0] == expected[:3]
    # The second image is logged before the first.
    swapped = [e._replace(log_time_ns=START - 1) if e.topic == DEPTH and e.log_time_ns == START + SECOND // 4 else e
               for e in entries]  # fmt: skip
    path = write_mcap(tmp_path / "swapped.mcap", sorted(swapped, key=lambda e: e.log_time_ns))
    assert read(robot_of(path)) == (expected, FrameCounts(used=6))
    assert read(robot_of(path), start=0.3)[0] == expected[2:]


def restamped(entries, topic, index, stamp_ns):
    """The messages, with another stamp for one message of a topic."""
    chosen = [e for e in entries if e.topic == topic][index]
    value = dataclasses.replace(chosen.value, header=ros2.header(stamp_ns, "camera"))
    return [e._replace(value=value) if e is chosen else e for e in entries]


def test_one_stamp_of_the_future_does_not_end_a_span(tmp_path):
    entries = restamped(robot_entries(num_frames=12), DEPTH, 2, START + 10**6 * SECOND)
    stamps, counts = read(robot_of(write_mcap(tmp_path / "r.mcap", entries)), duration=2.0)
    assert stamps == [0.0, 0.25, 0.75, 1.0, 1.25, 1.5, 1.75]
    assert counts == FrameCounts(used=7, undecodable=1)


def test_a_valid_stamp_ahead_makes_others_late_and_is_named(tmp_path):
    entries = restamped(robot_entries(num_frames=12), DEPTH, 2, START + 60 * SECOND)
    stamps, counts = read(robot_of(write_mcap(tmp_path / "r.mcap", entries)), duration=2.0)
    assert stamps == [0.0, 0.25]
    assert counts.late == 9
    assert "before the newest stamp so far" in counts.first_missing["late"]


def test_a_stamp_from_before_the_clock_was_set_is_not_the_start(tmp_path):
    entries = restamped(robot_entries(num_frames=6), DEPTH, 0, 5 * SECOND)
    stamps, _ = read(robot_of(write_mcap(tmp_path / "r.mcap", entries)), duration=0.6)
    assert stamps == [0.25, 0.5, 0.75]


@pytest.mark.parametrize("topic", [DEPTH, LABELS, INFO, "/odom", "/tf_static"])
def test_a_damaged_first_message_loses_itself_only(tmp_path, topic):
    rows = [ros_row(entry) for entry in robot_entries(num_frames=6)]
    extra = next(row for row in rows if row.topic == topic)
    broken = dataclasses.replace(extra, data=extra.data[:-3], log_time_ns=START - SECOND) if dataclasses.is_dataclass(
        extra) else extra._replace(data=extra.data[:-3], log_time_ns=START - SECOND)  # fmt: skip
    path = write_rows(tmp_path / "r.mcap", [broken, *rows])
    [robot] = discover([path])
    stamps, _ = read(dataclasses.replace(robot, robot_id="r"))
    assert stamps[-5:] == [0.25, 0.5, 0.75, 1.0, 1.25]


def test_one_label_info_serves_all_robots_of_a_log(tmp_path):
    entries = [e for name in ("ada", "bob") for e in robot_entries(namespace=name) if "label_info" not in e.topic]
    entries.append(Entry("/label_info", "vision_msgs/msg/LabelInfo", ros2.label_info(START, NAMES), START))
    path = write_mcap(tmp_path / "both.mcap", sorted(entries, key=lambda e: e.log_time_ns))
    robots = discover([path])
    assert [(robot.robot_id, robot.label_info_topic) for robot in robots] == [
        ("ada", "/label_info"), ("bob", "/label_info"),
    ]  # fmt: skip
    assert resolve(RunConfig(robots)).classes.names == ("ground", "tree", "wall")


@pytest.mark.parametrize("namespace", ["semantic_bot", "classroom", "depth_7", "confidence"])
def test_hints_in_a_namespace_do_not_matter(tmp_path, namespace):
    [robot] = discover([write_mcap(tmp_path / "r.mcap", robot_entries(namespace=namespace))])
    assert robot.depth_topic == f"/{namespace}/camera/depth/image_raw"
    assert robot.label_topic == f"/{namespace}/camera/labels/image_raw"


def test_a_single_foxglove_transform_is_fixed_beside_moving_ones(tmp_path):
    rows = [ros_row(e) for e in robot_entries(poses="none") if e.topic != "/tf_static"]
    still = foxglove_transform("base", "camera", START, (0, 0, 0.5))
    rows.append(foxglove_row("/tf", "FrameTransform", still, START, "json"))
    for i in range(12):
        stamp = START + i * SECOND // 8
        moving = foxglove_transform("map", "base", stamp, (i, 0, 0), IDENTITY)
        rows.append(foxglove_row("/tf", "FrameTransform", moving, stamp, "json"))
    path = write_rows(tmp_path / "r.mcap", sorted(rows, key=lambda row: row.log_time_ns))
    robot = robot_of(path, pose_topic="/tf", map_frame="map")
    with RobotLog(robot, TimeConfig(), TABLE) as log:
        frames = list(log.frames())
    assert [frame.T_team_sensor[0, 3] for frame in frames] == [0, 2, 4, 6, 8, 10]
    assert all(frame.T_team_sensor[2, 3] == 0.5 for frame in frames)


def odometry_entries(first: float, last: float):
    """Poses at 10 Hz between two times [s] from the first image on."""
    stamps = [START + round(i * SECOND / 10) for i in range(round(first * 10), round(last * 10))]
    return [Entry("/odom", "nav_msgs/msg/Odometry", ros2.odometry(s, ((s - START) / SECOND, 0, 0)), s) for s in stamps]


def test_poses_without_images_are_not_kept(tmp_path, monkeypatch):
    entries = [e for e in robot_entries(num_frames=12) if e.topic != "/odom"] + odometry_entries(-60.0, 300.0)
    path = write_mcap(tmp_path / "r.mcap", sorted(entries, key=lambda e: e.log_time_ns))
    most, taken = [0], [0]
    original = PoseSource.take

    def take(self, message):
        original(self, message)
        taken[0] += 1
        most[0] = max(most[0], len(self._track))

    monkeypatch.setattr(PoseSource, "take", take)
    stamps, counts = read(robot_of(path))
    assert (len(stamps), counts.used) == (12, 12)
    assert most[0] < 200
    # Reading continues for a while behind the last image, but not to the end.
    assert taken[0] < 600 + 30 + 120


def test_bodies_are_known_where_poses_begin_long_before_the_images(tmp_path):
    entries = [e for e in robot_entries(num_frames=12) if e.topic != "/odom"] + odometry_entries(-60.0, 10.0)
    path = write_mcap(tmp_path / "r.mcap", sorted(entries, key=lambda e: e.log_time_ns))
    robots = (robot_of(path), dataclasses.replace(robot_of(path, body_box=(-1, -1, -1, 1, 1, 1)), robot_id="b"))
    with TeamBodies(robots, TimeConfig()) as bodies:
        for tick in range(1, 4):
            bodies.advance(START + (tick - 1) * SECOND, START + tick * SECOND)
            frame = CloudFrame("r", START + tick * SECOND - SECOND // 2, np.zeros((1, 3), np.float32), None, np.eye(4))
            [box] = bodies.add_to(0, frame).boxes
            origin = np.linalg.inv(box.T_box_team)[:3, 3]
            np.testing.assert_allclose(origin, [tick - 0.5, 0, 0], atol=1e-9)


def test_a_box_in_an_unknown_frame_is_refused(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", robot_entries())
    with pytest.raises(InputError, match=r"'nonsense'.*name another body_frame"):
        read(robot_of(path, body_box=(-1, -1, -1, 1, 1, 1), body_frame="nonsense"))


def test_a_field_that_no_cloud_has_is_named(tmp_path):
    entries = [e for e in robot_entries(labels=False) if "camera" not in e.topic]
    cloud = ros2.cloud(START, {name: np.ones(2, "f4") for name in ("x", "y", "z", "lable")}, frame_id="camera")
    entries.append(Entry("/points", "sensor_msgs/msg/PointCloud2", cloud, START))
    robot = RobotConfig("r", (write_mcap(tmp_path / "r.mcap", entries),), label_field="label")
    with pytest.raises(InputError, match="have no field 'label'; their fields are x, y, z, lable"):
        resolve(RunConfig((robot,)))
    assert resolve(RunConfig((dataclasses.replace(robot, label_field=""),))).classes.num_classes == 1


def test_missing_poses_are_reported_with_the_first_message(tmp_path):
    entries = [e for e in robot_entries(num_frames=8) if not (e.topic == "/odom" and e.log_time_ns > START + SECOND)]
    _, counts = read(robot_of(write_mcap(tmp_path / "r.mcap", entries)))
    assert counts == FrameCounts(used=5, no_pose=3)
    assert counts.first_missing == {"no_pose": f"{tmp_path / 'r.mcap'}: topic '{DEPTH}' with the stamp 101.250 s"}
