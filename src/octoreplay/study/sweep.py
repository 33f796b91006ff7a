"""A sweep: every combination of varied settings as a run of its own, their numbers in one table."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octoreplay._version import __version__
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.fingerprint import fingerprint, log_files
from octoreplay.report.sweep_plots import write_sweep_figures
from octoreplay.study.folder import SweepFolder
from octoreplay.study.grid import Combination, Variation, check_variations, combinations, parse_variation
from octoreplay.study.local import run_local
from octoreplay.study.numbers import RUN_COLUMNS, TIMING_COLUMNS, TRUTH_COLUMNS
from octoreplay.study.task import DATA_LOST, FAILED, Row, Task

_TABLE_SECONDS = 2.0
"""The table is written at most this often while runs finish; a table of very many runs takes its time."""


@dataclass(frozen=True)
class SweepProgress:
    """Runs finished so far, those of earlier sweeps included, how many of them failed, and an estimate [s] or NaN."""

    num_finished: int
    num_failed: int
    num_runs: int
    seconds_left: float


@dataclass(frozen=True)
class Sweep:
    """A finished sweep. ``rows`` are the runs in the order of the combinations, by column; ``names`` what is varied.

    ``num_earlier`` of them were finished before and not run again; ``warnings`` are sentences.
    """

    folder: Path
    table: Path
    names: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    num_earlier: int
    warnings: tuple[str, ...]

    @property
    def failed(self) -> tuple[Row, ...]:
        """The runs that failed; their ``error`` says why."""
        return tuple(row for row in self.rows if row["status"] == FAILED)

    def result(self, row: Row) -> Path:
        """Where the result of a run is kept, of a sweep that keeps them."""
        return SweepFolder(self.folder).result(_name({name: row[name] for name in ("team", *self.names, "seed")}))

    @property
    def lost_data(self) -> bool:
        """True when any log was cut or any frame could not be used."""
        return any(row["status"] == DATA_LOST for row in self.rows)


def run_sweep(
    teams: str | Path | Sequence[str | Path],
    variations: Sequence[str],
    output: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    num_seeds: int | None = None,
    truth: str | Path | None = None,
    keep: bool = False,
    num_jobs: int | None = None,
    num_threads: int = 1,
    scheduler: str | None = None,
    progress: Callable[[SweepProgress], None] | None = None,
) -> Sweep:
    """Run every combination of team files and variations, and write the table into the folder ``output``.

    ``variations`` are texts such as ``topology=complete,ring`` (docs/sweeps.md), ``settings`` parameters of all runs by
    name, and ``preset``; ``num_seeds`` runs every combination with so many values of network_seed. ``truth`` is the
    file to evaluate against, beside each team file or as given; ``keep`` keeps the results. The runs are processes on
    this machine, ``num_jobs`` at once (unless given, as many as there are processors for ``num_threads`` each), or on
    the dask cluster of ``scheduler``. What ``output`` holds of the same runs is not run again. A run that fails has a
    row that says why.

    Raises ConfigError for anything that is wrong with any combination before the first run, InputError and
    OutputError where the team files, the truth, the folder or the scheduler cannot be used.
    """
    fixed = {name: value for name, value in (settings or {}).items() if value is not None}
    parsed = [parse_variation(text) for text in variations]
    check_variations(parsed, fixed, num_seeds)
    check_workers(num_jobs, num_threads, scheduler)
    paths = _labels([Path(team) for team in ([teams] if isinstance(teams, str | Path) else teams)])
    bases = {label: load_team_file(path) for label, path in paths.items()}
    truths = {label: None if truth is None else _truth(Path(truth), path) for label, path in paths.items()}
    runs = list(combinations(bases, parsed, fixed, num_seeds))
    names = tuple(name for variation in parsed for name in variation.names)
    columns = _columns(names, has_truth=truth is not None)
    with SweepFolder.locked(Path(output)) as folder:
        keys = _Keys()
        tasks = [_task(run, truths[run.team], folder, keys, keep=keep, num_threads=num_threads) for run in runs]
        folder.describe(_description(paths, parsed, fixed, num_seeds, truths, tasks))
        board = _Board(folder, tasks, columns, progress)
        left = board.begin()
        if left:
            finished = run_local(left, num_jobs) if scheduler is None else _on_cluster(left, scheduler)
            try:
                with closing(finished):
                    for task, row in finished:
                        board.add(task, row)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    f"interrupted; {len(board.rows)} of {len(tasks)} runs are finished, and the same command goes on"
                    " with the others"
                ) from None
            finally:
                board.write()
        varied = [variation.names for variation in parsed]
        write_sweep_figures(board.ordered(), varied, folder.figures)
        rows, num_earlier = board.ordered(), len(tasks) - len(left)
        return Sweep(folder.path, folder.table, names, columns, rows, num_earlier, tuple(_warnings(runs, num_seeds)))


def _on_cluster(tasks: Sequence[Task], scheduler: str) -> Generator[tuple[Task, Row]]:
    from octoreplay.study.cluster import run_on_cluster

    return run_on_cluster(tasks, scheduler)


def check_workers(num_jobs: int | None, num_threads: int, scheduler: str | None) -> None:
    """Refuse what says wrongly where runs are done. Raises ConfigError."""
    for name, number in (("jobs", num_jobs), ("threads", num_threads)):
        if number is not None and number < 1:
            raise ConfigError(f"{name}: {number} is below the least value 1")
    if scheduler is not None:
        if num_jobs is not None:
            raise ConfigError("--jobs is for this machine and --scheduler for another; leave one out")
        if not re.fullmatch(r"(tcp|tls|ucx|ws|wss)://[^/\s]+:\d{1,5}/?", scheduler):
            raise ConfigError(f"scheduler: '{scheduler}' is not an address such as tcp://host:8786")


class _Board:
    """What is finished: the rows, the table, and the progress."""

    def __init__(
        self,
        folder: SweepFolder,
        tasks: Sequence[Task],
        columns: Sequence[str],
        progress: Callable[[SweepProgress], None] | None,
    ) -> None:
        self.rows: dict[str, Row] = {}
        self._folder = folder
        self._tasks = tasks
        self._columns = columns
        self._progress = progress
        self._started = self._written = time.monotonic()
        self._num_earlier = 0

    def begin(self) -> list[Task]:
        """Take in what is finished; the tasks that are left."""
        for task in self._tasks:
            row = self._folder.row(task.name, task.key)
            has_result = not task.keep or Path(task.result).exists()
            # A row of another version of the table, or of a run that failed, is made again.
            if row is not None and set(self._columns) <= {*row, *task.labels} and has_result:
                self.rows[task.name] = {**row, **task.labels}
        self._num_earlier = len(self.rows)
        self.write()
        self._show()
        return [task for task in self._tasks if task.name not in self.rows]

    def add(self, task: Task, row: Row) -> None:
        """Take in one run."""
        self.rows[task.name] = {**task.labels, **row}
        if not task.keep or row["status"] == FAILED:
            # An earlier sweep's, of other settings.
            Path(task.result).unlink(missing_ok=True)
        self._folder.add_row(task.name, task.key, self.rows[task.name])
        if time.monotonic() > self._written + _TABLE_SECONDS:
            self.write()
        self._show()

    def write(self) -> None:
        """Write the table of what is finished."""
        self._folder.write_table(self._columns, self.ordered())
        self._written = time.monotonic()

    def ordered(self) -> tuple[Row, ...]:
        """The rows in the tasks' order."""
        return tuple(self.rows[task.name] for task in self._tasks if task.name in self.rows)

    def _show(self) -> None:
        """Report the progress."""
        if self._progress is None:
            return
        rows = self.rows.values()
        num_new = len(rows) - self._num_earlier
        pace = (time.monotonic() - self._started) / num_new if num_new else math.nan
        num_failed = sum(row["status"] == FAILED for row in rows)
        left = len(self._tasks) - len(rows)
        self._progress(SweepProgress(len(rows), num_failed, len(self._tasks), pace * left if left else 0.0))


