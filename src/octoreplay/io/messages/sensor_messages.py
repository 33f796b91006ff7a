"""Sensor, pose and label messages in one form for ROS message types and Foxglove schemas.

Sources: ROS's common_interfaces, geometry2 and vision_msgs; apriltag_ros and
isaac_ros_apriltag_interfaces; livox_ros_driver; velodyne_msgs; https://docs.foxglove.dev/docs/sdk/schemas
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeAlias

import numpy as np

from octoreplay.io.messages import livox, velodyne
from octoreplay.io.messages.decoders import Bytes, DamagedMessageError
from octoreplay.io.messages.inertial import Inertial, convert_imu
from octoreplay.io.messages.ros_types import stamp_to_ns
from octoreplay.records import Float64Array
from octoreplay.transforms import normalise, pose_matrix


class Kind(StrEnum):
    """Kind of a message; the value is the name shown to users."""

    IMAGE = "image"
    COMPRESSED_IMAGE = "compressed image"
    CAMERA_INFO = "CameraInfo"
    CLOUD = "point cloud"
    SCAN = "laser scan"
    ODOMETRY = "odometry"
    POSE = "pose"
    PATH = "path"
    TF = "TF"
    LABEL_INFO = "LabelInfo"
    FIX = "position fix"
    TAGS = "tags"
    IMU = "IMU"


@dataclass(frozen=True, eq=False, slots=True)
class Image:
    """Raw image: rows of ``step`` bytes in ``data``; ``encoding`` as in sensor_msgs/image_encodings."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    is_big_endian: bool
    step: int
    data: Bytes


@dataclass(frozen=True, eq=False, slots=True)
class CompressedImage:
    """Compressed image; ``format`` as in the message: 'png', '16UC1; compressedDepth png', ..."""

    stamp_ns: int
    frame_id: str
    format: str
    data: Bytes


