"""Simulation of a team: a village, robots that explore it, and the logs that they record."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay import interrupts
from octoreplay.config.frames_file import dump_frames
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.sensor import MapConfig
from octoreplay.config.team_file import dump_team
from octoreplay.errors import ConfigError, OutputError
from octoreplay.io import output_file
from octoreplay.io.datasets.pose_files import write_tum
from octoreplay.io.robots.robot_log_writer import MAP_FRAME, RobotLogWriter, fix_topic, topics
from octoreplay.records import CameraModel, ClassTable, FilePath, Float64Array, Int64Array
from octoreplay.simulate.body_poses import T_BODY_CAMERA, body_poses, midway, pose_errors
from octoreplay.simulate.camera import LabelPatches, MeshCamera, add_depth_noise, add_label_noise, depth_to_millimetres
from octoreplay.simulate.colour import COLOUR_FORMATS, ColourCamera
from octoreplay.simulate.exploration import Exploration, explore
from octoreplay.simulate.odometry import HEIGHT_FACTOR, drift_corrections, own_frame, position_fixes
from octoreplay.simulate.village import make_village
from octoreplay.simulate.world import MAX_KINDS, Terrain, village_classes
from octoreplay.simulate.world_files import write_ground_truth, write_mesh
from octoreplay.transforms import inverse, numbers_of

START_NS = 1_700_000_000_000_000_000
"""Stamp of a simulation's first message, constant so that equal settings give equal bytes."""

_ODOMETRY_RATE = 20.0


@dataclass(frozen=True)
class SimulationConfig:
    """Settings of a simulation. Raises ConfigError for a value out of range.

    Attributes
    ----------
    num_robots : int
        Number of robots.
    duration : float
        Length of the logs [s].
    rate : float
        Images per second and robot [Hz].
    image : tuple of int
        Width and height of the images [pixels].
    seed : int
        Seed of the village and of all noise.
    resolution : float
        Cell size of the ground truth, and resolution in the team file [m].
    label_noise : float
        Share of the pixels that get a wrong class.
    patchy_noise : float
        Share of the cubes of 2 m in which a robot's labels are always wrong; drawn for each robot.
    depth_noise : float
        Factor on the standard deviation of a depth camera's noise.
    pose_noise : float
        Standard deviation of the recorded x and y [m]; a tenth of it is that of the heading [rad].
    odometry_drift : tuple of float
        Drift of the recorded poses as in dead reckoning: position [% of the way], heading [degrees per 10 m of way].
    own_frames : bool
        True to record each robot's poses in a frame of its own, which starts at its first pose. The robots start with
        random headings.
    fixes : float or None
        Standard deviation of a horizontal coordinate of position fixes [m], one each second; None for logs without.
    kinds_per_class : int
        Number of classes that each of the eight classes is divided into.
    has_labels : bool
        False for logs without label images and LabelInfo.
    colour : str or None
        Form of the colour images: 'raw', 'jpeg' or 'png'; None for logs without colour images.
    colour_offset : tuple of float
        Position of the colour camera in the depth camera's optical frame [m]; zeros for images aligned to depth.
    world_size : float
        Edge length of the drivable square [m].
    identical_houses : bool
        True for a village that repeats itself: copies of one house between straight roads on flat ground.
    max_depth : float
        Range of the camera [m].
    """

    num_robots: int = 6
    duration: float = 60.0
    rate: float = 4.0
    image: tuple[int, int] = (160, 120)
    seed: int = 0
    resolution: float = 0.3
    label_noise: float = 0.1
    patchy_noise: float = 0.0
    depth_noise: float = 1.0
    pose_noise: float = 0.0
    odometry_drift: tuple[float, float] = (0.0, 0.0)
    own_frames: bool = False
    fixes: float | None = None
    kinds_per_class: int = 1
    has_labels: bool = True
    colour: str | None = None
    colour_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    world_size: float = 70.0
    identical_houses: bool = False
    max_depth: float = 20.0

    def __post_init__(self) -> None:
        for name, value, least, most in (
            ("num_robots", self.num_robots, 1, 100),
            ("duration", self.duration, 1.0, 86_400.0),
            ("rate", self.rate, 0.1, 100.0),
            ("image width", self.image[0], 8, 4096),
            ("image height", self.image[1], 6, 4096),
            ("seed", self.seed, 0, 2**32 - 1),
            ("resolution", self.resolution, 0.02, 5.0),
            ("label_noise", self.label_noise, 0.0, 1.0),
            ("patchy_noise", self.patchy_noise, 0.0, 1.0),
            ("depth_noise", self.depth_noise, 0.0, 100.0),
            ("pose_noise", self.pose_noise, 0.0, 10.0),
            ("odometry_drift in percent", self.odometry_drift[0], 0.0, 100.0),
            ("odometry_drift in degrees per 10 m", self.odometry_drift[1], 0.0, 90.0),
            ("fixes", 0.001 if self.fixes is None else self.fixes, 0.001, 1000.0),
            ("kinds_per_class", self.kinds_per_class, 1, MAX_KINDS),
            *(("colour_offset", value, -5.0, 5.0) for value in self.colour_offset),
            ("world_size", self.world_size, 20.0, 1000.0),
            ("max_depth", self.max_depth, 1.0, 65.0),
        ):
            if not least <= value <= most:
                raise ConfigError(f"{name}: {value:g} is not between {least:g} and {most:g}")
        if self.colour not in (None, *COLOUR_FORMATS):
            raise ConfigError(f"colour: '{self.colour}' is not one of {', '.join(COLOUR_FORMATS)}")
        if any(self.colour_offset) and self.colour is None:
            raise ConfigError("colour_offset: needs colour images")

    @property
    def camera(self) -> CameraModel:
        """Camera of the robots: fx = fy = 65.25 pixels at a width of 160 pixels, principal point at the centre."""
        width, height = self.image
        focal = 65.25 * width / 160
        return CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def class_table(self) -> ClassTable:
        """Classes of the label images."""
        return village_classes(self.kinds_per_class)

    @property
    def has_pose_truth(self) -> bool:
        """True if the true frames and trajectories are written, because the recorded ones differ from them."""
        return self.own_frames or any(self.odometry_drift)

    @property
    def robot_ids(self) -> tuple[str, ...]:
        """Names of the robots: husky_1, husky_2, ..."""
        return tuple(f"husky_{index + 1}" for index in range(self.num_robots))


