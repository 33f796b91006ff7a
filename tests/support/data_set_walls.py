"""A wall that the stand-ins of data sets show: its points in sensors' frames, and the maps made of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from octoreplay.result import open_result
from support.command_line import octoreplay

# A wall of 2 m by 1 m at x = 6 m.
Y, Z = np.meshgrid(np.linspace(-1.0, 1.0, 41), np.linspace(0.5, 1.5, 21))
WALL = np.column_stack([np.full(Y.size, 6.03), Y.ravel(), Z.ravel()])

FORWARD = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Pose of an optical frame in a body whose x axis points forward."""


def pose(index: int, side: float = 0.0) -> npt.NDArray[np.float64]:
    """Pose of a body that moves towards the wall and turns, in a world with z up."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [0.1 * index - 0.1, 0.02, 0.03]).as_matrix()
    T[:3, 3] = 0.4 * index, side, 0.8
    return T


def seen(T_world_sensor: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Points of the wall in a sensor's frame."""
    return ((WALL - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3]).astype(np.float32)


def depth(T_world_camera: npt.NDArray[np.float64], camera: tuple[int, int, float]) -> npt.NDArray[np.float64]:
    """Depth image (H, W) of the wall's plane in metres, 0 beside the wall; ``camera`` is (W, H, f), centred."""
    width, height, f = camera
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - (width - 1) / 2) / f, (v - (height - 1) / 2) / f, np.ones_like(u, float)], axis=-1)
    world = rays @ T_world_camera[:3, :3].T
    distance = (6.03 - T_world_camera[0, 3]) / world[..., 0]
    hits = T_world_camera[:3, 3] + distance[..., None] * world
    inside = (np.abs(hits[..., 1]) <= 1.0) & (np.abs(hits[..., 2] - 1.0) <= 0.5) & (distance > 0)
    return np.where(inside, distance, 0.0)


def mapped(
    team_file: Path,
    *options: object,
    moved: tuple[float, float, float] = (0.0, 0.0, 0.0),
    wall: npt.NDArray[np.float64] = WALL,
) -> set[str]:
    """Run a team, check that every robot's map is the wall (``moved``) alone, and return the classes in the maps."""
    result = team_file.parent / "result.mcap"
    done = octoreplay("run", team_file, "-o", result, "--resolution", 0.1, "-q", "--publish-period", 0.5, *options)
    assert done.returncode == 0, done.stderr
    names = set()
    with open_result(result) as opened:
        for robot in opened.robots:
            leaves = opened.evidence(robot).leaves()
            is_occupied = leaves.log_odds.max(axis=1) > 0
            occupied = leaves.centers[is_occupied] - moved
            assert len(occupied) > 50
            lower, upper = wall.min(axis=0) - 0.1, wall.max(axis=0) + 0.1
            assert (occupied >= lower).all(), occupied.min(axis=0)
            assert (occupied <= upper).all(), occupied.max(axis=0)
            names |= {
                opened.class_table.classes[k - 1].name
                for k in set((leaves.log_odds[is_occupied].argmax(axis=1) + 1).tolist())
            }
    return names
