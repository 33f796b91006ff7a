"""Errors of a team's trajectories against the true ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay.errors import InputError
from octoreplay.io.datasets.pose_files import read_tum_track
from octoreplay.io.robots.trajectories import Trajectory
from octoreplay.records import Float64Array, Int64Array
from octoreplay.replay.refinement import RobotTrajectory

# Largest time between two true poses that are interpolated.
_POSE_GAP_NS = 1_000_000_000


@dataclass(frozen=True)
class TrajectoryErrors:
    """Absolute trajectory errors [m]: root mean square distance from the true positions, before and after the repair.

    One rigid transform aligns the whole team to the truth (Umeyama, Least-Squares Estimation of Transformation
    Parameters Between Two Point Patterns, PAMI 1991), once before and once after. ``robots`` has the errors of each
    robot by its id.
    """

    before: float
    after: float
    robots: Mapping[str, tuple[float, float]]


def read_truth(folder: Path, robot_ids: Sequence[str]) -> dict[str, Trajectory]:
    """Return the true trajectories: ROBOT.tum in a folder or in its subfolder ``truth``.

    Raises InputError where a robot has no file.
    """
    subfolder = folder / "truth"
    folder = subfolder if subfolder.is_dir() else folder
    for robot_id in robot_ids:
        if not (folder / f"{robot_id}.tum").is_file():
            raise InputError(f"{folder}: holds no {robot_id}.tum; --truth expects one TUM file for each robot")
    return {robot_id: read_tum_track(folder / f"{robot_id}.tum") for robot_id in robot_ids}


def trajectory_errors(trajectories: Sequence[RobotTrajectory], truth: Mapping[str, Trajectory]) -> TrajectoryErrors:
    """Return the trajectory errors before and after a repair. Raises InputError where a robot's times do not match."""
    owners, true, recorded, corrected = [], [], [], []
    for index, trajectory in enumerate(trajectories):
        places, positions = _matched(trajectory.stamps_ns, truth[trajectory.robot_id])
        if places.size == 0:
            raise InputError(
                f"the true trajectory of robot '{trajectory.robot_id}' has no times in common with its log"
            )
        owners.append(np.full(places.size, index))
        true.append(positions)
        recorded.append(trajectory.recorded[places, :3, 3])
        corrected.append(trajectory.corrected[places, :3, 3])
    owner, target = np.concatenate(owners), np.concatenate(true)
    squared = [_aligned_squares(np.concatenate(positions), target) for positions in (recorded, corrected)]
    before, after = (float(np.sqrt(errors.mean())) for errors in squared)
    robots = {
        trajectory.robot_id: (_root_mean(squared[0][owner == index]), _root_mean(squared[1][owner == index]))
        for index, trajectory in enumerate(trajectories)
    }
    return TrajectoryErrors(before, after, robots)


def _root_mean(squares: Float64Array) -> float:
    """Root of the mean of squares."""
    return float(np.sqrt(squares.mean()))


def _matched(stamps_ns: Int64Array, truth: Trajectory) -> tuple[Int64Array, Float64Array]:
    """Places (n,) of the stamps with a true pose, and the true positions (n, 3)."""
    poses = [truth.matrix_at(stamp, _POSE_GAP_NS) for stamp in stamps_ns.tolist()]
    places = np.flatnonzero([pose is not None for pose in poses])
    return places, np.array([pose[:3, 3] for pose in poses if pose is not None]).reshape(-1, 3)


def _aligned_squares(positions: Float64Array, target: Float64Array) -> Float64Array:
    """Squared distances (n,) between positions (n, 3) and targets (n, 3) after the best rigid transform."""
    centred, wanted = positions - positions.mean(axis=0), target - target.mean(axis=0)
    left, _, right = np.linalg.svd(centred.T @ wanted)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return np.asarray(np.square(centred @ rotation - wanted).sum(axis=1))
