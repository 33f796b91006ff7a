"""Seeded small teams for tests: robots that drive through an analytic scene with overlapping views.

The scene is a ground plane (grass with a dirt road) and axis-aligned boxes (buildings, trees, cars), ray-cast in closed
form with numpy. Images have depth noise, wrong labels, pixels without label and pixels without depth. Nothing in the
scene, the poses or the stamps is aligned with cells, except where a stamp falls on a tick on purpose.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.config.network import NetworkConfig
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.records import (
    NO_CLASS,
    CameraModel,
    ClassTable,
    CloudFrame,
    DepthFrame,
    Float64Array,
    Frame,
    Int64Array,
    SemanticClass,
    UInt8Array,
)

START_NS = 1_700_000_000_000_000_000
"""First stamp of the team."""

CLASS_NAMES = ("grass", "dirt_road", "building", "tree", "car")
GRASS, DIRT_ROAD, BUILDING, TREE, CAR = range(1, 6)

GROUND_HEIGHT = -0.0731
ROAD_HALF_WIDTH = 1.137


@dataclass(frozen=True)
class TeamShape:
    """Parameters of a scenario. Lengths in metres, times in seconds.

    The last robot starts at ``late_start`` of the duration and the last but one ends at ``early_end`` of it (teams of
    three and more). ``sensors``: 'depth16' (uint16 mm), 'depth32' (float32 m), 'cloud', or 'mixed', which gives robot
    i the i-th of these in turn.
    """

    num_robots: int = 4
    num_ticks: int = 102
    publish_period: float = 1.0
    scan_period: float = 0.5
    image: tuple[int, int] = (24, 18)
    sensors: str = "depth16"
    resolution: float = 0.2
    max_range: float = 4.0
    sensor_range: float = 12.0
    label_noise: float = 0.1
    dropout: float = 0.02
    unlabelled: float = 0.02
    late_start: float = 0.3
    early_end: float = 0.6


@dataclass(frozen=True, eq=False)
class Scenario:
    """Frames of a team in order of (stamp, robot), and their configuration."""

    frames: tuple[Frame, ...]
    class_table: ClassTable
    base_config: RunConfig

    @property
    def robot_ids(self) -> tuple[str, ...]:
        """Robot ids in the team's order."""
        return tuple(robot.robot_id for robot in self.base_config.robots)

    def config(self, edges: tuple[tuple[str, str, float | None], ...] = (), **parameters: Any) -> RunConfig:
        """Return the configuration with parameters replaced; ``edges`` is for topology='edges'."""
        network_names = {field.name for field in dataclasses.fields(NetworkConfig)}
        network = {name: parameters.pop(name) for name in list(parameters) if name in network_names}
        config = self.base_config.with_parameters(parameters)
        config = dataclasses.replace(config, network=dataclasses.replace(config.network, edges=edges, **network))
        return dataclasses.replace(config, sensor=config.effective_sensor)


@dataclass(frozen=True, eq=False)
class Scene:
    """Axis-aligned boxes over a ground plane: corners (B, 3) each, and the class of each box (B,)."""

    lower: Float64Array
    upper: Float64Array
    classes: Int64Array

    def cast(self, origin: Float64Array, directions: Float64Array) -> tuple[Float64Array, Int64Array]:
        """Return the ray parameter t (P,) and class (P,) of the first surface on each ray origin + t direction (P, 3).

        t is infinite where there is no surface. A box that holds the origin is ignored.
        """
        with np.errstate(divide="ignore"):
            inverse = 1.0 / directions[:, None, :]
        to_lower = (self.lower - origin)[None] * inverse
        to_upper = (self.upper - origin)[None] * inverse
        enter = np.minimum(to_lower, to_upper).max(axis=2)
        leave = np.maximum(to_lower, to_upper).min(axis=2)
        box_t = np.where((enter <= leave) & (enter > 0), enter, np.inf)
        nearest = box_t.argmin(axis=1)
        t = box_t[np.arange(len(box_t)), nearest]
        classes = self.classes[nearest]

        down = directions[:, 2] < 0
        ground_t = np.where(down, (GROUND_HEIGHT - origin[2]) / np.where(down, directions[:, 2], 1.0), np.inf)
        ground_y = origin[1] + np.where(down, ground_t, 0.0) * directions[:, 1]
        ground_class = np.where(np.abs(ground_y) < ROAD_HALF_WIDTH, DIRT_ROAD, GRASS)
        is_ground = ground_t < t
        return np.where(is_ground, ground_t, t), np.where(is_ground, ground_class, classes)


