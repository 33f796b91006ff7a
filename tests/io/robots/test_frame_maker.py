from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.robots.frame_maker import CloudFrameMaker, DepthFrameMaker
from octoreplay.io.robots.frame_queue import Settled
from octoreplay.io.sensors import cameras
from octoreplay.io.sensors.labels import OCCUPIED, LabelLookup, class_table_from_names
from octoreplay.records import BodyBox, CameraModel, CloudFrame, DepthFrame
from support.log_factory import (
    HEIGHT,
    NAMES,
    WIDTH,
    Entry,
    depth_pixels,
    foxglove_row,
    foxglove_stamp,
    label_pixels,
    ros2,
    ros_row,
)

TABLE = class_table_from_names({"r": NAMES})
DEPTH, LABELS, SURE, INFO, POINTS = "/depth", "/labels", "/sure", "/info", "/points"
POSE = np.diag([1.0, -1.0, -1.0, 1.0])
BOX = BodyBox(np.zeros(3), np.ones(3), np.eye(4), is_own=True)
D = (-0.2, 0.05, 0.0, 0.0, 0.0)
P = (40.0, 0, 5, 0, 0, 41.0, 4, 0, 0, 0, 1, 0)


def message(topic: str, type_name: str, value) -> RawMessage:
    return ros_row(Entry(topic, f"sensor_msgs/msg/{type_name}", value, 5)).message()


def image(topic: str, pixels, encoding: str) -> RawMessage:
    return message(topic, "Image", ros2.image(5, pixels, encoding))


def robot_of(**fields) -> RobotConfig:
    return RobotConfig("r", (Path("a.mcap"),), **fields)


def depth_maker(info=None, *, labels=True, **fields) -> DepthFrameMaker:
    topics = {"depth_topic": DEPTH, "label_topic": LABELS, "confidence_topic": SURE}
    calibration = None if info is None else message(INFO, "CameraInfo", info)
    lookup = LabelLookup(TABLE) if labels else None
    return DepthFrameMaker(robot_of(**{**topics, **fields}), lookup, calibration)


def make(maker, sensor: RawMessage, *partners: RawMessage | None):
    return maker.make(Settled(5, sensor, partners, np.eye(4)), 77, POSE, (BOX,))


DEPTH_IMAGE = image(DEPTH, depth_pixels(0), "16UC1")
LABEL_IMAGE = image(LABELS, label_pixels(0), "mono8")
INFO_MESSAGE = ros2.camera_info(0, (WIDTH, HEIGHT))


def test_a_depth_frame_holds_everything():
    sure = np.full((HEIGHT, WIDTH), 99, np.uint8)
    maker = depth_maker(INFO_MESSAGE, depth_unit=0.01)
    frame = make(maker, DEPTH_IMAGE, LABEL_IMAGE, image(SURE, sure, "mono8"))
    assert isinstance(frame, DepthFrame)
    assert (frame.robot_id, frame.stamp_ns, frame.depth_unit, frame.boxes) == ("r", 77, 0.01, (BOX,))
    assert frame.camera == CameraModel(WIDTH, HEIGHT, 50.0, 60.0, 5.5, 3.5)
    assert frame.T_team_sensor is POSE
    np.testing.assert_array_equal(frame.depth_image, depth_pixels(0))
    np.testing.assert_array_equal(frame.class_image, np.array([1, 2, 3, 0])[np.arange(96).reshape(HEIGHT, WIDTH) % 4])
    np.testing.assert_array_equal(frame.confidence_image, sure)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, (LABELS, SURE)), ({"confidence_topic": None}, (LABELS,)), ({"label_topic": None}, ()),
        ({"label_topic": ""}, ()), ({"labels": False}, ()),
    ],
)  # fmt: skip
def test_partner_topics_of_a_depth_image(fields, expected):
    maker = depth_maker(INFO_MESSAGE, **fields)
    assert maker.partner_topics == expected
    frame = make(maker, DEPTH_IMAGE, *[None] * len(expected))
    assert (frame.class_image, frame.confidence_image) == (None, None)
    assert CloudFrameMaker(robot_of(cloud_topic=POINTS), LabelLookup(TABLE)).partner_topics == ()


@pytest.mark.parametrize(
    ("topic", "rectified", "fx", "distorts"),
    [
        ("/depth/image_raw", None, 50.0, True), ("/depth/image_rect", None, 40.0, False),
        ("/depth/Image_Rect_raw", None, 40.0, False), ("/depth/image_rect", False, 50.0, True),
        ("/depth/image_raw", True, 40.0, False),
    ],
)  # fmt: skip
def test_a_rectified_image_is_known_by_its_topic_or_the_configuration(topic, rectified, fx, distorts):
    info = ros2.camera_info(0, (WIDTH, HEIGHT), d=D, p=P)
    camera = make(depth_maker(info, depth_topic=topic, rectified=rectified), DEPTH_IMAGE, None, None).camera
    assert (camera.fx, camera.slopes is not None) == (fx, distorts)


def test_a_camera_without_a_size_has_that_of_its_images():
    maker = depth_maker(ros2.camera_info(0, (0, 0)))
    assert make(maker, DEPTH_IMAGE, None, None).camera == CameraModel(WIDTH, HEIGHT, 50.0, 60.0, 5.5, 3.5)
    with pytest.raises(InputError, match=r"the image is 4x3, but its CameraInfo is for 12x8; name the right"):
        make(maker, image(DEPTH, depth_pixels(0)[:3, :4], "16UC1"), None, None)


