"""Messages of IMUs: sensor_msgs/Imu (https://github.com/ros2/common_interfaces, REP 145)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from octoreplay.io.messages.ros_types import stamp_to_ns


@dataclass(frozen=True, slots=True)
class Inertial:
    """Angular velocity [rad/s] and acceleration as in sensor_msgs/Imu, both (x, y, z) in ``frame_id``.

    A value that the IMU does not measure, which its covariance of -1 states, is NaN. The acceleration includes that of
    gravity, upwards at rest. Its unit is m/s^2, with some drivers the standard gravity. The orientation is not read.
    """

    stamp_ns: int
    frame_id: str
    angular_velocity: tuple[float, float, float]
    acceleration: tuple[float, float, float]


def convert_imu(value: Any) -> Inertial:
    """Return the measurements of a decoded message. Raises AttributeError, TypeError, ValueError or IndexError."""
    return Inertial(
        stamp_to_ns(value.header.stamp), str(value.header.frame_id),
        _measured(value.angular_velocity, value.angular_velocity_covariance),
        _measured(value.linear_acceleration, value.linear_acceleration_covariance),
    )  # fmt: skip


def _measured(vector: Any, covariance: Any) -> tuple[float, float, float]:
    """The components of a vector; NaN where its covariance states that it is not measured."""
    if float(covariance[0]) == -1.0:
        return (math.nan,) * 3
    return float(vector.x), float(vector.y), float(vector.z)
