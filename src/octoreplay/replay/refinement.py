"""Repair of drift of a team's logs: submaps, corrected trajectories, and their test on scans that were held back."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.pose_files import write_tum
from octoreplay.io.messages.decoders import DamagedMessageError
from octoreplay.io.messages.sensor_messages import Transforms
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.io.robots.team_frames import frames_warning
from octoreplay.mapping.scan_points import scan_points
from octoreplay.mapping.sensor import sensor_reach
from octoreplay.records import Float64Array, Frame, FrameCounts, Int64Array, UInt8Array
from octoreplay.registration.drift import Correction, DriftModel, Track, correction_of, repair_drift
from octoreplay.registration.submaps import Submap
from octoreplay.replay.held_back import RobotScore, compare_held_back, is_held_back, judge
from octoreplay.transforms import inverse, numbers_of, transform_of

# Scans a second that are read, unless rate_limit is set.
_SCAN_RATE = 5.0
_POINTS_PER_SCAN = 5_000
# Edge length of a submap's voxels in cells, and range of its points in max_range.
_VOXEL_CELLS, _RANGE_SHARE = 2.0 / 3.0, 1.5
# A mount moves where T_body_sensor changes by more than this.
_FIXED_MOUNT = 1e-6


@dataclass(frozen=True)
class RefinementConfig:
    """Settings of the repair of drift.

    Attributes
    ----------
    submap_seconds : float
        Length of a submap [s].
    hold_back : int
        Every n-th scan is held back for the test.
    drift : DriftModel
        Standard deviations of the recorded poses' errors.
    """

    submap_seconds: float = 6.0
    hold_back: int = 5
    drift: DriftModel = field(default_factory=DriftModel)

    def __post_init__(self) -> None:
        for name, value, least, most in (
            ("submap_seconds", self.submap_seconds, 0.5, 3600.0),
            ("hold_back", self.hold_back, 2, 1000),
            ("drift in percent", self.drift.percent, 0.01, 100.0),
            ("drift in degrees per 10 m", self.drift.degrees, 0.01, 90.0),
            ("frame_sigma in metres", self.drift.frame_shift, 0.001, 1000.0),
            ("frame_sigma in degrees", self.drift.frame_angle, 0.001, 180.0),
        ):
            if not least <= value <= most:
                raise ConfigError(f"{name}: {value:g} is not between {least:g} and {most:g}")


@dataclass(frozen=True, eq=False)
class RobotTrajectory:
    """Trajectory of one robot before and after the repair.

    - ``stamps_ns`` (n,): stamps of the recorded poses in the log's clock, without the clock offset.
    - ``recorded``, ``corrected`` (n, 4, 4) float64: T_team_body; equal where the repair was not accepted.
    - ``T_body_sensor``: seven numbers of the mount; None where it moves, and the poses are those of the sensor.
    - ``T_team_map``: seven numbers. The corrected trajectory begins with the first recorded pose in this frame.
    """

    robot_id: str
    stamps_ns: Int64Array
    recorded: Float64Array
    corrected: Float64Array
    T_body_sensor: tuple[float, ...] | None
    T_team_map: tuple[float, ...]
    is_accepted: bool

    @property
    def map_poses(self) -> Float64Array:
        """Corrected poses T_map_body (n, 4, 4)."""
        return np.asarray(inverse(transform_of(self.T_team_map)) @ self.corrected)

    @property
    def shifts(self) -> Float64Array:
        """Distance between recorded and corrected positions (n,) [m]."""
        return np.asarray(np.linalg.norm(self.corrected[:, :3, 3] - self.recorded[:, :3, 3], axis=1))


@dataclass(frozen=True, eq=False)
class Refinement:
    """Result of the repair of a team's drift: trajectories, edges, scores, and the counts of the frames read."""

    trajectories: tuple[RobotTrajectory, ...]
    num_submaps: int
    num_edges: int
    num_rejected: int
    scores: tuple[RobotScore, ...]
    frame_counts: dict[str, FrameCounts]

    @property
    def lost_data(self) -> bool:
        """True where any log was cut or any frame could not be used."""
        return any(counts.lost_data for counts in self.frame_counts.values())


