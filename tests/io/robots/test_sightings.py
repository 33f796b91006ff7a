"""Position fixes and tags of robots' logs: discovery, reading, and what is left out."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.messages.sensor_messages import Kind, convert, kind_of
from octoreplay.io.robots.discover import discover, resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.sightings import read_sightings
from support.discovered_logs import START, run_of
from support.log_factory import (
    IDENTITY,
    SECOND,
    TAG,
    Entry,
    Factory,
    foxglove_row,
    foxglove_stamp,
    robot_entries,
    ros2,
    ros_row,
    write_bag,
    write_mcap,
    write_rosbag2,
    write_rows,
)

FIX, TF = "sensor_msgs/msg/NavSatFix", "tf2_msgs/msg/TFMessage"
PLACE = (48.0, 11.0, 500.0)
STAMPS = [START + i * SECOND // 4 for i in range(6)]


def fix_entries(*, topic="/fix", factory=ros2, stamps=STAMPS, **fields) -> list[Entry]:
    """Fixes to the north of a place, at the stamps of the robot's frames."""
    return [
        Entry(topic, FIX, factory.fix(s, (PLACE[0] + i / 1000, *PLACE[1:]), **fields), s) for i, s in enumerate(stamps)
    ]


def in_order(*groups: list[Entry]) -> list[Entry]:
    return sorted((entry for group in groups for entry in group), key=lambda entry: entry.log_time_ns)


def sightings(robot, time=None):
    time = time or TimeConfig()
    with RobotLog(robot, time, None) as log:
        return read_sightings(log, time)


def found_in(path, time=None):
    (robot,) = discover([path])
    return sightings(robot, time)


@pytest.mark.parametrize("container", ["mcap", "sqlite3", "bag"])
def test_fixes_have_the_antennas_position_in_the_map_frame(tmp_path, container):
    factory = Factory(ros1=container == "bag")
    mount = Entry("/tf_static", TF, factory.tf(("base_link", "gps", START, (0.0, 0.3, 1.2), IDENTITY)), START)
    entries = in_order([mount], robot_entries(factory=factory), fix_entries(factory=factory, frame_id="gps", sigma=0.5))
    write = {"mcap": write_mcap, "sqlite3": write_rosbag2, "bag": write_bag}[container]
    path = write(tmp_path / f"rover{'.bag' if container == 'bag' else '.mcap'}", entries)
    fixes = found_in(path).fixes
    np.testing.assert_allclose(fixes.points_map, [(i / 4, 0.3, 1.2) for i in range(6)], atol=1e-9)
    np.testing.assert_allclose(fixes.geodetic, [(48 + i / 1000, 11.0, 500.0) for i in range(6)])
    np.testing.assert_allclose(fixes.sigmas, [(0.5, 1.0)] * 6)
    np.testing.assert_allclose(fixes.seconds, np.arange(6) / 4)


@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "json"])
def test_foxglove_fixes(tmp_path, encoding):
    fields = {
        "timestamp": foxglove_stamp(STAMPS[2]), "frame_id": "elsewhere", "latitude": 48.0, "longitude": 11.0,
        "altitude": 500.0, "position_covariance": [4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0],
    }  # fmt: skip
    kind = 2
    if encoding == "protobuf":
        import foxglove.messages

        kind = foxglove.messages.LocationFixPositionCovarianceType.DiagonalKnown
    row = foxglove_row("/gps", "LocationFix", {**fields, "position_covariance_type": kind}, STAMPS[2], encoding)
    path = write_rows(tmp_path / "rover.mcap", [*map(ros_row, robot_entries()), row])
    fixes = found_in(path).fixes
    # The sensor stands for an antenna that TF does not place.
    np.testing.assert_allclose(fixes.points_map, [(0.5, 0.0, 0.5)], atol=1e-9)
    assert fixes.geodetic.tolist() == [[48.0, 11.0, 500.0]]
    assert fixes.sigmas.tolist() == [[2.0, 3.0]]


