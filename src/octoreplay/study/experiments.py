"""Experiments: simulated teams, sweeps over them, and what of the runs is compared (docs/experiments.md)."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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


@dataclass(frozen=True)
class Plan:
    """One sweep of an experiment.

    Attributes
    ----------
    name : str
        Name of the sweep's folder and CSV file.
    teams : tuple of str
        Labels of the teams.
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
    extra_columns: Callable[[SimulatedTeam, Row, Sweep], Row] = lambda *_: {}


@dataclass(frozen=True)
class Experiment:
    """Simulated teams by label, and the sweeps over them."""

    teams: Mapping[str, SimulatedTeam]
    plans: tuple[Plan, ...]


@dataclass(frozen=True)
class Question:
    """Experiment, and the tables and figures that answer its question.

    Attributes
    ----------
    experiment : function
        Experiment with logs of a length [s] and with a number of villages.
    comparisons : tuple of Comparison
        Tables.
    drawings : dict
        Figures by file name.
    """

    experiment: Callable[[float, int], Experiment]
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
    """Simulate the teams, do the sweeps, and return the rows of each plan by its name.

    ``folder`` gets a folder and ``<plan>.csv`` for each plan. ``teams_folder`` (default: ``folder / "teams"``) gets a
    folder for each simulation; several experiments can share it. Teams and runs that they already hold are used again.
    ``num_jobs`` and ``scheduler`` are those of ``run_sweep`` for plans that do not measure time.

    Raises InputError if a run failed, and the errors of ``simulated_team`` and ``run_sweep``.
    """
    check_workers(num_jobs, 1, scheduler)
    show = progress or _ignore_progress
    teams = _team_files(experiment, teams_folder or folder / "teams", show)
    tables: dict[str, list[Row]] = {}
    for plan in experiment.plans:

        def show_runs(runs: SweepProgress, name: str = plan.name) -> None:
            show(f"{name}: run {runs.num_finished} of {runs.num_runs}", runs.num_finished / runs.num_runs)

        measures_time = plan.num_threads > 1
        if measures_time:
            _compile(teams[plan.teams[0]])
        sweep = run_sweep(
            [teams[label] for label in plan.teams], plan.vary, folder / plan.name, settings=plan.settings,
            truth=TRUTH if plan.has_truth else None, keep=plan.keep, num_threads=plan.num_threads,
            num_jobs=1 if measures_time else num_jobs, scheduler=None if measures_time else scheduler,
            progress=show_runs,
        )  # fmt: skip
        for row in sweep.failed:
            raise InputError(
                f"{folder / plan.name}: {len(sweep.failed)} of {len(sweep.rows)} runs failed, the first with:"
                f" {row['error']}; the same command repeats them"
            )
        tables[plan.name] = _rows(experiment, plan, sweep)
        columns = list(dict.fromkeys(name for row in tables[plan.name] for name in row))
        write_whole(folder / f"{plan.name}.csv", table_csv(columns, tables[plan.name]))
    return tables


def _rows(experiment: Experiment, plan: Plan, sweep: Sweep) -> list[Row]:
    """Rows of a sweep with the experiment's team labels, the teams' seeds and the plan's extra columns."""
    # The team is the outermost variation of a sweep.
    num_runs = len(sweep.rows) // len(plan.teams)
    teams = [(label, experiment.teams[label]) for label in plan.teams for _ in range(num_runs)]
    rows = (
        {**row, "team": label, TEAM: team.simulation.seed, **plan.extra_columns(team, row, sweep)}
        for (label, team), row in zip(teams, sweep.rows, strict=True)
    )
    return [{name: _rounded(value) for name, value in row.items()} for row in rows]


def _rounded(value: Any) -> Any:
    """Number with seven significant digits, which keeps the tables of many runs small."""
    return float(f"{value:.7g}") if isinstance(value, float) else value


def _team_files(experiment: Experiment, folder: Path, show: Stage) -> dict[str, Path]:
    """Team files by label; each distinct simulation is done once."""
    folders = {team.simulation: folder / _folder_name(team.simulation) for team in experiment.teams.values()}
    for index, (simulation, team_folder) in enumerate(folders.items()):
        stage = f"simulating team {index + 1} of {len(folders)}"
        simulated_team(team_folder, simulation, functools.partial(show, stage))
    return {label: _team_file(label, team, folders[team.simulation]) for label, team in experiment.teams.items()}


def _folder_name(simulation: SimulationConfig) -> str:
    """Name of a simulation's folder: its seed, and a digest of all settings."""
    digest = hashlib.sha256(json_text(simulation).encode()).hexdigest()[:10]
    return f"seed_{simulation.seed}_{digest}"


def _team_file(label: str, team: SimulatedTeam, folder: Path) -> Path:
    """Team file of one team whose logs are in ``folder``; written beside them if it differs from the simulated one."""
    path = folder / "team.yaml"
    if team == SimulatedTeam(team.simulation):
        return path
    base = load_team_file(path)
    config = dataclasses.replace(
        base,
        robots=tuple(dataclasses.replace(robot, publish_period=team.publish_period) for robot in base.robots),
        merge_classes=team.merge_classes,
        network=dataclasses.replace(base.network, schedule=team.schedule),
    )
    changed = folder / f"{label}.yaml"
    write_whole(changed, dump_team(config, folder.resolve()))
    return changed


def _compile(team: Path) -> None:
    """Replay one second of a team's logs, so that measured times do not include the compilation of kernels."""
    replay_team(load_team_file(team).with_parameters({"duration": 1.0}), None)


def _ignore_progress(*_: object) -> None:
    """Default progress callback."""
