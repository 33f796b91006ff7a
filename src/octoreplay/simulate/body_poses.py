"""Poses of a simulated robot's base and of the camera on it."""

from __future__ import annotations

import numpy as np

from octoreplay.io.robots.robot_log_writer import OPTICAL_IN_BODY
from octoreplay.records import Float64Array
from octoreplay.simulate.world import Terrain

_POSE_CORRELATION_TIME = 10.0
_BASE_HEIGHT = 0.13
_CAMERA_POSITION = (0.35, 0.0, 0.75)
_CAMERA_PITCH = 0.08
_LIDAR_HEIGHT = 0.85


def body_poses(terrain: Terrain, states: Float64Array) -> Float64Array:
    """Return poses (T, 4, 4) of a base on the ground at states (T, 3) of x, y [m] and heading [rad]."""
    poses = np.zeros((len(states), 4, 4))
    up = terrain.normal(states[:, :2])
    heading = np.stack([np.cos(states[:, 2]), np.sin(states[:, 2]), np.zeros(len(states))], axis=1)
    left = np.cross(up, heading)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    poses[:, :3, 0] = np.cross(left, up)
    poses[:, :3, 1] = left
    poses[:, :3, 2] = up
    poses[:, :2, 3] = states[:, :2]
    poses[:, 2, 3] = terrain.height(states[:, :2]) + _BASE_HEIGHT
    poses[:, 3, 3] = 1.0
    return poses


def pose_errors(sigma: float, num_poses: int, period: float, rng: np.random.Generator) -> Float64Array:
    """Draw localisation errors (T, 3) of x, y [m] and heading [rad], one every ``period`` [s].

    They are a stationary first-order Gauss-Markov process with a correlation time of 10 s. Its standard deviation is
    ``sigma`` in x and y, and ``sigma`` / 10 m in heading, which moves points at 10 m distance by ``sigma`` as well.
    """
    correlation = np.exp(-period / _POSE_CORRELATION_TIME)
    steps = rng.standard_normal((num_poses, 3)) * (sigma, sigma, sigma / 10.0)
    steps[1:] *= np.sqrt(1.0 - correlation**2)
    errors: Float64Array = np.empty_like(steps)
    error = np.zeros(3)
    for row, step in zip(errors, steps, strict=True):
        error = correlation * error + step
        row[:] = error
    return errors


def midway(T_a: Float64Array, T_b: Float64Array) -> Float64Array:
    """Return the pose (4, 4) halfway between two: mean position and slerp's rotation at one half.

    That rotation is the one nearest to the sum of the two rotation matrices, computed by an SVD.
    """
    middle = np.eye(4)
    u, _, vt = np.linalg.svd(T_a[:3, :3] + T_b[:3, :3])
    middle[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    middle[:3, 3] = (T_a[:3, 3] + T_b[:3, 3]) / 2
    return middle


def _camera_mount() -> Float64Array:
    """Transform from the camera's optical frame to the base: ahead of its centre, on a mast, tilted down."""
    cos, sin = np.cos(_CAMERA_PITCH), np.sin(_CAMERA_PITCH)
    mount = np.eye(4)
    mount[:3, :3] = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]) @ OPTICAL_IN_BODY
    mount[:3, 3] = _CAMERA_POSITION
    return mount


T_BODY_CAMERA = _camera_mount()
"""Transform (4, 4) from the camera's optical frame to the body of a simulated robot."""

T_BODY_LIDAR = np.eye(4)
"""Transform (4, 4) from the LiDAR's frame to the body: above its centre, with parallel axes."""
T_BODY_LIDAR[2, 3] = _LIDAR_HEIGHT
