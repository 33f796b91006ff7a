"""An experiment: simulated teams, and sweeps over them whose tables answer a question (docs/experiments.md)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from octoreplay.config.class_tables.edits import Merges
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.errors import InputError
from octoreplay.io.text_files import write_whole
from octoreplay.replay.run import replay_team
from octoreplay.simulate.team import SimulationConfig
from octoreplay.study.folder import table_csv
from octoreplay.study.sweep import Sweep, SweepProgress, check_workers, run_sweep
from octoreplay.study.task import Row
from octoreplay.study.teams import simulated_team

TRUTH = "world.npz"
"""Where a simulated team's ground truth is, beside its team file."""


@dataclass(frozen=True)
class SimulatedTeam:
    """A team to simulate, and the classes that become one in its team file."""

    simulation: SimulationConfig
    merge_classes: Merges = ()


@dataclass(frozen=True)
class Plan:
    """One sweep of an experiment over the teams named by their labels.

    ``vary`` and ``settings`` are as ``run_sweep`` takes them. With ``has_truth`` the maps are evaluated against the
    simulated world. ``keep`` keeps the results. A plan with ``num_threads`` above 1 measures time: one run at once.
    ``more`` gives further columns of a row, from its team and the sweep that it is of.
    """

    name: str
    teams: tuple[str, ...]
    vary: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    has_truth: bool = True
    keep: bool = False
    num_threads: int = 1
    more: Callable[[SimulatedTeam, Row, Sweep], Row] = lambda *_: {}


@dataclass(frozen=True)
class Experiment:
    """The teams that are simulated by their labels, and the sweeps over them."""

    teams: Mapping[str, SimulatedTeam]
    plans: tuple[Plan, ...]


Stage = Callable[[str, float | None], None]
"""Told what is done at present, and the share of the whole experiment that is done, None where it is not known."""


def run_experiment(
    experiment: Experiment,
    folder: Path,
    *,
    num_jobs: int | None = None,
    scheduler: str | None = None,
    progress: Stage | None = None,
) -> dict[str, list[Row]]:
    """Simulate what is not there yet, run what has not been run yet, and give the rows by the plans' names.

    ``folder`` gets ``teams/<label>`` and a folder for each plan, and ``<plan>.csv`` with the rows. ``num_jobs`` and
    ``scheduler`` are as ``run_sweep`` takes them, for the plans that do not measure time. Raises InputError
    where a run failed, and what ``simulated_team`` and ``run_sweep`` raise.
    """
    check_workers(num_jobs, 1, scheduler)
    show = progress or _nobody_watches
    teams = {}
    for index, (label, team) in enumerate(experiment.teams.items()):
        stage = f"simulating team {index + 1} of {len(experiment.teams)}"
        teams[label] = _team_file(team, folder / "teams" / label, functools.partial(show, stage))
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
                f"{folder / plan.name}: {len(sweep.failed)} of {len(sweep.rows)} runs failed, the first:"
                f" {row['error']}; the same command does them again"
            )
        tables[plan.name] = _rows(experiment, plan, sweep)
        columns = list(dict.fromkeys(name for row in tables[plan.name] for name in row))
        write_whole(folder / f"{plan.name}.csv", table_csv(columns, tables[plan.name]))
    return tables


def _rows(experiment: Experiment, plan: Plan, sweep: Sweep) -> list[Row]:
    """A sweep's rows with the experiment's own labels of the teams and the plan's further columns."""
    # The team is what changes last.
    num_runs = len(sweep.rows) // len(plan.teams)
    labels = [label for label in plan.teams for _ in range(num_runs)]
    return [
        {**row, "team": label, **plan.more(experiment.teams[label], row, sweep)}
        for label, row in zip(labels, sweep.rows, strict=True)
    ]


def _team_file(team: SimulatedTeam, folder: Path, progress: Callable[[float], None]) -> Path:
    """The team's file, simulated if need be."""
    path = simulated_team(folder, team.simulation, progress)
    if not team.merge_classes:
        return path
    config = dataclasses.replace(load_team_file(path), merge_classes=team.merge_classes)
    merged = folder / "merged.yaml"
    write_whole(merged, dump_team(config, folder.resolve()))
    return merged


def _compile(team: Path) -> None:
    """Replay a second of a team's logs, so that what is measured after it finds its kernels compiled."""
    replay_team(load_team_file(team).with_parameters({"duration": 1.0}), None)


def _nobody_watches(*_: object) -> None:
    """Progress that nobody watches."""
