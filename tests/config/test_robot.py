"""Tests of robots in team files: valid and invalid values, writing and reading."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.config.robot_sensor import SENSOR_KEYS, RobotSensor
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, parse_team
from octoreplay.errors import ConfigError

FULL = RobotConfig(
    "a", (Path("/logs/a.mcap"), Path("/logs/b.mcap")), depth_topic="/depth", label_topic="", confidence_topic="/sure",
    camera_info_topic="/info", pose_file=Path("/logs/a.txt"), pose_times=Path("/elsewhere/times.txt"),
    pose_format="kitti", pose_origin=(477000.0, 4428000.0, 0.0),
    fix_topic="/gps/fix", tags_topic="",
    map_frame="map", sensor_frame="camera", intrinsics=(1.0, 2.0, 3.0, 4.0), rectified=False, depth_unit=0.01,
    clock_offset=-1.5, T_team_map=(1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0),
    T_team_map_sigma=(0.1, 0.1, 0.2, 0.01, 0.01, 0.02), T_team_map_from="aligned with c, L 812",
    T_body_sensor=(0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0), body_frame="base",
    body_box=(-1.0, -1.0, 0.0, 1.0, 1.0, 0.5), publish_period=2.0, publish_phase=1.0, min_range=0.25, max_range=4.0,
)  # fmt: skip
CLOUD = RobotConfig(
    "b", (Path("/logs/b.mcap"),), cloud_topic="/points", label_field="kind", confidence_field="sure",
    pose=(1.0, 2.0, 0.5, 0.0, 0.0, 0.6, 0.8),
)  # fmt: skip
SENSORS = (
    RobotSensor(
        depth_topic="/depth", label_topic="/labels", confidence_topic="/sure", camera_info_topic="/info",
        sensor_frame="camera", intrinsics=(1.0, 2.0, 3.0, 4.0), rectified=True, depth_unit=0.01, min_range=0.5,
        max_range=3.0, T_body_sensor=(0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0),
    ),
    RobotSensor(cloud_topic="/points", label_field="kind", confidence_field="sure"),
)  # fmt: skip
SEVERAL = RobotConfig("c", (Path("/logs/c.mcap"),), sensors=SENSORS, pose_topic="/odom")


@pytest.mark.parametrize("folder", [None, Path("/logs"), Path("/other")])
def test_every_field_is_written_and_read(folder):
    config = RunConfig(robots=(FULL, CLOUD, SEVERAL)).with_parameters({"hide_robots": True, "start": 2.0, "every": 3})
    config = config.with_parameters({"duration": 10.5, "rate_limit": 2.0})
    text = dump_team(config, folder)
    assert parse_team(text, name="team", folder=folder or Path("/nowhere")) == config
    assert ("pose_file: a.txt" in text) == (folder == Path("/logs"))
    assert "pose_times: /elsewhere/times.txt" in text


def test_the_robots_above_set_every_field():
    """Fields added to RobotConfig must be set in the robots above."""
    untested = set(RobotConfig.__dataclass_fields__) - {"pose_topic", "label_info_topic"}
    blank = RobotConfig("x", (Path("x"),))
    assert all(
        any(getattr(robot, name) != getattr(blank, name) for robot in (FULL, CLOUD, SEVERAL)) for name in untested
    )
    assert all(any(getattr(sensor, name) is not None for sensor in SENSORS) for name in SENSOR_KEYS)


def test_each_sensor_of_a_robot_is_a_view_with_its_own_fields():
    camera, lidar = SEVERAL.views
    assert (camera.depth_topic, camera.max_range, camera.pose_topic, camera.sensors) == ("/depth", 3.0, "/odom", ())
    assert (lidar.cloud_topic, lidar.depth_topic, lidar.robot_id) == ("/points", None, "c")
    assert FULL.views == (FULL,)


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ("cloud_topic: /a\n  sensors: [{cloud_topic: /b}]", "cloud_topic: applies to one sensor; give it in an entry"),
        ("sensors: [{label_topic: /b}]", "sensors: each needs a depth_topic or cloud_topic"),
        ("sensors: [{cloud_topic: /b}, {cloud_topic: /b}]", "sensors: two of them have the topic '/b'"),
        ("sensors: [{cloud_topic: /b, pose_topic: /p}]", "sensors: pose_topic: unknown key"),
        ("sensors: {cloud_topic: /b}", "sensors: expects a list of sensors"),
        ("sensors: [/b]", "sensors: every sensor is a mapping with its topics"),
        ("sensors: [{cloud_topic: 3}]", "cloud_topic: 3 has the wrong type"),
        (
            "sensors: [{cloud_topic: /b, min_range: 3, max_range: 2}]",
            "min_range must not be negative and must be below",
        ),
        ("sensors: [{cloud_topic: /b, T_body_sensor: [1, 2]}]", "T_body_sensor expects 7 numbers"),
        ("sensors: [{cloud_topic: /b}, {cloud_topic: /c}]\n  pose_file: p.txt", "each needs T_body_sensor"),
        ("sensors: [{cloud_topic: /b}, {cloud_topic: /c}]\n  pose: [0, 0, 0, 0, 0, 0, 1]", "each needs T_body_sensor"),
        ("cloud_topic: /a\n  max_range: 500", "max_range 500 m is above the team's max_range"),
        ("sensors: [{cloud_topic: /b, min_range: 400}]", "leave no measured point"),
    ],
)
def test_sensors_that_do_not_fit_together_are_refused(lines, sentence):
    with pytest.raises(ConfigError, match=f"robot 'r': .*{re.escape(sentence)}"):
        parse_team(f"robots:\n- id: r\n  log: a.mcap\n  {lines}\n", name="team.yaml", folder=Path("/x"))


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"depth_topic": "/a", "cloud_topic": "/b"}, "give depth_topic or cloud_topic, not both"),
        ({"pose_topic": "/a", "pose_file": Path("a")}, "give pose_topic or pose_file, not both"),
        ({"pose_topic": "/a", "pose": (0.0,) * 6 + (1.0,)}, "give pose_topic or pose, not both"),
        (
            {"pose_file": "a", "pose_topic": "/a", "pose": (0.0,) * 6 + (1.0,)},
            "pose_topic or pose_file or pose, not all",
        ),
        ({"pose": ()}, "pose expects 7 numbers x, y, z, qx, qy, qz, qw"),
        ({"pose": (0.0,) * 7}, "pose's quaternion must have length 1"),
        ({"pose_times": Path("a")}, "pose_times goes with pose_file"),
        ({"pose_format": "tum"}, "pose_format goes with pose_file"),
        ({"pose_file": Path("a"), "pose_format": "tam"}, "pose_format 'tam' is none of tum, euroc"),
        ({"pose_file": Path("a"), "pose_origin": (1.0, 2.0)}, "pose_origin expects 3 numbers"),
        ({"body_box": (0.0, 0.0, 0.0, 1.0, 1.0)}, "body_box expects 6 numbers XMIN, YMIN, ZMIN, XMAX, YMAX, ZMAX"),
        ({"body_box": (0.0, 0.0, 2.0, 1.0, 1.0, 1.0)}, "every minimum below its maximum"),
        ({"body_box": (0.0, 0.0, math.nan, 1.0, 1.0, 1.0)}, "every minimum below its maximum"),
        ({"depth_unit": 0.0}, "depth_unit must be greater than 0"),
        ({"clock_offset": 1e300}, "clock_offset must not hold numbers above 1e+12"),
        ({"T_team_map": (-1e13, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}, "T_team_map must not hold numbers above 1e+12"),
        ({"intrinsics": (1.0, 0.0, 1.0, 1.0)}, "intrinsics expects 4 numbers fx, fy, cx, cy"),
        ({"T_body_sensor": (0.0,) * 6}, "T_body_sensor expects 7 numbers"),
        ({"T_team_map": (0.0,) * 7}, "T_team_map's quaternion must have length 1"),
        ({"T_team_map": (math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}, "T_team_map must be finite, not "),
        ({"T_body_sensor": (0.0, 0.0, 0.0, math.nan, 0.0, 0.0, 1.0)}, "T_body_sensor must be finite, not "),
        ({"T_team_map_sigma": (0.1,) * 6}, "T_team_map_sigma goes with T_team_map"),
        ({"T_team_map_from": "aligned with c, L 812"}, "T_team_map_from goes with T_team_map"),
        (
            {"T_team_map": (0.0,) * 6 + (1.0,), "T_team_map_sigma": (-0.1, 0.0, 0.0, 0.0, 0.0, 0.0)},
            "T_team_map_sigma expects 6 standard deviations, none below 0",
        ),
        ({"intrinsics": (math.nan, 1.0, 1.0, 1.0)}, "intrinsics must be finite, not "),
        ({"intrinsics": (1.0, 1.0, math.inf, 1.0)}, "intrinsics must be finite, not "),
        ({"depth_unit": math.nan}, "depth_unit must be finite, not "),
        ({"clock_offset": math.inf}, "clock_offset must be finite, not inf"),
    ],
)
def test_contradicting_fields_are_refused(fields, sentence):
    with pytest.raises(ConfigError, match=f"^robot 'r': .*{re.escape(sentence)}"):
        RobotConfig("r", (Path("a"),), **fields)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("rectified: perhaps", "rectified"), ("depth_unit: [1]", "depth_unit"), ("body_box: 3", "body_box"),
        ("body_box: [a, 0, 0, 1, 1, 1]", "body_box"), ("pose_file: [a]", "pose_file"), ("pose_fil: a", "pose_fil"),
        ("label_field: [1]", "label_field"), ("depth_unit: .nan", "depth_unit"), ("clock_offset: .inf", "clock_offset"),
    ],
)  # fmt: skip
def test_values_of_the_wrong_type_are_refused_by_name(line, sentence):
    with pytest.raises(ConfigError, match=sentence):
        parse_team(f"robots:\n- id: r\n  log: a.mcap\n  {line}\n", name="team.yaml", folder=Path("/x"))


def test_the_files_of_a_robot_are_its_logs_and_pose_files(tmp_path, monkeypatch):
    assert FULL.files == (*FULL.logs, FULL.pose_file, FULL.pose_times)
    assert CLOUD.files == CLOUD.logs
    monkeypatch.chdir(tmp_path)
    found = RobotConfig("r", (Path("a.mcap"),), pose_file=Path("p.txt"), pose_times=Path("t.txt")).with_absolute_paths()
    assert found.files == (tmp_path / "a.mcap", tmp_path / "p.txt", tmp_path / "t.txt")
