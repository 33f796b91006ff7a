"""Configuration of one of several sensors of a robot."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass


@dataclass(frozen=True)
class RobotSensor:
    """Configuration of one of several sensors of a robot: topics, camera, frame and range.

    The fields have the meaning that they have in ``RobotConfig``, where those of a robot with one sensor are.
    """

    depth_topic: str | None = None
    label_topic: str | None = None
    confidence_topic: str | None = None
    camera_info_topic: str | None = None
    cloud_topic: str | None = None
    label_field: str | None = None
    confidence_field: str | None = None
    sensor_frame: str | None = None
    intrinsics: tuple[float, ...] | None = None
    rectified: bool | None = None
    depth_unit: float | None = None
    min_range: float | None = None
    max_range: float | None = None
    T_body_sensor: tuple[float, ...] | None = None


SENSOR_KEYS = tuple(item.name for item in dataclasses.fields(RobotSensor))
"""Keys of a sensor: those of a robot that apply to its sensor alone."""