class _Keys:
    """What runs depend on, as hashes; every file is looked at once."""

    def __init__(self) -> None:
        self._files: dict[tuple[Path, bool], list[Any]] = {}

    def key(self, config: RunConfig, team: str, truth: Path | None) -> str:
        """The hash of a configuration, its logs, the truth and the program's version."""
        whole = config.output.hash
        logs = [self._identity(path, whole=whole) for robot in config.robots for path in robot.files]
        truths = [] if truth is None else [self._identity(truth.resolve(), whole=whole)]
        return hashlib.sha256(json.dumps([__version__, team, logs, truths]).encode()).hexdigest()

    def _identity(self, path: Path, *, whole: bool) -> list[Any]:
        """What identifies the file or the folder; the reason where it cannot be read: the run will say it too."""
        if (path, whole) not in self._files:
            try:
                found = [fingerprint(file, whole=whole) for file in log_files(path)]
                self._files[path, whole] = [[str(f.path), f.size, f.method, f.value] for f in found]
            except (InputError, OSError) as error:
                self._files[path, whole] = [str(error)]
        return self._files[path, whole]


def _task(
    run: Combination, truth: Path | None, folder: SweepFolder, keys: _Keys, *, keep: bool, num_threads: int
) -> Task:
    """The task of one combination."""
    labels = {"team": run.team, **run.values, "seed": run.seed}
    robots = tuple(robot.with_absolute_paths() for robot in run.config.robots)
    config = dataclasses.replace(run.config, robots=robots)
    team = dump_team(config)
    name = _name(labels)
    return Task(
        name=name,
        key=keys.key(config, team, truth),
        labels=labels,
        team=team,
        unfinished=str(folder.unfinished(name).resolve()),
        result=str(folder.result(name).resolve()),
        keep=keep,
        truth=None if truth is None else str(truth.resolve()),
        version=__version__,
        num_threads=num_threads,
    )