def test_invalid_fixes_are_left_out(tmp_path):
    bad = [
        ros2.fix(STAMPS[0], PLACE, status=-1), ros2.fix(STAMPS[1], (math.nan, 11.0, 500.0)),
        ros2.fix(STAMPS[2], (48.0, 11.0, math.nan)), ros2.fix(STAMPS[3], (0.0, 0.0, 0.0)),
        ros2.fix(STAMPS[4], (91.0, 11.0, 500.0)),
    ]  # fmt: skip
    entries = [Entry("/fix", FIX, value, stamp) for value, stamp in zip(bad, STAMPS, strict=False)]
    seen = found_in(write_mcap(tmp_path / "bad.mcap", in_order(robot_entries(), entries)))
    assert len(seen.fixes) == 0
    (note,) = seen.notes
    assert note.startswith("none of the 5 position fixes of bad on '/fix' are valid: they have no fix, NaN, or")
    good = Entry("/fix", FIX, ros2.fix(STAMPS[5], PLACE, sigma=None), STAMPS[5])
    seen = found_in(write_mcap(tmp_path / "good.mcap", in_order(robot_entries(), entries, [good])))
    assert len(seen.fixes) == 1
    assert np.isnan(seen.fixes.sigmas).all()
    assert seen.notes == ()


def test_fixes_without_a_pose_and_outside_the_span_are_left_out(tmp_path):
    late = [stamp + 3600 * SECOND for stamp in STAMPS]
    path = write_mcap(tmp_path / "late.mcap", in_order(robot_entries(), fix_entries(stamps=late)))
    seen = found_in(path)
    assert len(seen.fixes) == 0
    assert seen.notes == ("none of the 6 position fixes of late on '/fix' have a pose at their time",)
    path = write_mcap(tmp_path / "all.mcap", in_order(robot_entries(), fix_entries()))
    assert len(found_in(path, TimeConfig(start=0.25, duration=0.75)).fixes) == 3
    assert len(found_in(path, TimeConfig(every=3)).fixes) == 6


def test_log_time_replaces_the_stamps_of_fixes_as_it_does_those_of_poses(tmp_path):
    odd = [entry._replace(log_time_ns=s) for s, entry in zip(STAMPS, fix_entries(stamps=[5] * 6), strict=True)]
    path = write_mcap(tmp_path / "r.mcap", in_order(robot_entries(), odd))
    assert len(found_in(path).fixes) == 0
    assert len(found_in(path, TimeConfig(clock="log")).fixes) == 6


def test_topics_are_found_named_and_disabled(tmp_path):
    entries = in_order(
        robot_entries(), fix_entries(topic="/gps/filtered"), fix_entries(topic="/gps/raw"), fix_entries(topic="/z")
    )
    path = write_mcap(tmp_path / "r.mcap", entries)
    assert discover([path])[0].fix_topic == "/gps/raw"
    for topic, number in (("/z", 6), ("", 0)):
        (robot,) = resolve(run_of(RobotConfig("r", (path,), fix_topic=topic))).robots
        assert robot.fix_topic == topic
        assert len(sightings(robot).fixes) == number
    for wrong, sentence in (
        ({"fix_topic": "/odom"}, "is of type nav_msgs/msg/Odometry and cannot be the fix_topic; position fix topics: "),
        ({"fix_topic": "/x"}, "topic '/x' not found; position fix topics: '/gps/filtered', '/gps/raw', '/z'"),
        ({"tags_topic": "/odom"}, "is of type nav_msgs/msg/Odometry and cannot be the tags_topic; tag topics: "),
    ):
        with pytest.raises(InputError, match=sentence):
            resolve(run_of(RobotConfig("r", (path,), **wrong)))


def test_robots_of_one_log_have_their_own_fixes(tmp_path):
    entries = in_order(
        robot_entries(namespace="a"), robot_entries(namespace="b"), fix_entries(topic="/b/fix", frame_id="b/base_link")
    )
    robots = discover([write_mcap(tmp_path / "team.mcap", entries)])
    assert [robot.fix_topic for robot in robots] == [None, "/b/fix"]


# --- tags ------------------------------------------------------------------------------------------------------------

# Two metres ahead of the camera, one to its right.
AHEAD = (1.0, 0.0, 2.0)