def test_given_intrinsics_have_the_size_of_the_images():
    maker = depth_maker(intrinsics=(9.0, 8.0, 4.0, 3.0))
    assert make(maker, DEPTH_IMAGE, None, None).camera == CameraModel(WIDTH, HEIGHT, 9.0, 8.0, 4.0, 3.0)


@pytest.mark.parametrize("topic", [LABELS, SURE])
def test_images_of_another_size_are_refused_by_name(topic):
    small = image(topic, np.ones((3, 4), np.uint8), "mono8")
    partners = (small, None) if topic == LABELS else (LABEL_IMAGE, small)
    sentence = f"topic '{topic}' at 0.000 s: the image is 4x3, but the depth image of '/depth' is 12x8"
    with pytest.raises(InputError, match=sentence):
        make(depth_maker(INFO_MESSAGE), DEPTH_IMAGE, *partners)


def cloud(**more) -> RawMessage:
    columns = {name: np.array([1, 2, 3], "f4") for name in "xyz"}
    return message(POINTS, "PointCloud2", ros2.cloud(5, {**columns, **more}))


def test_a_cloud_frame_holds_everything():
    labels, sure = np.array([7, 99, 1], "u4"), np.array([0, 128, 255], "u1")
    lookup = LabelLookup(TABLE)
    frame = make(CloudFrameMaker(robot_of(cloud_topic=POINTS), lookup), cloud(label=labels, confidence=sure))
    assert isinstance(frame, CloudFrame)
    assert (frame.robot_id, frame.stamp_ns, frame.boxes) == ("r", 77, (BOX,))
    np.testing.assert_array_equal(frame.points, [[1, 1, 1], [2, 2, 2], [3, 3, 3]])
    assert frame.class_ids.tolist() == [3, 0, 1]
    assert frame.confidences.tolist() == [0, 128, 255]
    assert lookup.unknown == {99: 1}


def test_the_named_fields_of_a_cloud_are_taken():
    message_ = cloud(label=np.zeros(3, "u1"), kind=np.array([1, 2, 7], "u1"), how=np.array([9, 8, 7], "u1"))
    robot = robot_of(cloud_topic=POINTS, label_field="kind", confidence_field="how")
    frame = make(CloudFrameMaker(robot, LabelLookup(TABLE)), message_)
    assert (frame.class_ids.tolist(), frame.confidences.tolist()) == ([1, 2, 3], [9, 8, 7])


def test_without_labels_there_are_no_confidences():
    message_ = cloud(confidence=np.array([9, 8, 7], "u1"))
    for lookup in (LabelLookup(OCCUPIED), None):
        frame = make(CloudFrameMaker(robot_of(cloud_topic=POINTS), lookup), message_)
        assert (frame.class_ids, frame.confidences) == (None, None)


def test_a_cloud_without_labels_is_none_where_there_are_several_classes():
    assert TABLE.num_classes > 1
    assert make(CloudFrameMaker(robot_of(cloud_topic=POINTS), LabelLookup(TABLE)), cloud()) is None


def test_a_scan_is_a_cloud_without_labels():
    fields = {"timestamp": foxglove_stamp(5), "start_angle": 0.0, "end_angle": 1.0, "ranges": [2.0, 3.0]}
    scan = foxglove_row(POINTS, "LaserScan", fields, 5, "protobuf").message()
    frame = make(CloudFrameMaker(robot_of(cloud_topic=POINTS), LabelLookup(OCCUPIED)), scan)
    np.testing.assert_allclose(frame.points, [[2, 0, 0], [3 * np.cos(1), 3 * np.sin(1), 0]])
    assert frame.class_ids is None


def test_messages_of_another_type_are_damage_and_no_camera():
    maker = CloudFrameMaker(robot_of(cloud_topic=DEPTH), None)
    with pytest.raises(
        DamagedMessageError, match=r"topic '/depth' at .*: is of type sensor_msgs/msg/Image, not a point"
    ):
        make(maker, DEPTH_IMAGE)
    for depth, label in ((cloud(), LABEL_IMAGE), (DEPTH_IMAGE, cloud())):
        with pytest.raises(DamagedMessageError, match=r"is of type sensor_msgs/msg/PointCloud2, not an image"):
            make(depth_maker(INFO_MESSAGE), depth, label, None)
    with pytest.raises(InputError, match=r"is of type sensor_msgs/msg/Image, not CameraInfo"):
        DepthFrameMaker(robot_of(depth_topic=DEPTH), None, DEPTH_IMAGE)


def test_rays_are_computed_at_the_first_image(monkeypatch):
    """A CameraInfo may give any size, and the rays of a large image take gigabytes."""
    sizes, work_out = [], cameras._rays

    def rays(*args):
        sizes.append(args[-2:])
        assert sizes[-1] == (WIDTH, HEIGHT)
        return work_out(*args)

    monkeypatch.setattr(cameras, "_rays", rays)
    for size, fits in (((8000, 8000), False), ((WIDTH, HEIGHT), True)):
        info = message(INFO, "CameraInfo", ros2.camera_info(5, size, d=D))
        maker = DepthFrameMaker(robot_of(depth_topic=DEPTH), None, info)
        assert sizes == []
        depth = Settled(5, image(DEPTH, depth_pixels(0), "16UC1"), (), POSE)
        if fits:
            assert maker.make(depth, 5, POSE, ()).camera.slopes is maker.make(depth, 6, POSE, ()).camera.slopes
        else:
            with pytest.raises(InputError, match=f"the image is {WIDTH}x{HEIGHT}, but its CameraInfo is for 8000x8000"):
                maker.make(depth, 5, POSE, ())
    assert sizes == [(WIDTH, HEIGHT)]
