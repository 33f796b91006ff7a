"""Frames of a team that is replayed with right frames, with unrelated ones, and with those that ``align`` finds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team
from octoreplay.io.output_file import write_whole
from octoreplay.records import Float64Array
from octoreplay.replay.alignment import align_logs, aligned_config
from octoreplay.transforms import inverse, pose_difference, pose_matrix, transform_of

RIGHT, UNALIGNED, ALIGNED = "right", "unaligned", "aligned"
FRAMES = (RIGHT, UNALIGNED, ALIGNED)
"""Frames of a team: the given ones, one of each robot's own, and those that ``align`` finds."""

MAX_SHIFT = 1.0
"""Largest shift of a robot's own frame along each axis [m], so that the maps still share space."""


def team_file(folder: Path, frames: str) -> Path | None:
    """Return the team file with one of ``FRAMES``; None where ``align`` connected no two robots."""
    path = folder / f"{frames}.yaml"
    return path if path.exists() else None


def own_frame(rng: np.random.Generator) -> Float64Array:
    """Return a random transform (4, 4) from a team's frame: any rotation about z, and a shift."""
    yaw = rng.uniform(-math.pi, math.pi)
    return pose_matrix(rng.uniform(-MAX_SHIFT, MAX_SHIFT, 3).tolist(), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))


def without_frames(config: RunConfig) -> RunConfig:
    """Return the configuration without the frames of the robots."""
    robots = (
        dataclasses.replace(robot, T_team_map=None, T_team_map_sigma=None, T_team_map_from=None)
        for robot in config.robots
    )
    return dataclasses.replace(config, robots=tuple(robots))


def write_team_files(
    folder: Path, right: RunConfig, unaligned: RunConfig, dof: int, resolution: float,
    progress: Callable[[float], None],
) -> None:  # fmt: skip
    """Write the team file with each kind of frames; that of ``ALIGNED`` only where ``align`` connects robots.

    ``align`` has ``dof`` degrees of freedom and maps of cells of ``resolution`` [m], and knows no frame. Raises the
    errors of ``align_logs``.
    """
    _write_team(folder, RIGHT, right)
    _write_team(folder, UNALIGNED, unaligned)
    unknown = without_frames(right)
    team = align_logs(unknown.with_parameters({"resolution": resolution}), dof=dof, progress=progress).teams[0]
    if len(team) > 1:
        _write_team(folder, ALIGNED, aligned_config(unknown, team))


def frame_errors(right: RunConfig, found: RunConfig) -> tuple[float, float]:
    """Return the largest errors of the frames of ``found`` against the right ones: shift [m] and angle [degrees].

    They are errors between each robot and the first one of ``found``, whose frame is the reference.
    """
    true, given = (
        {robot.robot_id: transform_of(robot.T_team_map_or_identity) for robot in config.robots}
        for config in (right, found)
    )
    first = found.robots[0].robot_id
    errors = [
        pose_difference(inverse(true[first]) @ true[robot_id], inverse(given[first]) @ given[robot_id])
        for robot_id in given
    ]
    shifts, angles = zip(*errors, strict=True)
    return max(shifts), math.degrees(max(angles))


def _write_team(folder: Path, name: str, config: RunConfig) -> None:
    """Write a team file."""
    write_whole(folder / f"{name}.yaml", dump_team(config, folder.resolve()))
