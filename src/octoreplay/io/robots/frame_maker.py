"""Decoding of sensor messages with their labels and poses into frames: depth images, point clouds, laser scans."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any

from octoreplay.config.robot import RobotConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import RawMessage
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Calibration, Cloud, CompressedImage, Image, Scan
from octoreplay.io.robots.frame_queue import Settled
from octoreplay.io.sensors.cameras import camera_model, check_camera, has_rectified_name, image_size
from octoreplay.io.sensors.clouds import decode_cloud, decode_scan
from octoreplay.io.sensors.images import decode_confidences, decode_depth, decode_labels
from octoreplay.io.sensors.labels import LabelLookup
from octoreplay.records import (
    BodyBox,
    CameraModel,
    CloudFrame,
    DepthFrame,
    Float64Array,
    Frame,
    UInt8Array,
)


class FrameMaker(ABC):
    """Decoder of one sensor's messages."""

    def __init__(self, robot: RobotConfig, labels: LabelLookup | None) -> None:
        self._robot = robot
        self._labels = labels

    @property
    @abstractmethod
    def partner_topics(self) -> tuple[str, ...]:
        """Topics of the messages that are paired with each sensor message; the first is required."""

    @abstractmethod
    def make(
        self, settled: Settled[RawMessage], stamp_ns: int, T_team_sensor: Float64Array, boxes: tuple[BodyBox, ...]
    ) -> Frame | None:
        """Return the frame of a sensor message; None where its labels are missing.

        ``stamp_ns`` is on the team's clock. Raises DamagedMessageError where only this message is unusable, else
        InputError.
        """


class DepthFrameMaker(FrameMaker):
    """Decoder of depth images, raw or compressed, with label and confidence images of the same size."""

    def __init__(self, robot: RobotConfig, labels: LabelLookup | None, calibration: RawMessage | None) -> None:
        super().__init__(robot, labels)
        self._camera: CameraModel | None = None
        self._calibration: Calibration | None = None
        self._where = "" if calibration is None else calibration.where
        if calibration is not None:
            found = calibration.sensor_message()
            if not isinstance(found, Calibration):
                raise InputError(f"{calibration.where}: is of type {calibration.type_name}, not CameraInfo")
            check_camera(found, self._where, is_rectified=_is_rectified(robot))
            self._calibration = found

    @property
    def partner_topics(self) -> tuple[str, ...]:
        """Topics of labels and confidences."""
        if self._labels is None or not self._robot.label_topic:
            return ()
        return tuple(topic for topic in (self._robot.label_topic, self._robot.confidence_topic) if topic)

    def make(
        self, settled: Settled[RawMessage], stamp_ns: int, T_team_sensor: Float64Array, boxes: tuple[BodyBox, ...]
    ) -> DepthFrame:
        """Return the frame of a depth image."""
        message = settled.message
        depth, unit = decode_depth(_image(message), message.where, self._robot.depth_unit)
        camera = self._camera_of(depth, message.where)
        label, confidence = (*settled.partners, None, None)[:2]
        class_image, confidence_image = None, None
        if label is not None and self._labels is not None:
            image = decode_labels(_image(label), label.where)
            self._check_size(image.pixels, depth, label, message)
            class_image = self._labels.of_image(image, label.where)
        if confidence is not None:
            confidence_image = decode_confidences(_image(confidence), confidence.where)
            self._check_size(confidence_image, depth, confidence, message)
        return DepthFrame(
            self._robot.robot_id, stamp_ns, depth, unit, class_image, camera, T_team_sensor, confidence_image, boxes,
            self._robot.min_range, self._robot.max_range,
        )  # fmt: skip

    def _camera_of(self, depth: Any, where: str) -> CameraModel:
        """The camera of an image. Raises InputError where its size differs from the calibration or the first image."""
        height, width = depth.shape
        expected = (0, 0) if self._calibration is None else image_size(self._calibration)
        if self._camera is not None:
            expected = self._camera.width, self._camera.height
        if expected[0] and expected != (width, height):
            reason = "the first image is" if self._calibration is None else "its CameraInfo is for"
            raise InputError(
                f"{where}: the image is {width}x{height}, but {reason} {expected[0]}x{expected[1]}; name the right "
                f"depth_topic or camera_info_topic, or give intrinsics: [fx, fy, cx, cy]"
            )
        if self._camera is None:
            self._camera = self._new_camera(width, height)
        return self._camera

    def _new_camera(self, width: int, height: int) -> CameraModel:
        """A camera with the size of the first image."""
        if self._calibration is None:
            fx, fy, cx, cy = self._robot.intrinsics or (0.0, 0.0, 0.0, 0.0)
            return CameraModel(width, height, fx, fy, cx, cy)
        camera = camera_model(self._calibration, self._where, is_rectified=_is_rectified(self._robot))
        return dataclasses.replace(camera, width=width, height=height)

    @staticmethod
    def _check_size(image: Any, depth: Any, message: RawMessage, depth_message: RawMessage) -> None:
        """Raise InputError where an image has another size than its depth image."""
        if image.shape[:2] != depth.shape:
            raise InputError(
                f"{message.where}: the image is {image.shape[1]}x{image.shape[0]}, but the depth image of "
                f"'{depth_message.topic}' is {depth.shape[1]}x{depth.shape[0]}; name topics of one image size"
            )


class CloudFrameMaker(FrameMaker):
    """Decoder of point clouds and laser scans; labels and confidences are fields of their points."""

    @property
    def partner_topics(self) -> tuple[str, ...]:
        """Empty: clouds have no partners."""
        return ()

    def make(
        self, settled: Settled[RawMessage], stamp_ns: int, T_team_sensor: Float64Array, boxes: tuple[BodyBox, ...]
    ) -> Frame | None:
        """Return the frame of a cloud or a scan."""
        message = settled.message
        found = message.sensor_message()
        if isinstance(found, Scan):
            points, T_frame_points = decode_scan(found), found.T_frame_scan
        elif isinstance(found, Cloud):
            T_frame_points = found.T_frame_cloud
            points = decode_cloud(
                found, message.where, wanted_labels=self._robot.label_field,
                wanted_confidences=self._robot.confidence_field,
            )  # fmt: skip
        else:
            raise DamagedMessageError(f"{message.where}: is of type {message.type_name}, not a point cloud")
        class_ids: UInt8Array | None = None
        if self._labels is not None and points.labels is not None:
            class_ids = self._labels.of_points(points.labels, message.where)
        elif self._labels is not None and self._labels.num_classes > 1:
            return None
        if T_frame_points is not None:
            # Rays begin at the origin of the frame that the points are given in.
            T_team_sensor = T_team_sensor @ T_frame_points
        confidences = points.confidences if class_ids is not None else None
        return CloudFrame(
            self._robot.robot_id, stamp_ns, points.points, class_ids, T_team_sensor, confidences, boxes,
            self._robot.min_range, self._robot.max_range,
        )  # fmt: skip


def _image(message: RawMessage) -> Image | CompressedImage:
    """The image in a message. Raises DamagedMessageError for a message of another type on the topic."""
    found = message.sensor_message()
    if not isinstance(found, Image | CompressedImage):
        raise DamagedMessageError(f"{message.where}: is of type {message.type_name}, not an image")
    return found


def _is_rectified(robot: RobotConfig) -> bool:
    """True where the depth image is rectified, by the team file or else by the topic's name."""
    if robot.rectified is not None:
        return robot.rectified
    return has_rectified_name(str(robot.depth_topic))
