"""Equal maps from the same content in every container and encoding (fixtures/containers and streams)."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import octoreplay
from fixtures.foxglove_messages import write_protobuf
from fixtures.make_streams import PALETTE, SIDES, clouds, lidar_poses, scan_ranges
from fixtures.scene import (
    CAMERA,
    DEPTH,
    FOXGLOVE,
    FOXGLOVE_TYPES,
    INFO,
    JOINT,
    LABELS,
    ROS2,
    START_NS,
    UNLABELLED,
    camera_poses,
    in_order,
    pose_entries,
    record,
)
from fixtures.writers import JSON, Encoding, idl_definition, write_mcap
from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.io.containers.logs import open_log
from octoreplay.io.messages.sensor_messages import LabelNames
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import ClassTable, CloudFrame, DepthFrame, Frame, FrameCounts, SemanticClass
from support import command_line, room
from support.fixture_paths import CONTAINERS, STREAMS
from support.log_factory import IDENTITY, SECOND, Entry
from support.long_suite import long
from support.scan_maps import packet_of
from support.velodyne_logs import rays_of_a_turn

LOGS = sorted(path.name for path in CONTAINERS.iterdir())
REFERENCE = "cdr_none.mcap"
CLASSES = ClassTable(
    tuple(SemanticClass(k + 1, name, PALETTE[raw], (raw,)) for k, (raw, name) in enumerate(room.NAMES.items()))
)
CLASS_IDS = np.zeros(256, np.uint8)
CLASS_IDS[list(room.NAMES)] = [1, 2, 3, 4]


def names_its_classes(name: str) -> bool:
    """True where the log names its labels: vision_msgs/LabelInfo exists in ROS 2 alone."""
    return not (name.startswith(("foxglove", "ros1")) or name.endswith(".bag"))


def resolved(path: Path, classes: ClassTable | None) -> ResolvedRun:
    """The resolved run of a log's path, with the classes where the log does not name them."""
    return octoreplay.resolve(RunConfig(octoreplay.discover([path]), classes=classes))


def frames_of(robot: ResolvedRobot, classes: ClassTable | None) -> list[Frame]:
    """All frames of a robot; none may be lost."""
    with RobotLog(robot, TimeConfig(), classes) as log:
        frames = list(log.frames())
        assert log.counts == FrameCounts(used=len(frames))
        return frames


@cache
def frames_in(name: str) -> list[DepthFrame]:
    """The frames of one of the containers."""
    config = resolved(CONTAINERS / name, None if names_its_classes(name) else CLASSES)
    frames = frames_of(config.robots[0], config.classes)
    assert all(isinstance(frame, DepthFrame) for frame in frames)
    return frames


@cache
def packet_in(name: str) -> bytes:
    """Encoded map of one of the containers."""
    return packet_of(frames_in(name), CLASSES.num_classes)


def assert_images(frames: list[Frame], recording, poses: np.ndarray) -> None:
    """Check that frames equal the first ones of a recording: exactly, and poses up to rounding."""
    assert frames
    for index, frame in enumerate(frames):
        assert frame.stamp_ns == recording.stamps_ns[index]
        assert (frame.depth_image.dtype, frame.depth_unit) == (np.uint16, 0.001)
        np.testing.assert_array_equal(frame.depth_image, recording.depth[index])
        np.testing.assert_array_equal(frame.class_image, CLASS_IDS[recording.labels[index]])
        assert frame.camera == CAMERA
        assert frame.camera.slopes is None
        np.testing.assert_allclose(frame.T_team_sensor, poses[index], rtol=0, atol=1e-12)


# --- containers and encodings ----------------------------------------------------------------------------------------


def test_no_container_is_missing() -> None:
    assert len(LOGS) == 25
    assert REFERENCE in LOGS


@pytest.mark.parametrize("name", LOGS)
def test_robot_and_topics_are_found_from_the_path_alone(name: str) -> None:
    [robot] = octoreplay.discover([CONTAINERS / name])
    assert robot.to_config() == RobotConfig(
        Path(name).stem,
        (CONTAINERS / name,),
        depth_topic=DEPTH,
        label_topic=LABELS,
        camera_info_topic=INFO,
        pose_topic="/odom",
        label_info_topic="/labels/label_info" if names_its_classes(name) else None,
        map_frame="odom",
        sensor_frame="camera",
    )


@pytest.mark.parametrize("name", LOGS)
def test_classes_come_from_the_label_info(name: str) -> None:
    if names_its_classes(name):
        found = resolved(CONTAINERS / name, None).classes
        assert [(c.name, c.raw_labels) for c in found.classes] == [(c.name, c.raw_labels) for c in CLASSES.classes]
    else:
        with pytest.raises(octoreplay.ConfigError, match="no LabelInfo names the labels on '/camera/labels/"):
            resolved(CONTAINERS / name, None)


