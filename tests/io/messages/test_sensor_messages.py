"""Equal content gives equal records in all schemas and encodings."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from octoreplay.errors import OctoreplayError
from octoreplay.io.messages import sensor_messages
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import (
    Calibration,
    Cloud,
    CloudField,
    CompressedImage,
    Image,
    Kind,
    LabelNames,
    Scan,
    StampedTransform,
    Transforms,
    convert,
    kind_of,
)
from octoreplay.transforms import pose_matrix
from support.log_factory import (
    FOXGLOVE_ENCODINGS,
    IDENTITY,
    SECOND,
    Entry,
    Factory,
    Row,
    foxglove_pose,
    foxglove_row,
    foxglove_stamp,
    foxglove_transform,
    ros1_row,
    ros2,
    ros_row,
)

STAMP = 1_700_000_000 * SECOND + 123_456_789
STAMPED = {"timestamp": foxglove_stamp(STAMP), "frame_id": "camera"}
ros1 = Factory(ros1=True)
TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


def plain(value):
    """Return a record in a form that can be compared: arrays and bytes as lists."""
    if dataclasses.is_dataclass(value):
        return type(value).__name__, {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, bytes | bytearray | memoryview):
        return bytes(value)
    if isinstance(value, np.ndarray):
        return value.tolist() if value.dtype != np.uint8 else value.tobytes()
    return [plain(part) for part in value] if isinstance(value, tuple) else value


def ros_rows(type_name: str, make) -> dict[str, Row]:
    """Return a message of a type that ROS 1 and ROS 2 have, in both encodings."""
    return {
        "ros2": ros_row(Entry("/t", type_name, make(ros2), STAMP)),
        "ros1": ros1_row(Entry("/t", type_name, make(ros1), STAMP)),
    }


def foxglove_rows(name: str, fields) -> dict[str, Row]:
    """Return a message of a Foxglove schema in all encodings."""
    return {encoding: foxglove_row("/t", name, fields, STAMP, encoding) for encoding in FOXGLOVE_ENCODINGS}


def check(rows: dict[str, Row], expected, *, stamped: str | None = "camera") -> None:
    """Check that each row gives the record, and that its stamp and frame are read without decoding."""
    for dialect, row in rows.items():
        message = row.message()
        if isinstance(expected, Transforms) and kind_of(message.type_name) is Kind.TF:
            expected = dataclasses.replace(expected, holds=dialect in FOXGLOVE_ENCODINGS)
        assert plain(message.sensor_message()) == plain(expected), dialect
        if stamped is not None:
            assert (message.header_stamp_ns(), message.header_frame_id()) == (STAMP, stamped), dialect


def test_images():
    pixels = np.arange(12, dtype=np.uint16).reshape(3, 4)
    rows = ros_rows("sensor_msgs/msg/Image", lambda f: f.image(STAMP, pixels, "16UC1", padding=2))
    data = np.pad(pixels.view(np.uint8), ((0, 0), (0, 2)), constant_values=171).tobytes()
    fields = {**STAMPED, "width": 4, "height": 3, "encoding": "16UC1", "step": 10, "data": data}
    rows |= foxglove_rows("RawImage", fields)
    assert len(rows) == 5
    check(rows, Image(STAMP, "camera", 3, 4, "16UC1", False, 10, data))


def test_big_endian_images_are_marked():
    pixels = np.arange(12, dtype=np.uint16).reshape(3, 4)
    rows = ros_rows("sensor_msgs/msg/Image", lambda f: f.image(STAMP, pixels, "mono16", big_endian=True))
    check(rows, Image(STAMP, "camera", 3, 4, "mono16", True, 8, pixels.astype(">u2").tobytes()))


def test_compressed_images():
    rows = ros_rows("sensor_msgs/msg/CompressedImage", lambda f: f.compressed_image(STAMP, b"\0\1\xff", "png"))
    rows |= foxglove_rows("CompressedImage", {**STAMPED, "data": b"\0\1\xff", "format": "png"})
    check(rows, CompressedImage(STAMP, "camera", "png", b"\0\1\xff"))


def test_cameras():
    k, p, d = (50.0, 0.0, 5.5, 0.0, 60.0, 3.5, 0.0, 0.0, 1.0), tuple(map(float, range(12))), (0.1, 0.2, 0.3, 0.4, 0.5)
    rows = ros_rows("sensor_msgs/msg/CameraInfo", lambda f: f.camera_info(STAMP, (64, 48), k=k, d=d, p=p))
    fields = {**STAMPED, "width": 64, "height": 48, "distortion_model": "plumb_bob", "D": list(d), "K": list(k)}
    rows |= foxglove_rows("CameraCalibration", {**fields, "R": np.eye(3).ravel().tolist(), "P": list(p)})
    matrices = np.array(d), np.reshape(k, (3, 3)), np.reshape(p, (3, 4))
    check(rows, Calibration(STAMP, "camera", 64, 48, "plumb_bob", *matrices))
    rows = ros_rows(
        "sensor_msgs/msg/CameraInfo",
        lambda f: f.camera_info(STAMP, (64, 48), k=k, d=d, p=p, binning=(2, 3), roi=(4, 5, 30, 20)),
    )
    check(rows, Calibration(STAMP, "camera", 64, 48, "plumb_bob", *matrices, (2, 3), (4, 5, 30, 20)))


def test_a_camera_without_p_has_zeros():
    fields = {**STAMPED, "width": 64, "height": 48, "distortion_model": "", "D": [], "K": [1.0] * 9, "R": [1.0] * 9}
    for encoding in ("protobuf", "json"):
        found = foxglove_row("/t", "CameraCalibration", {**fields, "P": []}, STAMP, encoding).message().sensor_message()
        np.testing.assert_array_equal(found.P, np.zeros((3, 4)))


KINDS = ("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8")


def test_clouds():
    columns = {name: np.array([3, 1, 4], kind) for name, kind in zip("abcdefgh", KINDS, strict=True)}
    rows = ros_rows("sensor_msgs/msg/PointCloud2", lambda f: f.cloud(STAMP, columns, frame_id="camera", gap=3))
    message = ros2.cloud(STAMP, columns, gap=3)
    data = message.data.tobytes()
    offsets = [field.offset for field in message.fields]
    # Foxglove's type codes, in the order of KINDS.
    fields = [{"name": "abcdefgh"[i], "offset": offsets[i], "type": i + 1} for i in range(8)]
    cloud = {**STAMPED, "pose": foxglove_pose((0, 0, 0)), "point_stride": message.point_step, "fields": fields}
    rows |= foxglove_rows("PointCloud", {**cloud, "data": data})
    expected = tuple(CloudField("abcdefgh"[i], offsets[i], KINDS[i]) for i in range(8))
    check(rows, Cloud(STAMP, "camera", 1, 3, expected, False, message.point_step, len(data), data))


@pytest.mark.parametrize("encoding", FOXGLOVE_ENCODINGS)
@pytest.mark.parametrize("length", [1.0, 2.0])
def test_the_pose_of_a_cloud_or_scan_is_a_transform(encoding, length):
    pose = foxglove_pose((1, 2, 3), [length * q for q in TURN])
    cloud = {**STAMPED, "pose": pose, "point_stride": 4, "fields": [], "data": b""}
    scan = {**STAMPED, "pose": pose, "start_angle": 0.0, "end_angle": 1.0, "ranges": [1.0, 2.0], "intensities": []}
    found = foxglove_row("/t", "PointCloud", cloud, STAMP, encoding).message().sensor_message()
    np.testing.assert_allclose(found.T_frame_cloud, pose_matrix((1, 2, 3), TURN), atol=1e-12)
    found = foxglove_row("/t", "LaserScan", scan, STAMP, encoding).message().sensor_message()
    np.testing.assert_allclose(found.T_frame_scan, pose_matrix((1, 2, 3), TURN), atol=1e-12)


def test_an_unset_pose_is_none():
    cloud = {**STAMPED, "point_stride": 4, "fields": [], "data": b""}
    assert foxglove_row("/t", "PointCloud", cloud, STAMP, "protobuf").message().sensor_message().T_frame_cloud is None
    pose = foxglove_pose((1, 2, 3), (0, 0, 0, 0))
    found = foxglove_row("/t", "PointCloud", {**cloud, "pose": pose}, STAMP, "protobuf").message().sensor_message()
    np.testing.assert_array_equal(found.T_frame_cloud, pose_matrix((1, 2, 3), IDENTITY))


@pytest.mark.parametrize(
    "bad", [((math.nan, 0, 0), IDENTITY), ((1, 0, 0), (math.nan, 0, 0, 1)), ((0, 0, 0), (1e-9, 0, 0, 0))]
)
def test_an_invalid_pose_is_damage(bad):
    cloud = {**STAMPED, "pose": foxglove_pose(*bad), "point_stride": 4, "fields": [], "data": b""}
    with pytest.raises(DamagedMessageError):
        foxglove_row("/t", "PointCloud", cloud, STAMP, "protobuf").message().sensor_message()


def test_scans():
    # Numbers that float32 represents exactly.
    ranges = [1.0, 2.5, math.inf, 0.25]
    rows = ros_rows(
        "sensor_msgs/msg/LaserScan", lambda f: f.scan(STAMP, ranges, angle_min=-0.5, frame_id="camera", limits=(0.5, 8))
    )
    expected = Scan(STAMP, "camera", -0.5, 0.25, 0.5, 8.0, np.array(ranges))
    check(rows, expected)
    fields = {"pose": foxglove_pose((0, 0, 0)), "start_angle": -0.5, "end_angle": 0.25, "ranges": ranges}
    rows = foxglove_rows("LaserScan", {**STAMPED, **fields, "intensities": []})
    # Foxglove's scans have no limits.
    check(rows, dataclasses.replace(expected, range_min=0.0, range_max=math.inf))


def transforms(*children: str, parent: str = "camera") -> Transforms:
    return Transforms(tuple(StampedTransform(STAMP, parent, child, (1.0, 2.0, 3.0), TURN) for child in children))


def test_poses_and_odometry():
    odometry = ros_rows(
        "nav_msgs/msg/Odometry", lambda f: f.odometry(STAMP, (1, 2, 3), TURN, frame_id="camera", child="base")
    )
    odometry["protobuf"] = foxglove_row(
        "/t",
        "Odometry",
        {**STAMPED, "body_frame_id": "base", "pose": foxglove_pose((1, 2, 3), TURN)},
        STAMP,
        "protobuf",
    )
    check(odometry, transforms("base"))
    poses = ros_rows(
        "geometry_msgs/msg/PoseStamped", lambda f: f.pose_stamped(STAMP, (1, 2, 3), TURN, frame_id="camera")
    )
    poses |= foxglove_rows("PoseInFrame", {**STAMPED, "pose": foxglove_pose((1, 2, 3), TURN)})
    check(poses, transforms(""))
    with_covariance = ros_rows(
        "geometry_msgs/msg/PoseWithCovarianceStamped", lambda f: f.pose_with_covariance(STAMP, (1, 2, 3), frame_id="a")
    )
    check(with_covariance, Transforms((StampedTransform(STAMP, "a", "", (1.0, 2.0, 3.0), IDENTITY),)), stamped="a")


def test_poses_without_a_frame_have_that_of_the_path():
    def make(factory):
        poses = [factory.pose_stamped(STAMP, (1, 2, 3), TURN, frame_id=frame) for frame in ("", "other")]
        return factory.path(STAMP, poses, frame_id="camera")

    expected = Transforms((*transforms("").transforms, *transforms("", parent="other").transforms))
    check(ros_rows("nav_msgs/msg/Path", make), expected)


def test_transforms():
    edges = [("camera", child, STAMP, (1, 2, 3), TURN) for child in ("a", "b")]
    rows = ros_rows("tf2_msgs/msg/TFMessage", lambda f: f.tf(*edges))
    rows |= foxglove_rows("FrameTransforms", {"transforms": [foxglove_transform(*edge) for edge in edges]})
    check(rows, transforms("a", "b"), stamped=None)
    check(foxglove_rows("FrameTransform", foxglove_transform(*edges[0])), transforms("a"), stamped=None)
    stamped = ros_rows("geometry_msgs/msg/TransformStamped", lambda f: f.tf(edges[0]).transforms[0])
    check(stamped, transforms("a"))


def test_label_names():
    row = ros_row(Entry("/t", "vision_msgs/msg/LabelInfo", ros2.label_info(STAMP, {4: "x", 2: "y"}), STAMP))
    check({"ros2": row}, LabelNames({4: "x", 2: "y"}), stamped="camera")


def test_kinds_of_all_names_of_a_type():
    assert kind_of("foxglove_msgs/msg/PointCloud") is kind_of("foxglove.PointCloud") is Kind.CLOUD
    assert kind_of("std_msgs/msg/String") is None
    assert {kind_of(name) for name in sensor_messages._TYPES} == set(Kind)


@pytest.mark.parametrize("value", [None, [], 3, "text", SimpleNamespace(), SimpleNamespace(header=None)])
@pytest.mark.parametrize("type_name", [*sensor_messages._TYPES, "std_msgs/msg/String"])
def test_missing_fields_and_unused_types_are_damage(type_name, value):
    with pytest.raises(DamagedMessageError):
        convert(type_name, value)


ODD = [None, -1, 1e300, math.nan, math.inf, 10**400, "text", [], [[1], [2]], {}, True]


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("RawImage", {**STAMPED, "width": 1, "height": 1, "encoding": "mono8", "step": 1, "data": b"a"}),
        ("CompressedImage", {**STAMPED, "data": b"a", "format": "png"}),
        ("CameraCalibration", {**STAMPED, "width": 1, "height": 1, "distortion_model": "", "D": [], "K": [1.0] * 9,
                               "P": []}),
        ("PointCloud", {**STAMPED, "pose": foxglove_pose((0, 0, 0)), "point_stride": 4, "fields": [], "data": b""}),
        ("PointCloud", {**STAMPED, "pose": foxglove_pose((0, 0, 0)), "point_stride": 4, "data": b"",
                        "fields": [{"name": "x", "offset": 0, "type": 7}]}),
        ("LaserScan", {**STAMPED, "pose": foxglove_pose((1, 0, 0)), "start_angle": 0.0, "end_angle": 1.0,
                       "ranges": [1.0]}),
        ("PoseInFrame", {**STAMPED, "pose": foxglove_pose((0, 0, 0))}),
        ("FrameTransform", foxglove_transform("a", "b", STAMP, (0, 0, 0))),
    ],
)  # fmt: skip
def test_invalid_json_values_give_a_record_or_damage(name, fields):
    """Each value of a message, also in nested messages, is replaced by invalid ones."""

    def variants(value):
        yield from ODD
        if isinstance(value, dict):
            for key in value:
                yield {k: v for k, v in value.items() if k != key}
                for variant in variants(value[key]):
                    yield {**value, key: variant}
        if isinstance(value, list):
            for i in range(min(len(value), 2)):
                for variant in variants(value[i]):
                    yield [*value[:i], variant, *value[i + 1 :]]

    num_good = 0
    for variant in variants(fields):
        message = foxglove_row("/t", name, variant, STAMP, "json").message()
        with contextlib.suppress(OctoreplayError):
            assert abs(message.header_stamp_ns()) < 1 << 63
        with contextlib.suppress(OctoreplayError):
            assert isinstance(message.header_frame_id(), str)
        try:
            found = message.sensor_message()
        except OctoreplayError:
            continue
        num_good += 1
        for field in dataclasses.fields(found):
            value = getattr(found, field.name)
            if isinstance(value, int):
                assert abs(value) < 1 << 63
            elif field.name not in ("D", "K", "P", "data", "ranges", "roi", "binning", "range_min", "range_max"):
                assert not isinstance(value, list | dict), field.name
    assert num_good > 0