def make_scenario(seed: int = 0, shape: TeamShape | None = None) -> Scenario:
    """Return a seeded team; the same seed and shape give the same frames."""
    shape = shape or TeamShape()
    rng = np.random.default_rng(seed)
    paths = [_Path.random(i, shape.num_robots, rng) for i in range(shape.num_robots)]
    scene = _random_scene(paths, rng)
    frames: list[Frame] = []
    for i, path in enumerate(paths):
        robot_rng = np.random.default_rng([seed, i])
        frames.extend(_robot_frames(i, path, scene, shape, robot_rng))
    table = _class_table()
    robots = tuple(RobotConfig(_robot_id(i), (Path(f"{_robot_id(i)}.mcap"),)) for i in range(shape.num_robots))
    config = RunConfig(robots=robots, classes=table).with_parameters(
        {
            "resolution": shape.resolution,
            "max_range": shape.max_range,
            "min_range": 0.3,
            "publish_period": shape.publish_period,
        }
    )
    return Scenario(tuple(sorted(frames, key=lambda frame: (frame.stamp_ns, frame.robot_id))), table, config)


def _robot_id(index: int) -> str:
    """Return robot ids in alphabetical order (up to ten robots)."""
    return f"robot_{index}"


def _class_table() -> ClassTable:
    """Return the five classes of the scene; raw label = class_id."""
    return ClassTable(
        tuple(SemanticClass(i + 1, name, PALETTE[i], (i + 1,)) for i, name in enumerate(CLASS_NAMES)),
        ignored_raw_labels=(NO_CLASS,),
    )


@dataclass(frozen=True)
class _Path:
    """Closed drive around a centre near the middle of the scene, with a swinging camera."""

    centre: tuple[float, float]
    radii: tuple[float, float]
    period: float
    phase: float
    height: float
    pitch: float
    swing: float

    @staticmethod
    def random(index: int, num_robots: int, rng: np.random.Generator) -> _Path:
        """Return the drive of robot ``index``; the views of neighbours on the circle of centres overlap most."""
        angle = 2 * np.pi * index / num_robots + rng.uniform(-0.2, 0.2)
        return _Path(
            centre=(2.6 * np.cos(angle), 2.6 * np.sin(angle)),
            radii=(rng.uniform(1.0, 1.8), rng.uniform(1.0, 1.8)),
            period=rng.uniform(45.0, 75.0),
            phase=rng.uniform(0.0, 2 * np.pi),
            height=rng.uniform(0.45, 0.85),
            pitch=rng.uniform(0.02, 0.2),
            swing=rng.uniform(0.6, 1.4),
        )

    def position(self, seconds: float) -> Float64Array:
        """Return the position (3,) of the camera [m]."""
        turn = 2 * np.pi * seconds / self.period + self.phase
        x = self.centre[0] + self.radii[0] * np.cos(turn)
        y = self.centre[1] + self.radii[1] * np.sin(turn)
        return np.array([x, y, self.height + 0.02 * np.sin(3.1 * turn)])

    def pose(self, seconds: float) -> Float64Array:
        """Return T_team_sensor (4, 4): z points forward, x right, y down."""
        turn = 2 * np.pi * seconds / self.period + self.phase
        yaw = turn + np.pi / 2 + self.swing * np.sin(2.3 * turn)
        pitch = self.pitch + 0.05 * np.sin(1.7 * turn)
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = self.position(seconds)
        return pose


def _random_scene(paths: list[_Path], rng: np.random.Generator) -> Scene:
    """Return boxes of buildings, trees and cars in a square of 16 m, none within 0.6 m of a drive."""
    driven = np.array([path.position(s)[:2] for path in paths for s in np.linspace(0.0, path.period, 60)])
    sizes = {BUILDING: (2.2, 1.7, 2.1), TREE: (0.35, 0.35, 2.4), CAR: (1.3, 0.7, 0.8)}
    lower: list[Float64Array] = []
    upper: list[Float64Array] = []
    classes: list[int] = []
    while len(classes) < 22:
        class_id = (BUILDING, TREE, CAR)[len(classes) % 3]
        half = 0.5 * np.array(sizes[class_id]) * rng.uniform(0.7, 1.3, size=3)
        centre = np.append(rng.uniform(-8.0, 8.0, size=2), GROUND_HEIGHT + half[2])
        if (np.abs(driven - centre[:2]) < half[:2] + 0.6).all(axis=1).any():
            continue
        lower.append(centre - half)
        upper.append(centre + half)
        classes.append(class_id)
    return Scene(np.array(lower), np.array(upper), np.array(classes))


