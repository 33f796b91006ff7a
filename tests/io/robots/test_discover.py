from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from octoreplay.config.class_file import class_table
from octoreplay.config.robot import RobotConfig
from octoreplay.config.team_file import dump_team, parse_team
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.robot_log import RobotLog
from support.discovered_logs import (
    DEPTH,
    INFO,
    LABELS,
    START,
    cloud_entries,
    count_frames,
    image_entry,
    run_of,
)
from support.log_factory import (
    IDENTITY,
    SECOND,
    Entry,
    Factory,
    depth_pixels,
    label_pixels,
    robot_entries,
    ros2,
    write_bag,
    write_mcap,
    write_rosbag2,
)  # fmt: skip


@pytest.mark.parametrize("container", ["mcap", "sqlite3", "bag"])
def test_a_robot_is_named_by_its_file_and_its_topics_are_found(tmp_path, container):
    if container == "mcap":
        path = write_mcap(tmp_path / "rover.mcap", robot_entries())
    elif container == "bag":
        path = write_bag(tmp_path / "rover.bag", robot_entries(factory=Factory(ros1=True)))
    else:
        path = write_rosbag2(tmp_path / "rover", robot_entries())
    (robot,) = discover([path])
    label_info = None if container == "bag" else "/label_info"
    assert robot.to_config() == RobotConfig(
        "rover", (path,), depth_topic=DEPTH, label_topic=LABELS, camera_info_topic=INFO, pose_topic="/odom",
        label_info_topic=label_info, map_frame="map", sensor_frame="camera",
    )  # fmt: skip
    assert count_frames(robot) == 6


