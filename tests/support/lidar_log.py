"""Logs of a simulated spinning LiDAR or depth camera on a robot that drives a curve, with the true poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import open3d as o3d

from octoreplay.records import Float64Array
from support.log_factory import SECOND, Entry, ros2, write_mcap

START = 100 * SECOND
MOUNT = np.array([0.2, 0.0, 0.6])
"""Position of the LiDAR on the robot; its axes are those of the robot."""


class Drive(NamedTuple):
    """Log with the stamps of its scans and the true poses T_world_base (n, 4, 4) at them."""

    log: Path
    stamps_ns: list[int]
    poses: Float64Array


def boxes(*corners: tuple[Sequence[float], Sequence[float]]) -> o3d.t.geometry.RaycastingScene:
    """A scene of axis-aligned boxes, each from its low to its high corner."""
    scene = o3d.t.geometry.RaycastingScene()
    for low, high in corners:
        size = np.subtract(high, low)
        mesh = o3d.geometry.TriangleMesh.create_box(*map(float, size)).translate(low)
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene


def swaying_turn(seconds: float) -> Float64Array:
    """T_world_base of a robot that stands for 1 s, then turns to and fro by up to 90 degrees per second."""
    moving = max(seconds - 1.0, 0.0)
    yaw = 0.5 * (1.0 - np.cos(np.pi * moving))
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = 0.5 * moving, 0.0, 0.0
    return T


def room() -> o3d.t.geometry.RaycastingScene:
    """A room of 16 m x 12 m x 4 m with furniture."""
    return boxes(
        ((-8, -6, 0), (8, 6, 4)), ((2, 3, 0), (4, 5, 1.5)), ((-5, -4, 0), (-3.5, -2, 2)), ((5, -5, 0), (6, -2, 3)),
        ((-7, 2, 0), (-6, 4, 1)), ((0, -5.5, 0), (1, -4.5, 2.5)), ((-2, 4.5, 0), (-1, 5.5, 1)),
    )  # fmt: skip


def plain() -> o3d.t.geometry.RaycastingScene:
    """A flat floor without end."""
    return boxes(((-500, -500, -1), (500, 500, 0)))


def base_pose(seconds: float) -> Float64Array:
    """T_world_base on a curve through the middle of the room, at 0.6 m/s and with turns."""
    angle = 0.3 * seconds
    x, y = 2.0 * np.cos(angle) - 2.0, 2.0 * np.sin(angle) - 1.0
    yaw = angle + np.pi / 2 + 0.2 * np.sin(1.5 * seconds)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, 0.0
    return T


def write_drive(
    path: Path,
    scene: o3d.t.geometry.RaycastingScene,
    *,
    num_scans: int = 20,
    rings: int = 16,
    columns: int = 360,
    period: float = 0.1,
    times: str | None = "t",
    noise: float = 0.01,
    pose=base_pose,
    wheels: float | None = None,
    with_tf: bool = True,
    is_scan: bool = False,
    imu: Imu | None = None,
    mount: Float64Array | None = None,
) -> Drive:
    """Write the log of a LiDAR whose columns are measured one after the other while the robot moves.

    ``times`` names the field of the points' times: 't' in nanoseconds after the stamp, 'time' in seconds after it,
    'timestamp' as a date in seconds. ``wheels`` adds odometry at 20 Hz with this error of scale. With ``is_scan`` the
    messages are laser scans of one ring. ``mount`` (3, 3) is the rotation of the LiDAR on the robot, which stands in no
    transform. ``imu`` adds an IMU of planar motions.
    """
    rng = np.random.default_rng(0)
    R_base_lidar = np.eye(3) if mount is None else mount
    elevation = np.zeros(1) if is_scan else np.radians(np.linspace(-25, 15, rings))
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    when = np.linspace(0.0, period, columns, endpoint=False)
    entries, stamps, poses = [], [], []
    for index in range(num_scans):
        stamp = START + round(index * period * SECOND)
        rays = np.empty((columns, len(elevation), 6), np.float32)
        directions = np.stack(
            [
                np.cos(elevation)[None] * np.cos(azimuth)[:, None],
                np.cos(elevation)[None] * np.sin(azimuth)[:, None],
                np.broadcast_to(np.sin(elevation), (columns, len(elevation))),
            ], axis=-1,
        )  # fmt: skip
        for column in range(columns):
            T = pose(index * period + when[column])
            rays[column, :, :3] = T[:3, :3] @ MOUNT + T[:3, 3]
            rays[column, :, 3:] = directions[column] @ (T[:3, :3] @ R_base_lidar).T
        distance = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy().astype(np.float64)
        distance += noise * rng.standard_normal(distance.shape)
        stamps.append(stamp)
        poses.append(pose(index * period))
        if is_scan:
            message = ros2.scan(stamp, distance[:, 0], angle_min=-np.pi, angle_increment=2 * np.pi / columns)
            entries.append(Entry("/scan", "sensor_msgs/msg/LaserScan", message, stamp))
            continue
        seen = distance.reshape(-1) < 80.0
        points = np.where(distance < 80.0, distance, 0.0)[..., None] * directions
        points = points.reshape(-1, 3)
        fields = {name: points[seen, axis].astype("f4") for axis, name in enumerate("xyz")}
        at = np.repeat(when, len(elevation))[seen]
        if times is not None:
            fields[times] = {
                "t": (at * 1e9).astype("u4"), "time": at.astype("f4"), "timestamp": stamp / 1e9 + at,
            }[times]  # fmt: skip
        entries.append(Entry("/points", "sensor_msgs/msg/PointCloud2", ros2.cloud(stamp, fields), stamp))
    if with_tf:
        tf = ros2.tf(("base_link", "lidar", START, MOUNT, (0.0, 0.0, 0.0, 1.0)))
        entries.append(Entry("/tf_static", "tf2_msgs/msg/TFMessage", tf, START - SECOND))
    if wheels is not None:
        for tick in range(-2, round(num_scans * period * 20) + 3):
            T, stamp = pose(tick / 20), START + tick * SECOND // 20
            half = np.arctan2(T[1, 0], T[0, 0]) / 2
            odometry = ros2.odometry(
                stamp, tuple((1 + wheels) * T[:3, 3]), (0.0, 0.0, np.sin(half), np.cos(half)), child="base_link"
            )
            entries.append(Entry("/wheels", "nav_msgs/msg/Odometry", odometry, stamp))
    if imu is not None:
        entries += imu_entries(imu, pose, num_scans * period, R_base_lidar)
    write_mcap(path, sorted(entries, key=lambda entry: entry.log_time_ns))
    return Drive(path, stamps, np.array(poses))


class Imu(NamedTuple):
    """IMU at 100 Hz with a bias [rad/s] and noise; its axes are ``R_lidar_imu`` in the LiDAR's."""

    frame: str = "lidar"
    R_lidar_imu: Float64Array = np.eye(3)
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise: float = 0.002


