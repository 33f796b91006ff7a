"""Robots with several sensors: their maps, counts, results and commands."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.robot import RobotConfig
from octoreplay.config.robot_sensor import RobotSensor
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.sensor_logs import SensorLogs
from octoreplay.mapping.codec import encode_packet
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.scan_points import scan_points
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.replay.own_maps import own_evidence
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from support.command_line import octoreplay
from support.interrupted import resumed
from support.log_factory import SECOND, Entry, ros2, write_mcap
from support.long_suite import long
from support.several_sensors import BACKWARDS, CLOUD, DEPTH, FRONT, REAR, SENSORS, START, entries, robot_with_sensors


def frames_of_each_sensor(robot):
    """(stamp, index of the sensor, frame) of every sensor alone, in the order of stamps and sensors."""
    found = []
    for index, view in enumerate(robot.views):
        with RobotLog(view, TimeConfig(), None) as log:
            found += [(frame.stamp_ns, index, frame) for frame in log.frames()]
    return sorted(found, key=lambda entry: entry[:2])


@pytest.mark.parametrize("is_split", [False, True])
def test_the_map_is_that_of_all_scans_in_the_order_of_stamps_and_sensors(tmp_path, is_split):
    config = resolve(RunConfig(robots=(robot_with_sensors(tmp_path, is_split=is_split),)))
    robot, sensor = config.robots[0], config.effective_sensor
    expected = frames_of_each_sensor(robot)
    stamps = [stamp for stamp, _, _ in expected]
    assert [index for _, index, _ in expected[:3]] == [0, 1, 2]
    assert len(set(stamps)) < len(stamps) == 16
    octree, caster = SemanticOctree(config.map.resolution, 1), ScanCaster(sensor, config.map, 1)
    for _, _, frame in expected:
        add_scan(octree, caster.cast(frame), clamped_increments(sensor), 0)
    own = own_evidence(config, robot)
    assert encode_packet(own.octree) == encode_packet(octree)
    with SensorLogs(robot, TimeConfig(), None) as logs:
        found = [(frame.stamp_ns, frame.sensor_index, frame) for frame in logs.frames()]
    assert [entry[:2] for entry in found] == [entry[:2] for entry in expected]
    for (_, _, frame), (_, _, other) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(frame.T_team_sensor, other.T_team_sensor)
    reversed_order = dataclasses.replace(robot, sensors=robot.sensors[::-1])
    assert [index for _, index, _ in frames_of_each_sensor(reversed_order)[:3]] == [0, 1, 2]
    assert encode_packet(own_evidence(config, robot.views[0]).octree) != encode_packet(octree)


def test_each_sensor_has_its_own_extrinsics_and_range(tmp_path):
    config = resolve(RunConfig(robots=(robot_with_sensors(tmp_path),)))
    expected = frames_of_each_sensor(config.robots[0])
    first = {index: frame for _, index, frame in reversed(expected)}
    np.testing.assert_allclose(first[1].T_team_sensor[:3, 3], (0.5, 0, 0.5))
    np.testing.assert_allclose(first[2].T_team_sensor[:3, :2], [[-1, 0], [0, -1], [0, 0]], atol=1e-12)
    assert [(first[i].min_range, first[i].max_range) for i in range(3)] == [(None, None), (None, 4.0), (2.5, None)]
    sensor = config.effective_sensor
    lidar = [frame for _, index, frame in expected if index == 1]
    distances = [np.linalg.norm(scan_points(f, sensor, max_range=9.0, max_points=999)[0], axis=1) for f in lidar]
    assert 3.9 < max(part.max(initial=0) for part in distances) <= 4.0
    for limit in ({"max_range": 2.9}, {"min_range": 3.1}):
        blank = dataclasses.replace(lidar[0], min_range=None, max_range=None)
        wanted = ScanCaster(dataclasses.replace(sensor, **limit), config.map, 1).cast(blank)
        cells = ScanCaster(sensor, config.map, 1).cast(dataclasses.replace(blank, **limit))
        np.testing.assert_array_equal(cells.codes, wanted.codes)
        np.testing.assert_array_equal(cells.marks, wanted.marks)


def test_results_hold_the_counts_of_every_topic_and_the_configuration(tmp_path):
    config = RunConfig(robots=(robot_with_sensors(tmp_path),)).with_parameters({"settle": 0})
    counts = replay_team(config, tmp_path / "whole.mcap").frame_counts["r"]
    assert (counts.used, counts.lost_data, counts.unaccounted) == (16, False, {})
    numbers = {topic: counts.messages[topic].get("used") for topic in (DEPTH, FRONT, REAR, "/odom")}
    assert numbers == {DEPTH: 8, FRONT: 4, REAR: 4, "/odom": 15}
    with open_result(tmp_path / "whole.mcap") as result:
        stored = result.config.robots[0]
    assert [sensor.depth_topic or sensor.cloud_topic for sensor in stored.sensors] == [DEPTH, FRONT, REAR]


@long
def test_runs_resume_and_are_repeated_with_the_same_bytes(tmp_path):
    config = RunConfig(robots=(robot_with_sensors(tmp_path),)).with_parameters({"settle": 0, "state_every": 1.0})
    replay_team(config, tmp_path / "whole.mcap")
    resumed(config, tmp_path / "resumed.mcap", 0)
    whole = (tmp_path / "whole.mcap").read_bytes()
    assert (tmp_path / "resumed.mcap").read_bytes() == whole
    again = octoreplay("run", "--config-from", tmp_path / "whole.mcap", "-o", tmp_path / "again.mcap")
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "again.mcap").read_bytes() == whole


def test_losses_and_frames_of_a_robot_that_is_off_count_by_topic(tmp_path):
    robot = robot_with_sensors(tmp_path)
    late = ros2.cloud(START + 10 * SECOND, {name: np.ones(4, "f4") for name in "xyz"}, frame_id="rear")
    write_mcap(tmp_path / "r.mcap", [*entries(), Entry(REAR, CLOUD, late, START + 10 * SECOND)])
    config = RunConfig(robots=(robot,)).with_parameters({"settle": 0})
    off = ScheduleEntry(start=0.0, end=1.0, robots_off=("r",))
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=(off,)))
    counts = replay_team(config, tmp_path / "out.mcap").frame_counts["r"]
    assert (counts.used, counts.no_pose, counts.off, counts.unaccounted) == (8, 1, 8, {})
    rows = {topic: counts.outcomes[topic] for topic in (DEPTH, FRONT, REAR)}
    assert rows == {
        DEPTH: {"used": 4, "off": 4}, FRONT: {"used": 2, "off": 2}, REAR: {"used": 2, "off": 2, "no_pose": 1},
    }  # fmt: skip
    assert counts.used_span == (START, START + 7 * SECOND // 4)


def test_front_and_rear_lidars_are_found_and_others_named(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", [e for e in entries() if "camera" not in e.topic])
    (robot,) = discover([path])
    assert [(s.cloud_topic, s.sensor_frame) for s in robot.sensors] == [(FRONT, "front"), (REAR, "rear")]
    assert (robot.cloud_topic, robot.pose_topic, robot.map_frame) == (None, "/odom", "map")
    team = tmp_path / "team.yaml"
    assert octoreplay("init", path, "-o", team).returncode == 0
    written = load_team_file(team).robots[0]
    assert written.sensors == robot.sensors
    found = octoreplay("info", path)
    assert f"sensor 1      {FRONT}, front" in found.stdout
    assert f"sensor 2      {REAR}, rear" in found.stdout
    data = json.loads(octoreplay("info", path, "--json").stdout)
    assert [sensor["cloud_topic"] for sensor in data["robots"][0]["robot"]["sensors"]] == [FRONT, REAR]
    with_camera = write_mcap(tmp_path / "c.mcap", entries())
    (summary,) = describe([with_camera]).robots
    assert summary.robot.depth_topic == DEPTH
    assert summary.other_sensors == (FRONT, REAR)
    assert f"sensors: not used: '{FRONT}', '{REAR}'" in summary.notes[0]


@pytest.mark.parametrize(
    ("names", "frames"),
    [
        (("/points", "/points_filtered"), ("front", "rear")),
        (("/front/points", "/rear/points"), ("front", "front")),
        (("/lidar_1/points", "/lidar_2/scan"), ("front", "rear")),
    ],
)
def test_topics_that_may_be_the_same_measurements_are_not_joined(tmp_path, names, frames):
    poses = [e for e in entries() if e.topic in ("/odom", "/tf_static")]
    clouds = [
        Entry(name, CLOUD, ros2.cloud(START, {axis: np.ones(4, "f4") for axis in "xyz"}, frame_id=frame), START)
        for name, frame in zip(names, frames, strict=True)
    ]
    path = write_mcap(tmp_path / "r.mcap", [*clouds, *poses])
    with pytest.raises(ConfigError, match="robot 'r' has 2 point clouds; put one of these lines"):
        discover([path])


def test_a_sensor_without_labels_or_topics_is_named(tmp_path):
    robot = robot_with_sensors(tmp_path)
    team = tmp_path / "team.yaml"
    classes = "classes: [{name: a, raw_labels: [1]}, {name: b, raw_labels: [2]}]\n"
    labelled = dataclasses.replace(
        robot, sensors=(RobotSensor(cloud_topic=FRONT, label_field="x"), RobotSensor(cloud_topic=REAR))
    )
    team.write_text(dump_team(RunConfig(robots=(labelled,))) + classes, encoding="utf-8")
    ended = octoreplay("run", team, "-o", tmp_path / "out.mcap")
    assert ended.returncode == 2
    assert f"robot 'r' has no labels on '{REAR}', but the team has 2 classes" in ended.stderr
    missing = dataclasses.replace(robot, sensors=(SENSORS[0], RobotSensor(cloud_topic="/reer/points")))
    team.write_text(dump_team(RunConfig(robots=(missing,))), encoding="utf-8")
    ended = octoreplay("run", team, "-o", tmp_path / "out.mcap")
    assert ended.returncode == 1
    assert "topic '/reer/points' not found" in ended.stderr
    assert not (tmp_path / "out.mcap").exists()


def test_trajectory_files_and_refine_of_several_sensors(tmp_path):
    robot = robot_with_sensors(tmp_path)
    rows = [f"{START / 1e9 + second} {second} 0 0 0 0 0 1" for second in range(3)]
    (tmp_path / "poses.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    mounts = ((0.0, 0.0, 0.5, -0.5, 0.5, -0.5, 0.5), (0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0), (-0.5, 0.0, 0.5, *BACKWARDS))
    sensors = tuple(dataclasses.replace(s, T_body_sensor=T) for s, T in zip(SENSORS, mounts, strict=True))
    of_file = dataclasses.replace(robot, pose_file=tmp_path / "poses.txt", pose_format="tum", sensors=sensors)
    config = RunConfig(robots=(of_file,)).with_parameters({"pose_gap": 2.0})
    by_file, by_topic = (
        own_evidence(c, c.robots[0]).octree for c in (resolve(config), resolve(RunConfig(robots=(robot,))))
    )
    assert encode_packet(by_file) == encode_packet(by_topic)
    team = tmp_path / "team.yaml"
    team.write_text(dump_team(RunConfig(robots=(robot, RobotConfig("s", robot.logs, depth_topic=DEPTH)))), "utf-8")
    ended = octoreplay("refine", team, "-o", tmp_path / "refined.yaml")
    assert ended.returncode == 2, ended.stderr
    assert "robot 'r' has several sensors, whose poses cannot be corrected together" in ended.stderr


def test_a_part_of_the_logs_has_the_scans_of_all_sensors_in_it(tmp_path):
    (robot,) = resolve(RunConfig(robots=(robot_with_sensors(tmp_path),))).robots
    with SensorLogs(robot, TimeConfig(start=0.5, duration=1.0), None) as logs:
        found = [(frame.stamp_ns, frame.sensor_index) for frame in logs.frames()]
        counts = logs.counts
    expected = [(stamp, index) for stamp, index, _ in frames_of_each_sensor(robot)]
    assert found == [pair for pair in expected if START + SECOND // 2 <= pair[0] < START + 3 * SECOND // 2]
    assert counts.messages[DEPTH]["used"] + counts.messages[REAR]["used"] + counts.messages[FRONT]["used"] == len(found)


def test_commands_for_one_sensor_name_the_choice(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", [e for e in entries() if "camera" not in e.topic])
    for words in (
        ("odometry", path, "-o", tmp_path / "r.tum"),
        ("label", path, "--model", path, "--classes", "cityscapes", "-o", tmp_path / "l.mcap"),
    ):
        ended = octoreplay(*words)
        assert ended.returncode == 2, ended.stderr
        assert f"error: {path}: robot 'r' has 2 point clouds; put one of these lines" in ended.stderr
    assert [found.name for found in tmp_path.iterdir()] == ["r.mcap"]
