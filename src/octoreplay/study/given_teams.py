"""Teams of team files, whose frames are the given ones, unrelated or found by an alignment."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octoreplay._version import __version__
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, OctoreplayError
from octoreplay.io.containers.fingerprint import fingerprint, log_files
from octoreplay.io.output_file import new_folder, writing
from octoreplay.io.robots.discover import resolve
from octoreplay.io.text_files import json_text
from octoreplay.study.team_frames import own_frame, team_file, without_frames, write_team_files
from octoreplay.transforms import numbers_of, transform_of


@dataclass(frozen=True)
class GivenTeam:
    """Team of a team file, whose frames are right.

    Attributes
    ----------
    path : Path
        Team file.
    frames : str
        One of ``FRAMES``.
    seed : int
        Seed of the robots' own frames. Teams of one seed differ in ``frames`` only.
    """

    path: Path
    frames: str
    seed: int

    @property
    def folder_name(self) -> str:
        """Name of the folder of the team files, which changes with the team file and with its logs."""
        config = load_team_file(self.path)
        files = [file for robot in config.robots for log in robot.logs for file in log_files(log)]
        logs = [fingerprint(file).value for file in files]
        content = [__version__, self.seed, str(self.path.resolve()), self.path.read_text(encoding="utf-8"), logs]
        return f"given_{self.seed}_{hashlib.sha256(json_text(content).encode()).hexdigest()[:10]}"

    def write(self, folder: Path, progress: Callable[[float], None]) -> None:
        """Write a team file for each kind of frames, unless the folder exists. Raises the errors of ``align_logs``."""
        if folder.exists():
            return
        with writing(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
        with new_folder(folder) as new:
            right = _team_with_frames(self.path)
            rng = np.random.default_rng(self.seed)
            unaligned = (
                dataclasses.replace(
                    robot, T_team_map=numbers_of(own_frame(rng) @ transform_of(given.T_team_map_or_identity))
                )
                for robot, given in zip(without_frames(right).robots, right.robots, strict=True)
            )
            unrelated = dataclasses.replace(right, robots=tuple(unaligned))
            write_team_files(new.path, right, unrelated, 4, right.map.resolution, progress)
            new.put()

    def team_file(self, label: str, folder: Path) -> Path | None:
        """Return the team file with the team's frames; None where ``align`` connected no two robots."""
        del label
        return team_file(folder, self.frames)

    def right_config(self, run: RunConfig) -> RunConfig:
        """Return the configuration of the team file."""
        del run
        return _team_with_frames(self.path)

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return len(load_team_file(self.path).robots)


def check_given(path: Path) -> None:
    """Check that a team file can be run and has the frames of its robots.

    Raises ConfigError for fewer than two robots and for frames that nothing relates, and the errors of ``resolve``.
    """
    config = _team_with_frames(path)
    if len(config.robots) < 2:
        raise ConfigError(f"{path}: has one robot; frames are compared in teams of two and more")
    try:
        resolve(config.with_parameters({"strict_frames": True}))
    except OctoreplayError as error:
        raise type(error)(f"{path}: {error}") from error


def _team_with_frames(path: Path) -> RunConfig:
    """Team of a team file, with absolute paths, that does not find its frames during the run."""
    return load_team_file(path.resolve()).with_parameters({"align": "off"})
