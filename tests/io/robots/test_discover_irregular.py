"""Logs with damaged and contradictory messages are described or refused with an error of the package."""

from __future__ import annotations

import json

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import OctoreplayError
from octoreplay.io.messages.sensor_messages import Kind, kind_of
from octoreplay.io.robots.describe import LogDescription, describe
from octoreplay.io.robots.discover import discover, resolve
from support.discovered_logs import (
    DEPTH,
    INFO,
    LABELS,
    START,
    count_frames,
    foxglove_rows,
    run_of,
)
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    HEIGHT,
    IDENTITY,
    WIDTH,
    Entry,
    Row,
    robot_entries,
    ros2,
    ros_row,
    write_mcap,
    write_rows,
)  # fmt: skip


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