def imu_entries(imu: Imu, pose, seconds: float, R_base_lidar: Float64Array) -> list[Entry]:
    """Messages of an IMU on a robot that turns about its vertical axis; its acceleration is gravity and noise."""
    rng = np.random.default_rng(1)
    R_imu_base = (R_base_lidar @ imu.R_lidar_imu).T
    entries = []
    for tick in range(-2, round(100 * seconds) + 3):
        stamp = START + tick * SECOND // 100
        before, after = pose(tick / 100 - 0.001)[:3, :3], pose(tick / 100 + 0.001)[:3, :3]
        turned = before.T @ after
        rate = np.array([0.0, 0.0, np.arctan2(turned[1, 0], turned[0, 0]) / 0.002])
        rates = R_imu_base @ rate + imu.bias + imu.noise * rng.standard_normal(3)
        up = R_imu_base @ (0.0, 0.0, 9.81) + 10 * imu.noise * rng.standard_normal(3)
        message = ros2.imu(stamp, rates, up, frame_id=imu.frame)
        entries.append(Entry("/imu", "sensor_msgs/msg/Imu", message, stamp))
    return entries


def aligned_error(estimated: Float64Array, true: Float64Array) -> float:
    """Root mean square error of positions [m] after the best rigid transform (Umeyama 1991)."""
    one, other = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (estimated, true))
    left, _, right = np.linalg.svd(one.T @ other)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return float(np.sqrt(np.square(one @ rotation - other).sum(axis=1).mean()))
