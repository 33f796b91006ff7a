from __future__ import annotations

import random
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer

from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Cloud
from octoreplay.io.messages.velodyne import MAX_PACKETS, cloud_of
from octoreplay.io.robots.discover import discover
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.sensors.clouds import decode_cloud
from octoreplay.odometry.scans import times_after
from support.command_line import assert_fails
from support.log_damage import MUTATIONS
from support.log_factory import SECOND, Entry, Factory, Row, ros1_row, ros2, ros_row, write_rows
from support.log_factory import robot_entries as entries_of_a_robot
from support.long_suite import long
from support.velodyne_logs import (
    ELEVATIONS,
    OFFSETS,
    PACKET,
    SCAN,
    packets_of,
    rays_of_a_turn,
    velodyne_row,
    velodyne_types,
    vlp16_packets,
)

HERE = "a.mcap: topic '/v' at 100.000 s"
START = 100 * SECOND
WALL = 6.0
FULL_TURN = 76
COMMAND = re.escape("pip install 'octoreplay[velodyne]'")


def wall(rays: np.ndarray) -> np.ndarray:
    """Distances along rays to the plane x = WALL; infinite beside it."""
    ahead = rays[:, 0] > 0.2
    return np.where(ahead, WALL / np.where(ahead, rays[:, 0], 1.0), np.inf)


PACKETS = packets_of(wall, FULL_TURN)


def decoded(row: Row) -> Cloud:
    """The cloud of a scan."""
    cloud = row.message().sensor_message()
    assert isinstance(cloud, Cloud)
    return cloud


def column(cloud: Cloud, name: str, kind: str) -> np.ndarray:
    """One field of all points of a cloud."""
    [field] = [field for field in cloud.fields if field.name == name]
    assert field.kind == kind
    return np.ndarray(cloud.width, f"<{kind}", cloud.data, field.offset, cloud.point_step)


def robot_log(path: Path, clouds: list[Row], *, ros1: bool = False) -> Path:
    """A robot's log with its poses, and clouds in place of its camera."""
    entries = entries_of_a_robot(labels=False, factory=Factory(ros1=ros1))
    rest = [(ros1_row if ros1 else ros_row)(entry) for entry in entries if "camera/" not in entry.topic]
    rows = sorted([*rest, *clouds], key=lambda row: row.log_time_ns)
    if not ros1:
        return write_rows(path, rows)
    with Writer(path) as writer:
        connections = {}
        for row in rows:
            if row.topic not in connections:
                connections[row.topic] = writer.add_connection(
                    row.topic, row.schema_name, typestore=velodyne_types(ros1=True)
                )
            writer.write(connections[row.topic], row.log_time_ns, row.data)
    return path


@pytest.mark.parametrize("ros1", [False, True])
def test_points_lie_on_the_wall_with_ring_intensity_and_time(ros1):
    cloud = decoded(velodyne_row("/v", PACKETS, START, ros1=ros1, frame_id="top"))
    assert (cloud.stamp_ns, cloud.frame_id) == (START, "top")
    found = decode_cloud(cloud, HERE, wants_times=True)
    rays = rays_of_a_turn(FULL_TURN).reshape(-1, 3)
    hits = np.isfinite(wall(rays)) & (wall(rays) < 100.0)
    assert len(found.points) == hits.sum() > 10_000
    expected = (rays * wall(rays)[:, None])[hits]
    expected[:, 2] += np.tile(OFFSETS, FULL_TURN * 24)[hits]
    # Azimuths are in hundredths of a degree, and ranges up to 33 m in steps of 2 mm.
    np.testing.assert_allclose(found.points[:, 0], WALL, rtol=0, atol=0.01)
    np.testing.assert_allclose(found.points, expected, rtol=0, atol=0.015)
    ranks = np.argsort(np.argsort(ELEVATIONS))
    np.testing.assert_array_equal(column(cloud, "ring", "u1"), np.tile(ranks, FULL_TURN * 24)[hits])
    assert set(column(cloud, "intensity", "f4")) == {40.0}
    times = times_after(found.times, START)
    assert times is not None
    # The turn takes 0.1 s and ends with the packet of the header's stamp, which takes 1.3 ms.
    assert -0.1 < times.min() < -0.09
    assert 0.0012 < times.max() < 0.0014


