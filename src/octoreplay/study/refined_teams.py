"""Simulated teams with wrong poses, as recorded and after the repair of their drift."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from octoreplay._version import __version__
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.evaluate.trajectories import read_truth, trajectory_errors
from octoreplay.io.output_file import new_folder, write_whole, writing
from octoreplay.io.robots.discover import resolve
from octoreplay.io.text_files import json_text
from octoreplay.registration.drift import DriftModel
from octoreplay.replay.refinement import RefinementConfig, refine_team, refined_config, write_trajectories
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team

RECORDED, REFINED = "recorded", "refined"
POSES = {RECORDED: "team", REFINED: "refined"}
"""Names of the team files without suffix, by kind of poses: as recorded, and corrected."""
_ERRORS = "errors.json"


@dataclass(frozen=True)
class RefinedTeam:
    """Simulated team with wrong poses, which ``refine`` corrects.

    It expects the drift of the simulation, its default one where the poses have other errors.

    Attributes
    ----------
    simulation : SimulationConfig
        Settings of the simulation, with drift or noise of the poses.
    poses : str
        Kind of poses, one of ``POSES``. Both teams have the same folder.
    """

    simulation: SimulationConfig
    poses: str

    @property
    def seed(self) -> int:
        """Seed of the simulation."""
        return self.simulation.seed

    @property
    def folder_name(self) -> str:
        """Name of the folder of the logs: the seed, and a digest of all settings and the version."""
        digest = hashlib.sha256(json_text([__version__, self.simulation]).encode()).hexdigest()[:10]
        return f"refined_{self.seed}_{digest}"

    @property
    def settings(self) -> RefinementConfig:
        """Settings of the repair."""
        drift = self.simulation.odometry_drift
        return RefinementConfig(drift=DriftModel(*drift)) if any(drift) else RefinementConfig()

    def write(self, folder: Path, progress: Callable[[float], None]) -> None:
        """Simulate the team and correct its poses, unless the folder exists.

        The folder gets both team files and the errors of the poses. Raises the errors of ``simulate_team`` and
        ``refine_team``.
        """
        if folder.exists():
            return
        with writing(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
        with new_folder(folder) as new:
            simulate_team(new.path, self.simulation, lambda share: progress(0.5 * share))
            config = load_team_file(new.path / "team.yaml")
            refinement = refine_team(resolve(config), self.settings, progress=lambda share: progress(0.5 + 0.5 * share))
            poses = new.path / "refined-poses"
            poses.mkdir()
            write_trajectories(refinement, poses)
            refined = dump_team(refined_config(config, refinement, poses), new.path.resolve())
            write_whole(new.path / f"{POSES[REFINED]}.yaml", refined)
            errors = trajectory_errors(refinement.trajectories, read_truth(new.path, self.simulation.robot_ids))
            num_corrected = sum(trajectory.is_accepted for trajectory in refinement.trajectories)
            content = PoseErrors(errors.before, errors.after, num_corrected / self.simulation.num_robots)
            write_whole(new.path / _ERRORS, json_text(content._asdict()))
            new.put()

    def team_file(self, label: str, folder: Path) -> Path:
        """Return the team file with the recorded or with the corrected poses."""
        del label
        return folder / f"{POSES[self.poses]}.yaml"


class PoseErrors(NamedTuple):
    """Errors of a team's recorded and corrected poses [m] (``TrajectoryErrors``), and the share of corrected robots."""

    recorded: float
    refined: float
    corrected: float


def pose_errors(folder: Path) -> PoseErrors:
    """Return the errors of the poses in a folder that ``RefinedTeam.write`` has written."""
    return PoseErrors(**json.loads((folder / _ERRORS).read_text(encoding="utf-8")))