def _stamps(index: int, shape: TeamShape, rng: np.random.Generator) -> Int64Array:
    """Return one robot's stamps. The first robot has the team's first stamp; some of its stamps are exactly ticks."""
    duration = (shape.num_ticks - 1) * shape.publish_period - 0.25 * shape.publish_period
    begin, end = 0.0, duration
    if shape.num_robots >= 3 and index == shape.num_robots - 1:
        begin = shape.late_start * duration
    if shape.num_robots >= 3 and index == shape.num_robots - 2:
        end = shape.early_end * duration
    period = shape.scan_period * (1.0 + 0.13 * index)
    seconds = np.arange(begin, end, period)
    nanoseconds = np.rint(seconds * 1e9).astype(np.int64)
    if index:
        nanoseconds += rng.integers(1, 40_000_000, size=len(nanoseconds))
    return START_NS + nanoseconds


def _robot_frames(
    index: int, path: _Path, scene: Scene, shape: TeamShape, rng: np.random.Generator
) -> list[DepthFrame] | list[CloudFrame]:
    """Return all frames of one robot."""
    width, height = shape.image
    camera = CameraModel(width, height, 0.72 * width, 0.72 * width, 0.5 * (width - 1), 0.5 * (height - 1))
    kinds = ("depth16", "depth32", "cloud")
    kind = kinds[index % 3] if shape.sensors == "mixed" else shape.sensors
    frames: list[Any] = []
    for stamp_ns in _stamps(index, shape, rng).tolist():
        pose = path.pose((stamp_ns - START_NS) * 1e-9)
        depth, classes = _see(scene, camera, pose, shape, rng)
        if kind == "cloud":
            frames.append(_as_cloud(_robot_id(index), stamp_ns, depth, classes, camera, pose))
        else:
            image = _as_uint16(depth, rng) if kind == "depth16" else depth.astype(np.float32)
            unit = 0.001 if kind == "depth16" else 1.0
            frames.append(DepthFrame(_robot_id(index), stamp_ns, image, unit, classes, camera, pose))
    return frames


def _see(
    scene: Scene, camera: CameraModel, pose: Float64Array, shape: TeamShape, rng: np.random.Generator
) -> tuple[Float64Array, UInt8Array]:
    """Return a noisy depth image (H, W) [m], NaN where nothing was measured, and a noisy class image (H, W)."""
    pixels = _pixel_directions(camera)
    # The directions have z = 1 in the camera's frame, so the ray parameter is the depth along z.
    depth, classes = scene.cast(pose[:3, 3], pixels @ pose[:3, :3].T)
    with np.errstate(invalid="ignore"):
        depth = depth + rng.normal(size=depth.shape) * (0.0012 + 0.0019 * (np.minimum(depth, 20.0) - 0.4) ** 2)
    lost = (depth > shape.sensor_range) | (rng.random(depth.shape) < shape.dropout)
    depth[lost] = np.nan
    wrong = rng.random(classes.shape) < shape.label_noise
    classes = np.where(wrong, rng.integers(1, len(CLASS_NAMES) + 1, size=classes.shape), classes)
    classes[rng.random(classes.shape) < shape.unlabelled] = NO_CLASS
    size = (camera.height, camera.width)
    return depth.reshape(size), classes.astype(np.uint8).reshape(size)


def _pixel_directions(camera: CameraModel) -> Float64Array:
    """Return ray directions (H * W, 3) with z = 1 in the camera's frame."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)


def _as_uint16(depth: Float64Array, rng: np.random.Generator) -> Any:
    """Return depths [mm]; pixels without measurement are 0 or, in one of four cases, 65535."""
    lost = np.where(rng.random(depth.shape) < 0.25, 65535.0, 0.0)
    return np.where(np.isnan(depth), lost, np.rint(np.nan_to_num(depth) * 1000.0)).astype(np.uint16)


def _as_cloud(
    robot_id: str, stamp_ns: int, depth: Float64Array, classes: UInt8Array, camera: CameraModel, pose: Float64Array
) -> CloudFrame:
    """Return the image as points float32; rows without measurement are NaN."""
    points = _pixel_directions(camera) * depth.reshape(-1, 1)
    return CloudFrame(robot_id, stamp_ns, points.astype(np.float32), classes.ravel(), pose)