def assert_places(tags, name, stamps=STAMPS):
    """The tag is seen from each stamp's pose, two metres ahead and one to the right of the camera."""
    np.testing.assert_allclose(
        tags[name][:, :3, 3], [((s - START) / SECOND + 2.0, -1.0, 0.5) for s in stamps], atol=1e-9
    )


def test_tags_of_ros_1(tmp_path):
    ros1 = Factory(ros1=True)
    entries = [Entry("/tag_detections", f"{TAG}Array", ros1.tags(s, {3: AHEAD, 12: AHEAD}), s) for s in STAMPS]
    path = write_bag(tmp_path / "r.bag", in_order(robot_entries(factory=ros1), entries))
    assert discover([path])[0].tags_topic == "/tag_detections"
    tags = found_in(path).tags
    assert list(tags) == ["12", "3"]
    assert_places(tags, "3")


@pytest.mark.parametrize(("frame", "name"), [("tag36h11:3", "tag36h11:3"), ("/tag_3", "3"), ("r/tag_3", "3")])
def test_tags_in_tf(tmp_path, frame, name):
    entries = [Entry("/tf", TF, ros2.tf(("camera", frame, s, AHEAD, IDENTITY)), s) for s in STAMPS]
    unplaced = [Entry("/tf", TF, ros2.tf(("other_camera", "tag_9", s, AHEAD, IDENTITY)), s) for s in STAMPS]
    path = write_mcap(tmp_path / "r.mcap", in_order(robot_entries(), entries, unplaced))
    (robot,) = discover([path])
    assert robot.tags_topic is None
    seen = sightings(robot)
    assert list(seen.tags) == [name]
    assert_places(seen.tags, name)
    assert seen.notes == ()
    assert list(sightings(replace(robot, tags_topic="/tf")).tags) == [name]
    assert sightings(replace(robot, tags_topic="")).tags == {}


def test_tags_whose_camera_tf_does_not_place_are_named(tmp_path):
    ros1 = Factory(ros1=True)
    entries = [Entry("/tags", f"{TAG}Array", ros1.tags(s, {3: AHEAD}, frame_id="eye"), s) for s in STAMPS]
    seen = found_in(write_bag(tmp_path / "r.bag", in_order(robot_entries(factory=ros1), entries)))
    assert seen.tags == {}
    assert seen.notes == (
        "the tags of r on '/tags' are not used: no fixed transform in TF leads from their frame 'eye' to the sensor's",
    )
    late = [Entry("/tags", f"{TAG}Array", ros1.tags(s + 10**12, {3: AHEAD}), s) for s in STAMPS]
    seen = found_in(write_bag(tmp_path / "l.bag", in_order(robot_entries(factory=ros1), late)))
    assert seen.notes == ("the tags of l on '/tags' are not used: there is no pose at their time",)


def test_damaged_detections_are_named_and_bad_poses_left_out(tmp_path):
    ros1 = Factory(ros1=True)
    entries = [Entry("/tags", f"{TAG}Array", ros1.tags(s, {3: (math.nan, 0, 0), 4: AHEAD}), s) for s in STAMPS]
    path = write_bag(tmp_path / "r.bag", in_order(robot_entries(factory=ros1), entries))
    assert list(found_in(path).tags) == ["4"]
    rows = [*map(ros_row, robot_entries()), *map(ros_row, fix_entries())]
    rows = [row._replace(data=row.data[:20]) if row.topic == "/fix" else row for row in rows]
    seen = found_in(write_rows(tmp_path / "cut.mcap", rows))
    assert seen.notes == ("none of the 6 messages of cut on '/fix' can be decoded",)


def test_tags_of_isaac_ros_have_their_family():
    pose = SimpleNamespace(
        position=SimpleNamespace(x=1.0, y=2.0, z=3.0), orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    )
    stamped = SimpleNamespace(pose=SimpleNamespace(pose=pose))
    value = SimpleNamespace(
        header=ros2.header(START, "camera"),
        detections=[SimpleNamespace(family="tag36h11", id=3, pose=stamped)],
    )
    name = "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray"
    assert kind_of(name) is Kind.TAGS
    (tag,) = convert(name, value).transforms
    assert (tag.parent, tag.child, tag.translation) == ("camera", "tag36h11:3", (1.0, 2.0, 3.0))