def refine_team(
    config: ResolvedRun,
    settings: RefinementConfig,
    *,
    progress: Callable[[float], None] | None = None,
    num_threads: int | None = None,
) -> Refinement:
    """Return the corrected trajectories of a team's robots.

    The recorded poses stay where the scans that were held back do not clearly contradict each other less under the
    corrected ones (``judge``). ``progress`` is called with the finished share, 0 to 1; ``num_threads`` does not change
    the result. Raises InputError for logs without frames or poses, ConfigError for robots whose map frames nothing
    relates and for a robot whose body_box has no fixed frame.
    """
    _check_frames(config)
    if config.time.rate_limit is None:
        config = dataclasses.replace(config, time=dataclasses.replace(config.time, rate_limit=_SCAN_RATE))
    show = progress or _ignore
    with ExitStack() as stack:
        threads = stack.enter_context(ThreadPoolExecutor(num_threads or os.cpu_count() or 1))
        reach = sensor_reach(config.sensor, config.map)
        logs = [
            stack.enter_context(RobotLog(robot, config.time, config.classes, reach=reach)) for robot in config.robots
        ]
        start_ns = min(log.first_stamp_ns for log in logs)
        readings = list(
            threads.map(lambda index: _read(index, logs[index], start_ns, config, settings), range(len(logs)))
        )
        counts = {log.robot_id: log.counts for log in logs}
        show(0.4)
        submaps = [submap for reading in readings for submap in reading.submaps]
        if not submaps:
            raise InputError("no robot has a frame that can be used")
        tracks = [reading.track for reading in readings]
        repair = repair_drift(
            submaps, tracks, settings.drift, run=threads.map, progress=lambda share: show(0.4 + 0.3 * share)
        )
        corrections = [correction_of(index, submaps, repair.poses) for index in range(len(logs))]
        held_back = compare_held_back(config, logs, start_ns, settings.hold_back, tracks, corrections, threads)
        scores = judge(held_back, repair.groups)
        show(0.9)

        def trajectory(index: int) -> RobotTrajectory:
            correction = corrections[index] if scores[index].is_accepted else None
            return _trajectory(logs[index], config, config.robots[index], correction)

        trajectories = tuple(threads.map(trajectory, range(len(logs))))
        show(1.0)
    return Refinement(trajectories, len(submaps), len(repair.edges), repair.num_rejected, scores, counts)


def write_trajectories(refinement: Refinement, folder: Path) -> None:
    """Write ROBOT.tum for each corrected robot, its corrected poses in its map frame, into an existing folder."""
    for trajectory in refinement.trajectories:
        if trajectory.is_accepted:
            write_tum(folder / f"{trajectory.robot_id}.tum", trajectory.stamps_ns, trajectory.map_poses)


def refined_config(config: RunConfig, refinement: Refinement, folder: Path) -> RunConfig:
    """Return the configuration with the corrected trajectories that ``write_trajectories`` writes into a folder."""
    corrected = {trajectory.robot_id: trajectory for trajectory in refinement.trajectories if trajectory.is_accepted}
    robots = tuple(
        _refined_robot(robot, corrected[robot.robot_id], folder) if robot.robot_id in corrected else robot
        for robot in config.robots
    )
    return dataclasses.replace(config, robots=robots)


def _refined_robot(robot: RobotConfig, trajectory: RobotTrajectory, folder: Path) -> RobotConfig:
    """Return a robot with its corrected trajectory, or with a corrected frame where its sensor stands still."""
    robot = dataclasses.replace(
        robot, T_team_map=trajectory.T_team_map, T_team_map_sigma=None, T_team_map_from="refined"
    )
    if robot.pose is not None:
        return robot
    robot = robot.with_poses(pose_file=folder / f"{robot.robot_id}.tum", pose_format="tum")
    return dataclasses.replace(robot, T_body_sensor=trajectory.T_body_sensor)


def _check_frames(config: ResolvedRun) -> None:
    """Raise ConfigError where nothing relates the map frames of two robots, and for a robot with ``sensors``."""
    several = next((robot.robot_id for robot in config.robots if robot.sensors), None)
    if several is not None:
        raise ConfigError(
            f"robot '{several}' has several sensors, whose poses cannot be corrected together; give it the keys of one "
            f"of them in place of sensors"
        )
    if frames_warning([(robot, robot.frame) for robot in config.robots if robot.frame is not None]) is not None:
        names = ", ".join(robot.robot_id for robot in config.robots if robot.T_team_map is None)
        raise ConfigError(
            f"T_team_map: {names} have none, and nothing relates their map frames; find it with 'octoreplay align', or"
            " give it in the team file"
        )


def _ignore(share: float) -> None:
    """Default progress callback."""


@dataclass(frozen=True, eq=False)
class _Reading:
    """Submaps of one robot and the sensor's recorded poses."""

    submaps: list[Submap]
    track: Track


def _read(index: int, log: RobotLog, start_ns: int, config: ResolvedRun, settings: RefinementConfig) -> _Reading:
    """Read one robot's log; the scans that are held back are left out of the submaps."""
    builder = _SubmapBuilder(index, config, round(settings.submap_seconds * 1e9))
    stamps: list[int] = []
    poses: list[Float64Array] = []
    for number, frame in enumerate(log.frames(start_ns)):
        stamps.append(frame.stamp_ns)
        poses.append(frame.T_team_sensor)
        if not is_held_back(number, settings.hold_back):
            builder.add(frame)
    return _Reading(builder.finished(), Track(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4)))


