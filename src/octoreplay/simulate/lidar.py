"""Scans of a mesh by a spinning LiDAR."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.records import Float32Array, Float64Array, UInt8Array
from octoreplay.simulate.scene import NO_LABEL, MeshScene
from octoreplay.simulate.world import World

RANGE_SIGMA = 0.02
"""Standard deviation of a LiDAR's range noise [m]."""


class LidarModel(NamedTuple):
    """Rays of a scan: ``rings`` elevations from ``low`` to ``high`` [rad], ``columns`` azimuths over a full turn.

    Both are evenly spaced. Azimuth 0 is along x, and azimuths grow counter-clockwise.
    """

    rings: int
    columns: int
    low: float
    high: float

    def directions(self) -> Float64Array:
        """Return unit vectors (rings, columns, 3) in the LiDAR's frame: x forward, y left, z up."""
        elevation = np.linspace(self.low, self.high, self.rings)[:, None]
        azimuth = np.arange(self.columns) * (2 * np.pi / self.columns)
        x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        return np.stack([x, y, np.broadcast_to(z, x.shape)], axis=-1)


class MeshLidar:
    """LiDAR that scans a world. All rays of a scan are cast at one time.

    ``directions`` (rings, columns, 3) are those of the model. Raises InputError if Open3D or one of its shared
    libraries is missing.
    """

    def __init__(self, world: World, model: LidarModel) -> None:
        self._scene = MeshScene(world)
        self.directions = model.directions()

    def take(self, T_world_lidar: Float64Array, max_range: float) -> tuple[Float32Array, UInt8Array]:
        """Measure ranges (rings, columns) float32 [m], 0 beyond ``max_range`` [m], and labels (rings, columns) uint8.

        ``T_world_lidar`` (4, 4) is the pose of the LiDAR's frame.
        """
        ranges, labels, _ = self._scene.cast(T_world_lidar[:3, 3], self.directions @ T_world_lidar[:3, :3].T)
        beyond = ~(ranges <= max_range)
        ranges[beyond] = 0.0
        labels[beyond] = NO_LABEL
        return ranges, labels

    def points(self, ranges: Float32Array) -> Float64Array:
        """Return the coordinates (rings, columns, 3) [m] of a scan's points in the LiDAR's frame."""
        points: Float64Array = ranges[..., None] * self.directions
        return points


def add_range_noise(ranges: Float32Array, rng: np.random.Generator, factor: float = 1.0) -> Float32Array:
    """Return the ranges [m] with Gaussian noise of ``factor`` * RANGE_SIGMA; rays without a return stay 0."""
    noise = np.float32(factor * RANGE_SIGMA) * rng.standard_normal(ranges.shape, dtype=np.float32)
    return np.where(ranges > 0, np.maximum(ranges + noise, np.float32(0.001)), np.float32(0.0))
