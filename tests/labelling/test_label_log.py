"""Labelled logs: their labels, what they copy, interrupted labellings, and logs that are refused."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from octoreplay.config.class_file import named_class_table
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.robots.discover import discover
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.labelling.finished_frames import FinishedFrames, unfinished_path
from octoreplay.labelling.label_log import LabelOptions, LabelSummary, label_log
from octoreplay.labelling.streams import StreamOptions
from octoreplay.records import ClassTable
from support.colour_logs import CLASSES, colour_entries, coloured_robot, in_time, static_transform, true_labels
from support.log_factory import (
    HEIGHT,
    SECOND,
    WIDTH,
    Entry,
    Factory,
    depth_pixels,
    robot_entries,
    ros2,
    write_bag,
    write_mcap,
    write_rosbag2,
)
from support.networks import COLORS, nearest_color_network
from support.stored_messages import pixels, read_messages, stamp_ns

DEPTH = "/camera/depth/image_raw"


class Room:
    """A folder with a network and its class table."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.network = nearest_color_network(folder / "net.onnx")
        (folder / "classes.yaml").write_text(CLASSES)
        self.output = folder / "robot.labelled.mcap"

    @property
    def classes(self) -> ClassTable:
        return named_class_table(str(self.folder / "classes.yaml"))

    def log(self, entries: list[Entry]) -> Path:
        return write_mcap(self.folder / "robot.mcap", entries)

    def label(self, log: Path, output: Path | None = None, **options) -> LabelSummary:
        resume = options.pop("resume", False)
        progress = options.pop("progress", None)
        label_options = LabelOptions(StreamOptions(**options.pop("streams", {})), **options)
        return label_log(
            log, output or self.output, self.network, self.classes, label_options, resume=resume, progress=progress
        )

    def files(self) -> set[str]:
        """Names of visible files without those that a test has made."""
        made = {"net.onnx", "classes.yaml", "robot.mcap", "robot.bag", "robot"}
        return {path.name for path in self.folder.iterdir() if not path.name.startswith(".")} - made


@pytest.fixture
def room(tmp_path: Path) -> Room:
    return Room(tmp_path)


