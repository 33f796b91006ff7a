"""One robot's ordinary log: depth, labels, intrinsics, TF, odometry and class names, as a ROS 2 robot records them."""

from __future__ import annotations

import math
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay.errors import InputError
from octoreplay.io.containers.mcap_writer import RosMcapWriter
from octoreplay.io.messages.ros_types import header, message
from octoreplay.records import CameraModel, ClassTable, Float64Array

MAP_FRAME = "map"
"""The frame that the logs' poses are given in."""

OPTICAL_IN_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of a forward looking optical frame (z forward, x right, y down) in a body (x forward, y left): REP 103."""


class RobotLogWriter:
    """Writes one robot's log as MCAP; a context manager that finishes the file.

    Topics of robot R: ``/R/camera/depth/image_raw`` (16UC1 in millimetres or 32FC1 in metres),
    ``/R/camera/depth/camera_info``, ``/R/camera/labels/image_raw`` (mono8 or mono16), ``/R/labels/label_info`` (once),
    ``/R/odom``, ``/tf`` (map to R/base_link) and ``/tf_static`` (R/base_link to R/camera_optical_frame).

    ``class_table`` is None for a log without labels. ``T_body_sensor`` is (4, 4) float64, from the camera's optical
    frame to the base. ``start_ns`` stamps what is written once, before everything else. Calls must come in time order.
    Raises OutputError where the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        robot_id: str,
        camera: CameraModel,
        class_table: ClassTable | None,
        *,
        T_body_sensor: Float64Array,
        start_ns: int,
    ) -> None:
        self.path = path
        self._camera = camera
        self._depth_topic, self._label_topic, self._info_topic, self._pose_topic, label_info = topics(robot_id)
        self._body_frame = f"{robot_id}/base_link"
        self._camera_frame = f"{robot_id}/camera_optical_frame"
        self._writer = RosMcapWriter(path)
        self._write_transform("/tf_static", start_ns, self._body_frame, self._camera_frame, T_body_sensor)
        if class_table is not None:
            self._writer.write(
                label_info, "vision_msgs/msg/LabelInfo", self._label_info(class_table, start_ns), start_ns
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()

    def write_pose(self, stamp_ns: int, T_map_body: Float64Array, speed: float = 0.0, turn_rate: float = 0.0) -> None:
        """Append the base's pose, (4, 4) float64, as odometry and TF; ``speed`` in m/s, ``turn_rate`` in rad/s."""
        self._write_transform("/tf", stamp_ns, MAP_FRAME, self._body_frame, T_map_body)
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
            header=header(stamp_ns, MAP_FRAME),
            child_frame_id=self._body_frame,
            pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self._writer.write(self._pose_topic, "nav_msgs/msg/Odometry", odometry, stamp_ns)

    def write_frame(
        self, stamp_ns: int, depth_image: npt.NDArray[Any], label_image: npt.NDArray[Any] | None = None
    ) -> None:
        """Append one depth image with its CameraInfo, and its label image.

        ``depth_image`` is (H, W) uint16 in millimetres or float32 in metres; ``label_image`` (H, W) uint8 or uint16
        raw labels. Raises InputError for another type or a size other than the camera's.
        """
        self._write_image(self._depth_topic, stamp_ns, depth_image, {"u2": "16UC1", "f4": "32FC1"})
        self._writer.write(self._info_topic, "sensor_msgs/msg/CameraInfo", self._camera_info(stamp_ns), stamp_ns)
        if label_image is not None:
            self._write_image(self._label_topic, stamp_ns, label_image, {"u1": "mono8", "u2": "mono16"})

    def _write_image(self, topic: str, stamp_ns: int, image: npt.NDArray[Any], encodings: dict[str, str]) -> None:
        """Append one image in the encoding of its type."""
        encoding = encodings.get(image.dtype.str[1:])
        size = (self._camera.height, self._camera.width)
        if encoding is None or image.shape != size:
            raise InputError(
                f"{self.path}: topic '{topic}': an image of {image.shape} {image.dtype} does not fit a camera of {size}"
            )
        data = np.ascontiguousarray(image.astype(image.dtype.newbyteorder("<"), copy=False))
        value = message(
            "sensor_msgs/msg/Image",
            header=header(stamp_ns, self._camera_frame),
            height=size[0],
            width=size[1],
            encoding=encoding,
            is_bigendian=0,
            step=size[1] * image.dtype.itemsize,
            data=data.view(np.uint8).reshape(-1),
        )
        self._writer.write(topic, "sensor_msgs/msg/Image", value, stamp_ns)

    def _camera_info(self, stamp_ns: int) -> Any:
        """CameraInfo of the rectified camera."""
        camera = self._camera
        projection = np.array([[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0]], np.float64)
        region = message(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return message(
            "sensor_msgs/msg/CameraInfo",
            header=header(stamp_ns, self._camera_frame),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=projection[:, :3].ravel(),
            r=np.eye(3).ravel(),
            p=projection.ravel(),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def _label_info(self, class_table: ClassTable, stamp_ns: int) -> Any:
        """LabelInfo that names every raw label of a class table."""
        class_map = [
            message("vision_msgs/msg/VisionClass", class_id=raw, class_name=item.name)
            for item in class_table.classes
            for raw in item.raw_labels
        ]
        return message(
            "vision_msgs/msg/LabelInfo",
            header=header(stamp_ns, self._camera_frame),
            class_map=class_map,
            threshold=0.0,
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


def topics(robot_id: str) -> tuple[str, str, str, str, str]:
    """A robot's topics: depth images, label images, camera info, odometry, label info."""
    camera = f"/{robot_id}/camera"
    return (
        f"{camera}/depth/image_raw",
        f"{camera}/labels/image_raw",
        f"{camera}/depth/camera_info",
        f"/{robot_id}/odom",
        f"/{robot_id}/labels/label_info",
    )


def rotation_to_quaternion(rotation: npt.ArrayLike) -> tuple[float, float, float, float]:
    """The quaternion (x, y, z, w), w >= 0, of a (3, 3) rotation matrix.

    Starts from the largest of the four components, so that nothing is divided by a small number (Shepperd 1978).
    """
    r = np.asarray(rotation, dtype=np.float64)
    squares = np.array([1 + r[0, 0] - r[1, 1] - r[2, 2], 1 - r[0, 0] + r[1, 1] - r[2, 2],
                        1 - r[0, 0] - r[1, 1] + r[2, 2], 1 + r[0, 0] + r[1, 1] + r[2, 2]])  # fmt: skip
    largest = int(np.argmax(squares))
    rows = (
        (squares[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]),
        (r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]),
        (r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]),
        (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]),
    )
    x, y, z, w = (float(value) for value in rows[largest])
    norm = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
    return x / norm, y / norm, z / norm, w / norm


def _quaternion(rotation: npt.ArrayLike) -> Any:
    """geometry_msgs/Quaternion of a rotation matrix."""
    x, y, z, w = rotation_to_quaternion(rotation)
    return message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _xyz(type_name: str, values: Any) -> Any:
    """A message with the fields x, y, z."""
    x, y, z = (float(value) for value in values)
    return message(type_name, x=x, y=y, z=z)
