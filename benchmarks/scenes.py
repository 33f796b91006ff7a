"""The workloads: a seeded village seen by a moving depth camera or LiDAR, and real depth images.

The village is ray cast with Open3D, so every frame has exact depth, one class per pixel and an exact pose. Generated
frames are kept in a cache folder: ``OCTOREPLAY_BENCH_CACHE``, or ``octoreplay-benchmarks`` in the temp folder.
"""

from __future__ import annotations

import math
import os
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.config.time import TimeConfig
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import (
    BoolArray,
    CameraModel,
    CloudFrame,
    DepthFrame,
    Float32Array,
    Float64Array,
    Frame,
    Int64Array,
    UInt8Array,
)

NUM_CLASSES = 8
GROUND, ROAD, WALL, ROOF, TRUNK, CROWN, CAR, FENCE = range(1, NUM_CLASSES + 1)

CAMERA_RANGE = 10.0
LIDAR_RANGE = 30.0
NUM_BUILDINGS, NUM_TREES, NUM_CARS = 12, 30, 8

_VERSION = 1  # part of the names in the cache: raise it with every change of what is generated
_MILLIMETRE = 0.001
_ROUNDING = 0.002  # generated ranges stay this far below the range limit, so that no rounding carries a point past it


@dataclass(frozen=True, eq=False)
class Scene:
    """Frames of one sensor in order, and the range up to which they are mapped."""

    name: str
    frames: tuple[Frame, ...]
    max_range: float

    def sensor(self, rays: str = "cells") -> SensorConfig:
        """The sensor model of the benchmarks: the defaults, with this scene's range."""
        return SensorConfig(max_range=self.max_range, rays=rays)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Input of a peer for one frame, in the world's frame.

    ``origin`` (3,) float32 of the sensor, ``points`` (P, 3) float32, ``class_ids`` (P,) uint8.
    """

    origin: Float32Array
    points: Float32Array
    class_ids: UInt8Array


@dataclass(frozen=True)
class Workload:
    """Workload of one frame of a scene at a resolution, as means over the frames."""

    valid_share: float
    points: float
    end_cells: float
    ray_steps: float
    marked_cells: float


def cache_folder() -> Path:
    """Folder of the generated inputs, which are kept for the next benchmark."""
    folder = Path(os.environ.get("OCTOREPLAY_BENCH_CACHE") or Path(tempfile.gettempdir()) / "octoreplay-benchmarks")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


# --- scenes -----------------------------------------------------------------------------------------------------------


def camera_scene(num_frames: int = 100, seed: int = 0, track: int = 0, tracks: int = 1) -> Scene:
    """A 640x480 depth camera with a horizontal view of 70 degrees that moves through the village.

    Depth is uint16 millimetres along z, 0 beyond 10 m and where nothing is met. ``track`` of ``tracks`` chooses the
    part of the village, for several robots.
    """
    focal = 320 / math.tan(math.radians(35.0))
    camera = CameraModel(640, 480, focal, focal, 319.5, 239.5)
    path = cache_folder() / f"camera-v{_VERSION}-{num_frames}-{seed}-{track}of{tracks}.npz"
    if not path.exists():
        eye = _Eye(seed)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        lengths = np.linalg.norm(rays, axis=-1)
        poses = _camera_path(num_frames, track, tracks)
        depths = np.zeros((num_frames, *u.shape), np.uint16)
        labels = np.zeros((num_frames, *u.shape), np.uint8)
        for index, pose in enumerate(poses):
            depth, class_ids = eye.cast(rays, pose)
            seen = depth * lengths < CAMERA_RANGE - _ROUNDING
            depths[index][seen] = np.rint(depth[seen] / _MILLIMETRE)
            labels[index][seen] = class_ids[seen]
        _save(path, depths=depths, labels=labels, poses=poses)
    with np.load(path) as stored:
        depths, labels, poses = stored["depths"], stored["labels"], stored["poses"]
    frames = tuple(
        DepthFrame("robot", index * 100_000_000, depths[index], _MILLIMETRE, labels[index], camera, poses[index])
        for index in range(num_frames)
    )
    return Scene("camera", frames, CAMERA_RANGE)


def lidar_scene(num_frames: int = 100, seed: int = 0, track: int = 0, tracks: int = 1) -> Scene:
    """A LiDAR of 64 rings (-25 to 15 degrees) x 1024 columns on the camera's path, 1.8 m above the ground.

    Points are float32 in the sensor's frame; rays that meet nothing within 30 m have no point.
    """
    path = cache_folder() / f"lidar-v{_VERSION}-{num_frames}-{seed}-{track}of{tracks}.npz"
    if not path.exists():
        eye = _Eye(seed)
        azimuth, elevation = np.meshgrid(np.arange(1024) * 2 * math.pi / 1024, np.radians(np.linspace(15, -25, 64)))
        rays = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
        )
        poses = _lidar_path(num_frames, track, tracks)
        points, labels, ends = [], [], [0]
        for pose in poses:
            distances, class_ids = eye.cast(rays, pose)
            seen = distances < LIDAR_RANGE - _ROUNDING
            points.append((rays[seen] * distances[seen, None]).astype(np.float32))
            labels.append(class_ids[seen])
            ends.append(ends[-1] + len(points[-1]))
        _save(path, points=np.concatenate(points), labels=np.concatenate(labels), ends=np.array(ends), poses=poses)
    with np.load(path) as stored:
        all_points, all_labels, bounds, poses = (stored[name] for name in ("points", "labels", "ends", "poses"))
    frames = tuple(
        CloudFrame("robot", index * 100_000_000, all_points[start:end], all_labels[start:end], poses[index])
        for index, (start, end) in enumerate(pairwise(bounds))
    )
    return Scene("lidar", frames, LIDAR_RANGE)


def seven_scenes(folder: Path, num_frames: int = 100) -> Scene:
    """Real frames of a 7-Scenes sequence (``frame-NNNNNN.depth.png`` and ``.pose.txt``); they carry no labels."""
    from octoreplay.io.datasets.rgbd_folder import import_rgbd
    from octoreplay.io.robots.discover import discover
    from octoreplay.io.robots.robot_log import RobotLog

    log_path = cache_folder() / f"seven-scenes-{folder.resolve().name}-{num_frames}.mcap"
    if not log_path.exists():
        import_rgbd(folder, log_path, rate=10.0, last=num_frames - 1)
    (robot,) = discover([log_path])
    with RobotLog(robot, TimeConfig(), None) as log:
        return Scene("seven-scenes", tuple(log.frames()), CAMERA_RANGE)


def load(name: str, num_frames: int, folder: Path | None = None) -> Scene:
    """The scene of that name; ``folder`` is where the 7-Scenes frames are."""
    if name == "camera":
        return camera_scene(num_frames)
    if name == "lidar":
        return lidar_scene(num_frames)
    if folder is None:
        raise SystemExit("give the folder of a 7-Scenes sequence: --folder DIR")
    return seven_scenes(folder, num_frames)


# --- what a frame holds -----------------------------------------------------------------------------------------------


def measured_pixels(frame: DepthFrame) -> BoolArray:
    """Pixels (H, W) that measured something."""
    depth = frame.depth_image
    is_integer = depth.dtype.kind in "ui"
    return (depth > 0) & (depth < np.iinfo(depth.dtype).max) if is_integer else np.isfinite(depth) & (depth > 0)


def world_points(frame: Frame) -> tuple[Float64Array, UInt8Array]:
    """The measured points (P, 3) of a frame in the world's frame, and their classes (P,)."""
    if isinstance(frame, DepthFrame):
        rows, columns = np.nonzero(measured_pixels(frame))
        z = frame.depth_image[rows, columns].astype(np.float64) * frame.depth_unit
        camera = frame.camera
        points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
        labels = np.ones(len(z), np.uint8) if frame.class_image is None else frame.class_image[rows, columns]
    else:
        points = frame.points.astype(np.float64)
        labels = np.ones(len(points), np.uint8) if frame.class_ids is None else frame.class_ids
    pose = frame.T_team_sensor
    return points @ pose[:3, :3].T + pose[:3, 3], labels


