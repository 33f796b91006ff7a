from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from octoreplay.config.class_file import class_table
from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, parse_team
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError, OctoreplayError
from octoreplay.io.messages.sensor_messages import Kind, kind_of
from octoreplay.io.robots.describe import LogDescription, describe
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.robot_log import RobotLog
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    HEIGHT,
    IDENTITY,
    NAMES,
    SECOND,
    WIDTH,
    Entry,
    Factory,
    Row,
    depth_pixels,
    foxglove_row,
    foxglove_stamp,
    foxglove_transform,
    label_pixels,
    robot_entries,
    ros2,
    ros_row,
    write_bag,
    write_mcap,
    write_rosbag2,
    write_rows,
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
    assert parse_team(text, name="team", folder=tmp_path) == config.to_config()
    assert config.robots[0].log_span_ns == (START, START + 5 * SECOND // 4)
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
        f"{path}: robot 'r' has 2 depth images; put one of these lines into its entry of a team file:"
        "\n    depth_topic: /camera/depth/image_raw\n    depth_topic: /rear/depth/image_raw"
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
            r"no poses \(.*\) for robot 'r'; give pose_file: .*, or, if the sensor does not move, pose_topic",
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


def test_describe_gives_robots_topics_rates_and_overlap(tmp_path):
    first = write_mcap(tmp_path / "a.mcap", robot_entries(num_frames=9))
    second = write_mcap(tmp_path / "b.mcap", robot_entries(start_ns=START + SECOND, num_frames=9))
    description = describe([first, second])
    assert [summary.robot.robot_id for summary in description.robots] == ["a", "b"]
    assert all(summary.missing == () for summary in description.robots)
    assert description.overlap_ns == (START + SECOND, START + 2 * SECOND)
    assert description.class_table.names == tuple(NAMES.values())
    assert description.missing == ()
    log = description.logs[0]
    assert (log.path, log.num_messages, log.damage) == (first, len(robot_entries(num_frames=9)), None)
    assert (log.start_ns, log.end_ns) == (START, START + 2 * SECOND)
    topics = {topic.name: topic for topic in log.topics}
    assert topics[DEPTH].rate_hz == pytest.approx(4.0)
    assert topics[DEPTH].detail == "16UC1 12x8"
    assert topics["/odom"].rate_hz == pytest.approx(8.0)
    assert topics["/tf_static"].rate_hz is None
    far = write_mcap(tmp_path / "c.mcap", robot_entries(start_ns=START + 60 * SECOND))
    assert describe([first, far]).overlap_ns is None


def test_describe_lists_what_is_missing_instead_of_raising(tmp_path):
    entries = [*robot_entries(labels=False, poses="none"), image_entry("/rear/depth", depth_pixels(0), "16UC1")]
    no_frames = [e for e in robot_entries() if e.topic not in ("/tf_static", "/label_info")]
    paths = [write_mcap(tmp_path / "a.mcap", entries), write_mcap(tmp_path / "b.mcap", no_frames)]
    empty = write_mcap(tmp_path / "c.mcap", [])
    description = describe([*paths, empty])
    a, b, c = (summary.missing for summary in description.robots)
    assert any("has 2 depth images" in sentence for sentence in a)
    assert any("no poses" in sentence for sentence in a)
    assert any("no transform from 'camera' to 'base_link'" in sentence for sentence in b)
    assert any("the log holds no messages" in sentence for sentence in c)
    assert any("no LabelInfo names the labels" in sentence for sentence in description.missing)
    assert description.overlap_ns is not None
    description = describe([tmp_path / "missing.mcap", paths[0]])
    assert [log.error for log in description.logs] == [f"{tmp_path / 'missing.mcap'}: no such file", None]
    assert [summary.robot.robot_id for summary in description.robots] == ["a"]


def test_no_logs_are_a_configuration_error():
    with pytest.raises(ConfigError, match="no logs given"):
        discover([])


# --- other schemas and encodings -------------------------------------------------------------------------------------


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


def test_encoded_depth_and_labels_are_found(tmp_path):
    depth = compressed("/camera/depth/compressedDepth", b"\0" * 12 + png(depth_pixels(0)), "16UC1; compressedDepth png")
    labels = compressed("/camera/labels/compressed", png(label_pixels(0)), "png")
    color = compressed("/camera/color/compressed", cv2.imencode(".jpg", COLORS)[1].tobytes(), "jpeg")
    path = write_mcap(tmp_path / "r.mcap", replaced(depth, labels, color))
    (robot,) = discover([path])
    assert (robot.depth_topic, robot.label_topic, robot.camera_info_topic) == (depth.topic, labels.topic, INFO)
    assert count_frames(robot, resolve(run_of(robot)).classes) == 1
    (log,) = describe([path]).logs
    details = {topic.name: topic.detail for topic in log.topics}
    assert [details[e.topic] for e in (depth, labels, color)] == ["16UC1 12x8", "8UC1 12x8", "jpeg rgb8 12x8"]


@pytest.mark.parametrize(
    "data", [png(label_pixels(0)), png(COLORS), cv2.imencode(".jpg", COLORS)[1].tobytes()], ids=["ids", "png", "jpeg"]
)
def test_compressed_images_are_labels_by_their_name(tmp_path, data):
    (robot,) = discover([write_mcap(tmp_path / "a.mcap", replaced(compressed("/front/semantics", data, "")))])
    assert robot.label_topic == "/front/semantics"
    other = compressed("/front/rgb", data, "")
    entries = [e for e in robot_entries() if e.topic != LABELS]
    (robot,) = discover([write_mcap(tmp_path / "b.mcap", [*entries, other])])
    assert robot.label_topic is None


@pytest.mark.parametrize("form", ["rgb8", "bgr8", "png", "jpeg"])
def test_ids_are_preferred_to_colours(tmp_path, form):
    topic = "/camera/labels/colored"
    if form in ("rgb8", "bgr8"):
        entry = image_entry(topic, COLORS.reshape(HEIGHT, -1), form)
        entry.value.width = WIDTH
    else:
        entry = compressed(topic, cv2.imencode(".jpg" if form == "jpeg" else ".png", COLORS)[1].tobytes(), form)
    (robot,) = discover([write_mcap(tmp_path / "a.mcap", [*robot_entries(), entry])])
    assert robot.label_topic == LABELS
    entries = [e for e in robot_entries() if e.topic != LABELS]
    (robot,) = discover([write_mcap(tmp_path / "b.mcap", [*entries, entry])])
    assert robot.label_topic == topic


def test_confidences_go_with_labels_of_their_size(tmp_path):
    sure = image_entry("/camera/labels/confidence", label_pixels(0), "mono8")
    small = image_entry("/camera/labels/small/confidence", np.ones((3, 4), np.float32), "32FC1")
    depth = image_entry("/camera/depth/confidence", label_pixels(0), "mono8")
    entries = [*robot_entries(), sure, small, depth]
    (robot,) = discover([write_mcap(tmp_path / "a.mcap", entries)])
    assert (robot.depth_topic, robot.label_topic, robot.confidence_topic) == (DEPTH, LABELS, sure.topic)
    (robot,) = discover([write_mcap(tmp_path / "b.mcap", [e for e in entries if e.topic != LABELS])])
    assert (robot.label_topic, robot.confidence_topic) == (None, None)


def test_laser_scans_are_used_without_depth_and_clouds(tmp_path):
    def log(name: str, *topics: str, cloud: bool):
        scans = [
            Entry(topic, "sensor_msgs/msg/LaserScan", ros2.scan(START, [1.0, 2.0], frame_id="camera"), START)
            for topic in topics
        ]
        entries = cloud_entries(with_label=False)
        return write_mcap(tmp_path / name, [*(entries if cloud else entries[:-1]), *scans])

    path = log("a.mcap", "/scan", cloud=False)
    (robot,) = discover([path])
    assert (robot.depth_topic, robot.cloud_topic, robot.sensor_frame) == (None, "/scan", "camera")
    assert count_frames(robot) == 1
    assert resolve(run_of(robot)).classes.names == ("occupied",)
    details = {topic.name: topic.detail for topic in describe([path]).logs[0].topics}
    assert details["/scan"] == "2 ranges"
    (robot,) = discover([log("b.mcap", "/scan", cloud=True)])
    assert robot.cloud_topic == "/points"
    with pytest.raises(ConfigError, match=r"2 laser scans.*\n    cloud_topic: /front\n    cloud_topic: /rear"):
        discover([log("c.mcap", "/front", "/rear", cloud=False)])
    named = RobotConfig("b", (tmp_path / "b.mcap",), cloud_topic="/scan")
    assert resolve(run_of(named)).robots[0].cloud_topic == "/scan"


def test_a_cloud_with_labels_is_preferred_and_a_field_can_be_named(tmp_path):
    plain = cloud_entries(with_label=False)[-1]._replace(topic="/raw")
    path = write_mcap(tmp_path / "r.mcap", [*cloud_entries(with_label=True), plain])
    (robot,) = discover([path])
    assert robot.cloud_topic == "/points"
    table = class_table([{"name": "a", "raw_labels": [1]}, {"name": "b", "raw_labels": [2]}])
    given = RobotConfig("r", (path,), cloud_topic="/raw", label_field="x")
    assert resolve(run_of(given, classes=table)).classes == table
    with pytest.raises(ConfigError, match="robot 'r' has no labels, but the team has 2 classes"):
        resolve(run_of(replace(given, label_field=None), classes=table))


def test_transforms_are_poses_like_odometry(tmp_path):
    vicon = [
        Entry("/vicon", "geometry_msgs/msg/TransformStamped",
              ros2.tf(("world", "base_link", stamp, (1, 2, 3), IDENTITY)).transforms[0], stamp)
        for stamp in (START, START + SECOND // 4)
    ]  # fmt: skip
    (robot,) = discover([write_mcap(tmp_path / "r.mcap", [*robot_entries(poses="none"), *vicon])])
    assert (robot.pose_topic, robot.map_frame) == ("/vicon", "world")
    assert count_frames(robot) == 2


def test_a_path_is_a_pose_topic_even_where_it_is_empty_at_first(tmp_path):
    poses = [ros2.pose_stamped(START, (1, 2, 3)), ros2.pose_stamped(START + SECOND // 4, (1, 2, 3))]
    paths = [
        Entry("/path", "nav_msgs/msg/Path", ros2.path(START + i, poses[:i], frame_id="world"), START + i)
        for i in range(3)
    ]
    path = write_mcap(tmp_path / "r.mcap", [*robot_entries(poses="none"), *paths])
    (robot,) = resolve(run_of(RobotConfig("r", (path,), T_body_sensor=(0.0, 0.0, 0.0, *IDENTITY)))).robots
    assert robot.pose_topic == "/path"
    assert count_frames(robot) == 2


def test_a_pose_file_replaces_pose_topics(tmp_path):
    trajectory = tmp_path / "tum.txt"
    trajectory.write_text("100 1 2 3 0 0 0 1\n100.25 1 2 3 0 0 0 1\n")
    path = write_mcap(tmp_path / "r.mcap", robot_entries(poses="none"))
    (robot,) = resolve(run_of(RobotConfig("r", (path,), pose_file=trajectory))).robots
    assert (robot.pose_topic, robot.depth_topic) == (None, DEPTH)
    assert count_frames(robot) == 2


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


@pytest.mark.parametrize("encoding", FOXGLOVE_ENCODINGS)
def test_a_robot_with_foxglove_schemas_is_found(tmp_path, encoding):
    path = write_rows(tmp_path / "r.mcap", foxglove_rows(encoding))
    (robot,) = discover([path])
    assert robot.to_config() == RobotConfig(
        "r", (path,), depth_topic="/camera/depth", label_topic="/camera/labels",
        camera_info_topic="/camera/calibration", pose_topic="/camera/tf", map_frame="map", sensor_frame="camera",
    )  # fmt: skip
    assert count_frames(robot) == 1
    (log,) = describe([path]).logs
    details = {topic.name: topic.detail for topic in log.topics}
    assert (details["/camera/depth"], details["/camera/labels"]) == ("16UC1 12x8", "8UC1 12x8")


def test_a_wrong_name_lists_the_topics_of_every_schema(tmp_path):
    entry = compressed("/rear/depth", b"\0" * 12 + png(depth_pixels(0)), "16UC1; compressedDepth png")
    rows = [*foxglove_rows("protobuf"), *map(ros_row, [*robot_entries(), entry])]
    path = write_rows(tmp_path / "r.mcap", rows)
    for role, sentence in (
        ("depth_topic", f"image topics: '{DEPTH}', '{LABELS}', '/camera/depth', '/camera/labels', '/rear/depth'"),
        ("confidence_topic", f"image topics: '{DEPTH}', '{LABELS}', '/camera/depth', '/camera/labels', '/rear/depth'"),
        ("camera_info_topic", f"CameraInfo topics: '/camera/calibration', '{INFO}'"),
        ("pose_topic", "pose topics: '/camera/mount', '/camera/tf', '/odom', '/tf_static'"),
    ):
        with pytest.raises(InputError) as caught:
            resolve(run_of(RobotConfig("r", (path,), **{role: "/wrong"})))
        names = str(caught.value).split("topics: ")[1].split(", ")
        assert str(caught.value).startswith(f"{path}: topic '/wrong' not found; ")
        assert sorted(names) == sorted(sentence.split("topics: ")[1].split(", "))


# --- odd logs --------------------------------------------------------------------------------------------------------


def check_nothing_else_is_raised(path) -> LogDescription:
    """The log is described, and finding and reading its robots gives frames or an error of the package."""
    description = describe([path])
    for step in (
        lambda: discover([path]),
        lambda: resolve(run_of(RobotConfig("r", (path,)))),
        lambda: [count_frames(ResolvedRobot.from_config(summary.robot, None)) for summary in description.robots],
    ):
        try:
            step()
        except OctoreplayError as error:
            text = str(error)
            assert text
    return description


GARBAGE = [b"", b"\0", b"\0\1\0\0", b"\xff" * 40, b"\0" * 400, b"{}", b"[]", b"null", b'"x"', b"3", b'{"header": 1}']


@pytest.mark.parametrize("data", GARBAGE, ids=repr)
@pytest.mark.parametrize("topics", ["all", "sensors", "poses", "cameras", "static", "classes"])
@pytest.mark.parametrize("encoding", ["ros2", *FOXGLOVE_ENCODINGS])
def test_garbage_on_topics_of_known_types(tmp_path, data, topics, encoding):
    rows = [*map(ros_row, robot_entries())] if encoding == "ros2" else foxglove_rows(encoding)
    kinds = {
        "all": tuple(Kind), "sensors": (Kind.IMAGE, Kind.COMPRESSED_IMAGE), "poses": (Kind.ODOMETRY, Kind.TF),
        "cameras": (Kind.CAMERA_INFO,), "classes": (Kind.LABEL_INFO,), "static": (Kind.TF,),
    }  # fmt: skip

    def is_hit(row: Row) -> bool:
        return kind_of(row.schema_name) in kinds[topics] and not (topics == "poses" and row.topic == "/tf_static")

    rows = [row._replace(data=data) if is_hit(row) else row for row in rows]
    check_nothing_else_is_raised(write_rows(tmp_path / "r.mcap", rows))


@pytest.mark.parametrize("encoding", ["ros2", *FOXGLOVE_ENCODINGS])
@pytest.mark.parametrize(
    "schema", [b"", b"\xff\xfe", b"\x0a\x03abc", b"uint8 x\n", b"float64 header\n", b"string data\n"]
)
def test_missing_or_wrong_definitions(tmp_path, encoding, schema):
    rows = [*map(ros_row, robot_entries())] if encoding == "ros2" else foxglove_rows(encoding)
    check_nothing_else_is_raised(write_rows(tmp_path / "r.mcap", [row._replace(schema=schema) for row in rows]))


def test_messages_of_other_types_on_all_topics(tmp_path):
    """Every topic begins with one message of an unused type and one of another used type."""
    rows = [*map(ros_row, robot_entries())]
    text = ros_row(Entry("", "std_msgs/msg/String", ros2.make("std_msgs/msg/String", data="x"), START - 2))
    scan = ros_row(Entry("", "sensor_msgs/msg/LaserScan", ros2.scan(START, [1.0]), START - 1))
    topics = dict.fromkeys(row.topic for row in rows)
    for extra in ([text], [scan], [text, scan]):
        more = [row._replace(topic=topic) for row in extra for topic in topics]
        check_nothing_else_is_raised(write_rows(tmp_path / "r.mcap", [*more, *rows]))


def test_transforms_that_are_not_finite_or_go_in_circles(tmp_path):
    bad = [
        ros2.tf(("map", "base_link", START, (np.nan, 0, 0), IDENTITY)),
        ros2.tf(("map", "base_link", START, (0, 0, 0), (np.inf, 0, 0, np.nan))),
        ros2.tf(("base_link", "base_link", START, (0, 0, 0), IDENTITY)),
        ros2.tf(("base_link", "map", START, (0, 0, 0), IDENTITY), ("map", "base_link", START, (0, 0, 0), IDENTITY)),
        ros2.tf(("", "", START, (0, 0, 0), IDENTITY)),
        ros2.tf(),
    ]
    for topic in ("/tf", "/tf_static"):
        for value in bad:
            entries = [e for e in robot_entries(poses="none") if e.topic != topic]
            path = write_mcap(tmp_path / "r.mcap", [*entries, Entry(topic, "tf2_msgs/msg/TFMessage", value, START)])
            check_nothing_else_is_raised(path)


@pytest.mark.parametrize(
    "names", [{}, {0: ""}, {65535: "x"}, {255: "tree", 1: "void"}, {i: str(i) for i in range(300)}]
)
def test_strange_classes(tmp_path, names):
    entries = [e for e in robot_entries() if e.topic != "/label_info"]
    info = Entry("/label_info", "vision_msgs/msg/LabelInfo", ros2.label_info(START, names), START)
    description = check_nothing_else_is_raised(write_mcap(tmp_path / "r.mcap", [*entries, info]))
    assert description.class_table is not None or description.missing


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 2**32 - 1, "height": 2**32 - 1}, {"width": 0}, {"step": 0}, {"encoding": ""}, {"encoding": "x" * 999},
    ],
)  # fmt: skip
def test_odd_images(tmp_path, changes):
    entries = robot_entries()
    for entry in entries:
        if entry.topic in (DEPTH, LABELS):
            for name, value in changes.items():
                setattr(entry.value, name, value)
    check_nothing_else_is_raised(write_mcap(tmp_path / "r.mcap", entries))


@pytest.mark.parametrize(
    "info",
    [
        ros2.camera_info(0, (2**32 - 1, 2**32 - 1), d=(0.1,) * 5), ros2.camera_info(0, (0, 0), d=(0.1,) * 4),
        ros2.camera_info(0, (WIDTH, HEIGHT), k=(np.nan,) * 9), ros2.camera_info(0, (WIDTH, HEIGHT), d=(np.inf,) * 5),
        ros2.camera_info(0, (WIDTH, HEIGHT), d=(1e300,) * 5), ros2.camera_info(0, (WIDTH, HEIGHT), d=(1.0,), model="?"),
    ],
    ids=range(6),
)  # fmt: skip
def test_odd_cameras(tmp_path, info):
    entries = [e._replace(value=info) if e.topic == INFO else e for e in robot_entries()]
    (summary,) = check_nothing_else_is_raised(write_mcap(tmp_path / "r.mcap", entries)).robots
    assert any(INFO in sentence for sentence in summary.missing)


def test_odd_json_of_every_kind(tmp_path):
    odd = [None, -1, 1e300, 10**40, "x", [], {}, [[1]], {"sec": 1e999, "nsec": 0}, {"sec": 10**30, "nsec": 0}]
    for value in odd:
        for key in (
            "timestamp",
            "frame_id",
            "encoding",
            "width",
            "height",
            "step",
            "data",
            "K",
            "D",
            "transforms",
            "format",
        ):
            rows = []
            for row in foxglove_rows("json"):
                fields = json.loads(row.data)
                rows.append(row._replace(data=json.dumps(fields | ({key: value} if key in fields else {})).encode()))
            check_nothing_else_is_raised(write_rows(tmp_path / "r.mcap", rows))
