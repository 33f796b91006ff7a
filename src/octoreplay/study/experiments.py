"""Experiments: teams, sweeps over them, and what of the runs is compared (docs/experiments.md)."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from octoreplay.config.class_tables.edits import Merges
from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.errors import InputError
from octoreplay.io.output_file import write_whole
from octoreplay.io.text_files import json_text
from octoreplay.replay.run import replay_team
from octoreplay.report.comparisons import TEAM, Comparison, Tables, TextTable, tables_of
from octoreplay.report.experiment_plots import Drawing
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.study.folder import table_csv
from octoreplay.study.sweep import Sweep, SweepProgress, check_workers, run_sweep
from octoreplay.study.task import Row
from octoreplay.study.teams import simulated_team

TRUTH = "world.npz"
"""File of a simulated team's ground truth, in the folder of its team file."""


class ExperimentTeam(Protocol):
    """Team of an experiment: its logs in a folder, and its team file there."""

    @property
    def seed(self) -> int:
        """Number of the team; runs of teams with equal numbers are paired."""

    @property
    def folder_name(self) -> str:
        """Name of the folder of the logs. Teams with equal logs share it."""

    def write(self, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the logs into a folder, unless it holds them; ``progress`` is called with the finished share."""

    def team_file(self, label: str, folder: Path) -> Path | None:
        """Return the team file of written logs, which may be named ``label``; None where the team has none."""


@dataclass(frozen=True)
class SimulatedTeam:
    """Settings of a simulated team, and what its team file changes.

    Attributes
    ----------
    simulation : SimulationConfig
        Settings of the simulation.
    merge_classes : Merges
        Merged classes.
    schedule : tuple of ScheduleEntry
        Schedule of the network.
    publish_period : float or None
        Period between the published maps of every robot [s], a multiple of the length of a tick; None for one tick.
    """

    simulation: SimulationConfig
    merge_classes: Merges = ()
    schedule: tuple[ScheduleEntry, ...] = ()
    publish_period: float | None = None

    @property
    def seed(self) -> int:
        """Seed of the simulation."""
        return self.simulation.seed

    @property
    def folder_name(self) -> str:
        """Name of a simulation's folder: its seed, and a digest of all settings."""
        digest = hashlib.sha256(json_text(self.simulation).encode()).hexdigest()[:10]
        return f"seed_{self.seed}_{digest}"

    def write(self, folder: Path, progress: Callable[[float], None]) -> None:
        """Simulate the team as ``simulated_team`` does."""
        simulated_team(folder, self.simulation, progress)

    def team_file(self, label: str, folder: Path) -> Path:
        """Return the team file; it is written beside the simulated one where it differs."""
        path = folder / "team.yaml"
        if self == SimulatedTeam(self.simulation):
            return path
        base = load_team_file(path)
        config = dataclasses.replace(
            base,
            robots=tuple(dataclasses.replace(robot, publish_period=self.publish_period) for robot in base.robots),
            merge_classes=self.merge_classes,
            network=dataclasses.replace(base.network, schedule=self.schedule),
        )
        changed = folder / f"{label}.yaml"
        write_whole(changed, dump_team(config, folder.resolve()))
        return changed


@dataclass(frozen=True)
class Plan:
    """One sweep of an experiment.

    Attributes
    ----------
    name : str
        Name of the sweep's folder and CSV file.
    teams : tuple of str
        Labels of the teams. Those without a team file are left out.
    vary, settings
        Variations and settings of ``run_sweep``.
    has_truth : bool
        True to evaluate the maps against the simulated world.
    keep : bool
        True to keep the results.
    num_threads : int
        Threads of each run. A plan with more than one measures time and does one run at once.
    extra_columns : callable
        Additional columns of a row, from its team, the row and the sweep.
    """

    name: str
    teams: tuple[str, ...]
    vary: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    has_truth: bool = True
    keep: bool = False
    num_threads: int = 1
    extra_columns: Callable[[Any, Row, Sweep], Row] = lambda *_: {}


@dataclass(frozen=True)
class Experiment:
    """Teams by label, and the sweeps over them."""

    teams: Mapping[str, ExperimentTeam]
    plans: tuple[Plan, ...]


@dataclass(frozen=True)
class Question:
    """Experiment, and the tables and figures that answer its question.

    Attributes
    ----------
    experiment : function
        Experiment. Its parameters are the length of the logs [s] and the number of villages for simulated teams, and
        the folders of the recordings for recorded ones.
    comparisons : tuple of Comparison
        Tables.
    drawings : dict
        Figures by file name.
    """

    experiment: Callable[..., Experiment]
    comparisons: tuple[Comparison, ...]
    drawings: Mapping[str, Drawing]

    def tables(self, found: Tables) -> list[TextTable]:
        """Return the tables of an experiment's runs."""
        return [table for comparison in self.comparisons for table in tables_of(comparison, found)]


Stage = Callable[[str, float], None]
"""Progress callback: description of the current stage, and the finished share of it, 0 to 1."""


def run_experiment(
    experiment: Experiment,
    folder: Path,
    *,
    teams_folder: Path | None = None,
    num_jobs: int | None = None,
    scheduler: str | None = None,
    progress: Stage | None = None,
) -> dict[str, list[Row]]:
    """Write the logs of the teams, do the sweeps, and return the rows of each plan by its name.

    ``folder`` gets a folder and ``<plan>.csv`` for each plan. ``teams_folder`` (default: ``folder / "teams"``) gets a
    folder for the logs of each team; several experiments can share it. Teams and runs that they already hold are used
    again. ``num_jobs`` and ``scheduler`` are those of ``run_sweep`` for plans that do not measure time.

    Raises InputError if a run failed, and the errors of ``ExperimentTeam.write`` and ``run_sweep``.
    """
    check_workers(num_jobs, 1, scheduler)
    show = progress or _ignore_progress
    # Team files that are written beside the logs name them relative to an absolute folder.
    teams = _team_files(experiment, (teams_folder or folder / "teams").resolve(), show)
    tables: dict[str, list[Row]] = {}
    for plan in experiment.plans:

        def show_runs(runs: SweepProgress, name: str = plan.name) -> None:
            show(f"{name}: run {runs.num_finished} of {runs.num_runs}", runs.num_finished / runs.num_runs)

        labels = [label for label in plan.teams if label in teams]
        measures_time = plan.num_threads > 1
        if measures_time:
            _compile(teams[labels[0]])
        sweep = run_sweep(
            [teams[label] for label in labels], plan.vary, folder / plan.name, settings=plan.settings,
            truth=TRUTH if plan.has_truth else None, keep=plan.keep, num_threads=plan.num_threads,
            num_jobs=1 if measures_time else num_jobs, scheduler=None if measures_time else scheduler,
            progress=show_runs,
        )  # fmt: skip
        for row in sweep.failed:
            raise InputError(
                f"{folder / plan.name}: {len(sweep.failed)} of {len(sweep.rows)} runs failed, the first with:"
                f" {row['error']}; the same command repeats them"
            )
        tables[plan.name] = _rows(plan, {label: experiment.teams[label] for label in labels}, sweep)
        columns = list(dict.fromkeys(name for row in tables[plan.name] for name in row))
        write_whole(folder / f"{plan.name}.csv", table_csv(columns, tables[plan.name]))
    return tables


def _rows(plan: Plan, teams: Mapping[str, ExperimentTeam], sweep: Sweep) -> list[Row]:
    """Rows of a sweep over teams by label, with their labels, their seeds and the plan's extra columns."""
    # The team is the outermost variation of a sweep.
    num_runs = len(sweep.rows) // len(teams)
    repeated = [entry for entry in teams.items() for _ in range(num_runs)]
    rows = (
        {**row, "team": label, TEAM: team.seed, **plan.extra_columns(team, row, sweep)}
        for (label, team), row in zip(repeated, sweep.rows, strict=True)
    )
    return [{name: _rounded(value) for name, value in row.items()} for row in rows]


def _rounded(value: Any) -> Any:
    """Number with seven significant digits, which keeps the tables of many runs small."""
    return float(f"{value:.7g}") if isinstance(value, float) else value


def _team_files(experiment: Experiment, folder: Path, show: Stage) -> dict[str, Path]:
    """Team files by label, of the teams that have one; equal logs are written once."""
    distinct = {team.folder_name: team for team in experiment.teams.values()}
    for index, (name, team) in enumerate(distinct.items()):
        stage = f"writing the logs of team {index + 1} of {len(distinct)}"
        team.write(folder / name, functools.partial(show, stage))
    files = {label: team.team_file(label, folder / team.folder_name) for label, team in experiment.teams.items()}
    return {label: path for label, path in files.items() if path is not None}


def _compile(team: Path) -> None:
    """Replay one second of a team's logs, so that measured times do not include the compilation of kernels."""
    replay_team(load_team_file(team).with_parameters({"duration": 1.0}), None)


def _ignore_progress(*_: object) -> None:
    """Default progress callback."""
