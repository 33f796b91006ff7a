"""Expected motion between two scans: from wheel odometry, else the last motion, with the rotation of an IMU."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Self

import numpy as np

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.config.time import TimeConfig
from octoreplay.io.containers.log_reader import LogReader, RawMessage
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.odometry.inertial import InertialMotion
from octoreplay.odometry.motion import part_of
from octoreplay.records import Float64Array
from octoreplay.transforms import inverse

# Poses are read up to this much log time past the stamp that they are needed for.
_LOOK_AHEAD_NS = 10_000_000_000


class WheelMotion:
    """Motion of the sensor by wheel odometry, which is read beside the scans; a context manager.

    Raises InputError where the log has no such odometry.
    """

    def __init__(self, robot: ResolvedRobot, time: TimeConfig, logs: Sequence[LogReader]) -> None:
        self._log = RobotLog(robot, time, None, logs=logs)
        self._poses = self._log.pose_source()
        self._offset_ns = robot.clock_offset_ns
        self._messages: Iterator[RawMessage] | None = None
        self._last: Float64Array | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._log.close()

    def to(self, stamp_ns: int) -> Float64Array | None:
        """Return the motion (4, 4) since the last call; None where the odometry does not cover both stamps."""
        self._advance(stamp_ns - self._offset_ns)
        pose = self._poses.at(stamp_ns - self._offset_ns)
        last, self._last = self._last, pose
        return None if last is None or pose is None else inverse(last) @ pose

    def _advance(self, stamp_ns: int) -> None:
        """Read the poses up to a stamp."""
        self._poses.forget_before(stamp_ns)
        if self._messages is None:
            self._messages = self._log.pose_messages(self._poses, stamp_ns)
        while not self._poses.is_known(stamp_ns):
            message = next(self._messages, None)
            if message is None:
                return
            elapsed_ns = stamp_ns - (self._log.first_stamp_ns - self._offset_ns)
            if message.log_time_ns - self._log.first_log_time_ns > max(elapsed_ns, 0) + _LOOK_AHEAD_NS:
                return


class ExpectedMotion:
    """Motion to the next scan: by wheel odometry where it is known, else the last motion at constant velocity.

    Where an IMU covers the time between the scans, its rotation replaces that of the last motion.
    """

    def __init__(self, wheels: WheelMotion | None, imu: InertialMotion | None = None) -> None:
        self._wheels, self._imu = wheels, imu
        self._motion, self._seconds = np.eye(4), 0.0
        self.num_by_wheels = 0
        """Number of motions that came from wheel odometry."""
        self.num_by_imu = 0
        """Number of motions with the rotation of the IMU."""

    def to(self, stamp_ns: int, seconds: float, middle_ns: int = 0) -> Float64Array:
        """Return the expected motion (4, 4) in the ``seconds`` up to the next stamp; 0 for the first scan.

        ``middle_ns`` is the time of the middle of the sweep after the stamp, for which the pose is estimated.
        """
        by_wheels = None if self._wheels is None else self._wheels.to(stamp_ns)
        if by_wheels is not None:
            self.num_by_wheels += 1
            return by_wheels
        motion = part_of(self._motion, seconds / self._seconds) if self._seconds > 0 else np.eye(4)
        rotation = None if self._imu is None else self._turn(self._imu, stamp_ns + middle_ns, seconds)
        if rotation is not None:
            self.num_by_imu += 1
            motion[:3, :3] = rotation
        return motion

    @staticmethod
    def _turn(imu: InertialMotion, stamp_ns: int, seconds: float) -> Float64Array | None:
        """Rotation (3, 3) by the IMU up to the next stamp; None for the first scan."""
        if seconds > 0:
            return imu.to(stamp_ns)
        imu.begin(stamp_ns)
        return None

    def learn(self, motion: Float64Array, seconds: float) -> None:
        """Set the last motion (4, 4) and its duration."""
        self._motion, self._seconds = motion, seconds
