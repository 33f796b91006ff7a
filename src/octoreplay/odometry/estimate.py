"""Trajectory of a robot's sensor from its scans."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np

from octoreplay.config.time import TimeConfig
from octoreplay.errors import InputError
from octoreplay.io.containers.log_reader import LogReader
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.robot_log_writer import OPTICAL_IN_BODY
from octoreplay.odometry.depth import DepthOdometry
from octoreplay.odometry.guess import ExpectedMotion, WheelMotion
from octoreplay.odometry.inertial import find_imu, levelled
from octoreplay.odometry.lidar import LidarOdometry
from octoreplay.odometry.motion import part_of
from octoreplay.odometry.quality import Limits, Quality, fault_of
from octoreplay.odometry.registration import Odometer, ScanPose
from octoreplay.odometry.scans import TimedCloud, TimedCloudMaker, colored_depth_maker
from octoreplay.odometry.source import OdometrySource, SensorKind
from octoreplay.records import Float64Array, FrameCounts, Int64Array
from octoreplay.transforms import inverse

# Number of scans without a pose after which the local map begins again.
_PATIENCE = 5
# Least constraint of a depth image: errors of 0.3 m occurred below 0.0125 and of 2 mm above 0.02 (a simulated room).
_DEPTH_CONSTRAINT = 0.015
# A share of scans below which the poses are worthless.
_LEAST_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class OdometryResult:
    """Trajectory from odometry.

    Attributes
    ----------
    stamps_ns : (n,) int64
        Stamps of the scans with a pose, without the robot's clock offset.
    poses : (n, 4, 4) float64
        T_map_frame. The map is ``body_frame`` as it is at the first scan, so that z points up where the body's does.
        Where ``is_level``, z is the vertical by the IMU and x the horizontal part of the body's x axis.
    frame, sensor_frame, body_frame : str
        Frame that the poses describe, frame of the sensor, and the highest frame that fixed transforms join to the
        sensor. Without such transforms ``body_frame`` is the sensor's frame; for a camera, its axes forward, left, up.
    T_frame_sensor : (4, 4) float64
        Transform from the sensor to ``frame``; the identity where the poses are the sensor's.
    quality : Quality
    counts : FrameCounts
        Messages by outcome of reading.
    imu_topic : str or None
        IMU that gave rotations.
    is_level : bool
        True where a standstill at the first scan gave the vertical.
    num_unusable_imu : int
        Messages of this IMU that could not be used.
    unjoined_imus : dict of str to str
        Topics of IMUs that fixed transforms do not join to the sensor, with their frames.
    """

    stamps_ns: Int64Array
    poses: Float64Array
    frame: str
    sensor_frame: str
    body_frame: str
    T_frame_sensor: Float64Array
    quality: Quality
    counts: FrameCounts
    imu_topic: str | None = None
    is_level: bool = False
    num_unusable_imu: int = 0
    unjoined_imus: Mapping[str, str] = field(default_factory=dict)


def estimate(
    source: OdometrySource,
    time: TimeConfig,
    logs: Sequence[LogReader],
    *,
    frame: str | None = None,
    max_range: float | None = None,
    voxel_size: float | None = None,
    limits: Limits | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> OdometryResult:
    """Return the trajectory of a frame of the robot (default: the sensor) from its scans.

    Scans are read and registered one by one. ``max_range`` [m] leaves out farther points (default: 100 m for clouds,
    10 m for depth images), ``voxel_size`` [m] is the edge of the voxels of the local map of clouds. ``progress`` is
    called with the number of scans so far. Raises InputError where fewer than two scans, or less than half of them,
    have a pose, and where no fixed transform joins ``frame`` to the sensor; ConfigError without the package of the
    sensor's kind.
    """
    with ExitStack() as stack:
        log = RobotLog(
            source.robot, time, None, logs=logs, depth_maker=colored_depth_maker(source.color_topic),
            cloud_maker=TimedCloudMaker,
        )  # fmt: skip
        stack.enter_context(log)
        poses = log.pose_source()
        T_frame_sensor = _mount(poses, frame, logs)
        wheels = None if source.wheels is None else stack.enter_context(WheelMotion(source.wheels, time, logs))
        imu, unjoined = find_imu(source.imus, logs, poses, time, source.robot.clock_offset_ns)
        if imu is None and source.needs_imu:
            raise InputError(_unjoined(unjoined, poses.sensor_frame, logs))
        odometer: Odometer
        if source.kind is SensorKind.LIDAR:
            odometer = LidarOdometry(max_range=max_range or 100.0, voxel_size=voxel_size)
        else:
            odometer = DepthOdometry(max_range=max_range or 10.0)
            limits = dataclasses.replace(limits or Limits(), min_constraint=_DEPTH_CONSTRAINT)
        expected = ExpectedMotion(wheels, imu)
        stamps, found, quality = _track(log, odometer, expected, limits or Limits(), progress)
        quality.num_by_wheels, quality.num_by_imu = expected.num_by_wheels, expected.num_by_imu
        _check(quality, log)
    T_body_sensor, body_frame = _start(poses, source)
    up = None if imu is None else imu.up
    if up is not None:
        T_body_sensor = levelled(T_body_sensor, up) @ T_body_sensor
    T_sensor_frame = inverse(T_frame_sensor)
    T_first_sensor = _at_stamps(stamps, found)
    T_map_sensor = T_body_sensor @ inverse(T_first_sensor[0]) @ T_first_sensor
    return OdometryResult(
        np.array(stamps, np.int64) - source.robot.clock_offset_ns, T_map_sensor @ T_sensor_frame,
        frame or poses.sensor_frame, poses.sensor_frame, body_frame, T_frame_sensor, quality, log.counts,
        None if imu is None else imu.topic, up is not None, 0 if imu is None else imu.num_unusable, unjoined,
    )  # fmt: skip


def _track(
    log: RobotLog, odometer: Odometer, expected: ExpectedMotion, limits: Limits, progress: Callable[[int], None]
) -> tuple[list[int], list[ScanPose], Quality]:
    """Stamps and poses of the scans that keep the limits, and their quality."""
    stamps: list[int] = []
    found: list[ScanPose] = []
    quality = Quality()
    last_ns: int | None = None
    T_last, velocity, num_lost = np.eye(4), None, 0
    for frame in log.frames():
        seconds = 0.0 if last_ns is None else (frame.stamp_ns - last_ns) / 1e9
        middle = frame.middle if isinstance(frame, TimedCloud) else 0.0
        motion = expected.to(frame.stamp_ns, seconds, round(middle * 1e9))
        pose = odometer.register(frame, np.eye(4) if last_ns is None else motion, seconds)
        moved = inverse(T_last) @ pose.T_map_sensor
        fault = fault_of(pose, moved, velocity, seconds, limits) if last_ns is not None else _first_fault(pose.overlap)
        if fault is None:
            odometer.keep()
            quality.use(pose, float(np.linalg.norm(moved[:3, 3])) if stamps else 0.0)
            stamps.append(frame.stamp_ns)
            found.append(pose)
            T_last, num_lost = pose.T_map_sensor, 0
            if seconds > 0:
                expected.learn(moved, seconds)
                velocity = _per_second(moved, seconds)
        elif stamps:
            quality.lose(fault, frame.stamp_ns, is_first=num_lost == 0)
            num_lost += 1
            T_last, velocity = T_last @ motion, None
            if num_lost % _PATIENCE == 0:
                odometer.restart()
                quality.num_breaks += 1
            else:
                odometer.leave_out()
        else:
            quality.lose(fault, frame.stamp_ns, is_first=num_lost == 0)
            num_lost += 1
            progress(quality.num_scans)
            continue
        last_ns = frame.stamp_ns
        progress(quality.num_scans)
    return stamps, found, quality


def _at_stamps(stamps: Sequence[int], found: Sequence[ScanPose]) -> Float64Array:
    """Poses (n, 4, 4) at the stamps of the scans, from those at some time in their sweeps, at constant velocity."""
    result = [found[0].T_map_sensor]
    for (before_ns, before), (after_ns, after) in itertools.pairwise(zip(stamps, found, strict=True)):
        seconds = (after_ns - before_ns) / 1e9 + after.offset - before.offset
        motion = inverse(before.T_map_sensor) @ after.T_map_sensor
        if len(result) == 1:
            result[0] = before.T_map_sensor @ part_of(motion, -before.offset / seconds)
        result.append(after.T_map_sensor @ part_of(motion, -after.offset / seconds))
    return np.array(result)


def _first_fault(overlap: float) -> str | None:
    """Fault of the first scan: too few points."""
    return None if overlap > 0 else "num_low_overlap"


def _per_second(motion: Float64Array, seconds: float) -> Float64Array:
    """A motion scaled to one second, its translation only."""
    result = np.eye(4)
    result[:3, 3] = motion[:3, 3] / seconds
    return result


def _mount(poses: PoseSource, frame: str | None, logs: Sequence[LogReader]) -> Float64Array:
    """T_frame_sensor (4, 4). Raises InputError where no fixed transform joins the frame to the sensor."""
    if frame is None or frame == poses.sensor_frame:
        return np.eye(4)
    T_sensor_frame = poses.T_sensor_frame(frame)
    if T_sensor_frame is None:
        paths = ", ".join(str(log.path) for log in logs)
        raise InputError(
            f"{paths}: no fixed transform in TF joins '{frame}' to the sensor's frame '{poses.sensor_frame}'; name "
            f"another --frame, or leave it out for the poses of the sensor"
        )
    return inverse(T_sensor_frame)


def _unjoined(imus: Mapping[str, str], sensor_frame: str, logs: Sequence[LogReader]) -> str:
    """Error for a named IMU that cannot be used."""
    paths = ", ".join(str(log.path) for log in logs)
    named = ", ".join(f"the frame '{frame}' of '{topic}'" for topic, frame in imus.items()) or "an IMU with a frame"
    return (
        f"{paths}: no fixed transform in TF joins {named} to the sensor's frame '{sensor_frame}'; record /tf_static, "
        f"or use --guess none"
    )


def _start(poses: PoseSource, source: OdometrySource) -> tuple[Float64Array, str]:
    """Pose of the sensor in the map at the first scan, and the name of the body that begins at the map's origin."""
    body_frame = poses.body_frame
    T_sensor_body = poses.T_sensor_frame(body_frame) if body_frame != poses.sensor_frame else None
    if T_sensor_body is not None:
        return inverse(T_sensor_body), body_frame
    T_body_sensor = np.eye(4)
    if source.kind is not SensorKind.LIDAR:
        T_body_sensor[:3, :3] = OPTICAL_IN_BODY
    return T_body_sensor, body_frame


def _check(quality: Quality, log: RobotLog) -> None:
    """Raise InputError where the poses are worthless."""
    paths = ", ".join(str(path) for path in log.robot.logs)
    if quality.num_scans < 2:
        raise InputError(
            f"{paths}: topic '{log.sensor_topic}' has {quality.num_scans} usable scan{'s'[: quality.num_scans != 1]}, "
            f"and odometry needs two; give --static-pose to 'octoreplay run' for a sensor that stands still"
        )
    if quality.num_registered < 2 or quality.registered_share < _LEAST_SHARE:
        causes = {
            "share too few points with earlier scans": quality.num_low_overlap,
            "leave a direction of motion open (a wall or a floor alone)": quality.num_unconstrained,
            "jump": quality.num_jumps,
        }
        worst = max(causes, key=lambda cause: causes[cause])
        raise InputError(
            f"{paths}: only {quality.num_registered} of {quality.num_scans} scans of '{log.sensor_topic}' could "
            f"be registered; {causes[worst]} of them {worst}; use another --sensor or --topic, a larger --max-range, "
            f"or poses from elsewhere"
        )
