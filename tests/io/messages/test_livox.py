from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.time import TimeConfig
from octoreplay.io.messages.decoders import DamagedMessageError, UndefinedTypeError
from octoreplay.io.messages.livox import TYPES, check_definition
from octoreplay.io.messages.sensor_messages import Cloud
from octoreplay.io.robots.discover import discover
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.clouds import decode_cloud
from support.livox_logs import MESSAGE, POINT, livox_row
from support.log_damage import MUTATIONS
from support.log_factory import SECOND, robot_entries, ros_row, write_rows
from support.long_suite import examples

HERE = "a.mcap: topic '/livox/lidar' at 1.000 s"
POINTS = [(1.0, 2.0, 3.0), (0.0, 0.0, 0.0), (-4.5, 0.25, 1e-3)]


@examples(60)
@given(
    st.lists(st.tuples(*[st.floats(-100, 100, width=32)] * 3), max_size=9), st.text("abc_/é", max_size=13),
    st.sampled_from(["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"]), st.booleans(),
)  # fmt: skip
def test_custom_messages_of_both_ros_versions_are_decoded(points, frame_id, package, ros1):
    message = livox_row("/l", points, 7 * SECOND + 5, package=package, ros1=ros1, frame_id=frame_id).message()
    assert message.header_stamp_ns() == 7 * SECOND + 5
    cloud = message.sensor_message()
    assert isinstance(cloud, Cloud)
    assert (cloud.stamp_ns, cloud.frame_id) == (7 * SECOND + 5, frame_id)
    expected = np.array(points, np.float32).reshape(-1, 3)
    np.testing.assert_array_equal(decode_cloud(cloud, HERE).points, expected[expected.any(axis=1)])
    found = decode_cloud(cloud, HERE, wants_times=True)
    np.testing.assert_array_equal(found.times, 10_000 * np.arange(len(points))[expected.any(axis=1)])


@pytest.mark.parametrize("ros1", [False, True])
def test_damaged_messages_are_refused_or_within_their_bytes(ros1):
    row, rng = livox_row("/l", POINTS, SECOND, ros1=ros1), random.Random(5)
    outcomes = set()
    for _ in range(1500):
        data = rng.choice(MUTATIONS)(row.data, rng)
        try:
            cloud = row._replace(data=data).message().sensor_message()
            decode_cloud(cloud, HERE)
        except DamagedMessageError:
            outcomes.add("damaged")
        else:
            outcomes.add("read")
    assert outcomes == {"damaged", "read"}
    for length in range(len(row.data)):
        with pytest.raises(DamagedMessageError):
            row._replace(data=row.data[:length]).message().sensor_message()


def test_a_number_of_points_beyond_the_bytes_is_refused():
    row = livox_row("/l", POINTS, SECOND, ros1=True)
    count_at = len(row.data) - 19 * len(POINTS) - 4
    many = row.data[:count_at] + b"\xff\xff\xff\xff" + row.data[count_at + 4 :]
    with pytest.raises(DamagedMessageError, match="damaged livox_ros_driver2/msg/CustomMsg"):
        row._replace(data=many).message().sensor_message()


def test_other_fields_than_livox_s_are_refused():
    row = livox_row("/l", POINTS, SECOND)
    for old, new in ((b"uint8 tag", b"uint16 tag"), (b"uint64 timebase", b"uint32 timebase")):
        assert old in row.schema
        changed = row._replace(schema=row.schema.replace(old, new))
        with pytest.raises(UndefinedTypeError, match="'livox_ros_driver2/msg/CustomMsg' cannot be parsed"):
            changed.message().decode()
    empty = row._replace(schema=b"")
    assert empty.message().sensor_message().height == 3
    check_definition(MESSAGE.format(header="Header") + "=" * 80 + "\nMSG: livox_ros_driver/CustomPoint\n" + POINT)
    assert {row.schema_name for row in (livox_row("/l", [], 0, package=name.split("/")[0]) for name in TYPES)} == {
        *TYPES
    }


def test_a_livox_log_becomes_frames(tmp_path):
    rest = [ros_row(entry) for entry in robot_entries(labels=False) if "camera/" not in entry.topic]
    clouds = [livox_row("/livox/lidar", POINTS, 100 * SECOND + i * SECOND // 4, frame_id="camera") for i in range(5)]
    path = write_rows(tmp_path / "r.mcap", sorted([*rest, *clouds], key=lambda row: row.log_time_ns))
    (robot,) = discover([path])
    assert robot.cloud_topic == "/livox/lidar"
    with RobotLog(robot, TimeConfig(), None) as log:
        frames = list(log.frames())
    assert [frame.points.tolist() for frame in frames] == [np.float32([POINTS[0], POINTS[2]]).tolist()] * 5