def _warnings(runs: Sequence[Combination], num_seeds: int | None) -> Iterator[str]:
    """What is worth knowing of a sweep that can be done."""
    if (num_seeds or 1) > 1 and not any(_draws(run.config) for run in runs):
        yield "no setting of these runs leaves anything to chance, so --seeds repeats the same runs; leave it out"


def _draws(config: RunConfig) -> bool:
    """Whether a run depends on its seed."""
    overrides = (value for *_, values in config.link_overrides for _, value in values)
    return config.network.topology == "random" or config.link.is_random or any(overrides)


def _name(labels: Mapping[str, Any]) -> str:
    """A run's name, from what tells it from the others."""
    return ",".join(f"{key}={value}" for key, value in labels.items())


def _labels(teams: Sequence[Path]) -> dict[str, Path]:
    """Team files by a short label: their names, with as many folders as it takes to tell them apart."""
    if not teams:
        raise ConfigError("a sweep needs a team file")
    paths = [path.resolve().with_suffix("") for path in teams]
    if len(set(paths)) < len(paths):
        raise ConfigError("a team file is given twice")
    count = next(n for n in range(1, 1000) if len({path.parts[-n:] for path in paths}) == len(paths))
    return {"/".join(path.parts[-count:]): team for path, team in zip(paths, teams, strict=True)}


def _truth(truth: Path, team: Path) -> Path:
    """The truth, a file or a folder that holds one: beside the team file, else as given."""
    for path in dict.fromkeys((team.parent / truth, truth)):
        if path.exists():
            return path
    raise InputError(f"{truth}: not found, neither beside {team} nor here")


def _columns(names: Sequence[str], *, has_truth: bool) -> tuple[str, ...]:
    """The table's columns."""
    truth = TRUTH_COLUMNS if has_truth else ()
    return ("team", *names, "seed", "status", "error", *RUN_COLUMNS, *truth, *TIMING_COLUMNS)


def _description(
    paths: Mapping[str, Path],
    variations: Sequence[Variation],
    settings: Mapping[str, Any],
    num_seeds: int | None,
    truths: Mapping[str, Path | None],
    tasks: Sequence[Task],
) -> dict[str, Any]:
    """What is swept, for the reader."""
    return {
        "octoreplay": __version__,
        "teams": {label: str(path.resolve()) for label, path in paths.items()},
        "vary": {"+".join(v.names): ["+".join(entry) for entry in v.values] for v in variations},
        "seeds": num_seeds,
        "settings": dict(settings),
        "truths": {label: None if path is None else str(path.resolve()) for label, path in truths.items()},
        "runs": [task.name for task in tasks],
    }