class _SubmapBuilder:
    """Collector of one robot's scans into submaps of a fixed length."""

    def __init__(self, robot: int, config: ResolvedRun, length_ns: int) -> None:
        self._robot, self._config, self._length_ns = robot, config, length_ns
        self._scans: list[tuple[int, Float64Array, Float64Array, UInt8Array]] = []
        self._submaps: list[Submap] = []

    def add(self, frame: Frame) -> None:
        """Add a scan; it begins a new submap where the present one is complete."""
        if self._scans and frame.stamp_ns - self._scans[0][0] >= self._length_ns:
            self._close()
        points, class_ids = scan_points(
            frame,
            self._config.effective_sensor,
            max_range=_RANGE_SHARE * self._config.sensor.max_range,
            max_points=_POINTS_PER_SCAN,
        )
        self._scans.append((frame.stamp_ns, frame.T_team_sensor, points, class_ids))

    def finished(self) -> list[Submap]:
        """Submaps of all scans."""
        if self._scans:
            self._close()
        return self._submaps

    def _close(self) -> None:
        """Make a submap of the scans so far, anchored at the middle one."""
        stamp_ns, T_team_anchor, _, _ = self._scans[len(self._scans) // 2]
        T_anchor_team = inverse(T_team_anchor)
        points = [
            points @ (T_anchor_team @ T_team_sensor)[:3, :3].T + (T_anchor_team @ T_team_sensor)[:3, 3]
            for _, T_team_sensor, points, _ in self._scans
        ]
        class_ids = np.concatenate([class_ids for *_, class_ids in self._scans])
        voxel = _VOXEL_CELLS * self._config.map.resolution
        self._submaps.append(
            Submap.of_points(self._robot, stamp_ns, T_team_anchor, np.concatenate(points), class_ids, voxel)
        )
        self._scans = []


def _trajectory(
    log: RobotLog, config: ResolvedRun, robot: ResolvedRobot, correction: Correction | None
) -> RobotTrajectory:
    """Trajectory of one robot at the stamps of its recorded poses."""
    poses = log.pose_source()
    stamps = _pose_stamps(log, poses, uses_log_time=config.time.clock == "log")
    T_map_sensor = [poses.at(stamp) for stamp in stamps.tolist()]
    known = np.array([pose is not None for pose in T_map_sensor], np.bool_)
    stamps = stamps[known]
    sensor = log.T_team_map @ np.array([pose for pose in T_map_sensor if pose is not None]).reshape(-1, 4, 4)
    corrected = sensor if correction is None else correction.corrected(stamps + robot.clock_offset_ns, sensor)
    mount = _fixed_mount(robot, poses, stamps)
    to_body = np.eye(4) if mount is None else inverse(mount)
    T_team_map = log.T_team_map
    if correction is not None:
        T_team_map = corrected[0] @ inverse(sensor[0]) @ T_team_map
    return RobotTrajectory(
        robot.robot_id, stamps, sensor @ to_body, corrected @ to_body, None if mount is None else numbers_of(mount),
        numbers_of(T_team_map), correction is not None,
    )  # fmt: skip


def _pose_stamps(log: RobotLog, poses: PoseSource, *, uses_log_time: bool) -> Int64Array:
    """Stamps (n,) of the recorded poses, ascending; all poses are in ``poses`` afterwards."""
    found: set[int] = set()
    for message in log.pose_messages(poses, 0):
        if uses_log_time:
            found.add(message.log_time_ns)
            continue
        with contextlib.suppress(DamagedMessageError):
            transforms = message.sensor_message()
            if isinstance(transforms, Transforms):
                found.update(entry.stamp_ns for entry in transforms.transforms)
    if poses.trajectory is not None:
        found.update(poses.trajectory.stamps_ns.tolist())
    if log.robot.pose is not None:
        found.add(log.first_stamp_ns - log.robot.clock_offset_ns)
    return np.array(sorted(found), np.int64)


def _fixed_mount(robot: ResolvedRobot, poses: PoseSource, stamps: Int64Array) -> Float64Array | None:
    """T_body_sensor (4, 4) where it is the same at all times; None where the sensor moves on the robot."""
    chosen = stamps[np.linspace(0, stamps.size - 1, min(stamps.size, 50)).astype(np.int64)].tolist()
    mounts = [mount for mount in map(poses.T_body_sensor_at, chosen) if mount is not None]
    if mounts and all(np.abs(mount - mounts[0]).max() < _FIXED_MOUNT for mount in mounts):
        return mounts[0]
    if robot.body_box is not None and robot.body_frame is None:
        raise ConfigError(
            f"robot '{robot.robot_id}': the sensor moves on the robot, so that the corrected poses are the sensor's; "
            f"give body_frame, the frame of body_box"
        )
    return None
