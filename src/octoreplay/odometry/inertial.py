"""Rotation of the sensor and direction of the vertical from an IMU.

Source of the fields and units: REP 145 (https://ros.org/reps/rep-0145.html) and sensor_msgs/Imu.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise

import numpy as np

from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import LogReader, RawMessage, first_whole_message
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.inertial import Inertial
from octoreplay.io.messages.sensor_messages import Kind
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.stamp_check import StampCheck
from octoreplay.records import Float64Array

# Longest time between two samples, and longest time between two scans.
_MAX_GAP_NS, _MAX_SPAN_NS = 100_000_000, 10_000_000_000
# Bounds of damaged samples: angular velocity [rad/s], acceleration [m/s^2].
_MAX_RATE, _MAX_ACCELERATION = 100.0, 1000.0
# Lengths of a standstill from the first scan on, the longest first.
_STILL_NS = (2_000_000_000, 1_000_000_000, 500_000_000)
_MIN_STILL_SAMPLES = 10
# Limits at a standstill: standard deviation and mean of the angular velocity [rad/s], standard deviation of the
# acceleration relative to its mean, and deviation of this mean from 9.81 m/s^2, or from 1 g
# where a driver uses this unit.
_STILL_NOISE, _MAX_BIAS = 0.03, 0.05
_STILL_SHAKE, _GRAVITY_ERROR = 0.03, 0.05
_GRAVITIES = (9.81, 1.0)


class InertialMotion:
    """Rotation of the sensor between stamps by the samples of one IMU topic.

    ``R_sensor_imu`` (3, 3) is the fixed rotation from the IMU's frame to the sensor's. Without ``logs`` the samples
    come by ``take`` alone. All stamps are in nanoseconds and include the clock offset ``offset_ns``. A sample whose
    stamp is damaged (``StampCheck``) or not later than the one before, or that is not finite, is not used.
    """

    def __init__(
        self, topic: str, R_sensor_imu: Float64Array, logs: Sequence[LogReader] = (), *, offset_ns: int = 0,
        use_log_time: bool = False,
    ) -> None:  # fmt: skip
        self.topic = topic
        self.num_unusable = 0
        """Number of messages that could not be used: damaged, late, or without an angular velocity."""
        self.up: Float64Array | None = None
        """Direction of the vertical in the sensor's frame at the first scan, (3,); None without a standstill."""
        self.bias = np.zeros(3)
        """Bias of the angular velocity in the sensor's frame, (3,) [rad/s]."""
        self._R_sensor_imu = R_sensor_imu
        self._messages: Iterator[RawMessage] = heapq.merge(
            *(log.messages((topic,)) for log in logs), key=lambda message: message.log_time_ns
        )
        self._offset_ns, self._use_log_time = offset_ns, use_log_time
        self._check = StampCheck(offset_ns)
        self._stamps: list[int] = []
        self._rates: list[Float64Array] = []
        self._accelerations: list[Float64Array] = []
        self._last_ns: int | None = None

    def begin(self, stamp_ns: int) -> None:
        """Begin at the first scan: a standstill of at least 0.5 s from its stamp on gives the bias and the vertical."""
        self._last_ns, self.up, self.bias = stamp_ns, None, np.zeros(3)
        self._read(stamp_ns, stamp_ns + _STILL_NS[0] + _MAX_GAP_NS)
        # The IMU may start shortly after the scanner.
        start_ns = max(stamp_ns, self._stamps[0]) if self._stamps else stamp_ns
        if start_ns - stamp_ns > _MAX_GAP_NS:
            return
        for length_ns in _STILL_NS:
            if self._is_covered(start_ns, start_ns + length_ns):
                first, last = bisect_left(self._stamps, start_ns), bisect_right(self._stamps, start_ns + length_ns)
                rates, accelerations = np.array(self._rates[first:last]), np.array(self._accelerations[first:last])
                if _is_still(rates, accelerations):
                    mean = accelerations.mean(axis=0)
                    self.bias, self.up = rates.mean(axis=0), mean / np.linalg.norm(mean)
                    return

    def to(self, stamp_ns: int) -> Float64Array | None:
        """Return the rotation (3, 3) since the last call; None where the samples do not cover it."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is None or not 0 < stamp_ns - last_ns <= _MAX_SPAN_NS:
            return None
        self._read(last_ns, stamp_ns)
        rotation = self.rotation_between(last_ns, stamp_ns)
        self._forget_before(stamp_ns)
        return rotation

    def rotation_between(self, start_ns: int, end_ns: int) -> Float64Array | None:
        """Return R_start_end (3, 3) of the sensor; None where samples around or between the stamps are missing.

        The angular velocity is linear between samples, and each step turns by its mean (midpoint rule).
        """
        from scipy.spatial.transform import Rotation

        if not self._is_covered(start_ns, end_ns):
            return None
        first, last = bisect_right(self._stamps, start_ns), bisect_left(self._stamps, end_ns)
        within = [(stamp - start_ns) / 1e9 for stamp in self._stamps[first:last]]
        knots = np.array([0.0, *within, (end_ns - start_ns) / 1e9])
        # The samples around the stamps give the values at them.
        low, high = max(first - 1, 0), last + 1
        times = np.array([stamp - start_ns for stamp in self._stamps[low:high]]) / 1e9
        rates = np.array(self._rates[low:high]) - self.bias
        at = np.stack([np.interp(knots, times, rates[:, axis]) for axis in range(3)], axis=1)
        steps = (at[1:] + at[:-1]) / 2.0 * np.diff(knots)[:, None]
        result = np.eye(3)
        for step in Rotation.from_rotvec(steps).as_matrix():
            result = result @ step
        return result

    def take(self, message: RawMessage, needed_from_ns: int | None = None) -> None:
        """Take a message of the topic; one before ``needed_from_ns`` is not decoded."""
        with suppress(InputError):
            stamp = message.log_time_ns if self._use_log_time else message.header_stamp_ns()
            if self._check.is_good(message.topic, stamp, message.log_time_ns):
                stamp += self._offset_ns
                if needed_from_ns is not None and stamp < needed_from_ns:
                    return
                if self._add(stamp, message.sensor_message()):
                    return
        self.num_unusable += 1

    def _add(self, stamp_ns: int, found: object) -> bool:
        """Add a sample; False where it cannot be used."""
        if not isinstance(found, Inertial) or (self._stamps and stamp_ns <= self._stamps[-1]):
            return False
        rate = np.array(found.angular_velocity)
        if not (np.abs(rate) <= _MAX_RATE).all():
            return False
        acceleration = np.array(found.acceleration)
        if not (np.abs(acceleration) <= _MAX_ACCELERATION).all():
            acceleration = np.full(3, np.nan)
        self._stamps.append(stamp_ns)
        self._rates.append(self._R_sensor_imu @ rate)
        self._accelerations.append(self._R_sensor_imu @ acceleration)
        return True

    def _read(self, from_ns: int, to_ns: int) -> None:
        """Read the samples from around one stamp up to another."""
        self._forget_before(from_ns)
        while not self._stamps or self._stamps[-1] < to_ns:
            message = next(self._messages, None)
            if message is None:
                return
            self.take(message, from_ns - _MAX_GAP_NS)

    def _forget_before(self, stamp_ns: int) -> None:
        """Forget the samples that no rotation from a stamp on needs."""
        num = max(bisect_right(self._stamps, stamp_ns) - 1, 0)
        del self._stamps[:num], self._rates[:num], self._accelerations[:num]

    def _is_covered(self, start_ns: int, end_ns: int) -> bool:
        """True where samples are at or around both stamps, without a gap."""
        first = bisect_right(self._stamps, start_ns) - 1
        last = bisect_left(self._stamps, end_ns)
        if first < 0 or last >= len(self._stamps):
            return False
        return all(after - before <= _MAX_GAP_NS for before, after in pairwise(self._stamps[first : last + 1]))


def find_imu(
    topics: Sequence[str], logs: Sequence[LogReader], poses: PoseSource, time: TimeConfig, offset_ns: int
) -> tuple[InertialMotion | None, dict[str, str]]:
    """Return the first of some IMU topics with a frame that fixed transforms join to the sensor, and the others.

    The second value holds the frame of each IMU before it that is not joined.
    """
    unjoined: dict[str, str] = {}
    for topic in topics:
        firsts = [first_whole_message(log, topic, (Kind.IMU,)) for log in logs]
        first = min((m for m in firsts if m is not None), key=lambda message: message.log_time_ns, default=None)
        if first is None:
            continue
        try:
            frame = first.header_frame_id().lstrip("/")
        except DamagedMessageError:
            continue
        T_sensor_imu = np.eye(4) if frame == poses.sensor_frame else poses.T_sensor_frame(frame)
        if T_sensor_imu is not None:
            use_log_time = time.clock == "log"
            imu = InertialMotion(topic, T_sensor_imu[:3, :3], logs, offset_ns=offset_ns, use_log_time=use_log_time)
            return imu, unjoined
        unjoined[topic] = frame
    return None, unjoined


def levelled(T_body_sensor: Float64Array, up_sensor: Float64Array) -> Float64Array:
    """Return T_map_body (4, 4), a rotation about the body's origin with z along the vertical.

    ``up_sensor`` (3,) is the vertical in the sensor's frame. The map's x axis is the horizontal part of the body's, or
    of its z axis where the body's x axis is vertical.
    """
    up = T_body_sensor[:3, :3] @ up_sensor
    forward = np.eye(3)[0] if abs(up[0]) < 0.99 else np.eye(3)[2]
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    result = np.eye(4)
    result[:3, :3] = x, np.cross(up, x), up
    return result


def _is_still(rates: Float64Array, accelerations: Float64Array) -> bool:
    """True where samples (n, 3) are steady, with a mean acceleration of gravity."""
    if len(rates) < _MIN_STILL_SAMPLES or not np.isfinite(accelerations).all():
        return False
    gravity = float(np.linalg.norm(accelerations.mean(axis=0)))
    return bool(
        (rates.std(axis=0) <= _STILL_NOISE).all()
        and np.linalg.norm(rates.mean(axis=0)) <= _MAX_BIAS
        and any(abs(gravity - usual) <= _GRAVITY_ERROR * usual for usual in _GRAVITIES)
        and (accelerations.std(axis=0) <= _STILL_SHAKE * gravity).all()
    )