@dataclass(frozen=True)
class SimulationSummary:
    """Files of a simulation, and the numbers of images, of labelled ground truth cells and of bytes in them."""

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

    With own frames or drift, ``frames.yaml`` holds the true T_team_map of each robot, from the frame of its recorded
    poses to the village's (``load_frames_file``), and ``truth/ROBOT.tum`` its true poses in the village's frame.
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
    camera = MeshCamera(world, config.camera)
    num_cells = write_ground_truth(work / "world.npz", world, config.resolution, config.class_table)
    write_mesh(work / "world.ply", world, config.class_table)
    progress(0.1)
    schedule = _Schedule.of(config)
    drive = explore(
        world,
        config.num_robots,
        schedule.num_poses,
        schedule.pose_period_ns / 1e9,
        headings=_start_headings(config),
        progress=lambda share: progress(0.1 + 0.2 * share),
    )
    total = config.num_robots * len(schedule.exposures(0, config.num_robots))
    num_frames = 0
    frames: dict[str, tuple[float, ...]] = {}
    for index, robot_id in enumerate(config.robot_ids):
        recorder = _Recorder(config, world.terrain, camera, drive, index, schedule)
        with RobotLogWriter(
            work / f"{robot_id}.mcap",
            robot_id,
            config.camera,
            config.class_table if config.has_labels else None,
            T_body_sensor=T_BODY_CAMERA,
            T_body_color=recorder.T_body_color,
            start_ns=START_NS,
            map_frame=f"{robot_id}/odom" if config.own_frames else MAP_FRAME,
        ) as log:
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


def _start_headings(config: SimulationConfig) -> Float64Array | None:
    """Headings (N,) of the robots at the start; None for the default, in which own frames would not differ in yaw."""
    rng = np.random.default_rng([config.seed, 6])
    return rng.uniform(-np.pi, np.pi, config.num_robots) if config.own_frames else None


def _team(folder: Path, config: SimulationConfig) -> RunConfig:
    """Configuration for the team file: robots with their topics, classes and resolution."""
    robots = []
    for robot_id in config.robot_ids:
        depth, labels, camera_info, odometry, label_info = topics(robot_id)
        robots.append(
            RobotConfig(
                robot_id=robot_id,
                logs=(folder / f"{robot_id}.mcap",),
                depth_topic=depth,
                label_topic=labels if config.has_labels else None,
                camera_info_topic=camera_info,
                pose_topic=odometry,
                label_info_topic=label_info if config.has_labels else None,
                fix_topic=None if config.fixes is None else fix_topic(robot_id),
            )
        )
    classes = config.class_table if config.has_labels else None
    return RunConfig(tuple(robots), classes=classes, map=MapConfig(resolution=config.resolution))


