"""Trajectory errors of simulated teams with drifting odometry before and after ``octoreplay refine``."""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rounds import Report, Row, arguments

from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.evaluate.trajectories import TrajectoryErrors, read_truth, trajectory_errors
from octoreplay.io.robots.discover import resolve
from octoreplay.registration.rigid import moved
from octoreplay.replay.alignment import align_logs, aligned_config
from octoreplay.replay.refinement import Refinement, RefinementConfig, refine_team
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.transforms import numbers_of, transform_of

DRIFT = (1.0, 0.5)
TEAMS = ((4, 90, 45), (6, 60, 45), (5, 60, 45), (4, 60, 45), (6, 90, 60), (5, 90, 60), (6, 60, 60), (4, 120, 45))
"""Robots, length of the logs [s] and edge of the village [m] of each team; further teams begin again at the first."""
FRAME_SHIFT, FRAME_ANGLE = 0.12, math.radians(0.4)


@dataclass(frozen=True)
class Outcome:
    """Result of one team."""

    team: str
    errors: TrajectoryErrors
    refinement: Refinement
    seconds: float

    @property
    def ratio(self) -> float:
        """Trajectory error after / before."""
        return self.errors.after / self.errors.before


def main() -> None:
    """Simulate teams, give each robot a frame, refine, and compare with the true trajectories."""
    options = arguments(__doc__ or "", rounds=1, add=_add_options)
    report = Report("refinement", vars(options))
    outcomes = []
    for number in range(options.teams):
        outcome = _outcome(options.heldout_seed + number, TEAMS[number % len(TEAMS)], options.frames)
        outcomes.append(outcome)
        robots = len(outcome.refinement.trajectories)
        accepted = sum(trajectory.is_accepted for trajectory in outcome.refinement.trajectories)
        note = f"{outcome.errors.before:.3f} -> {outcome.errors.after:.3f} m, {accepted} of {robots} robots corrected"
        report.add(Row(f"{outcome.team}: error after / before", outcome.ratio, "", note=note))
    ratios = [outcome.ratio for outcome in outcomes]
    worse = sum(ratio > 1.0 for ratio in ratios)
    report.add(
        Row("median over the teams", statistics.median(ratios), "", min(ratios), max(ratios), must=0.5, goal=0.3)
    )
    report.add(Row("teams made worse", worse, "teams", must=0, goal=0))
    seconds = [outcome.seconds for outcome in outcomes]
    report.add(Row("time of refine", statistics.median(seconds), "s", min(seconds), max(seconds)))
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--teams", type=int, default=8, help="number of teams (default: %(default)s)")
    parser.add_argument("--heldout-seed", type=int, default=7000, help="seed of the first team (default: %(default)s)")
    parser.add_argument(
        "--frames", choices=("noisy", "align"), default="noisy",
        help="T_team_map: the true one with errors of 0.12 m and 0.4 degrees, or from an alignment (default: noisy)",
    )  # fmt: skip


def _outcome(seed: int, team: tuple[int, int, int], frames: str) -> Outcome:
    """Simulate and refine one team."""
    robots, duration, edge = team
    simulation = SimulationConfig(
        num_robots=robots, duration=duration, world_size=edge, seed=seed, own_frames=True, odometry_drift=DRIFT
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "logs"
        config = load_team_file(simulate_team(folder, simulation).team_file)
        config = _with_noisy_frames(config, folder, seed) if frames == "noisy" else _aligned(config)
        started = time.monotonic()
        refinement = refine_team(resolve(config), RefinementConfig())
        seconds = time.monotonic() - started
        truth = read_truth(folder, [robot.robot_id for robot in config.robots])
        errors = trajectory_errors(refinement.trajectories, truth)
    return Outcome(f"seed {seed}, {len(config.robots)} robots, {duration} s, {edge} m", errors, refinement, seconds)


def _with_noisy_frames(config: RunConfig, folder: Path, seed: int) -> RunConfig:
    """Give each robot its true frame with a random error, as large as an alignment's."""
    frames, rng = load_frames_file(folder / "frames.yaml"), np.random.default_rng([seed, 99])
    robots = []
    for robot in config.robots:
        shift, turn = rng.normal(size=(2, 3)) * [[FRAME_SHIFT], [FRAME_ANGLE]] / math.sqrt(3.0)
        error = moved(np.eye(4)[None], np.concatenate([turn, shift])[None])[0]
        T_team_map = transform_of(frames[robot.robot_id]) @ error
        robots.append(dataclasses.replace(robot, T_team_map=numbers_of(T_team_map)))
    return dataclasses.replace(config, robots=tuple(robots))


def _aligned(config: RunConfig) -> RunConfig:
    """Give each robot of the largest component its frame from an alignment; leave the others out."""
    return aligned_config(config, align_logs(config).teams[0])


if __name__ == "__main__":
    main()