@pytest.mark.parametrize("name", LOGS)
def test_frames_equal_the_recorded_ones(name: str) -> None:
    recording = record()
    frames = frames_in(name)
    assert len(frames) == len(recording.stamps_ns)
    assert_images(frames, recording, camera_poses(recording.base, recording.joint, recording.stamps_ns))


@pytest.mark.parametrize("name", [name for name in LOGS if name != REFERENCE])
def test_frames_and_map_are_the_same_bit_by_bit(name: str) -> None:
    for frame, expected in zip(frames_in(name), frames_in(REFERENCE), strict=True):
        assert frame.T_team_sensor.tobytes() == expected.T_team_sensor.tobytes()
        assert frame.depth_image.tobytes() == expected.depth_image.tobytes()
        assert frame.class_image.tobytes() == expected.class_image.tobytes()
    assert packet_in(name) == packet_in(REFERENCE)


def test_the_map_depends_on_every_frame() -> None:
    """Otherwise equal maps would prove nothing."""
    frames = frames_in(REFERENCE)
    packets = {packet_of([*frames[:k], *frames[k + 1 :]], CLASSES.num_classes) for k in range(len(frames))}
    assert len(packets | {packet_in(REFERENCE)}) == len(frames) + 1


def test_the_bare_file_of_a_folder_is_the_same_log() -> None:
    for name, file in (
        ("rosbag2_sqlite3", "rosbag2_sqlite3.db3"),
        ("rosbag2_mcap", "rosbag2_mcap.mcap"),
        ("rosbag2_mcap_storage_zstd", "rosbag2_mcap_storage_zstd.mcap"),
    ):
        config = resolved(CONTAINERS / name / file, None)
        assert packet_of(frames_of(config.robots[0], config.classes), CLASSES.num_classes) == packet_in(REFERENCE)


def test_the_halves_of_a_split_recording_are_one_log_when_listed() -> None:
    for name, suffix in (("rosbag2_sqlite3_split", "db3"), ("rosbag2_mcap_split", "mcap")):
        files = tuple(CONTAINERS / name / f"{name}_{k}.{suffix}" for k in (0, 1))
        config = octoreplay.resolve(RunConfig((RobotConfig("robot", files),)))
        assert packet_of(frames_of(config.robots[0], config.classes), CLASSES.num_classes) == packet_in(REFERENCE)


@long
def test_runs_on_different_containers_end_with_the_same_map(tmp_path: Path) -> None:
    maps = set()
    for name in ("foxglove_protobuf.mcap", "rosbag2_sqlite3_file_zstd", "bz2.bag"):
        team, result = tmp_path / f"{name}.yaml", tmp_path / f"{name}.result.mcap"
        classes = "".join(f"- {{name: {text}, raw_labels: [{raw}]}}\n" for raw, text in room.NAMES.items())
        team.write_text(f"robots: [{{id: robot, log: {CONTAINERS / name}}}]\nclasses:\n{classes}")
        done = command_line.octoreplay("run", team, "-o", result)
        assert done.returncode == 0, done.stderr
        with octoreplay.open_result(result) as opened:
            leaves = opened.map("robot").leaves()
        assert len(leaves) > 1000
        maps.add((leaves.centers.tobytes(), leaves.sizes.tobytes(), leaves.log_odds.tobytes()))
    assert len(maps) == 1


