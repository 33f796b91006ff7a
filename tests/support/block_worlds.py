"""Worlds of labelled blocks on a ground of two classes, and the maps that ideal robots make of them."""

from __future__ import annotations

import numpy as np

from octoreplay.registration.own_map import FREE, OwnMap
from octoreplay.transforms import inverse

NUM_CLASSES = 5
LAWN, ROAD = 1, 2
RESOLUTION = 0.3
HEIGHT = 3.0


class BlockWorld:
    """Square of 28 m with blocks of random sizes and classes, and a ground with crossing roads."""

    def __init__(self, seed, num_blocks=36):
        rng = np.random.default_rng(seed)
        self.low = np.column_stack([rng.uniform(-14, 14, (num_blocks, 2)), np.zeros(num_blocks)])
        self.high = self.low + np.column_stack(
            [rng.uniform(0.6, 5, (num_blocks, 2)), rng.uniform(1.2, 2.8, num_blocks)]
        )
        self.class_ids = rng.integers(3, NUM_CLASSES + 1, num_blocks)
        self.roads = rng.uniform(-12, 12, (2, 2))

    def states(self, points):
        """State of space at points (n, 3): free, or the class of the block or of the ground."""
        states = np.full(len(points), FREE, np.uint8)
        on_road = (np.abs(points[:, None, :2] - self.roads) < 2).any(axis=(1, 2))
        states[points[:, 2] < 0] = np.where(on_road, ROAD, LAWN)[points[:, 2] < 0]
        for low, high, class_id in zip(self.low, self.high, self.class_ids, strict=True):
            states[((points >= low) & (points < high)).all(axis=1)] = class_id
        return states

    def view(self, centre, radius, T_world_own, resolution=RESOLUTION):
        """Map of the space within ``radius`` of a ``centre`` (2,) [m] in the frame ``T_world_own`` (4, 4)."""
        T = inverse(T_world_own)
        reach = radius + 1.0
        corners = np.array([[x, y, z] for x in (-reach, reach) for y in (-reach, reach) for z in (-1.0, HEIGHT + 1)])
        corners = (corners + np.array([*centre, 0.0])) @ T[:3, :3].T + T[:3, 3]
        low, high = np.floor(corners.min(axis=0) / resolution), np.ceil(corners.max(axis=0) / resolution)
        axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
        keys = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int64)
        points = (keys + 0.5) * resolution @ T_world_own[:3, :3].T + T_world_own[:3, 3]
        inside = (
            (np.hypot(*(points[:, :2] - centre).T) < radius) & (points[:, 2] > -resolution) & (points[:, 2] < HEIGHT)
        )
        # Only surfaces are seen.
        deep = self.low + 1.5 * resolution, self.high - 1.5 * resolution
        for low, high in zip(*deep, strict=True):
            inside &= ~((points >= (*low[:2], 0.0)) & (points < high)).all(axis=1)
        return OwnMap.of_cells(keys[inside], self.states(points[inside]), resolution, NUM_CLASSES)


def upright_pose(yaw, x, y, z=0.0):
    """Pose (4, 4) with a rotation about the vertical axis [rad]."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def pose_error(T, T_true):
    """Distance [m] and angle [degree] between two poses (4, 4)."""
    difference = inverse(T_true) @ T
    angle = np.degrees(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)))
    return float(np.linalg.norm(difference[:3, 3])), float(angle)
