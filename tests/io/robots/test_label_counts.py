"""Histograms of raw labels, and class tables that do not fit a log's labels."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.class_file import class_table
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.logs import open_log
from octoreplay.io.robots.describe import describe
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.label_counts import RawLabel, count_labels
from octoreplay.io.robots.robot_log import RobotLog
from support.log_factory import (
    HEIGHT,
    SECOND,
    WIDTH,
    Entry,
    label_pixels,
    robot_entries,
    ros2,
    write_mcap,
)

LABELS = "/camera/labels/image_raw"
TABLE = class_table([{"name": name, "raw_labels": [raw]} for raw, name in ((1, "ground"), (2, "tree"))])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "robot.mcap", robot_entries())


def counted(log: Path, table=TABLE, number: int = 32, **fields):
    robot = RobotConfig("robot", (log,), **{"depth_topic": "/camera/depth/image_raw", "label_topic": LABELS, **fields})
    with open_log(log) as reader:
        return count_labels(robot, [reader], table, number)


def test_the_histogram_counts_every_raw_label(log: Path) -> None:
    found = counted(log)
    values, numbers = np.unique([label_pixels(index) for index in range(6)], return_counts=True)
    assert {label.raw: label.number for label in found.labels} == dict(zip(map(str, values), numbers, strict=True))
    assert {label.raw: label.class_name for label in found.labels} == {"1": "ground", "2": "tree", "7": None, "255": ""}
    assert (found.num_read, found.num_messages) == (6, 6)
    assert found.num_unknown == found.num_known / 2
    assert "have labels without a class: 7; --classes" in found.warning


def test_a_sample_is_spread_over_the_log(tmp_path: Path) -> None:
    entries = robot_entries(num_frames=40)
    for number, entry in enumerate(e for e in entries if e.topic == LABELS):
        entry.value.data = np.full(WIDTH * HEIGHT, number, np.uint8)
    found = counted(write_mcap(tmp_path / "robot.mcap", entries), number=8)
    assert [int(label.raw) for label in found.labels] == [0, 5, 10, 15, 20, 25, 30, 35]
    assert (found.num_read, found.num_messages) == (8, 40)


def test_colours_are_rows_too(tmp_path: Path) -> None:
    colors = np.array([(10, 20, 30), (200, 100, 50), (1, 2, 3)], np.uint8)
    pixels = colors[np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 4 % 3]
    entries = [e for e in robot_entries(num_frames=2) if e.topic != LABELS]
    entries.append(Entry(LABELS, "sensor_msgs/msg/Image", ros2.image(101 * SECOND, pixels, "rgb8"), 101 * SECOND))
    table = class_table([{"name": "wall", "color": [10, 20, 30]}, {"name": "door", "color": [200, 100, 50]}])
    found = counted(write_mcap(tmp_path / "robot.mcap", entries), table)
    assert found.labels == (
        RawLabel("#0a141e", 48, "wall"), RawLabel("#010203", 24, None), RawLabel("#c86432", 24, "door")
    )  # fmt: skip


def test_labels_of_points_are_counted(tmp_path: Path) -> None:
    columns = {name: np.arange(1, 9, dtype=np.float32) for name in "xyz"}
    columns["label"] = np.array([1, 1, 1, 2, 9, 9, 70000, 2], np.uint32)
    cloud = Entry("/points", "sensor_msgs/msg/PointCloud2", ros2.cloud(100 * SECOND, columns), 100 * SECOND)
    found = counted(
        write_mcap(tmp_path / "robot.mcap", [cloud]), depth_topic=None, label_topic=None, cloud_topic="/points"
    )
    assert {label.raw: label.class_name for label in found.labels} == {
        "1": "ground", "2": "tree", "9": None, "70000": None
    }  # fmt: skip


def test_a_run_of_labels_without_classes_is_refused(log: Path) -> None:
    other = class_table([{"name": "sky", "raw_labels": [40]}])
    config = RunConfig((RobotConfig("robot", (log,)),), classes=other)
    (robot,) = resolve(config).robots
    with pytest.raises(
        InputError, match=f"fewer than 1 % of the labelled pixels or points of '{LABELS}'.* 1, 7, 2|2, 7"
    ):
        RobotLog(robot, TimeConfig(), other)
    # A class of one label in a hundred is enough, and ignored labels do not count.
    RobotLog(robot, TimeConfig(), class_table([{"name": "sky", "raw_labels": [7]}])).close()
    ignored = dataclasses.replace(other, ignored_raw_labels=(1, 2, 7))
    RobotLog(robot, TimeConfig(), ignored).close()


def test_a_depth_image_in_place_of_labels_is_refused(log: Path) -> None:
    robot = RobotConfig("robot", (log,), label_topic="/camera/depth/image_raw")
    config = resolve(RunConfig((robot,), classes=TABLE))
    with pytest.raises(InputError, match="name the right label_topic"):
        RobotLog(config.robots[0], TimeConfig(), TABLE)


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        (
            ((2, "ground"), (1, "tree"), (7, "wall")),
            "raw label 1 is 'tree' in the table and 'ground' in the log, and 1 more",
        ),
        (((1, "sky"), (2, "sea")), "raw label 1 is 'sky' in the table and 'ground' in the log, and 1 more"),
        (((1, "Ground"), (2, "TREE")), None),
        (((1, "ground"), (2, "plant"), (7, "built")), None),
    ],
    ids=["swapped", "other names", "other case", "renamed"],
)
def test_a_table_that_contradicts_the_label_info_is_reported(log: Path, rows, sentence: str | None) -> None:
    table = class_table([{"name": name, "raw_labels": [raw]} for raw, name in rows])
    warnings = resolve(RunConfig((RobotConfig("robot", (log,)),), classes=table)).warnings
    if sentence is None:
        assert warnings == ()
    else:
        assert sentence in warnings[0]
    assert [w for w in describe([log], classes=table).warnings if "contradicts" in w] == list(warnings)


def test_a_description_has_the_histogram_and_what_a_run_refuses(log: Path) -> None:
    description = describe([log])
    assert [label.class_name for label in description.labels[0].labels] == ["ground", "tree", "wall", ""]
    assert description.is_ready
    description = describe([log], classes=class_table([{"name": "sky", "raw_labels": [40]}]))
    assert not description.is_ready
    assert "fewer than 1 %" in description.robots[0].missing[0]