@dataclass(frozen=True, eq=False, slots=True)
class Calibration:
    """Camera parameters as in sensor_msgs/CameraInfo: K (3, 3), P (3, 4), distortion coefficients D of ``model``.

    ``roi`` is (x, y, width, height) in pixels of the full image, before binning; all zeros denote the whole image.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    model: str
    D: Float64Array
    K: Float64Array
    P: Float64Array
    binning: tuple[int, int] = (1, 1)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class CloudField:
    """One field of a point: ``kind`` is a NumPy type code without byte order, such as 'f4'; '' if unknown."""

    name: str
    offset: int
    kind: str
    count: int = 1


@dataclass(frozen=True, eq=False, slots=True)
class Cloud:
    """Points as packed bytes; ``T_frame_cloud`` (4, 4) maps them to ``frame_id`` (None: identity)."""

    stamp_ns: int
    frame_id: str
    height: int
    width: int
    fields: tuple[CloudField, ...]
    is_big_endian: bool
    point_step: int
    row_step: int
    data: Bytes
    T_frame_cloud: Float64Array | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """Planar scan: ``ranges`` [m] at angles about z [rad] from ``angle_min`` on, valid within the limits [m].

    ``T_frame_scan`` (4, 4) maps the scan's frame to ``frame_id`` (None: identity).
    """

    stamp_ns: int
    frame_id: str
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: Float64Array
    T_frame_scan: Float64Array | None = None


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """T_parent_child at a stamp: translation (x, y, z) [m], rotation (x, y, z, w); ``child`` may be empty."""

    stamp_ns: int
    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Transforms:
    """All poses or transforms of one message. With ``holds`` a single one is valid at all times (Foxglove)."""

    transforms: tuple[StampedTransform, ...]
    holds: bool = False


@dataclass(frozen=True, slots=True)
class LabelNames:
    """Class names by raw label, as in vision_msgs/LabelInfo."""

    names: Mapping[int, str]


@dataclass(frozen=True, slots=True)
class PositionFix:
    """Position of an antenna in WGS 84: latitude and longitude [degree], height above the ellipsoid [m].

    ``sigma`` and ``height_sigma`` are the standard deviations [m] of a horizontal coordinate and of the height; NaN
    where they are unknown. ``is_valid`` is False without a fix.
    """

    stamp_ns: int
    frame_id: str
    latitude: float
    longitude: float
    altitude: float
    sigma: float
    height_sigma: float
    is_valid: bool


SensorMessage: TypeAlias = (
    Image | CompressedImage | Calibration | Cloud | Scan | Transforms | LabelNames | PositionFix | Inertial
)


def kind_of(type_name: str) -> Kind | None:
    """Return the kind of messages of a type; None for types that are not used."""
    entry = _TYPES.get(_plain(type_name))
    return None if entry is None else entry[0]


def convert(type_name: str, value: Any) -> SensorMessage:
    """Convert a decoded message of a type that ``kind_of`` knows; bytes are not copied.

    Raises DamagedMessageError where a field is missing or has another type, as in JSON or in a type of the same name,
    and for a type that is not used, as on a topic with several types. For packets of a lidar raises the errors of
    ``velodyne.cloud_of``.
    """
    entry = _TYPES.get(_plain(type_name))
    if entry is None:
        raise DamagedMessageError(f"messages of the type '{type_name}' are not used")
    try:
        return entry[1](value)
    except (AttributeError, TypeError, ValueError, OverflowError, IndexError) as error:
        raise DamagedMessageError(f"the message does not have the fields of a {type_name}") from error


# --- images and cameras ----------------------------------------------------------------------------------------------


def _ros_image(value: Any) -> Image:
    return Image(
        *_head(value), _count(value.height), _count(value.width), str(value.encoding), bool(value.is_bigendian),
        _count(value.step), _data(value),
    )  # fmt: skip


def _foxglove_image(value: Any) -> Image:
    return Image(
        *_head(value), _count(value.height), _count(value.width), str(value.encoding), False, _count(value.step),
        _data(value),
    )  # fmt: skip


def _compressed_image(value: Any) -> CompressedImage:
    return CompressedImage(*_head(value), str(value.format), _data(value))


def _camera_info(value: Any) -> Calibration:
    # ROS 1 and Foxglove have these names in upper case.
    def matrix(name: str, shape: tuple[int, ...]) -> Float64Array:
        numbers = getattr(value, name) if hasattr(value, name) else getattr(value, name.lower())
        return np.asarray(list(numbers), dtype=np.float64).reshape(shape)

    projection = getattr(value, "P", getattr(value, "p", ()))
    roi = getattr(value, "roi", None)
    return Calibration(
        *_head(value), _count(value.width), _count(value.height), str(value.distortion_model), matrix("D", (-1,)),
        matrix("K", (3, 3)), matrix("P", (3, 4)) if len(projection) else np.zeros((3, 4)),
        (max(_count(getattr(value, "binning_x", 1)), 1), max(_count(getattr(value, "binning_y", 1)), 1)),
        (0, 0, 0, 0) if roi is None
        else (_count(roi.x_offset), _count(roi.y_offset), _count(roi.width), _count(roi.height)),
    )  # fmt: skip


# --- clouds and scans ------------------------------------------------------------------------------------------------

# Type codes of sensor_msgs/PointField and foxglove.PackedElementField, which differ in their order.
_ROS_FIELDS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_FOXGLOVE_FIELDS = ("", "u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8")


def _ros_cloud(value: Any) -> Cloud:
    fields = tuple(
        CloudField(str(f.name), _count(f.offset), _kind(_ROS_FIELDS, f.datatype), max(_count(f.count), 1))
        for f in value.fields
    )
    return Cloud(
        *_head(value), _count(value.height), _count(value.width), fields, bool(value.is_bigendian),
        _count(value.point_step), _count(value.row_step), _data(value),
    )  # fmt: skip


def _foxglove_cloud(value: Any) -> Cloud:
    fields = tuple(CloudField(str(f.name), _count(f.offset), _kind(_FOXGLOVE_FIELDS, f.type)) for f in value.fields)
    data, stride = _data(value), _count(value.point_stride)
    width = len(data) // stride if stride > 0 else 0
    return Cloud(*_head(value), 1, width, fields, False, stride, width * stride, data, _pose_matrix(value.pose))


def _kind(kinds: tuple[str, ...], number: Any) -> str:
    return kinds[int(number)] if 0 <= int(number) < len(kinds) else ""


def _ros_scan(value: Any) -> Scan:
    return Scan(
        *_head(value), _finite(value.angle_min), _finite(value.angle_increment), float(value.range_min),
        float(value.range_max), _row(value.ranges),
    )  # fmt: skip


def _foxglove_scan(value: Any) -> Scan:
    ranges = _row(value.ranges)
    start, end = _finite(value.start_angle), _finite(value.end_angle)
    increment = _finite((end - start) / max(ranges.size - 1, 1))
    return Scan(*_head(value), start, increment, 0.0, math.inf, ranges, _pose_matrix(value.pose))


# --- poses -----------------------------------------------------------------------------------------------------------


def _odometry(value: Any) -> Transforms:
    pose = value.pose.pose if hasattr(value.pose, "pose") else value.pose
    child = value.child_frame_id if hasattr(value, "child_frame_id") else getattr(value, "body_frame_id", "")
    return Transforms((StampedTransform(*_head(value), str(child), *_pose(pose)),))


def _transform_stamped(value: Any) -> Transforms:
    parts = _xyz(value.transform.translation), _xyzw(value.transform.rotation)
    return Transforms((StampedTransform(*_head(value), str(value.child_frame_id), *parts),))


def _path(value: Any) -> Transforms:
    # A pose without a frame id is in the path's frame.
    _, frame_id = _head(value)
    heads = [(_head(entry), entry.pose) for entry in value.poses]
    return Transforms(tuple(StampedTransform(stamp, frame or frame_id, "", *_pose(p)) for (stamp, frame), p in heads))


def _tf_message(value: Any) -> Transforms:
    found = [
        _transform_stamped(entry) if hasattr(entry, "header") else _frame_transform(entry) for entry in value.transforms
    ]
    transforms = tuple(transform for part in found for transform in part.transforms)
    return Transforms(transforms, holds=any(part.holds for part in found))


def _frame_transform(value: Any) -> Transforms:
    stamp = stamp_to_ns(value.timestamp)
    parts = _xyz(value.translation), _xyzw(value.rotation)
    return Transforms(
        (StampedTransform(stamp, str(value.parent_frame_id), str(value.child_frame_id), *parts),), holds=True
    )


# --- labels ----------------------------------------------------------------------------------------------------------


def _label_info(value: Any) -> LabelNames:
    return LabelNames({int(entry.class_id): str(entry.class_name) for entry in value.class_map})


# --- known places ----------------------------------------------------------------------------------------------------


def _position_fix(value: Any) -> PositionFix:
    position = float(value.latitude), float(value.longitude), float(value.altitude)
    # STATUS_NO_FIX is -1. Receivers without a fix also give NaN, or latitude and longitude 0.
    has_fix = value.status.status >= 0 if hasattr(value, "status") else True
    in_range = abs(position[0]) <= 90.0 and abs(position[1]) <= 360.0 and abs(position[2]) < 1e6
    variances = _row(value.position_covariance)[::4] if int(value.position_covariance_type) > 0 else np.zeros(3)
    east, north, up = variances if variances.size == 3 and np.all(variances > 0) else (math.nan,) * 3
    sigmas = math.sqrt((east + north) / 2), math.sqrt(up)
    return PositionFix(*_head(value), *position, *sigmas, has_fix and in_range and any(position[:2]))


def _tag_detections(value: Any) -> Transforms:
    # Several ids are those of a bundle of tags with one pose.
    def tag(detection: Any) -> str:
        ids = detection.id if hasattr(detection.id, "__len__") else (detection.id,)
        family = getattr(detection, "family", "")
        return (f"{family}:" if family else "") + "+".join(str(int(number)) for number in ids)

    def pose(part: Any) -> Any:
        return pose(part.pose) if hasattr(part, "pose") else part

    stamp, frame_id = _head(value)
    found = [(tag(detection), pose(detection.pose)) for detection in value.detections]
    return Transforms(tuple(StampedTransform(stamp, frame_id, name, *_pose(part)) for name, part in found))


# --- parts -----------------------------------------------------------------------------------------------------------


def _head(value: Any) -> tuple[int, str]:
    """Return stamp and frame id, of the header or of the message itself."""
    if hasattr(value, "header"):
        return stamp_to_ns(value.header.stamp), str(value.header.frame_id)
    return stamp_to_ns(value.timestamp), str(value.frame_id)


def _data(value: Any) -> Bytes:
    """Return the bytes of a field; JSON has them in base 64."""
    data: Bytes | str = value.data
    return base64.b64decode(data, validate=True) if isinstance(data, str) else memoryview(data)


def _count(number: Any) -> int:
    """Return an unsigned 32-bit integer; JSON may hold any other number. Raises ValueError."""
    count = int(number)
    if not 0 <= count < 1 << 32:
        raise ValueError("not an unsigned 32-bit integer")
    return count


def _finite(number: Any) -> float:
    """Return a finite number. Raises ValueError."""
    if not math.isfinite(float(number)):
        raise ValueError("not a finite number")
    return float(number)


def _row(numbers: Any) -> Float64Array:
    """Return a list of numbers as (N,) float64. Raises ValueError."""
    row = np.asarray(list(numbers), dtype=np.float64)
    if row.ndim != 1:
        raise ValueError("not a list of numbers")
    return row


def _pose(pose: Any) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    return _xyz(pose.position), _xyzw(pose.orientation)


def _pose_matrix(pose: Any) -> Float64Array | None:
    """Return a pose as (4, 4); None for the identity and for an unset pose (all zeros). Raises ValueError."""
    position, quaternion = _pose(pose)
    if not any((*position, *quaternion[:3])):
        return None
    # An unset rotation is the identity.
    rotation = normalise(quaternion) if any(quaternion) else (0.0, 0.0, 0.0, 1.0)
    if rotation is None or not all(map(math.isfinite, position)):
        raise ValueError("not a pose")
    return pose_matrix(position, rotation)


def _xyz(vector: Any) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _xyzw(quaternion: Any) -> tuple[float, float, float, float]:
    return float(quaternion.x), float(quaternion.y), float(quaternion.z), float(quaternion.w)


def _plain(type_name: str) -> str:
    """Return a type's name as in ``_TYPES``, where Foxglove's schemas have one name for all encodings."""
    return type_name.replace("foxglove_msgs/msg/", "foxglove.")


_TYPES: Mapping[str, tuple[Kind, Callable[[Any], SensorMessage]]] = {
    "sensor_msgs/msg/Image": (Kind.IMAGE, _ros_image),
    "foxglove.RawImage": (Kind.IMAGE, _foxglove_image),
    "sensor_msgs/msg/CompressedImage": (Kind.COMPRESSED_IMAGE, _compressed_image),
    "foxglove.CompressedImage": (Kind.COMPRESSED_IMAGE, _compressed_image),
    "sensor_msgs/msg/CameraInfo": (Kind.CAMERA_INFO, _camera_info),
    "foxglove.CameraCalibration": (Kind.CAMERA_INFO, _camera_info),
    "sensor_msgs/msg/PointCloud2": (Kind.CLOUD, _ros_cloud),
    "foxglove.PointCloud": (Kind.CLOUD, _foxglove_cloud),
    **dict.fromkeys(livox.TYPES, (Kind.CLOUD, _ros_cloud)),
    velodyne.TYPE: (Kind.CLOUD, lambda scan: _ros_cloud(velodyne.cloud_of(scan))),
    "sensor_msgs/msg/LaserScan": (Kind.SCAN, _ros_scan),
    "foxglove.LaserScan": (Kind.SCAN, _foxglove_scan),
    **dict.fromkeys(("nav_msgs/msg/Odometry", "foxglove.Odometry"), (Kind.ODOMETRY, _odometry)),
    "geometry_msgs/msg/TransformStamped": (Kind.ODOMETRY, _transform_stamped),
    "geometry_msgs/msg/PoseStamped": (Kind.POSE, _odometry),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (Kind.POSE, _odometry),
    "foxglove.PoseInFrame": (Kind.POSE, _odometry),
    "nav_msgs/msg/Path": (Kind.PATH, _path),
    "tf2_msgs/msg/TFMessage": (Kind.TF, _tf_message),
    "tf/msg/tfMessage": (Kind.TF, _tf_message),
    "foxglove.FrameTransforms": (Kind.TF, _tf_message),
    "foxglove.FrameTransform": (Kind.TF, _frame_transform),
    "vision_msgs/msg/LabelInfo": (Kind.LABEL_INFO, _label_info),
    **dict.fromkeys(("sensor_msgs/msg/NavSatFix", "foxglove.LocationFix"), (Kind.FIX, _position_fix)),
    "sensor_msgs/msg/Imu": (Kind.IMU, convert_imu),
    "apriltag_ros/msg/AprilTagDetectionArray": (Kind.TAGS, _tag_detections),
    "apriltags2_ros/msg/AprilTagDetectionArray": (Kind.TAGS, _tag_detections),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (Kind.TAGS, _tag_detections),
}