def point_cloud(frame: Frame) -> PointCloud:
    """A frame as ready-made points for a peer."""
    points, class_ids = world_points(frame)
    return PointCloud(frame.T_team_sensor[:3, 3].astype(np.float32), points.astype(np.float32, order="C"), class_ids)


def workload(scene: Scene, resolution: float) -> Workload:
    """Workload of the scene's frames. A ray step is one cell walked by the one ray of a distinct end cell."""
    caster = ScanCaster(scene.sensor(), MapConfig(resolution=resolution), NUM_CLASSES)
    rows = []
    for frame in scene.frames:
        cloud = point_cloud(frame)
        keys = distinct_keys(cloud.points, resolution)
        start = np.floor(cloud.origin.astype(np.float64) / resolution).astype(np.int64)
        octree = SemanticOctree(resolution, NUM_CLASSES)
        add_scan(octree, caster.cast(frame), clamped_increments(scene.sensor()), 0)
        size = frame.depth_image.size if isinstance(frame, DepthFrame) else 64 * 1024
        rows.append(
            (len(cloud.points) / size, len(cloud.points), len(keys), np.abs(keys - start).sum(), octree.num_cells)
        )
    return Workload(*(float(mean) for mean in np.mean(rows, axis=0)))


def distinct_keys(points: npt.NDArray[Any], resolution: float) -> Int64Array:
    """The distinct cells (n, 3) that points (P, 3) lie in."""
    keys = np.floor(points.astype(np.float64) / resolution).astype(np.int64)
    low = keys.min(axis=0)
    sizes = keys.max(axis=0) - low + 1
    flat = np.unique(np.ravel_multi_index(tuple((keys - low).T), tuple(sizes)))
    return np.stack(np.unravel_index(flat, tuple(sizes)), axis=1) + low


