"""Simulation of a team: a village, robots that explore it, and the logs that they record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay import interrupts
from octoreplay.config.frames_file import dump_frames
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.sensor import MapConfig
from octoreplay.config.team_file import dump_team
from octoreplay.errors import OutputError
from octoreplay.io import output_file
from octoreplay.io.datasets.pose_files import write_tum
from octoreplay.io.robots.robot_log_writer import (
    MAP_FRAME,
    RobotLogWriter,
    cloud_topic,
    confidence_topic,
    fix_topic,
    topics,
)
from octoreplay.records import FilePath, Float64Array
from octoreplay.simulate.body_poses import T_BODY_CAMERA, T_BODY_LIDAR
from octoreplay.simulate.camera import MeshCamera
from octoreplay.simulate.drive import drive_paths
from octoreplay.simulate.exploration import Motion, explore
from octoreplay.simulate.lidar import MeshLidar
from octoreplay.simulate.recorder import START_NS, Recorder, Schedule
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import World
from octoreplay.simulate.world_files import write_ground_truth, write_mesh
from octoreplay.transforms import numbers_of


@dataclass(frozen=True)
class SimulationSummary:
    """Files of a simulation, and the numbers of images or scans, of labelled ground truth cells and of bytes."""

    folder: Path
    team_file: Path
    logs: tuple[Path, ...]
    num_frames: int
    num_cells: int
    num_bytes: int


def simulate_team(
    folder: FilePath, config: SimulationConfig, progress: Callable[[float], None] | None = None
) -> SimulationSummary:
    """Simulate a team and write one log per robot, ``team.yaml``, ``world.npz`` and ``world.ply`` into a folder.

    With own frames, noise of poses or drift, ``frames.yaml`` holds the true T_team_map of each robot, from the frame of
    its recorded poses to the village's (``load_frames_file``), and ``truth/ROBOT.tum`` its true poses in that frame.
    Equal settings give equal bytes. ``progress`` is called with the finished share, 0 to 1. Files get their names only
    when all of them are complete. Raises OutputError if the folder is not empty or cannot be written, InputError if
    Open3D cannot be loaded.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; use a new folder")
    with output_file.locked(folder, is_folder=True):
        work = folder / ".partial"
        try:
            with output_file.writing(folder):
                _check_empty(folder)
                # A killed process leaves its folder.
                output_file.remove_temporary(work)
                work.mkdir()
                num_frames, num_cells = _write_all(work, config, progress or _no_progress)
                interrupts.check()
                _move_files(work, folder)
        finally:
            output_file.remove_temporary(work)
    return SimulationSummary(
        folder,
        folder / "team.yaml",
        tuple(folder / f"{robot_id}.mcap" for robot_id in config.robot_ids),
        num_frames,
        num_cells,
        sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
    )


def _no_progress(share: float) -> None:
    """Default progress callback."""


def _check_empty(folder: Path) -> None:
    """Raise OutputError for a folder that holds anything but its lock and what a killed process has left."""
    if {path.name for path in folder.iterdir()} - {output_file.FOLDER_LOCK, ".partial"}:
        raise OutputError(f"{folder}: is not empty; use a new folder, or empty this one")


def _move_files(work: Path, folder: Path) -> None:
    """Move complete files into their folder. Raises OSError, and then removes those that were moved."""
    output_file.sync_files(work)
    # The team file is moved last. If it exists, all other files do too.
    names = sorted((path.name for path in work.iterdir()), key=lambda name: (name == "team.yaml", name))
    with interrupts.deferred():
        try:
            for name in names:
                (work / name).replace(folder / name)
            output_file.sync_folder(folder)
        except OSError:
            for name in names:
                output_file.remove_temporary(folder / name)
            raise
        output_file.mark_written(folder)