# --- definitions -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("schema", ["ros2msg", "ros2idl"])
def test_a_type_is_read_as_its_log_defines_it(tmp_path: Path, schema: str) -> None:
    """Another version of a package may have its fields in another order."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    info = "std_msgs/Header header\nfloat32 threshold\nvision_msgs/VisionClass[2] class_map\n"
    store.register(get_types_from_msg("string class_name\nuint16 class_id\n", "vision_msgs/msg/VisionClass"))
    store.register(get_types_from_msg(info, "vision_msgs/msg/LabelInfo"))
    entries = [
        store.types["vision_msgs/msg/VisionClass"](class_name=name, class_id=raw)
        for raw, name in ((300, "tree"), (7, "wall"))
    ]
    value = store.types["vision_msgs/msg/LabelInfo"](ROS2.header(START_NS, "camera"), 0.5, entries)
    definitions = {
        "ros2msg": lambda name, _: (name, store.generate_msgdef(name, ros_version=2)[0]),
        "ros2idl": lambda name, _: (name, idl_definition(store, name)),
    }
    encoding = Encoding("ros2", "cdr", schema, definitions[schema], lambda v, name: bytes(store.serialize_cdr(v, name)))
    path = tmp_path / "robot.mcap"
    write_mcap(path, [Entry("/label_info", "vision_msgs/msg/LabelInfo", value, START_NS)], encoding)
    with open_log(path) as log:
        [message] = log.messages(["/label_info"])
        found = message.sensor_message()
    assert isinstance(found, LabelNames)
    assert found.names == {300: "tree", 7: "wall"}


# --- other sensors ---------------------------------------------------------------------------------------------------


def test_cloud_with_labels() -> None:
    config = resolved(STREAMS / "cloud.mcap", None)
    recording, expected = clouds()
    frames = frames_of(config.robots[0], config.classes)
    assert [frame.stamp_ns for frame in frames] == recording.stamps_ns.tolist()
    for frame, (points, labels), T in zip(frames, expected, lidar_poses(recording), strict=True):
        assert isinstance(frame, CloudFrame)
        assert frame.points.dtype == np.float32
        np.testing.assert_array_equal(frame.points, points)
        np.testing.assert_array_equal(frame.class_ids, CLASS_IDS[labels])
        np.testing.assert_allclose(frame.T_team_sensor, T, rtol=0, atol=1e-12)


def test_livox_clouds_have_the_points_of_ros_clouds() -> None:
    found, ros = resolved(STREAMS / "livox.mcap", None), resolved(STREAMS / "cloud.mcap", None)
    assert found.robots[0].cloud_topic == "/livox/lidar"
    frames, expected = frames_of(found.robots[0], None), frames_of(ros.robots[0], None)
    assert len(frames) == len(expected) == 4
    for frame, other in zip(frames, expected, strict=True):
        assert isinstance(frame, CloudFrame)
        assert isinstance(other, CloudFrame)
        assert frame.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(frame.points, other.points)
        np.testing.assert_array_equal(frame.T_team_sensor, other.T_team_sensor)


def test_packets_of_a_lidar_have_the_points_that_its_rays_hit() -> None:
    config = resolved(STREAMS / "velodyne.mcap", None)
    assert config.robots[0].cloud_topic == "/velodyne_packets"
    recording, rays = record(4), rays_of_a_turn(12).reshape(-1, 3)
    frames = frames_of(config.robots[0], None)
    assert [frame.stamp_ns for frame in frames] == recording.stamps_ns.tolist()
    for frame, T in zip(frames, lidar_poses(recording), strict=True):
        assert isinstance(frame, CloudFrame)
        expected = rays * room.look(T, rays)[0][:, None]
        # The lasers are up to 11 mm above or below the origin.
        np.testing.assert_allclose(frame.points, expected, rtol=0, atol=0.015)


def test_laser_scan_with_poses_from_tf() -> None:
    config = resolved(STREAMS / "scan.mcap", None)
    [robot] = config.robots
    assert (robot.cloud_topic, robot.pose_topic, robot.map_frame) == ("/scan", "/tf", "odom")
    assert config.classes.names == ("occupied",)
    recording = record(4)
    frames = frames_of(robot, config.classes)
    assert [frame.stamp_ns for frame in frames] == recording.stamps_ns.tolist()
    for frame, T in zip(frames, lidar_poses(recording), strict=True):
        ranges = scan_ranges(T).astype(float)
        angles = float(np.float32(-np.pi)) + float(np.float32(np.pi / 45)) * np.arange(ranges.size)
        good = np.isfinite(ranges)
        assert good.sum() == ranges.size - 2
        ranges, angles = ranges[good], angles[good]
        expected = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), 0 * ranges], axis=1)
        np.testing.assert_allclose(frame.points, expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(frame.T_team_sensor, T, rtol=0, atol=1e-12)
        assert frame.class_ids is None


def write_foxglove(path: Path, entries: list[Entry], encoding: str) -> None:
    if encoding == "protobuf":
        write_protobuf(path, entries, chunk_size=8_000)
    else:
        write_mcap(path, entries, JSON)


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_clouds_give_the_map_of_ros(tmp_path: Path, encoding: str) -> None:
    """The cloud's pose holds the lidar's position on the robot; rays begin there."""
    path = tmp_path / "robot.mcap"
    recording, expected = clouds()
    entries = pose_entries(recording, FOXGLOVE, FOXGLOVE_TYPES)
    for stamp, (points, labels) in zip(recording.stamps_ns.tolist(), expected, strict=True):
        columns = {"label": labels, **dict(zip("xyz", points.T, strict=True))}
        value = FOXGLOVE.cloud(stamp, columns, frame_id="base_link", position=JOINT, quaternion=IDENTITY)
        entries.append(Entry("/points", "foxglove.PointCloud", value, stamp))
    write_foxglove(path, in_order(entries), encoding)
    found = resolved(path, CLASSES)
    ros = resolved(STREAMS / "cloud.mcap", None)
    maps = [packet_of(frames_of(c.robots[0], c.classes), CLASSES.num_classes) for c in (found, ros)]
    assert maps[0] == maps[1]


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_scans_are_those_of_ros(tmp_path: Path, encoding: str) -> None:
    """As above, with a scanner mounted upside down."""
    path, start, step = tmp_path / "robot.mcap", float(np.float32(-np.pi)), float(np.float32(np.pi / 45))
    recording, upside_down = record(4), (1.0, 0.0, 0.0, 0.0)
    entries = pose_entries(recording, FOXGLOVE, FOXGLOVE_TYPES)
    for stamp, T in zip(recording.stamps_ns.tolist(), lidar_poses(recording), strict=True):
        # In the mirror image of its view, angles go down.
        ranges, pose = scan_ranges(T), {"position": JOINT, "quaternion": upside_down}
        value = FOXGLOVE.scan(stamp, ranges, -start, -start - 89 * step, frame_id="base_link", **pose)
        entries.append(Entry("/scan", "foxglove.LaserScan", value, stamp))
    write_foxglove(path, in_order(entries), encoding)
    found, ros = resolved(path, None), resolved(STREAMS / "scan.mcap", None)
    pairs = zip(*(frames_of(config.robots[0], config.classes) for config in (found, ros)), strict=True)
    for frame, expected in pairs:
        in_team = [f.points @ f.T_team_sensor[:3, :3].T + f.T_team_sensor[:3, 3] for f in (frame, expected)]
        np.testing.assert_allclose(*in_team, rtol=0, atol=1e-9)
        np.testing.assert_allclose(frame.T_team_sensor[:3, 3], expected.T_team_sensor[:3, 3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["compressed", "rvl"])
def test_compressed_images_give_the_map_of_raw_ones(name: str) -> None:
    config = resolved(STREAMS / f"{name}.mcap", None)
    [robot] = config.robots
    assert (robot.depth_topic, robot.label_topic) == (f"{DEPTH}/compressedDepth", f"{LABELS}/compressed")
    frames = frames_of(robot, config.classes)
    assert len(frames) == 4
    assert packet_of(frames, CLASSES.num_classes) == packet_of(frames_in(REFERENCE)[:4], CLASSES.num_classes)


def test_colours_give_the_map_of_labels() -> None:
    config = resolved(STREAMS / "palette.mcap", CLASSES)
    frames = frames_of(config.robots[0], config.classes)
    assert len(frames) == 4
    assert packet_of(frames, CLASSES.num_classes) == packet_of(frames_in(REFERENCE)[:4], CLASSES.num_classes)


@pytest.mark.parametrize(
    ("name", "pose_topic"), [("two_namespaces.mcap", "/{}/odom"), ("two_frame_prefixes.mcap", "/tf")]
)
def test_two_robots_in_one_file(name: str, pose_topic: str) -> None:
    config = resolved(STREAMS / name, None)
    assert [robot.robot_id for robot in config.robots] == list(SIDES)
    for robot, (robot_id, side) in zip(config.robots, SIDES.items(), strict=True):
        assert robot.depth_topic == f"/{robot_id}{DEPTH}"
        assert robot.pose_topic == pose_topic.format(robot_id)
        assert (robot.map_frame, robot.sensor_frame) == (f"{robot_id}/odom", f"{robot_id}/camera")
        recording = record(4, side=side)
        frames = frames_of(robot, config.classes)
        assert len(frames) == 4
        assert_images(frames, recording, camera_poses(recording.base, recording.joint, recording.stamps_ns))


def test_a_robot_has_the_same_map_alone_and_in_a_shared_file() -> None:
    config = resolved(STREAMS / "two_namespaces.mcap", None)
    frames = frames_of(config.robots[0], config.classes)
    assert packet_of(frames, CLASSES.num_classes) == packet_of(frames_in(REFERENCE)[:4], CLASSES.num_classes)


def test_the_fixtures_hold_the_difficult_cases() -> None:
    """Pixels without depth and labels, poses between stamps, and log times that differ from the stamps."""
    recording = record()
    assert (recording.depth == 0).any()
    assert (recording.labels == UNLABELLED).any()
    assert set(np.unique(recording.labels)) == {*room.NAMES, UNLABELLED}
    assert not np.isin(recording.stamps_ns, recording.base.stamps_ns).any()
    assert (recording.stamps_ns % SECOND != 0).all()
    with open_log(CONTAINERS / REFERENCE) as log:
        assert all(m.log_time_ns != m.header_stamp_ns() for m in log.messages([DEPTH]))