@dataclass(frozen=True)
class _Schedule:
    """Times of poses and images: the period of poses [ns], poses per image, and the number of poses."""

    pose_period_ns: int
    stride: int
    num_poses: int

    @classmethod
    def of(cls, config: SimulationConfig) -> _Schedule:
        """Schedule with about 20 poses a second and a whole number of poses per image."""
        stride = max(1, round(_ODOMETRY_RATE / config.rate))
        pose_period_ns = round(1e9 / config.rate / stride)
        return cls(pose_period_ns, stride, max(2, round(config.duration * 1e9 / pose_period_ns) + 1))

    @property
    def stamps_ns(self) -> Int64Array:
        """Stamps (T,) of the poses."""
        return START_NS + self.pose_period_ns * np.arange(self.num_poses, dtype=np.int64)

    def exposures(self, robot_index: int, num_robots: int) -> range:
        """Indices of the poses after which a robot takes an image; they differ between robots, as for real cameras."""
        return range(robot_index * self.stride // num_robots, self.num_poses - 1, self.stride)


class _Recorder:
    """Writer of one robot's poses and images.

    ``poses`` (T, 4, 4) are the true poses of the base in the village's frame; ``T_map_odom`` (4, 4) transforms from the
    frame of the recorded poses to the village's.
    """

    def __init__(
        self,
        config: SimulationConfig,
        terrain: Terrain,
        camera: MeshCamera,
        drive: Exploration,
        index: int,
        schedule: _Schedule,
    ) -> None:
        self._config = config
        self._camera = camera
        self._schedule = schedule
        self._states = drive.states[index]
        self.poses = body_poses(terrain, self._states)
        period, rng = schedule.pose_period_ns / 1e9, np.random.default_rng([config.seed, 3, index])
        errors = pose_errors(config.pose_noise, len(self._states), period, rng)
        recorded = body_poses(terrain, self._states + errors)
        if any(config.odometry_drift):
            rng = np.random.default_rng([config.seed, 4, index])
            recorded = drift_corrections(self.poses, *config.odometry_drift, rng) @ recorded
        self.T_map_odom = np.eye(4)
        if config.own_frames:
            self.T_map_odom = own_frame(self.poses[0], np.random.default_rng([config.seed, 5, index]))
            recorded = inverse(self.T_map_odom) @ recorded
        self._recorded = recorded
        self._fixes: dict[int, Float64Array] = {}
        if config.fixes is not None:
            steps = range(0, schedule.num_poses, max(1, round(1e9 / schedule.pose_period_ns)))
            rng = np.random.default_rng([config.seed, 8, index])
            self._fixes = dict(zip(steps, position_fixes(self.poses[steps, :3, 3], config.fixes, rng), strict=True))
        self._exposures = schedule.exposures(index, config.num_robots)
        self._rng = np.random.default_rng([config.seed, 2, index])
        self._patches: LabelPatches | None = None
        if config.patchy_noise > 0:
            rng = np.random.default_rng([config.seed, 7, index])
            self._patches = LabelPatches(config.patchy_noise, config.class_table.num_classes, rng)
        self._colour: ColourCamera | None = None
        self.T_body_color: Float64Array | None = None
        if config.colour is not None:
            self._colour = ColourCamera(camera, config.class_table, config.seed, index)
            if any(config.colour_offset):
                self.T_body_color = T_BODY_CAMERA.copy()
                self.T_body_color[:3, 3] += T_BODY_CAMERA[:3, :3] @ config.colour_offset

    def record(self, log: RobotLogWriter) -> Iterator[int]:
        """Write all poses and images in the order of time; yield each image's stamp."""
        config, period_ns = self._config, self._schedule.pose_period_ns
        for step, (state, T_map_body) in enumerate(zip(self._states, self.poses, strict=True)):
            recorded = self._recorded[step]
            stamp_ns = START_NS + step * period_ns
            following = self._states[min(step + 1, len(self._states) - 1)]
            speed = float(np.hypot(*(following[:2] - state[:2]))) * 1e9 / period_ns
            log.write_pose(stamp_ns, recorded, speed, float(following[2] - state[2]) * 1e9 / period_ns)
            if config.fixes is not None and step in self._fixes:
                log.write_fix(stamp_ns, self._fixes[step].tolist(), config.fixes, HEIGHT_FACTOR * config.fixes)
            if step in self._exposures:
                # Exposed midway between two poses, so that readers have to interpolate.
                T_map_exposed = midway(T_map_body, self.poses[step + 1])
                self._write_image(log, stamp_ns + period_ns // 2, T_map_exposed @ T_BODY_CAMERA)
                if self._colour is not None:
                    mount = T_BODY_CAMERA if self.T_body_color is None else self.T_body_color
                    image = self._colour.take(T_map_exposed @ mount)
                    log.write_color(stamp_ns + period_ns // 2, image, str(config.colour))
                yield stamp_ns + period_ns // 2

    def _write_image(self, log: RobotLogWriter, stamp_ns: int, T_map_camera: Float64Array) -> None:
        """Render and write one image with the noise of a depth camera and of a segmentation network."""
        config = self._config
        depth, labels = self._camera.take(T_map_camera, config.max_depth)
        if self._patches is not None:
            labels = self._patches.apply(labels, self._camera.points(depth, T_map_camera))
        if config.depth_noise > 0:
            depth = add_depth_noise(depth, self._rng, config.depth_noise)
        if config.label_noise > 0:
            labels = add_label_noise(labels, config.label_noise, config.class_table.num_classes, self._rng)
        log.write_frame(stamp_ns, depth_to_millimetres(depth), labels if config.has_labels else None)