def test_times_count_from_the_packet_with_the_stamp_of_the_header_also_at_a_full_hour():
    first = decode_cloud(decoded(velodyne_row("/v", PACKETS, START, stamped_first=True)), HERE, wants_times=True)
    assert 0.0 <= first.times.min() < 1e-4
    assert first.times.max() == pytest.approx(0.1, abs=2e-3)
    rays = rays_of_a_turn(FULL_TURN)
    distances = wall(rays.reshape(-1, 3)).reshape(rays.shape[:-1])
    late = vlp16_packets(np.where(distances < 100, distances, 0.0), first_us=3_600_000_000 - 50_000)
    found = decode_cloud(decoded(velodyne_row("/v", late, START, stamped_first=True)), HERE, wants_times=True)
    np.testing.assert_allclose(found.times, first.times, rtol=0, atol=2e-6)


def test_a_log_without_definitions_is_decoded():
    row = velodyne_row("/v", PACKETS[:3], START)
    assert decoded(row._replace(schema=b"")).data == decoded(row).data


@pytest.mark.parametrize("ros1", [False, True])
def test_a_velodyne_log_becomes_frames(tmp_path, ros1):
    clouds = [
        velodyne_row("/velodyne_packets", PACKETS, START + i * SECOND // 4, ros1=ros1, frame_id="camera")
        for i in range(5)
    ]
    # A scan of random bytes is counted as damaged.
    noise = random.Random(2).randbytes(1206)
    clouds.append(velodyne_row("/velodyne_packets", [noise], START + SECOND // 8, ros1=ros1, frame_id="camera"))
    (robot,) = discover([robot_log(tmp_path / ("r.bag" if ros1 else "r.mcap"), clouds, ros1=ros1)])
    assert robot.cloud_topic == "/velodyne_packets"
    with RobotLog(robot, TimeConfig(), None) as log:
        frames = list(log.frames())
        counts = log.counts
    assert len(frames) == 5
    assert counts.undecodable == 1
    for frame in frames:
        np.testing.assert_allclose(frame.points[:, 0], WALL, rtol=0, atol=0.01)


def test_point_clouds_of_a_driver_are_preferred_to_packets(tmp_path):
    row = velodyne_row("/velodyne_packets", PACKETS[:4], START, frame_id="camera")
    ones = dict.fromkeys("xyz", np.ones(3, np.float32))
    points = Entry("/velodyne_points", "sensor_msgs/msg/PointCloud2", ros2.cloud(START, ones, frame_id="camera"), START)
    (robot,) = discover([robot_log(tmp_path / "r.mcap", [row, ros_row(points)])])
    assert robot.cloud_topic == "/velodyne_points"


@pytest.mark.parametrize(
    ("packets", "reason"),
    [
        ([], "0 packets; 1 to 10000 are expected"),
        ([bytes(1206)], "a packet without the blocks of a Velodyne lidar"),
        ([PACKETS[0][:2] + b"\xff\xff" + PACKETS[0][4:]], "a packet without the blocks of a Velodyne lidar"),
        ([PACKETS[0], PACKETS[1][:-1] + b"\x24"], "packets of 2 models"),
        ([PACKETS[0][:-2] + b"\x07\x22"], "a packet with an unknown return mode"),
    ],
)  # fmt: skip
def test_damaged_packets_are_refused(packets, reason):
    with pytest.raises(DamagedMessageError) as caught:
        decoded(velodyne_row("/v", packets, START))
    assert str(caught.value) == f"{HERE}: damaged {SCAN}: {reason}"


def test_the_number_of_packets_is_checked_first():
    with pytest.raises(DamagedMessageError, match="10001 packets; 1 to 10000 are expected"):
        cloud_of(SimpleNamespace(packets=[None] * (MAX_PACKETS + 1)))


def test_packets_of_another_length_are_refused():
    row = velodyne_row("/v", PACKETS[:1], START)
    short = row.data[: -1206 - 1] + bytes(1)
    assert b"uint8[1206] data" in row.schema
    other = row._replace(schema=row.schema.replace(b"uint8[1206] data", b"uint8[1205] data"), data=short + bytes(1205))
    with pytest.raises(DamagedMessageError, match="a packet of 1205 bytes; 1206 are expected"):
        decoded(other)


@pytest.mark.parametrize("ros1", [False, True])
def test_cut_and_altered_messages_are_refused_or_decoded(ros1):
    row, rng = velodyne_row("/v", PACKETS[10:13], START, ros1=ros1), random.Random(5)
    outcomes = set()
    for _ in range(150):
        data = rng.choice(MUTATIONS)(row.data, rng)
        try:
            decode_cloud(decoded(row._replace(data=data)), HERE, wants_times=True)
        except DamagedMessageError:
            outcomes.add("damaged")
        except InputError as error:
            assert "not supported" in str(error)  # noqa: PT017 - one of several outcomes
        else:
            outcomes.add("decoded")
    assert outcomes == {"damaged", "decoded"}
    for length in range(0, len(row.data), 61):
        with pytest.raises(DamagedMessageError):
            decoded(row._replace(data=row.data[:length]))


def test_the_lidars_that_need_a_calibration_or_a_choice_are_refused_with_the_remedy(tmp_path):
    upper, lower = b"\xff\xee" + bytes(98), b"\xff\xdd" + bytes(98)
    hdl64 = velodyne_row("/v", [(upper + lower) * 6 + bytes(6)] * 2, START)
    with pytest.raises(InputError) as caught:
        discover([robot_log(tmp_path / "r.mcap", [hdl64])])
    path = tmp_path / "r.mcap"
    assert str(caught.value) == (
        f"{path}: no depth image, point cloud or laser scan to map; no message of '/v' can be decoded: {path}: topic "
        f"'/v' at 100.000 s: the packets are those of an HDL-64E, which needs the sensor's own calibration; "
        "play the log into the driver velodyne_pointcloud, and record its point clouds together with the other topics"
    )
    with pytest.raises(InputError, match=r"name the lidar model 0x23, which is not supported; play the log"):
        decoded(velodyne_row("/v", vlp16_packets(np.ones((2, 24, 16)), model=0x23), START))


def test_a_missing_package_is_named_where_packets_are_the_only_sensor(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    row = velodyne_row("/velodyne_packets", PACKETS[:4], START, frame_id="camera")
    with pytest.raises(ConfigError, match=COMMAND):
        discover([robot_log(tmp_path / "packets.mcap", [row])])
    ones = dict.fromkeys("xyz", np.ones(3, np.float32))
    points = Entry("/velodyne_points", "sensor_msgs/msg/PointCloud2", ros2.cloud(START, ones, frame_id="camera"), START)
    (robot,) = discover([robot_log(tmp_path / "both.mcap", [row, ros_row(points)])])
    assert robot.cloud_topic == "/velodyne_points"


@long
@pytest.mark.parametrize(("command", "output"), [("run", "x.mcap"), ("odometry", "x.tum")])
def test_commands_end_with_exit_code_2_without_the_package(tmp_path, monkeypatch, command, output):
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    path = robot_log(tmp_path / "r.mcap", [velodyne_row("/velodyne_packets", PACKETS[:4], START, frame_id="camera")])
    assert_fails(2, COMMAND, command, path, "-o", tmp_path / output)
    assert not (tmp_path / output).exists()


def test_the_definition_that_is_built_in_is_that_of_the_driver():
    fields = velodyne_types(ros1=False).fielddefs
    built_in = ros2.store.fielddefs
    assert [built_in[name] for name in (SCAN, PACKET)] == [fields[name] for name in (SCAN, PACKET)]