def _write_all(work: Path, config: SimulationConfig, progress: Callable[[float], None]) -> tuple[int, int]:
    """Write all files; return the numbers of images and of labelled cells."""
    world = make_village(config.world_size, config.seed, identical_houses=config.identical_houses)
    world = world.with_kinds(config.kinds_per_class)
    sensor = MeshLidar(world, config.lidar) if config.is_lidar else MeshCamera(world, config.camera)
    schedule = Schedule.of(config)
    states = _states(config, world, schedule, progress)
    num_cells = write_ground_truth(work / "world.npz", world, config.resolution, config.class_table)
    write_mesh(work / "world.ply", world, config.class_table)
    progress(0.3)
    total = config.num_robots * len(schedule.exposures(0, config.num_robots))
    num_frames = 0
    frames: dict[str, tuple[float, ...]] = {}
    for index, robot_id in enumerate(config.robot_ids):
        recorder = Recorder(config, world.terrain, sensor, states[index], index, schedule)
        with _log_writer(work, config, recorder, robot_id) as log:
            for _ in recorder.record(log):
                num_frames += 1
                progress(min(1.0, 0.3 + 0.7 * num_frames / total))
        if config.has_pose_truth:
            frames[robot_id] = numbers_of(recorder.T_map_odom)
            (work / "truth").mkdir(exist_ok=True)
            write_tum(work / "truth" / f"{robot_id}.tum", schedule.stamps_ns, recorder.poses)
    if config.has_pose_truth:
        output_file.write_whole(work / "frames.yaml", dump_frames(frames))
    output_file.write_whole(work / "team.yaml", dump_team(_team(work, config), work))
    return num_frames, num_cells


def _log_writer(folder: Path, config: SimulationConfig, recorder: Recorder, robot_id: str) -> RobotLogWriter:
    """Writer of one robot's log."""
    return RobotLogWriter(
        folder / f"{robot_id}.mcap",
        robot_id,
        None if config.is_lidar else config.camera,
        config.class_table if config.has_labels else None,
        T_body_sensor=T_BODY_LIDAR if config.is_lidar else T_BODY_CAMERA,
        T_body_color=recorder.T_body_color,
        start_ns=START_NS,
        map_frame=f"{robot_id}/odom" if config.own_frames else MAP_FRAME,
    )


def _states(
    config: SimulationConfig, world: World, schedule: Schedule, progress: Callable[[float], None]
) -> Float64Array:
    """States (N, T, 3) of the robots on their paths, or of their exploration."""
    motion = Motion(speed=config.speed)
    if config.paths:
        paths = dict(zip(config.robot_ids, config.paths, strict=True))
        return drive_paths(world, paths, schedule.num_poses, schedule.period, motion)
    return explore(
        world,
        config.num_robots,
        schedule.num_poses,
        schedule.period,
        motion=motion,
        headings=_start_headings(config),
        progress=lambda share: progress(0.2 * share),
    ).states


def _start_headings(config: SimulationConfig) -> Float64Array | None:
    """Headings (N,) of the robots at the start; None for the default, in which own frames would not differ in yaw."""
    rng = np.random.default_rng([config.seed, 6])
    return rng.uniform(-np.pi, np.pi, config.num_robots) if config.own_frames else None


def _team(folder: Path, config: SimulationConfig) -> RunConfig:
    """Configuration for the team file: robots with their topics, classes and resolution."""
    robots = []
    for robot_id in config.robot_ids:
        depth, labels, camera_info, odometry, label_info = topics(robot_id)
        has_images = not config.is_lidar
        robots.append(
            RobotConfig(
                robot_id=robot_id,
                logs=(folder / f"{robot_id}.mcap",),
                depth_topic=depth if has_images else None,
                label_topic=labels if has_images and config.has_labels else None,
                confidence_topic=confidence_topic(robot_id) if has_images and config.confidences is not None else None,
                camera_info_topic=camera_info if has_images else None,
                cloud_topic=None if has_images else cloud_topic(robot_id),
                pose_topic=odometry,
                label_info_topic=label_info if config.has_labels else None,
                fix_topic=None if config.fixes is None else fix_topic(robot_id),
            )
        )
    classes = config.class_table if config.has_labels else None
    return RunConfig(tuple(robots), classes=classes, map=MapConfig(resolution=config.resolution))
