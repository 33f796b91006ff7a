from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from octoreplay.config.resolved import MapFrame, ResolvedRobot
from octoreplay.errors import InputError
from octoreplay.io.containers.logs import open_log
from octoreplay.io.robots.pose_source import PoseSource, is_static_tf, moving_tf_names, tf_topics
from octoreplay.transforms import inverse, pose_matrix
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    IDENTITY,
    SECOND,
    Entry,
    Row,
    foxglove_pose,
    foxglove_row,
    foxglove_stamp,
    foxglove_transform,
    ros2,
    ros_row,
    write_rows,
)

START = 1_700_000_000 * SECOND + 1
TURN = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
MOUNT = ((0.1, 0.2, 0.3), TURN)
STAMPS = [START + i * SECOND // 10 for i in range(11)]
IMAGE = "/camera/depth"
TF = "tf2_msgs/msg/TFMessage"


def entry(topic: str, type_name: str, value, stamp: int) -> Row:
    return ros_row(Entry(topic, type_name, value, stamp))


def images() -> list[Row]:
    """Messages of a sensor at every stamp."""
    pixels = np.ones((1, 1), np.uint16)
    return [entry(IMAGE, "sensor_msgs/msg/Image", ros2.image(s, pixels, "16UC1"), s) for s in STAMPS]


def position(stamp: int) -> tuple[float, float, float]:
    """Position of the body, which drives along x at 1 m/s and climbs."""
    t = (stamp - START) / SECOND
    return t, 2.0, 3.0 + t


def odometry(*, frame_id="map", child="base") -> list[Row]:
    return [
        entry("/odom", "nav_msgs/msg/Odometry", ros2.odometry(s, position(s), TURN, frame_id=frame_id, child=child), s)
        for s in STAMPS
    ]


def tf(topic: str, *edges, stamps: Sequence[int] = STAMPS) -> list[Row]:
    """Transforms (parent, child, of stamp to translation, rotation) at some stamps."""
    return [entry(topic, TF, ros2.tf(*((a, b, s, of(s), rotation) for a, b, of, rotation in edges)), s) for s in stamps]


def static(parent="base", child="camera", mount=MOUNT, *, stamp=STAMPS[-1] + SECOND) -> list[Row]:
    """A fixed transform at the end of the log."""
    return [entry("/tf_static", TF, ros2.tf((parent, child, stamp, *mount)), stamp)]


class Poses:
    """A pose source after all messages of its log."""

    def __init__(
        self, tmp_path: Path, rows: Sequence[Row], *, gap_ns=SECOND // 2, use_log_time=False, **fields
    ) -> None:
        self.path = write_rows(tmp_path / "r.mcap", rows)
        with ExitStack() as stack:
            log = stack.enter_context(open_log(self.path))
            robot = ResolvedRobot("r", (self.path,), depth_topic=IMAGE, **fields)
            self.source = PoseSource(robot, [log], sensor_frame="camera", pose_gap_ns=gap_ns, use_log_time=use_log_time)
            self.known_at_first = self.source.is_known(STAMPS[0])
            for message in log.messages(self.source.topics):
                self.source.take(message)

    def check(self, expected, stamps: Sequence[int] = (STAMPS[0], STAMPS[3] + 31_415_926, STAMPS[-1])) -> None:
        """The poses at some stamps are those of a function of the stamp."""
        for stamp in stamps:
            assert self.source.is_known(stamp)
            np.testing.assert_allclose(self.source.at(stamp), expected(stamp), atol=1e-6)
        assert self.source.at(STAMPS[0] - 1) is None
        assert self.source.at(STAMPS[-1] + 1) is None


def body(stamp: int) -> np.ndarray:
    return pose_matrix(position(stamp), TURN)


def camera(stamp: int) -> np.ndarray:
    return body(stamp) @ pose_matrix(*MOUNT)


# --- pose topics -----------------------------------------------------------------------------------------------------


def test_odometry_with_a_mount_that_comes_last(tmp_path):
    poses = Poses(tmp_path, [*odometry(), *static()], pose_topic="/odom")
    assert poses.source.topics == ("/odom",)
    assert not poses.known_at_first
    assert not poses.source.is_known(STAMPS[-1] + 1)
    poses.check(camera)


def test_odometry_of_the_sensor_itself_and_with_slashes_before_its_frames(tmp_path):
    Poses(tmp_path, odometry(child="/camera"), pose_topic="/odom").check(body)


def test_a_given_mount_replaces_tf(tmp_path):
    given = (*MOUNT[0], *MOUNT[1])
    Poses(tmp_path, [*odometry(), *static(mount=((9, 9, 9), IDENTITY))], pose_topic="/odom", T_body_sensor=given).check(
        camera
    )


@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped", *FOXGLOVE_ENCODINGS])
def test_stamped_poses_with_a_given_mount(tmp_path, kind):
    def row(stamp: int) -> Row:
        if kind == "PoseStamped":
            return entry("/pose", f"geometry_msgs/msg/{kind}", ros2.pose_stamped(stamp, position(stamp)), stamp)
        if kind == "PoseWithCovarianceStamped":
            return entry("/pose", f"geometry_msgs/msg/{kind}", ros2.pose_with_covariance(stamp, position(stamp)), stamp)
        fields = {"timestamp": foxglove_stamp(stamp), "frame_id": "map", "pose": foxglove_pose(position(stamp))}
        return foxglove_row("/pose", "PoseInFrame", fields, stamp, kind)

    rows = [row(stamp) for stamp in STAMPS]
    poses = Poses(tmp_path, rows, pose_topic="/pose", T_body_sensor=(*MOUNT[0], *MOUNT[1]))
    poses.check(lambda stamp: pose_matrix(position(stamp), IDENTITY) @ pose_matrix(*MOUNT))
    with pytest.raises(InputError, match=r"topic '/pose' at .* s: the poses have no child frame; give T_body_sensor"):
        Poses(tmp_path, [*rows, *static()], pose_topic="/pose")


def test_a_transform_as_pose_topic_names_its_child_frame(tmp_path):
    rows = [
        entry(
            "/vicon",
            "geometry_msgs/msg/TransformStamped",
            ros2.tf(("map", "base", s, position(s), TURN)).transforms[0],
            s,
        )
        for s in STAMPS
    ]
    Poses(tmp_path, [*rows, *static()], pose_topic="/vicon").check(camera)


def path_rows(lengths: Sequence[int]) -> list[Row]:
    """A path with the given number of poses in each message."""
    poses = [ros2.pose_stamped(s, position(s), TURN, frame_id="") for s in STAMPS]
    return [
        entry("/path", "nav_msgs/msg/Path", ros2.path(s, poses[:length]), s)
        for s, length in zip(STAMPS, lengths, strict=False)
    ]


@pytest.mark.parametrize("lengths", [[11], range(1, 12), range(11), [0, 0, 11]])
def test_a_path_is_known_from_the_beginning_and_its_last_message_is_used(tmp_path, lengths):
    rows = path_rows(lengths)
    given = (*MOUNT[0], *MOUNT[1])
    poses = Poses(tmp_path, rows, pose_topic="/path", T_body_sensor=given)
    assert poses.known_at_first
    last = STAMPS[max(lengths) - 1]
    for stamp in (STAMPS[0], STAMPS[3] + 7, last):
        np.testing.assert_allclose(poses.source.at(stamp), camera(stamp), atol=1e-6)
    assert poses.source.at(last + 1) is None


def test_the_last_path_replaces_earlier_ones(tmp_path):
    wrong = [ros2.pose_stamped(s, (99, 99, 99), frame_id="map") for s in STAMPS]
    rows = [entry("/path", "nav_msgs/msg/Path", ros2.path(START, wrong), START), *path_rows([0, 11])[1:]]
    Poses(tmp_path, rows, pose_topic="/path", T_body_sensor=(*MOUNT[0], *MOUNT[1])).check(camera)


def test_the_poses_frame_is_joined_to_the_map(tmp_path):
    """map -> odom moves by TF, odom -> base is the odometry."""
    correction = tf("/tf", ("map", "odom", lambda s: (0, 10 * (s - START) / SECOND, 0), TURN))
    poses = Poses(tmp_path, [*correction, *odometry(frame_id="odom"), *static()], pose_topic="/odom", map_frame="map")
    assert poses.source.topics == ("/odom", "/tf")
    poses.check(lambda s: pose_matrix((0, 10 * (s - START) / SECOND, 0), TURN) @ camera(s))


def corrections(*numbers: int) -> list[Row]:
    """A jump of map -> odom at some of the stamps: y is the number of the stamp."""
    return [
        row
        for i in numbers
        for row in tf("/tf", ("map", "odom", lambda s, i=i: (0, i, 0), IDENTITY), stamps=[STAMPS[i]])
    ]


def corrected(y: float, stamp: int) -> np.ndarray:
    return pose_matrix((0, y, 0), IDENTITY) @ camera(stamp)


@pytest.mark.parametrize("pose_topic", ["/odom", "/tf"])
def test_a_correction_holds_before_the_first_after_the_last_and_across_gaps(tmp_path, pose_topic):
    """Corrections are at stamps 2, 3 and 8; two that are at most 0.2 s apart are interpolated."""
    moving = odometry(frame_id="odom") if pose_topic == "/odom" else tf("/tf", ("odom", "base", position, TURN))
    rows = [*moving, *corrections(2, 3, 8), *static()]
    rows.sort(key=lambda row: row.log_time_ns)
    frame = MapFrame("map", "odom", True)
    poses = Poses(tmp_path, rows, pose_topic=pose_topic, map_frame="map", frame=frame, gap_ns=SECOND // 5)
    between = STAMPS[2] + 25_000_000
    for stamp, y in [
        (STAMPS[0], 2), (STAMPS[2], 2), (between, 2.25), (STAMPS[3], 3), (STAMPS[7], 3), (STAMPS[8] - 1, 3),
        (STAMPS[8], 8), (STAMPS[10], 8),
    ]:  # fmt: skip
        np.testing.assert_allclose(poses.source.at(stamp), corrected(y, stamp), atol=1e-9)
    # The poses themselves do not hold.
    assert poses.source.at(STAMPS[0] - 1) is None
    assert poses.source.at(STAMPS[-1] + 1) is None


def test_the_first_correction_is_known_before_it_is_read(tmp_path):
    rows = [*odometry(frame_id="odom"), *static(), *corrections(9)]
    path = write_rows(tmp_path / "r.mcap", rows)
    robot = ResolvedRobot("r", (path,), depth_topic=IMAGE, pose_topic="/odom", map_frame="map")
    with open_log(path) as log:
        first = PoseSource(robot, [log], sensor_frame="camera", pose_gap_ns=SECOND, use_log_time=False)
        with mock.patch.object(PoseSource, "_read_first", side_effect=AssertionError):
            second = PoseSource(
                robot, [log], sensor_frame="camera", pose_gap_ns=SECOND, use_log_time=False, known=first
            )
        for source in (first, second):
            for message in log.messages(("/odom",)):
                source.take(message)
            np.testing.assert_allclose(source.at(STAMPS[1]), corrected(9, STAMPS[1]), atol=1e-9)
    with pytest.raises(InputError, match=r"no transform from 'odom' to 'earth'.*; name another map_frame"):
        Poses(tmp_path, rows, pose_topic="/odom", map_frame="earth")


def test_log_time_is_the_clock_where_it_is_chosen(tmp_path):
    rows = [row._replace(log_time_ns=row.log_time_ns + SECOND) for row in odometry()]
    poses = Poses(tmp_path, [*rows, *static()], pose_topic="/odom", use_log_time=True)
    np.testing.assert_allclose(poses.source.at(STAMPS[4] + SECOND), camera(STAMPS[4]), atol=1e-9)


# --- TF --------------------------------------------------------------------------------------------------------------


def test_a_chain_of_four_with_mounts_at_the_end_of_the_log(tmp_path):
    """map -> odom -> base move, base -> mast and mast -> camera are fixed."""
    moving = tf(
        "/tf", ("map", "odom", lambda s: (0, 5 * (s - START) / SECOND, 0), TURN), ("odom", "base", position, TURN)
    )
    mast = ((0.0, 0.0, 1.0), TURN)
    rows = [*moving, *static("base", "mast", mast), *static("mast", "camera", stamp=STAMPS[-1] + 2 * SECOND)]
    poses = Poses(tmp_path, rows, pose_topic="/tf", map_frame="map")
    assert poses.source.topics == ("/tf",)
    assert not poses.known_at_first

    def expected(stamp: int) -> np.ndarray:
        first = pose_matrix((0, 5 * (stamp - START) / SECOND, 0), TURN)
        return first @ body(stamp) @ pose_matrix(*mast) @ pose_matrix(*MOUNT)

    poses.check(expected)


def test_a_pose_is_known_once_every_transform_of_its_chain_is(tmp_path):
    fast = tf("/tf", ("odom", "base", position, TURN))
    slow = tf("/tf", ("map", "odom", lambda s: (0, 0, 0), IDENTITY), stamps=STAMPS[:6:5])
    rows = sorted([*fast, *slow, *static()], key=lambda row: row.log_time_ns)
    poses = Poses(tmp_path, rows, pose_topic="/tf", map_frame="map")
    assert poses.source.is_known(STAMPS[5])
    assert not poses.source.is_known(STAMPS[5] + 1)


@pytest.mark.parametrize("encoding", FOXGLOVE_ENCODINGS)
@pytest.mark.parametrize("several", [True, False])
def test_foxglove_transforms_with_a_single_fixed_one(tmp_path, encoding, several):
    def row(topic: str, *edge) -> Row:
        transform = foxglove_transform(*edge)
        name, fields = ("FrameTransforms", {"transforms": [transform]}) if several else ("FrameTransform", transform)
        return foxglove_row(topic, name, fields, edge[2], encoding)

    rows = [row("/moving", "map", "base", stamp, position(stamp), TURN) for stamp in STAMPS]
    mount = row("/mount", "base", "camera", STAMPS[-1] + SECOND, *MOUNT)
    poses = Poses(tmp_path, [*rows, mount], pose_topic="/moving", map_frame="map")
    assert poses.source.topics == ("/moving",)
    poses.check(camera)


def test_static_topics_are_known_by_name_or_a_single_message(tmp_path):
    def infos(rows: Sequence[Row]):
        with open_log(write_rows(tmp_path / "a.mcap", rows)) as log:
            return {info.name: info for info in log.topics}

    once = foxglove_row("/once", "FrameTransform", foxglove_transform("a", "b", 5, (0, 0, 0)), 5, "protobuf")
    often = [once._replace(topic="/often"), once._replace(topic="/often")]
    found = infos([*static(), once, *often, *tf("/r/tf", stamps=STAMPS[:1])])
    assert {name: is_static_tf(info) for name, info in found.items()} == {
        "/tf_static": True, "/once": True, "/often": False, "/r/tf": False,
    }  # fmt: skip
    assert moving_tf_names(tf_topics(found.values(), "/r/camera")) == ("/often", "/r/tf")


def test_the_tf_of_a_namespace_above_the_sensor_is_used_alone(tmp_path):
    rows = [*tf("/a/tf", stamps=STAMPS[:2]), *tf("/b/tf", stamps=STAMPS[:2])]
    with open_log(write_rows(tmp_path / "a.mcap", rows)) as log:
        assert [t.name for t in tf_topics(log.topics, "/a/camera/depth")] == ["/a/tf"]
        assert [t.name for t in tf_topics(log.topics, "/ab/camera/depth")] == ["/a/tf", "/b/tf"]


def test_tf_that_is_not_finite_gives_no_poses_and_no_crash(tmp_path):
    rows = [*tf("/tf", ("map", "base", lambda s: (np.nan, 0, 0), IDENTITY)), *static()]
    poses = Poses(tmp_path, rows, pose_topic="/tf", map_frame="map")
    assert poses.source.at(STAMPS[3]) is None
    rows = [*odometry(), *static(mount=((0, 0, 0), (0, np.nan, 0, 1)))]
    assert Poses(tmp_path, rows, pose_topic="/odom").source.at(STAMPS[3]) is None


# --- files -----------------------------------------------------------------------------------------------------------


def write_tum(path: Path, stamps: Sequence[int] = STAMPS) -> Path:
    def row(stamp: int) -> str:
        numbers = [*position(stamp), *TURN]
        return f"{stamp // SECOND}.{stamp % SECOND:09} {' '.join(map(repr, map(float, numbers)))}"

    path.write_text("\n".join(map(row, stamps)))
    return path


def write_kitti(path: Path, stamps: Sequence[int] = STAMPS) -> Path:
    path.write_text("\n".join(" ".join(map(repr, body(stamp)[:3].ravel().tolist())) for stamp in stamps))
    return path


def test_a_tum_file_is_exact_to_the_nanosecond_and_known_from_the_beginning(tmp_path):
    poses = Poses(tmp_path, images(), pose_file=write_tum(tmp_path / "tum.txt"))
    assert poses.source.topics == ()
    assert poses.known_at_first
    # ``check`` uses one nanosecond before the first pose and after the last.
    poses.check(body)


def test_a_file_of_the_bodys_poses_with_a_given_mount(tmp_path):
    given = (*MOUNT[0], *MOUNT[1])
    Poses(tmp_path, images(), pose_file=write_tum(tmp_path / "tum.txt"), T_body_sensor=given).check(camera)


@pytest.mark.parametrize("use_log_time", [False, True])
def test_a_kitti_file_has_a_pose_for_every_message_of_the_sensor(tmp_path, use_log_time):
    # The messages are not in stamp order.
    rows = [images()[i] for i in (1, 0, *range(2, 11))]
    rows = [row._replace(log_time_ns=STAMPS[i] + 5) for i, row in enumerate(rows)]
    poses = Poses(tmp_path, rows, pose_file=write_kitti(tmp_path / "kitti.txt"), use_log_time=use_log_time)
    for stamp in STAMPS:
        np.testing.assert_allclose(poses.source.at(stamp + 5 * use_log_time), body(stamp), atol=1e-9)


def test_a_kitti_file_with_times(tmp_path):
    times = tmp_path / "times.txt"
    times.write_text("\n".join(f"{stamp // SECOND}.{stamp % SECOND:09}" for stamp in STAMPS))
    poses = Poses(tmp_path, images()[:3], pose_file=write_kitti(tmp_path / "kitti.txt"), pose_times=times)
    poses.check(body)


def test_poses_without_a_time_each_are_refused_with_both_counts(tmp_path):
    kitti = write_kitti(tmp_path / "kitti.txt", STAMPS[:7])
    with pytest.raises(InputError) as caught:
        Poses(tmp_path, images(), pose_file=kitti)
    assert str(caught.value) == (
        f"{kitti}: has 7 poses, but '{IMAGE}' 11 messages; give pose_times: a file with the time [s] of each pose"
    )
    times = tmp_path / "times.txt"
    times.write_text("1\n2\n")
    with pytest.raises(InputError, match=f"^{re.escape(f'{kitti}: has 7 poses, but {times} has 2 times; ')}"):
        Poses(tmp_path, images(), pose_file=kitti, pose_times=times)


def test_damage_in_a_file_is_named_with_its_line(tmp_path):
    tum = write_tum(tmp_path / "tum.txt")
    tum.write_text(tum.read_text() + "\n1 2 3 4 5 6 7 x")
    with pytest.raises(InputError, match=f"^{re.escape(str(tum))} line 12: expects numbers, got '2 3 4 5 6 7 x'"):
        Poses(tmp_path, images(), pose_file=tum)
    with pytest.raises(InputError, match=r"missing\.txt: cannot be read: No such file"):
        Poses(tmp_path, images(), pose_file=tmp_path / "missing.txt")


# --- the robot's own body --------------------------------------------------------------------------------------------

BOX = (-1.0, -1.0, 0.0, 1.0, 1.0, 1.0)


def test_the_box_is_in_the_frame_of_the_poses_unless_named(tmp_path):
    poses = Poses(tmp_path, [*odometry(), *static()], pose_topic="/odom", body_box=BOX)
    np.testing.assert_allclose(poses.source.T_body_sensor_at(STAMPS[2]), pose_matrix(*MOUNT), atol=1e-12)
    poses = Poses(
        tmp_path, images(), pose_file=write_tum(tmp_path / "t"), body_box=BOX, T_body_sensor=(*MOUNT[0], *MOUNT[1])
    )
    np.testing.assert_allclose(poses.source.T_body_sensor_at(STAMPS[2]), pose_matrix(*MOUNT), atol=1e-12)


def test_the_box_of_another_frame_is_found_by_tf_as_it_moves(tmp_path):
    """camera <- base is fixed, trailer <- base swings."""
    swing = tf("/tf", ("base", "trailer", lambda s: (-(s - START) / SECOND, 0, 0), TURN))
    rows = [*swing, *odometry(), *static()]
    poses = Poses(tmp_path, rows, pose_topic="/odom", body_box=BOX, body_frame="/trailer")
    assert poses.source.topics == ("/odom", "/tf")
    poses.check(camera)
    stamp = STAMPS[4]
    expected = inverse(pose_matrix((-0.4, 0, 0), TURN)) @ pose_matrix(*MOUNT)
    np.testing.assert_allclose(poses.source.T_body_sensor_at(stamp), expected, atol=1e-9)
    assert poses.source.T_body_sensor_at(STAMPS[-1] + 1) is None


def test_the_box_of_a_robot_whose_poses_come_from_a_file_is_found_by_tf(tmp_path):
    poses = Poses(
        tmp_path, [*images(), *static()], pose_file=write_tum(tmp_path / "t"), body_box=BOX, body_frame="base"
    )  # fmt: skip
    poses.check(body)
    np.testing.assert_allclose(poses.source.T_body_sensor_at(STAMPS[2]), pose_matrix(*MOUNT), atol=1e-12)


def test_a_body_frame_that_nothing_joins_is_named(tmp_path):
    with pytest.raises(InputError, match=r"TF has no frame 'trailer'; .*; name another body_frame"):
        Poses(tmp_path, [*odometry(), *static()], pose_topic="/odom", body_box=BOX, body_frame="trailer")


# --- what cannot be --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "fields", "sentence"),
    [
        (odometry(), {}, "no transform from 'camera' to 'base': the log has no TF; name the sensor_frame, or"),
        ([*odometry(), *static("a", "camera")], {}, "no transform from 'camera' to 'base': TF has no frame 'base'"),
        (
            [*odometry(), *static("a", "camera"), *static("b", "base")], {},
            "no transform from 'camera' to 'base': the root of 'camera' is 'a', that of 'base' is 'b', and no ",
        ),
        ([*odometry(), *static()], {"map_frame": "earth"}, "no transform from 'map' to 'earth': "),
        (static(), {}, "topic '/odom' holds no poses for robot 'r'"),
        (path_rows([0, 0]), {"pose_topic": "/path"}, "topic '/path' holds no poses"),
        (tf("/tf", ("map", "base", position, TURN)), {"pose_topic": "/tf"}, "poses from TF need a map_frame"),
    ],
)  # fmt: skip
def test_logs_without_poses_are_refused_in_one_sentence(tmp_path, rows, fields, sentence):
    with pytest.raises(InputError, match=f"^{re.escape(str(tmp_path / 'r.mcap'))}: {sentence}") as caught:
        Poses(tmp_path, rows, **{"pose_topic": "/odom", **fields})
    assert "\n" not in str(caught.value)


def test_frames_that_tf_does_not_join_are_named_after_reading(tmp_path):
    rows = [*tf("/tf", ("map", "other", position, TURN)), *static()]
    poses = Poses(tmp_path, rows, pose_topic="/tf", map_frame="map")
    assert poses.source.at(STAMPS[2]) is None
    with pytest.raises(
        InputError, match="the root of 'camera' is 'base', that of 'map' is 'map', and no transform joins them"
    ):
        poses.source.check_connected()


def test_a_frame_with_two_parents_is_refused(tmp_path):
    rows = [*odometry(), *static(), *static("mast", "camera")]
    poses = Poses(tmp_path, rows, pose_topic="/odom")
    with pytest.raises(InputError, match="frame 'camera' has two parents in TF, 'base' and 'mast'"):
        poses.source.at(STAMPS[2])


def test_a_message_of_another_type_on_the_pose_topic_is_damage(tmp_path):
    pixels = np.ones((1, 1), np.uint16)
    poses = Poses(tmp_path, [*odometry(), *static()], pose_topic="/odom")
    other = entry("/odom", "sensor_msgs/msg/Image", ros2.image(START, pixels, "16UC1"), START)
    assert poses.source.take(other.message()) == "undecodable"
    assert poses.source.take(odometry()[0].message()) == "used"