def test_a_resolved_run_survives_a_team_file(tmp_path):
    path = write_mcap(tmp_path / "rover.mcap", robot_entries())
    config = resolve(run_of(*discover([path])))
    text = dump_team(config, tmp_path)
    expected = replace(config.to_config(), sensor=config.sensor)
    assert parse_team(text, name="team", folder=tmp_path) == expected
    assert config.robots[0].span_ns == (START, START + 5 * SECOND // 4)
    assert resolve(config) is config


def test_several_robots_of_one_log_are_named_by_namespace(tmp_path):
    entries = sorted(
        [*robot_entries(namespace="a"), *robot_entries(namespace="b", num_frames=4)], key=lambda e: e.log_time_ns
    )
    path = write_mcap(tmp_path / "team.mcap", entries)
    robots = discover([path])
    assert [robot.robot_id for robot in robots] == ["a", "b"]
    for robot, count in zip(robots, (6, 4), strict=True):
        own = [robot.depth_topic, robot.label_topic, robot.camera_info_topic, robot.pose_topic, robot.label_info_topic]
        assert all(topic.startswith(f"/{robot.robot_id}/") for topic in own)
        assert robot.sensor_frame == f"{robot.robot_id}/camera"
        assert count_frames(robot) == count
    # A team file with their ids alone gives the same robots; another id is refused with the known ones.
    assert resolve(run_of(*(RobotConfig(r.robot_id, (path,)) for r in robots))).robots == robots
    with pytest.raises(ConfigError, match="holds the robots a, b; use one of these names as id"):
        resolve(run_of(RobotConfig("c", (path,))))


def test_topics_without_a_leading_slash_hold_several_robots(tmp_path):
    both = [*robot_entries(namespace="a"), *robot_entries(namespace="b", num_frames=4)]
    entries = sorted((e._replace(topic=e.topic.lstrip("/")) for e in both), key=lambda e: e.log_time_ns)
    robots = discover([write_mcap(tmp_path / "team.mcap", entries)])
    assert [(robot.robot_id, robot.pose_topic) for robot in robots] == [("a", "a/odom"), ("b", "b/odom")]
    assert [count_frames(robot) for robot in robots] == [6, 4]


def test_namespaced_robots_that_share_tf(tmp_path):
    entries = sorted(
        [*robot_entries(namespace="a", poses="tf"), *robot_entries(namespace="b", poses="tf")],
        key=lambda e: e.log_time_ns,
    )
    robots = discover([write_mcap(tmp_path / "team.mcap", entries)])
    assert [(r.robot_id, r.pose_topic, r.map_frame) for r in robots] == [("a", "/tf", "map"), ("b", "/tf", "map")]
    assert [count_frames(robot) for robot in robots] == [6, 6]


def test_one_namespaced_robot_is_named_by_its_file(tmp_path):
    (robot,) = discover([write_mcap(tmp_path / "monday.mcap", robot_entries(namespace="husky"))])
    assert (robot.robot_id, robot.pose_topic) == ("monday", "/husky/odom")


def test_equal_file_names_are_replaced_by_the_folders_names(tmp_path):
    paths = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        paths.append(write_mcap(tmp_path / name / "log.mcap", robot_entries()))
    assert [robot.robot_id for robot in discover(paths)] == ["one", "two"]
    with pytest.raises(ConfigError, match="two logs would both be robot 'log'"):
        discover([paths[0], paths[0]])


def test_other_images_are_neither_depth_nor_labels(tmp_path):
    gray = np.ones((8, 12), np.uint8)
    entries = [
        *robot_entries(),
        image_entry("/camera/color/image_raw", np.ones((8, 36), np.uint8), "rgb8"),
        image_entry("/camera/infra/image_raw", gray, "mono8"),
        image_entry("/thermal/image_raw", gray.astype(np.uint16), "mono16"),
        Entry("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", ros2.camera_info(START, (12, 8)), START),
    ]
    (robot,) = discover([write_mcap(tmp_path / "r.mcap", entries)])
    assert (robot.depth_topic, robot.label_topic, robot.camera_info_topic) == (DEPTH, LABELS, INFO)


@pytest.mark.parametrize(
    ("encoding", "pixels", "topic", "role"),
    [
        ("32FC1", np.ones((8, 12), np.float32), "/front", "depth"),
        ("16UC1", np.ones((8, 12), np.uint16), "/front", "depth"),
        ("mono16", np.ones((8, 12), np.uint16), "/front/depth", "depth"),
        ("16UC1", np.ones((8, 12), np.uint16), "/front/semantics", "label"),
        ("mono16", np.ones((8, 12), np.uint16), "/segmentation", "label"),
        ("32SC1", np.ones((8, 12), np.int32), "/front", "label"),
        ("mono8", np.ones((8, 12), np.uint8), "/Front/Labels", "label"),
    ],
)
def test_roles_follow_from_encoding_and_name(tmp_path, encoding, pixels, topic, role):
    replaced = DEPTH if role == "depth" else LABELS
    entries = [e for e in robot_entries() if e.topic != replaced]
    (robot,) = discover([write_mcap(tmp_path / "r.mcap", [*entries, image_entry(topic, pixels, encoding)])])
    assert (robot.depth_topic, robot.label_topic) == ((topic, LABELS) if role == "depth" else (DEPTH, topic))


def test_several_depth_images_are_listed_as_lines_to_paste(tmp_path):
    entries = [*robot_entries(labels=False), image_entry("/rear/depth/image_raw", depth_pixels(0), "16UC1")]
    path = write_mcap(tmp_path / "r.mcap", entries)
    with pytest.raises(ConfigError) as caught:
        discover([path])
    assert str(caught.value) == (
        f"{path}: robot 'r' has 2 depth images; put one of these lines into its entry of a team file, or each "
        "into an entry of its sensors:\n    depth_topic: /camera/depth/image_raw\n"
        "    depth_topic: /rear/depth/image_raw"
    )
    (robot,) = resolve(run_of(RobotConfig("r", (path,), depth_topic=DEPTH))).robots
    assert (robot.depth_topic, robot.camera_info_topic) == (DEPTH, INFO)


def test_depth_that_is_registered_to_the_labels_is_preferred(tmp_path):
    raw = image_entry("/camera/unregistered_depth/image", np.ones((6, 6), np.uint16), "16UC1", "depth_camera")
    (robot,) = discover([write_mcap(tmp_path / "r.mcap", [*robot_entries(), raw])])
    assert robot.depth_topic == DEPTH


def test_several_odometries_are_listed(tmp_path):
    more = Entry("/odom/filtered", "nav_msgs/msg/Odometry", ros2.odometry(START, (0, 0, 0)), START)
    with pytest.raises(
        ConfigError, match=r"2 odometry topics.*\n    pose_topic: /odom\n    pose_topic: /odom/filtered"
    ):
        discover([write_mcap(tmp_path / "r.mcap", [*robot_entries(), more])])


def test_poses_come_from_odometry_then_tf_then_stamped_poses(tmp_path):
    def pose_entry(topic: str) -> Entry:
        return Entry(topic, "geometry_msgs/msg/PoseStamped", ros2.pose_stamped(START, (0, 0, 0)), START)

    stamped = [pose_entry("/pose"), pose_entry("/goal_pose")]
    (robot,) = discover([write_mcap(tmp_path / "a.mcap", [*robot_entries(poses="tf"), *stamped])])
    assert (robot.pose_topic, robot.map_frame) == ("/tf", "map")
    path = write_mcap(tmp_path / "b.mcap", [*robot_entries(poses="none"), *stamped])
    (robot,) = discover([path])
    assert (robot.pose_topic, robot.map_frame) == ("/pose", "map")
    path = write_mcap(tmp_path / "c.mcap", [*robot_entries(poses="tf"), *stamped])
    given = RobotConfig("c", (path,), T_body_sensor=(0.0, 0.0, 0.0, *IDENTITY))
    assert resolve(run_of(given)).robots[0].pose_topic == "/pose"


def test_the_map_frame_of_tf_is_the_root_above_the_sensor(tmp_path):
    entries = [
        *robot_entries(poses="tf"),
        Entry("/tf", "tf2_msgs/msg/TFMessage", ros2.tf(("earth", "map", START, (0, 0, 0), IDENTITY)), START + SECOND),
        Entry("/tf", "tf2_msgs/msg/TFMessage", ros2.tf(("x", "y", START, (0, 0, 0), IDENTITY)), START + SECOND),
    ]
    (robot,) = discover([write_mcap(tmp_path / "r.mcap", entries)])
    assert robot.map_frame == "earth"
    with pytest.raises(InputError, match="TF has no frame above the sensor's frame 'lens'"):
        resolve(run_of(replace(robot, map_frame=None, sensor_frame="lens")))


@pytest.mark.parametrize(
    ("drop", "sentence"),
    [
        (DEPTH, "no depth image, point cloud or laser scan to map; its messages are nav_msgs/msg/Odometry, "),
        (INFO, f"there is no CameraInfo for '{DEPTH}'; give intrinsics"),
        (
            "/odom",
            r"no poses \(.*\) for robot 'r'; 'octoreplay odometry .*r.mcap -o r.tum' .*or pose_topic",
        ),
    ],
)
def test_missing_topics_are_named_in_one_sentence(tmp_path, drop, sentence):
    keep = {DEPTH: ("/odom", "/tf_static")}.get(drop)
    entries = [e for e in robot_entries() if e.topic != drop and (keep is None or e.topic in keep)]
    path = write_mcap(tmp_path / "r.mcap", entries)
    with pytest.raises(InputError, match=sentence) as caught:
        discover([path])
    assert str(caught.value).startswith(f"{path}: ")
    (summary,) = describe([path]).robots
    assert str(caught.value) in summary.missing


def test_a_sensor_that_does_not_move(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", robot_entries(poses="none"))
    (robot,) = resolve(run_of(RobotConfig("r", (path,), pose_topic="/tf_static"))).robots
    assert robot.map_frame == "base_link"
    with RobotLog(robot, TimeConfig(), None) as log:
        frames = list(log.frames())
    assert len(frames) == 6
    np.testing.assert_allclose(frames[3].T_team_sensor[:3, 3], (0, 0, 0.5))


@pytest.mark.parametrize(
    ("role", "name", "sentence"),
    [
        ("depth_topic", "/depth", "topic '/depth' not found; image topics: '/camera/depth/image_raw', '/camera/labels"),
        (
            "depth_topic",
            "/odom",
            "topic '/odom' is of type nav_msgs/msg/Odometry and cannot be the depth_topic; image topics: ",
        ),
        ("pose_topic", "/pose", "topic '/pose' not found; pose topics: '/odom', '/tf_static'"),
        ("cloud_topic", "/points", "topic '/points' not found; there are no point cloud or laser scan topics"),
        ("camera_info_topic", "/x", "topic '/x' not found; CameraInfo topics: '/camera/depth/camera_info'"),
        ("label_info_topic", "/x", "topic '/x' not found; LabelInfo topics: '/label_info'"),
    ],
)
def test_named_topics_must_exist(tmp_path, role, name, sentence):
    path = write_mcap(tmp_path / "r.mcap", robot_entries())
    with pytest.raises(InputError, match=f"r.mcap: {sentence}"):
        resolve(run_of(RobotConfig("r", (path,), **{role: name})))


def test_named_topics_are_kept(tmp_path):
    rest = image_entry("/other/labels", label_pixels(0), "mono8")
    path = write_mcap(tmp_path / "r.mcap", [*robot_entries(), rest])
    given = RobotConfig(
        "r", (path,), label_topic="/other/labels", intrinsics=(1.0, 1.0, 0.0, 0.0), map_frame="here", sensor_frame="eye"
    )
    (robot,) = resolve(run_of(given)).robots
    assert robot.to_config() == replace(given, depth_topic=DEPTH, pose_topic="/odom", label_info_topic="/label_info")


def test_the_class_table_is_that_of_the_logs_united_over_robots(tmp_path):
    one = write_mcap(tmp_path / "one.mcap", robot_entries())
    entries = [e for e in robot_entries() if e.topic != "/label_info"]
    info = ros2.label_info(START, {1: "ground", 9: "car"})
    # The second robot's LabelInfo is at the end of its log.
    two = write_mcap(
        tmp_path / "two.mcap", [*entries, Entry("/label_info", "vision_msgs/msg/LabelInfo", info, START + 9)]
    )
    table = resolve(run_of(*discover([one, two]))).classes
    assert [(c.name, c.raw_labels) for c in table.classes] == [
        ("ground", (1,)), ("tree", (2,)), ("wall", (7,)), ("car", (9,)),
    ]  # fmt: skip
    given = class_table([{"name": "thing", "raw_labels": [1, 2]}])
    assert resolve(run_of(*discover([one, two]), classes=given)).classes == given


def test_a_team_without_labels_maps_occupancy(tmp_path):
    path = write_mcap(tmp_path / "r.mcap", robot_entries(labels=False))
    config = resolve(run_of(*discover([path])))
    assert config.classes.names == ("occupied",)
    assert config.robots[0].label_topic is None
    labelled = write_mcap(tmp_path / "l.mcap", robot_entries())
    assert resolve(run_of(RobotConfig("l", (labelled,), label_topic=""))).classes.names == ("occupied",)


def test_labels_without_a_table_or_of_some_robots_only_are_refused(tmp_path):
    entries = [e for e in robot_entries() if e.topic != "/label_info"]
    path = write_mcap(tmp_path / "r.mcap", entries)
    with pytest.raises(ConfigError, match=f"no LabelInfo names the labels on '{LABELS}'; give 'classes'"):
        resolve(run_of(*discover([path])))
    with_labels = write_mcap(tmp_path / "with.mcap", robot_entries())
    without = write_mcap(tmp_path / "without.mcap", robot_entries(labels=False))
    with pytest.raises(ConfigError, match="robot 'without' has no labels, but the team has 3 classes"):
        resolve(run_of(*discover([with_labels, without])))


@pytest.mark.parametrize("with_label", [True, False])
def test_clouds_are_used_without_depth(tmp_path, with_label):
    path = write_mcap(tmp_path / "r.mcap", cloud_entries(with_label=with_label))
    (robot,) = discover([path])
    assert (robot.depth_topic, robot.cloud_topic, robot.sensor_frame) == (None, "/points", "camera")
    assert count_frames(robot) == 1
    if with_label:
        with pytest.raises(ConfigError, match="no LabelInfo names the labels on '/points'"):
            resolve(run_of(robot))
    else:
        assert resolve(run_of(robot)).classes.names == ("occupied",)


def test_no_logs_are_a_configuration_error():
    with pytest.raises(ConfigError, match="no logs given"):
        discover([])
