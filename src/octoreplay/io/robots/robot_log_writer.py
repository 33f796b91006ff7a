"""Writer of one robot's ROS 2 log: depth images or clouds, labels, TF, odometry and class names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.ros_types import header, message
from octoreplay.records import CameraModel, ClassTable, Float64Array, UInt8Array
from octoreplay.transforms import rotation_to_quaternion

MAP_FRAME = "map"
"""Default frame of the poses."""

OPTICAL_IN_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of a forward looking optical frame (z forward, x right, y down) in a body (x forward, y left): REP 103."""

_POINT_TYPES = {"u1": 2, "u2": 4, "u4": 6, "f4": 7}
"""sensor_msgs/PointField datatype of each NumPy type of a point's fields."""


class RobotLogWriter:
    """Writes one robot's log as MCAP; a context manager that finishes the file.

    Topics of robot R: ``/R/camera/depth/image_raw`` (16UC1 in millimetres or 32FC1 in metres),
    ``/R/camera/depth/camera_info``, ``/R/camera/labels/image_raw`` (mono8 or mono16),
    ``/R/camera/label_confidence/image_raw`` (mono8), ``/R/labels/label_info`` (once), ``/R/odom``, ``/tf``
    (``map_frame`` to R/base_link), ``/tf_static`` (R/base_link to R/camera_optical_frame) and ``/R/fix``,
    ``/R/camera/color/image_raw`` (rgb8) or ``/R/camera/color/image_raw/compressed`` (JPEG or PNG), and
    ``/R/camera/color/camera_info``.
    Without a ``camera`` the log is a lidar's: ``/R/lidar/points`` in the frame R/lidar replaces the images.

    ``class_table`` is None for a log without labels. ``T_body_sensor`` is (4, 4) float64, from the camera's optical
    frame, or the lidar's, to the base. ``T_body_color`` is that of a colour camera in the frame R/color_optical_frame;
    without it colour images are in the camera's frame. ``distortion`` are the coefficients k1, k2, p1, p2, k3 of the
    camera's lens ('plumb_bob'); None for rectified images. ``start_ns`` is the stamp of messages that are written once,
    at the beginning. Calls must be in time order. Raises OutputError where the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        robot_id: str,
        camera: CameraModel | None,
        class_table: ClassTable | None,
        *,
        T_body_sensor: Float64Array,
        start_ns: int,
        map_frame: str = MAP_FRAME,
        T_body_color: Float64Array | None = None,
        distortion: Sequence[float] | None = None,
    ) -> None:
        self.path = path
        self._camera = camera
        self._distortion = np.zeros(5) if distortion is None else np.array(distortion, np.float64)
        self._depth_topic, self._label_topic, self._info_topic, self._pose_topic, label_info = topics(robot_id)
        self._map_frame, self._body_frame = map_frame, f"{robot_id}/base_link"
        self._confidence_topic = confidence_topic(robot_id)
        self._cloud_topic = cloud_topic(robot_id)
        self._fix_topic = fix_topic(robot_id)
        self._sensor_frame = f"{robot_id}/lidar" if camera is None else f"{robot_id}/camera_optical_frame"
        self._color_folder = f"/{robot_id}/camera/color"
        self._color_frame = self._sensor_frame
        self._writer = RosMcapWriter(path)
        self._write_transform("/tf_static", start_ns, self._body_frame, self._sensor_frame, T_body_sensor)
        if T_body_color is not None:
            self._color_frame = f"{robot_id}/color_optical_frame"
            self._write_transform("/tf_static", start_ns, self._body_frame, self._color_frame, T_body_color)
        if class_table is not None:
            self._writer.write(
                label_info,
                "vision_msgs/msg/LabelInfo",
                label_info_message(class_table, start_ns, self._sensor_frame),
                start_ns,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()

    def write_pose(self, stamp_ns: int, T_map_body: Float64Array, speed: float = 0.0, turn_rate: float = 0.0) -> None:
        """Append the base's pose, (4, 4) float64, as odometry and TF; ``speed`` in m/s, ``turn_rate`` in rad/s."""
        self._write_transform("/tf", stamp_ns, self._map_frame, self._body_frame, T_map_body)
        pose = message(
            "geometry_msgs/msg/Pose",
            position=_xyz("geometry_msgs/msg/Point", T_map_body[:3, 3]),
            orientation=_quaternion(T_map_body[:3, :3]),
        )
        twist = message(
            "geometry_msgs/msg/Twist",
            linear=_xyz("geometry_msgs/msg/Vector3", (speed, 0.0, 0.0)),
            angular=_xyz("geometry_msgs/msg/Vector3", (0.0, 0.0, turn_rate)),
        )
        odometry = message(
            "nav_msgs/msg/Odometry",
            header=header(stamp_ns, self._map_frame),
            child_frame_id=self._body_frame,
            pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self._writer.write(self._pose_topic, "nav_msgs/msg/Odometry", odometry, stamp_ns)

    def write_fix(self, stamp_ns: int, geodetic: Sequence[float], sigma: float, height_sigma: float) -> None:
        """Append a position fix of the base: latitude, longitude [degree], height above the ellipsoid [m] in WGS 84.

        ``sigma`` and ``height_sigma`` are the standard deviations of a horizontal coordinate and of the height [m].
        """
        latitude, longitude, altitude = map(float, geodetic)
        value = message(
            "sensor_msgs/msg/NavSatFix",
            header=header(stamp_ns, self._body_frame),
            # A fix without augmentation, from GPS.
            status=message("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=np.diag([sigma**2, sigma**2, height_sigma**2]).ravel(),
            # COVARIANCE_TYPE_DIAGONAL_KNOWN
            position_covariance_type=2,
        )
        self._writer.write(self._fix_topic, "sensor_msgs/msg/NavSatFix", value, stamp_ns)

    def write_frame(
        self,
        stamp_ns: int,
        depth_image: npt.NDArray[Any],
        label_image: npt.NDArray[Any] | None = None,
        confidence_image: UInt8Array | None = None,
    ) -> None:
        """Append one depth image with its CameraInfo, its label image, and the confidences of the labels.

        ``depth_image`` is (H, W) uint16 in millimetres or float32 in metres; ``label_image`` (H, W) uint8 or uint16
        raw labels; ``confidence_image`` (H, W) uint8 in 1 / 255. Raises InputError for another type or a size other
        than the camera's, and in a lidar's log.
        """
        camera = self._camera
        if camera is None:
            raise InputError(f"{self.path}: topic '{self._depth_topic}': a lidar's log takes no images")
        self._write_image(self._depth_topic, stamp_ns, depth_image, {"u2": "16UC1", "f4": "32FC1"}, camera)
        info = self._camera_info(camera, stamp_ns, self._sensor_frame)
        self._writer.write(self._info_topic, "sensor_msgs/msg/CameraInfo", info, stamp_ns)
        if label_image is not None:
            self._write_image(self._label_topic, stamp_ns, label_image, {"u1": "mono8", "u2": "mono16"}, camera)
        if confidence_image is not None:
            self._write_image(self._confidence_topic, stamp_ns, confidence_image, {"u1": "mono8"}, camera)

    def write_color(self, stamp_ns: int, image: UInt8Array, form: str) -> None:
        """Append one colour image (H, W, 3) uint8 red, green, blue with its CameraInfo.

        The intrinsics are the camera's. ``form`` is 'raw', 'jpeg' or 'png'. Raises InputError for a size other than the
        camera's, and in a lidar's log.
        """
        camera, topic = self._camera, f"{self._color_folder}/image_raw"
        if camera is None or image.shape != (camera.height, camera.width, 3):
            raise InputError(f"{self.path}: topic '{topic}': an image of {image.shape} does not fit the camera")
        if form == "raw":
            self._write_pixels(topic, stamp_ns, image, "rgb8", self._color_frame)
        else:
            _, data = cv2.imencode(f".{form}", np.ascontiguousarray(image[..., ::-1]))
            kind = "sensor_msgs/msg/CompressedImage"
            value = message(
                kind, header=header(stamp_ns, self._color_frame), format=f"rgb8; {form} compressed bgr8", data=data
            )
            self._writer.write(f"{topic}/compressed", kind, value, stamp_ns)
        info = self._camera_info(camera, stamp_ns, self._color_frame)
        self._writer.write(f"{self._color_folder}/camera_info", "sensor_msgs/msg/CameraInfo", info, stamp_ns)

    def write_cloud(
        self,
        stamp_ns: int,
        points: npt.NDArray[Any],
        *,
        labels: npt.NDArray[Any] | None = None,
        confidences: UInt8Array | None = None,
        rgb: npt.NDArray[Any] | None = None,
        intensity: npt.NDArray[Any] | None = None,
    ) -> None:
        """Append one point cloud.

        ``points`` is (P, 3) float in the sensor's frame, metres, written as float32; ``labels`` (P,) uint16 or uint32
        raw labels; ``confidences`` (P,) uint8 those of the labels in 1 / 255; ``rgb`` (P,) uint32 0x00RRGGBB, declared
        as float32 as in PCL, which viewers expect; ``intensity`` (P,) float. Raises InputError for other types or
        lengths, and in a camera's log.
        """
        columns = {name: points[:, axis].astype("<f4") for axis, name in enumerate("xyz")}
        if intensity is not None:
            columns["intensity"] = intensity.astype("<f4")
        if rgb is not None:
            columns["rgb"] = rgb.astype("<u4").view("<f4")
        if labels is not None:
            columns["label"] = labels
        if confidences is not None:
            columns["label_confidence"] = confidences
        num_points = len(points)
        fit = all(c.shape == (num_points,) and c.dtype.str[1:] in _POINT_TYPES for c in columns.values())
        if self._camera is not None or not fit:
            raise InputError(
                f"{self.path}: topic '{self._cloud_topic}': takes clouds in a lidar's log only; labels must be "
                "uint16 or uint32, and labels, confidences, colours and intensities must be given for every point or"
                " for none"
            )
        value = cloud_message(columns, stamp_ns, self._sensor_frame)
        self._writer.write(self._cloud_topic, "sensor_msgs/msg/PointCloud2", value, stamp_ns)

    def _write_image(
        self, topic: str, stamp_ns: int, image: npt.NDArray[Any], encodings: dict[str, str], camera: CameraModel
    ) -> None:
        """Append one image in the encoding of its dtype."""
        encoding = encodings.get(image.dtype.str[1:])
        size = (camera.height, camera.width)
        if encoding is None or image.shape != size:
            raise InputError(
                f"{self.path}: topic '{topic}': an image of {image.shape} {image.dtype} does not fit a camera of {size}"
            )
        self._write_pixels(topic, stamp_ns, image, encoding, self._sensor_frame)

    def _write_pixels(self, topic: str, stamp_ns: int, image: npt.NDArray[Any], encoding: str, frame_id: str) -> None:
        """Append one raw image."""
        self._writer.write(topic, "sensor_msgs/msg/Image", image_message(image, encoding, stamp_ns, frame_id), stamp_ns)

    def _camera_info(self, camera: CameraModel, stamp_ns: int, frame_id: str) -> Any:
        """CameraInfo of the camera; P is that of its rectified images."""
        projection = np.array([[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0]], np.float64)
        region = message(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return message(
            "sensor_msgs/msg/CameraInfo",
            header=header(stamp_ns, frame_id),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=self._distortion,
            k=projection[:, :3].ravel(),
            r=np.eye(3).ravel(),
            p=projection.ravel(),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def _write_transform(self, topic: str, stamp_ns: int, parent: str, child: str, T: Float64Array) -> None:
        """Append one TFMessage with one transform from child to parent."""
        transform = message(
            "geometry_msgs/msg/Transform",
            translation=_xyz("geometry_msgs/msg/Vector3", T[:3, 3]),
            rotation=_quaternion(T[:3, :3]),
        )
        stamped = message(
            "geometry_msgs/msg/TransformStamped",
            header=header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )
        value = message("tf2_msgs/msg/TFMessage", transforms=[stamped])
        self._writer.write(topic, "tf2_msgs/msg/TFMessage", value, stamp_ns)


def image_message(image: npt.NDArray[Any], encoding: str, stamp_ns: int, frame_id: str) -> Any:
    """Return a sensor_msgs/Image of pixels (H, W) or (H, W, channels) in an encoding that fits their type."""
    data = np.ascontiguousarray(image.astype(image.dtype.newbyteorder("<"), copy=False))
    return message(
        "sensor_msgs/msg/Image",
        header=header(stamp_ns, frame_id),
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=data.nbytes // image.shape[0],
        data=data.view(np.uint8).reshape(-1),
    )


def cloud_message(columns: dict[str, npt.NDArray[Any]], stamp_ns: int, frame_id: str) -> Any:
    """Return a sensor_msgs/PointCloud2 of fields (P,) uint8, uint16, uint32 or float32 by name."""
    dtype = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), dtype)
    for name, column in columns.items():
        table[name] = column
    fields = [
        message("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_POINT_TYPES[kind.str[1:]], count=1)
        for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
    ]
    return message(
        "sensor_msgs/msg/PointCloud2",
        header=header(stamp_ns, frame_id),
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=False,
        point_step=table.dtype.itemsize,
        row_step=table.nbytes,
        data=table.view(np.uint8).reshape(-1),
        is_dense=all(bool(np.isfinite(columns[name]).all()) for name in "xyz"),
    )


def label_info_message(class_table: ClassTable, stamp_ns: int, frame_id: str) -> Any:
    """Return a vision_msgs/LabelInfo that names every raw label of a class table."""
    class_map = [
        message("vision_msgs/msg/VisionClass", class_id=raw, class_name=item.name)
        for item in class_table.classes
        for raw in item.raw_labels
    ]
    return message("vision_msgs/msg/LabelInfo", header=header(stamp_ns, frame_id), class_map=class_map, threshold=0.0)


def topics(robot_id: str) -> tuple[str, str, str, str, str]:
    """Return a robot's topics: depth images, label images, camera info, odometry, label info."""
    camera = f"/{robot_id}/camera"
    return (
        f"{camera}/depth/image_raw",
        f"{camera}/labels/image_raw",
        f"{camera}/depth/camera_info",
        f"/{robot_id}/odom",
        f"/{robot_id}/labels/label_info",
    )


def confidence_topic(robot_id: str) -> str:
    """Return the topic of the confidences of a robot's label images."""
    return f"/{robot_id}/camera/label_confidence/image_raw"


def cloud_topic(robot_id: str) -> str:
    """Return the topic of a lidar robot's point clouds."""
    return f"/{robot_id}/lidar/points"


def fix_topic(robot_id: str) -> str:
    """Return the topic of a robot's position fixes."""
    return f"/{robot_id}/fix"


def _quaternion(rotation: npt.ArrayLike) -> Any:
    """geometry_msgs/Quaternion of a rotation matrix."""
    x, y, z, w = rotation_to_quaternion(rotation)
    return message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _xyz(type_name: str, values: Any) -> Any:
    """A message with the fields x, y, z."""
    x, y, z = (float(value) for value in values)
    return message(type_name, x=x, y=y, z=z)