def _save(path: Path, **arrays: npt.NDArray[Any]) -> None:
    """Write a cache file in one piece."""
    partial = path.with_suffix(".partial.npz")
    np.savez_compressed(partial, **arrays)
    partial.replace(path)


# --- the village ------------------------------------------------------------------------------------------------------

_STREET = 60.0
_SIDE = 9.0


def _ground_height(x: npt.NDArray[Any], y: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Gently rolling ground [m]."""
    return 0.25 * np.sin(0.19 * x + 0.4) + 0.2 * np.sin(0.23 * y + 0.11 * x)


def _camera_path(num_frames: int, track: int, tracks: int) -> Float64Array:
    """Poses (n, 4, 4), optical frame: along the street, looking left and right in turn and a little down."""
    share = np.linspace(0.0, 1.0, num_frames)
    length = (_STREET - 20.0) / tracks
    x = -(_STREET - 20.0) / 2 + length * (track + share)
    y = 1.5 * np.sin(2 * math.pi * share)
    yaw = np.radians(65.0) * np.sin(2 * math.pi * 2.0 * share)
    pitch = math.radians(12.0)
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    forward = np.stack([np.cos(yaw) * math.cos(pitch), np.sin(yaw) * math.cos(pitch), -math.sin(pitch) + 0 * yaw], 1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), 0 * yaw], 1)
    poses[:, :3, 0] = right
    poses[:, :3, 1] = np.cross(forward, right)
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = np.stack([x, y, _ground_height(x, y) + 2.2], 1)
    return poses


def _lidar_path(num_frames: int, track: int, tracks: int) -> Float64Array:
    """Poses (n, 4, 4) of an upright LiDAR that turns with the camera."""
    camera = _camera_path(num_frames, track, tracks)
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, :3, 0] = np.cross(-camera[:, :3, 0], [0.0, 0.0, 1.0])
    poses[:, :3, 1] = -camera[:, :3, 0]
    poses[:, :3, 3] = camera[:, :3, 3] - [0.0, 0.0, 0.4]
    return poses


class _Eye:
    """Casts rays into the village: ground with a road, 12 houses in fenced gardens, 30 trees and 8 cars."""

    def __init__(self, seed: int) -> None:
        try:
            import open3d
        except (ImportError, OSError) as error:
            raise SystemExit(f"the scenes need Open3D, which cannot be loaded: {error}") from error
        self._o3d = open3d
        self._rng = np.random.default_rng([seed, 7])
        self._meshes: list[tuple[Float64Array, Int64Array, int]] = []
        self._build()
        sizes = np.cumsum([0, *(len(vertices) for vertices, _, _ in self._meshes)])
        vertices = np.concatenate([vertices for vertices, _, _ in self._meshes]).astype(np.float32)
        triangles = np.concatenate(
            [faces + first for (_, faces, _), first in zip(self._meshes, sizes, strict=False)]
        ).astype(np.uint32)
        classes = [np.full(len(faces), class_id, np.uint8) for _, faces, class_id in self._meshes]
        self._classes = np.append(np.concatenate(classes), np.uint8(0))  # the last: a ray that meets nothing
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(triangles))

    def cast(self, rays: Float64Array, pose: Float64Array) -> tuple[Float32Array, UInt8Array]:
        """Hit distances in units of the rays' lengths, infinite where nothing is met, and the classes there."""
        directions = rays @ pose[:3, :3].T
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        tensor = self._o3d.core.Tensor(np.concatenate([origins, directions], axis=-1).astype(np.float32))
        answer = self._scene.cast_rays(tensor)
        triangle = np.minimum(answer["primitive_ids"].numpy(), len(self._classes) - 1)
        return answer["t_hit"].numpy(), self._classes[triangle]

    def _build(self) -> None:
        """Ground first, then what stands on it."""
        self._add_ground()
        rng = self._rng
        for index in range(NUM_BUILDINGS):
            side = 1.0 if index % 2 else -1.0
            x = -_STREET / 2 + 5.0 + (index // 2) * 10.0 + rng.uniform(-0.8, 0.8)
            self._add_house(x, side * (_SIDE + rng.uniform(-0.5, 1.5)), rng.uniform(2.4, 3.4), rng.uniform(2.2, 3.2))
            for k in range(6):
                self._add_box(x - 4.2 + 1.4 * k, side * 4.3, 0.6, 0.03, 1.0, FENCE) if k != 3 else None
        for index in range(NUM_TREES):
            side = 1.0 if index % 2 else -1.0
            x = -_STREET / 2 + (index // 2) * _STREET / 14 + rng.uniform(-1.0, 1.0)
            self._add_tree(x, side * rng.uniform(4.9, 6.2))
        for index in range(NUM_CARS):
            x = -_STREET / 2 + 4.0 + index * 7.5 + rng.uniform(-1.5, 1.5)
            y = (1.0 if index % 2 else -1.0) * 3.2
            self._add_box(x, y, 2.1, 0.85, 0.85, CAR, bottom=0.2)
            self._add_box(x - 0.2, y, 1.1, 0.75, 1.5, CAR, bottom=0.85)

    def _add(self, vertices: npt.ArrayLike, faces: npt.ArrayLike, class_id: int) -> None:
        self._meshes.append((np.asarray(vertices, np.float64), np.asarray(faces, np.int64), class_id))

    def _add_ground(self) -> None:
        """A grid of 0.2 m; the road is the strip where |y| < 2.5 m, and beside it grass makes the ground uneven."""
        x, y = np.meshgrid(np.arange(-70.0, 70.1, 0.2), np.arange(-45.0, 45.1, 0.2), indexing="ij")
        grass = np.where(np.abs(y) < 2.5, 0.01, 0.06) * self._rng.uniform(-1.0, 1.0, x.shape)
        vertices = np.stack([x, y, _ground_height(x, y) + grass], axis=-1).reshape(-1, 3)
        corner = (np.arange(x.shape[0] - 1)[:, None] * x.shape[1] + np.arange(x.shape[1] - 1)).ravel()
        faces = np.concatenate(
            [np.stack([corner, corner + x.shape[1], corner + 1], 1),
             np.stack([corner + 1, corner + x.shape[1], corner + x.shape[1] + 1], 1)]
        )  # fmt: skip
        is_road = np.abs(vertices[faces].mean(axis=1)[:, 1]) < 2.5
        self._add(vertices, faces[is_road], ROAD)
        self._add(vertices, faces[~is_road], GROUND)

    def _add_box(self, x: float, y: float, a: float, b: float, top: float, class_id: int, bottom: float = -0.5) -> None:
        """A box of half lengths a and b between two heights above the ground."""
        box = self._o3d.geometry.TriangleMesh.create_box(2 * a, 2 * b, top - bottom)
        ground = float(_ground_height(np.array(x), np.array(y)))
        self._add(
            np.asarray(box.vertices) + np.array([x - a, y - b, ground + bottom]), np.asarray(box.triangles), class_id
        )

    def _add_house(self, x: float, y: float, a: float, b: float) -> None:
        """Walls and a gable roof with eaves."""
        eaves, ridge = 2.8, 4.6
        self._add_box(x, y, a, b, eaves, WALL)
        ground = float(_ground_height(np.array(x), np.array(y)))
        c, d = a + 0.4, b + 0.4
        corners = [(-c, -d, eaves), (c, -d, eaves), (c, d, eaves), (-c, d, eaves), (-c, 0.0, ridge), (c, 0.0, ridge)]
        faces = [(0, 1, 5), (0, 5, 4), (2, 3, 4), (2, 4, 5), (1, 2, 5), (3, 0, 4), (0, 3, 2), (0, 2, 1)]
        self._add(np.array(corners) + np.array([x, y, ground]), faces, ROOF)

    def _add_tree(self, x: float, y: float) -> None:
        """A trunk and a crown of loose leaves."""
        mesh = self._o3d.geometry.TriangleMesh
        rng = self._rng
        ground = float(_ground_height(np.array(x), np.array(y)))
        height, crown = rng.uniform(1.8, 2.6), rng.uniform(1.1, 1.7)
        trunk = mesh.create_cylinder(rng.uniform(0.12, 0.22), height + 0.5, 10, 1)
        middle = np.array([x, y, ground + height / 2 - 0.25])
        self._add(np.asarray(trunk.vertices) + middle, np.asarray(trunk.triangles), TRUNK)
        leaves = rng.normal(size=(1200, 3))
        leaves *= crown * rng.uniform(0.3, 1.0, (1200, 1)) ** (1 / 3) / np.linalg.norm(leaves, axis=1, keepdims=True)
        corners = leaves[:, None] + rng.normal(scale=0.08, size=(1200, 3, 3)) + [x, y, ground + height + 0.6 * crown]
        self._add(corners.reshape(-1, 3), np.arange(3600).reshape(-1, 3), CROWN)
