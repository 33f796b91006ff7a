"""Two robots in a yard of walls and boxes, whose recorded poses drift; points instead of logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.drift import Track
from octoreplay.registration.rigid import inverses, rotation_exps
from octoreplay.registration.submaps import Submap
from octoreplay.transforms import inverse

VOXEL = 0.2
_SECOND = 1_000_000_000
_VIEW = 7.0
_NUM_POSES, _LENGTH = 48, 8


@dataclass(frozen=True, eq=False)
class DriftingTeam:
    """Submaps and tracks with drift, and the true poses (n, 4, 4) of each track."""

    submaps: list[Submap]
    tracks: list[Track]
    truth: list[Float64Array]

    def errors(self, poses: list[Float64Array]) -> Float64Array:
        """Distances between the positions of poses of each robot and the true ones."""
        pairs = zip(poses, self.truth, strict=True)
        return np.concatenate([np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1) for a, b in pairs])


def yard(rng: np.random.Generator) -> tuple[Float64Array, np.ndarray]:
    """Points (n, 3) and classes (n,) of ground (1) and of boxes of the classes 2 to 4."""
    ground = np.column_stack([rng.uniform(-16, 16, (40_000, 2)), np.zeros(40_000)])
    points, classes = [ground], [np.full(len(ground), 1)]
    for number, (x, y) in enumerate(rng.uniform(-14, 14, (18, 2))):
        size = np.append(rng.uniform(1.0, 3.0, 2), 2.0)
        side = rng.uniform(-0.5, 0.5, (2_000, 3))
        axis = rng.integers(0, 2, len(side))
        side[np.arange(len(side)), axis] = np.sign(side[np.arange(len(side)), axis]) * 0.5
        points.append(side * size + [x, y, 1.0])
        classes.append(np.full(len(side), 2 + number % 3))
    return np.concatenate(points), np.concatenate(classes).astype(np.uint8)


def loop(radius: float, start: float, num_poses: int) -> Float64Array:
    """Poses (n, 4, 4) on a circle, with one and a half rounds."""
    angles = start + np.linspace(0.0, 3 * np.pi, num_poses)
    poses = np.tile(np.eye(4), (num_poses, 1, 1))
    poses[:, :3, :3] = rotation_exps((angles + np.pi / 2)[:, None] * [0.0, 0.0, 1.0])
    poses[:, :3, 3] = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.ones(num_poses)])
    return poses


def drifting(poses: Float64Array, scale: float, turn: float) -> Float64Array:
    """Poses with a scale error and a turn per metre [rad], from the same first pose."""
    motions = inverses(poses[:-1]) @ poses[1:]
    recorded = [poses[0]]
    for motion in motions:
        way = np.linalg.norm(motion[:3, 3])
        wrong = motion.copy()
        wrong[:3, 3] *= 1.0 + scale
        wrong[:3, :3] = motion[:3, :3] @ rotation_exps(np.array([[0.0, 0.0, turn * way]]))[0]
        recorded.append(recorded[-1] @ wrong)
    return np.array(recorded)


def drifting_team(scale: float = 0.015, turn: float = 0.0025, second_start: float = 1.0) -> DriftingTeam:
    """Team whose robots drift in opposite directions."""
    rng = np.random.default_rng(0)
    points, classes = yard(rng)
    submaps, tracks, truth = [], [], []
    for robot, (radius, start, sign) in enumerate(((8.0, 0.0, 1.0), (6.0, second_start, -1.0))):
        poses = loop(radius, start, _NUM_POSES)
        recorded = drifting(poses, sign * scale, sign * turn)
        stamps = np.arange(_NUM_POSES) * _SECOND
        for first in range(0, _NUM_POSES, _LENGTH):
            middle = first + _LENGTH // 2
            seen = np.linalg.norm(points - poses[middle, :3, 3], axis=1) < _VIEW
            T_anchor_world = inverse(poses[middle])
            noisy = points[seen] + rng.normal(0.0, 0.02, (seen.sum(), 3))
            in_anchor = noisy @ T_anchor_world[:3, :3].T + T_anchor_world[:3, 3]
            submaps.append(
                Submap.of_points(robot, int(stamps[middle]), recorded[middle], in_anchor, classes[seen], VOXEL)
            )
        tracks.append(Track(stamps, recorded))
        truth.append(poses)
    return DriftingTeam(submaps, tracks, truth)
