"""Simulated teams in which frames of robots are wrong by a known error."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.evaluate.truth_frame import FRAMES_FILE
from octoreplay.io.output_file import write_whole
from octoreplay.records import Float64Array
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study.experiments import SimulatedTeam
from octoreplay.transforms import inverse, numbers_of, pose_matrix, transform_of

ONE, ITSELF, OTHERS = (
    "one frame wrong: maps of the other robots",
    "one frame wrong: map of that robot",
    "all other frames wrong: map of one robot",
)
CASES = (ONE, ITSELF, OTHERS)
"""Frames that are wrong, and the robots whose maps are compared with the truth.

``ONE`` and ``ITSELF`` are the same error in two frames: that of the truth as the right robots have it, and as the wrong
robot has it.
"""


@dataclass(frozen=True)
class MisalignedTeam:
    """Simulated team in which each wrong frame has an error of one size, in a random direction.

    Attributes
    ----------
    simulation : SimulationConfig
        Settings of the simulation, with own frames: each robot's map frame is its first pose.
    case : str
        One of ``CASES``.
    shift : float
        Horizontal shift of a wrong frame [m].
    angle : float
        Rotation of a wrong frame about the vertical axis through the robot's first position [degree].
    """

    simulation: SimulationConfig
    case: str
    shift: float
    angle: float

    @property
    def seed(self) -> int:
        """Seed of the simulation and of the errors' directions."""
        return self.simulation.seed

    @property
    def folder_name(self) -> str:
        """Name of the folder of the logs, that of the simulated team."""
        return SimulatedTeam(self.simulation).folder_name

    @property
    def judged(self) -> tuple[str, ...]:
        """Robots whose maps are compared with the truth, in whose frame they are."""
        first, *others = self.simulation.robot_ids
        return tuple(others) if self.case == ONE else (first,)

    def write(self, folder: Path, progress: Callable[[float], None]) -> None:
        """Simulate the team as ``simulated_team`` does."""
        SimulatedTeam(self.simulation).write(folder, progress)

    def team_file(self, label: str, folder: Path) -> Path:
        """Return the team file with the wrong frames, which is written beside the simulated one."""
        config = load_team_file(folder / "team.yaml")
        true = {robot_id: transform_of(T) for robot_id, T in load_frames_file(folder / FRAMES_FILE).items()}
        frames = self.frames(true)
        robots = tuple(
            dataclasses.replace(robot, T_team_map=numbers_of(frames[robot.robot_id])) for robot in config.robots
        )
        path = folder / f"{label}.yaml"
        write_whole(path, dump_team(dataclasses.replace(config, robots=robots), folder.resolve()))
        return path

    def frames(self, true: Mapping[str, Float64Array]) -> dict[str, Float64Array]:
        """Return the T_team_map (4, 4) of each robot, from the true ones."""
        first, *others = self.simulation.robot_ids
        error = self._error(0)
        if self.case == ONE:
            return {**true, first: true[first] @ error}
        if self.case == ITSELF:
            # The first robot has the same frame as above relative to the others, and its own true one.
            T_true_wrong = true[first] @ inverse(error) @ inverse(true[first])
            return {**true, **{robot_id: T_true_wrong @ true[robot_id] for robot_id in others}}
        return {**true, **{robot_id: true[robot_id] @ self._error(n) for n, robot_id in enumerate(others, start=1)}}

    def _error(self, index: int) -> Float64Array:
        """Error (4, 4) of one robot's frame; errors of other sizes have the same direction."""
        rng = np.random.default_rng([self.seed, 11, index])
        direction, sign = rng.uniform(-math.pi, math.pi), rng.choice((-1.0, 1.0))
        half = sign * math.radians(self.angle) / 2.0
        position = (self.shift * math.cos(direction), self.shift * math.sin(direction), 0.0)
        return pose_matrix(position, (0.0, 0.0, math.sin(half), math.cos(half)))