def test_depth_images_get_the_labels_of_the_colour_images_that_they_are_registered_to(room: Room) -> None:
    summary = room.label(room.log(coloured_robot()))
    found = read_messages(room.output)[f"{DEPTH}/labels"]
    assert [stamp_ns(image) for _, image in found] == [100 * SECOND + i * SECOND // 4 for i in range(6)]
    for index, (_, image) in enumerate(found):
        assert image.encoding == "mono8"
        assert np.array_equal(pixels(image), true_labels(index))
    assert summary.robots[0].num_labelled == 6
    assert summary.robots[0].alignment == "registered to the colour image"
    assert sum(summary.robots[0].classes.values()) == 6 * WIDTH * HEIGHT
    assert room.files() == {"robot.labelled.mcap"}


def test_a_labelled_log_alone_is_enough_for_a_run(room: Room) -> None:
    room.label(room.log(coloured_robot()))
    (robot,) = discover([room.output])
    assert robot.robot_id == "robot"
    assert (robot.label_topic, robot.confidence_topic) == (f"{DEPTH}/labels", f"{DEPTH}/label_confidence")
    with RobotLog(robot, TimeConfig(), room.classes) as log:
        frames = list(log.frames())
        assert not log.counts.lost_data
    assert len(frames) == 6
    for index, frame in enumerate(frames):
        assert np.array_equal(frame.class_image, true_labels(index) + 1)
        assert np.array_equal(frame.depth_image, depth_pixels(index))


def test_images_and_poses_are_copied_as_they_are_and_other_topics_left_out(room: Room) -> None:
    log = room.log(in_time(coloured_robot(), colour_entries(topic="/rear/image_raw", frame="rear")))
    room.label(log)

    def stored(path: Path) -> dict[str, list[tuple[int, bytes]]]:
        found: dict[str, list[tuple[int, bytes]]] = {}
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                found.setdefault(channel.topic, []).append((message.log_time, message.data))
        return found

    before, after = stored(log), stored(room.output)
    copied = {DEPTH, "/camera/depth/camera_info", "/odom", "/tf_static"}
    assert set(after) == copied | {f"{DEPTH}/{name}" for name in ("labels", "label_confidence", "label_info")}
    assert all(after[topic] == before[topic] for topic in copied)


@pytest.mark.parametrize("container", ["bag", "rosbag2"])
def test_other_containers_are_labelled_too(room: Room, container: str) -> None:
    if container == "bag":
        log = write_bag(room.folder / "robot.bag", coloured_robot(factory=Factory(ros1=True)))
    else:
        log = write_rosbag2(room.folder / "robot", coloured_robot())
    room.label(log)
    (robot,) = discover([room.output])
    with RobotLog(robot, TimeConfig(), room.classes) as found:
        frames = list(found.frames())
    assert len(frames) == 6
    assert all(np.array_equal(frame.class_image, true_labels(i) + 1) for i, frame in enumerate(frames))
    assert frames[-1].T_team_sensor[0, 3] == pytest.approx(1.25)


def test_labels_of_an_earlier_network_are_replaced(room: Room) -> None:
    log = room.log(in_time(robot_entries(), colour_entries()))
    room.label(log)
    (robot,) = discover([room.output])
    assert robot.label_topic == f"{DEPTH}/labels"
    assert robot.label_info_topic == f"{DEPTH}/label_info"


def test_depth_that_is_registered_to_colour_keeps_the_calibration_of_the_colour_camera(room: Room) -> None:
    entries = coloured_robot()
    registered = [entry._replace(topic="/camera/aligned/image") if entry.topic == DEPTH else entry for entry in entries]
    room.label(room.log(registered), streams={"sensor_topic": "/camera/aligned/image"})
    (robot,) = discover([room.output])
    assert robot.camera_info_topic == "/camera/color/camera_info"


def test_robots_that_share_a_log_are_all_labelled(room: Room) -> None:
    parts = [robot_entries(labels=False, namespace=name) for name in ("a", "b")]
    parts += [colour_entries(topic=f"/{name}/camera/color/image_raw", frame=f"{name}/camera") for name in "ab"]
    summary = room.label(room.log(in_time(*parts)))
    assert [(robot.robot_id, robot.num_labelled) for robot in summary.robots] == [("a", 6), ("b", 6)]
    assert [robot.label_topic for robot in discover([room.output])] == [f"/{name}{DEPTH}/labels" for name in "ab"]


def test_messages_without_stamps_are_refused(room: Room) -> None:
    entries = coloured_robot()
    for entry in entries:
        if entry.topic == DEPTH:
            entry.value.header.stamp.sec = entry.value.header.stamp.nanosec = 0
    with pytest.raises(InputError, match=f"those of '{DEPTH}' are missing"):
        room.label(room.log(entries))


def test_images_that_arrive_late_are_paired_by_their_stamps(room: Room) -> None:
    room.label(room.log(coloured_robot(delay_ns=3 * SECOND)))
    found = read_messages(room.output)[f"{DEPTH}/labels"]
    assert all(np.array_equal(pixels(image), true_labels(i)) for i, (_, image) in enumerate(found))


def test_sensor_messages_without_an_image_are_left_out_and_counted(room: Room) -> None:
    entries = robot_entries(labels=False)
    summary = room.label(room.log(in_time(entries, colour_entries(num_frames=4))))
    assert (summary.robots[0].num_labelled, summary.robots[0].num_without_image) == (4, 2)
    assert len(read_messages(room.output)[DEPTH]) == 4


def test_every_nth_message_is_labelled(room: Room) -> None:
    room.label(room.log(coloured_robot()), every=4)
    found = read_messages(room.output)[f"{DEPTH}/labels"]
    assert [pixels(image).tolist() for _, image in found] == [true_labels(i).tolist() for i in (0, 4)]


# --- cameras that differ ---------------------------------------------------------------------------------------------


def test_points_are_projected_into_the_image_of_another_camera(room: Room) -> None:
    entries = in_time(coloured_robot(frame="colour"), [static_transform("camera", "colour", (0.1, 0.0, 0.0))])
    summary = room.label(room.log(entries))
    assert summary.robots[0].alignment == "projected, extrinsics from static TF"
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for index, (_, image) in enumerate(read_messages(room.output)[f"{DEPTH}/labels"]):
        z = depth_pixels(index) / 1000.0
        # fx is 50 and the camera is 0.1 m to the right: pixels move by 5 / z to the left.
        column = np.floor(columns - 50 * 0.1 / z + 0.5).astype(int)
        expected = np.where(column >= 0, true_labels(index)[rows, np.maximum(column, 0)], 255)
        found = pixels(image)
        is_seen = found != 255
        assert np.array_equal(found[is_seen], expected[is_seen])
        assert is_seen.mean() > 0.5
        assert not is_seen[column < 0].any()


def test_given_extrinsics_replace_those_of_tf(room: Room) -> None:
    entries = in_time(coloured_robot(frame="colour"), [static_transform("camera", "colour", (0.1, 0.0, 0.0))])
    room.label(room.log(entries), streams={"T_sensor_colour": (0, 0, 0, 0, 0, 0, 1)})
    found = read_messages(room.output)[f"{DEPTH}/labels"]
    assert all(np.array_equal(pixels(image), true_labels(i)) for i, (_, image) in enumerate(found))


def cloud_entries(points: np.ndarray, colour_frame: str = "colour") -> list[Entry]:
    """Messages of a robot with a lidar that gives ``points`` (P, 3) and a colour camera ahead of it."""
    stamps = [100 * SECOND + i * SECOND // 4 for i in range(6)]
    columns = {name: points[:, axis].astype(np.float32) for axis, name in enumerate("xyz")}
    columns["intensity"] = np.ones(len(points), np.float32)
    clouds = [Entry("/points", "sensor_msgs/msg/PointCloud2", ros2.cloud(t, columns), t) for t in stamps]
    # The lidar's axes are those of the base: x forward. The camera looks along x.
    optical = (-0.5, 0.5, -0.5, 0.5)
    tf = ros2.tf(
        ("base_link", "lidar", stamps[0], (0, 0, 1), (0, 0, 0, 1)),
        ("base_link", colour_frame, stamps[0], (0.2, 0.0, 1.0), optical),
    )
    robot = coloured_robot(depth=False, frame="colour")
    robot = [entry for entry in robot if entry.topic != "/tf_static"]
    return in_time(robot, clouds, [Entry("/tf_static", "tf2_msgs/msg/TFMessage", tf, stamps[0])])


def test_points_of_a_lidar_get_labels_where_the_camera_sees_them(room: Room) -> None:
    rng = np.random.default_rng(8)
    ahead = np.column_stack([np.full(60, 4.0), rng.uniform(-0.4, 0.4, 60), rng.uniform(-0.25, 0.25, 60)])
    behind = ahead * [-1, 1, 1]
    points = np.vstack([ahead, behind])
    room.label(room.log(cloud_entries(points)))
    found = read_messages(room.output)["/points/labelled"]
    assert len(found) == 6
    for index, (_, cloud) in enumerate(found):
        table = np.frombuffer(
            cloud.data.tobytes(),
            [("xyz", "<f4", 3), ("label", "<u2"), ("label_confidence", "u1")],
        )
        assert [field.name for field in cloud.fields] == ["x", "y", "z", "label", "label_confidence"]
        assert np.allclose(table["xyz"], points, atol=1e-6)
        # In the camera x points right (-y of the base) and y down; it is 0.2 m ahead of the lidar.
        column = np.floor(50 * -points[:60, 1] / 3.8 + 5.5 + 0.5).astype(int)
        row = np.floor(60 * -points[:60, 2] / 3.8 + 3.5 + 0.5).astype(int)
        is_inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        assert is_inside.sum() > 40
        expected = np.where(is_inside, true_labels(index)[row.clip(0, HEIGHT - 1), column.clip(0, WIDTH - 1)], 65535)
        assert np.array_equal(table["label"][:60], expected)
        assert (table["label"][60:] == 65535).all()
        assert (table["label_confidence"][60:] == 0).all()
    (robot,) = discover([room.output])
    assert robot.cloud_topic == "/points/labelled"
    with RobotLog(robot, TimeConfig(), room.classes) as log:
        frames = list(log.frames())
    assert len(frames) == 6
    assert (frames[0].class_ids[60:] == 0).all()


# --- interrupted labellings ------------------------------------------------------------------------------------------


def interrupt_after(share: float):
    """A progress callback that interrupts the labelling."""

    def progress(done: float, _: str) -> None:
        if done >= share:
            raise KeyboardInterrupt

    return progress


def test_an_interrupted_labelling_continues_and_ends_with_the_same_bytes(room: Room) -> None:
    log = room.log(coloured_robot())
    whole = room.folder / "whole.mcap"
    room.label(log, whole)
    for share in (0.3, 0.8):
        with pytest.raises(KeyboardInterrupt):
            room.label(log, progress=interrupt_after(share), resume=share > 0.5)
        assert not room.output.exists()
    room.network.touch()
    summary = room.label(log, resume=True)
    assert summary.num_resumed == 5
    assert room.output.read_bytes() == whole.read_bytes()
    assert not unfinished_path(room.output).exists()


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_a_damaged_record_and_those_behind_it_are_labelled_again(room: Room, damage: str) -> None:
    log = room.log(coloured_robot())
    whole = room.folder / "whole.mcap"
    room.label(log, whole)
    with pytest.raises(KeyboardInterrupt):
        room.label(log, progress=interrupt_after(0.8))
    path = unfinished_path(room.output)
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[-20] ^= 1
    path.write_bytes(data[:-10] if damage == "cut" else data)
    assert room.label(log, resume=True).num_resumed == 4
    assert room.output.read_bytes() == whole.read_bytes()


def test_a_record_that_decompresses_to_another_size_is_refused(tmp_path: Path) -> None:
    output = tmp_path / "x.mcap"
    bomb = struct.pack("<IIQQ?", 0, 0, 4, 4, False) + zlib.compress(bytes(1 << 20))
    with FinishedFrames(output, "", continues=False) as finished:
        finished._add(bomb)
        with pytest.raises(InputError, match="is damaged; begin anew with --restart"):
            finished.get(0, 0)


def test_finished_labels_of_other_settings_are_refused(room: Room) -> None:
    log = room.log(coloured_robot())
    with pytest.raises(KeyboardInterrupt):
        room.label(log, progress=interrupt_after(0.5))
    nearest_color_network(room.network, colors=COLORS[::-1])
    with pytest.raises(ConfigError, match=r"robot\.labelled\.labels: was made with another log, model"):
        room.label(log, resume=True)


# --- logs that are refused -------------------------------------------------------------------------------------------


def without(entries: list[Entry], part: str) -> list[Entry]:
    """Messages of topics whose name does not contain a text."""
    return [entry for entry in entries if part not in entry.topic]


REFUSED = {
    "no colour images": (robot_entries(labels=False), {}, "robot 'robot' has no colour images to label"),
    "no sensor": (
        without(coloured_robot(), "depth"), {}, "no depth image, point cloud or laser scan.*--sensor-topic names one"
    ),
    "no common time": (
        coloured_robot(start_ns=900 * SECOND), {},
        "no sensor message has a colour image within 0.05 s: .* are from 100.000 s to 101.250 s; those of .*--pair-tol",
    ),
    "no extrinsics": (
        coloured_robot(frame="colour"), {}, "no transform from 'camera' to 'colour'.*give --extrinsics"
    ),
    "no intrinsics": (
        coloured_robot(frame="colour", camera_info=False), {},
        "no CameraInfo for '/camera/color/image_raw'; give --colour-intrinsics",
    ),
    "two cameras": (
        in_time(coloured_robot(), colour_entries(topic="/camera/left/image_raw")), {}, "has 2 colour topics"
    ),
    "wrong colour topic": (
        coloured_robot(), {"colour_topic": "/odom"},
        "topic '/odom' holds no colour images; there are '/camera/color/image_raw'",
    ),
    "wrong sensor topic": (
        coloured_robot(), {"sensor_topic": "/nothing"}, "topic '/nothing' holds no depth images or clouds"
    ),
    "no common view": (
        in_time(coloured_robot(frame="colour"), [static_transform("camera", "colour", (0, 0, 50.0))]), {},
        "no point of '/camera/depth/image_raw' is in an image of '/camera/color/image_raw'.*check the extrinsics",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("entries", "streams", "sentence"), REFUSED.values(), ids=REFUSED)
def test_a_log_that_cannot_be_labelled_is_refused_and_nothing_is_written(
    room: Room, entries: list[Entry], streams: dict, sentence: str
) -> None:
    with pytest.raises((InputError, ConfigError), match=sentence):
        room.label(room.log(entries), streams=streams)
    assert room.files() == set()


def test_given_intrinsics_stand_for_a_missing_camera_info(room: Room) -> None:
    entries = in_time(
        coloured_robot(frame="colour", camera_info=False), [static_transform("camera", "colour", (0.0, 0.0, 0.0))]
    )
    room.label(room.log(entries), streams={"colour_intrinsics": (50.0, 60.0, 5.5, 3.5)})
    found = read_messages(room.output)[f"{DEPTH}/labels"]
    assert all(np.array_equal(pixels(image), true_labels(i)) for i, (_, image) in enumerate(found))


def test_aligned_images_need_no_transform(room: Room) -> None:
    room.label(room.log(coloured_robot(frame="colour", camera_info=False)), streams={"is_aligned": True})
    found = read_messages(room.output)[f"{DEPTH}/labels"]
    assert all(np.array_equal(pixels(image), true_labels(i)) for i, (_, image) in enumerate(found))


def test_damaged_images_are_counted_and_left_out(room: Room) -> None:
    entries = coloured_robot()
    bad = next(
        entry for entry in entries if entry.topic == "/camera/color/image_raw" and entry.log_time_ns > 100 * SECOND
    )
    bad.value.data = bad.value.data[:50]
    summary = room.label(room.log(entries))
    assert (summary.robots[0].num_labelled, summary.robots[0].num_undecodable) == (5, 1)
    assert len(read_messages(room.output)[DEPTH]) == 5
