"""Sweeps: one run for every combination of varied settings, with the numbers of all runs in one table."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octoreplay._version import __version__
from octoreplay.config.file_url import InputFile
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, load_team_file
from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.containers.fingerprint import fingerprint, log_files
from octoreplay.io.output_file import mark_written
from octoreplay.records import FilePath
from octoreplay.report.sweep_plots import write_sweep_figures
from octoreplay.study.dask_client import check_address
from octoreplay.study.folder import SweepFolder
from octoreplay.study.grid import Combination, Variation, check_variations, combinations, parse_variation
from octoreplay.study.local import execute_locally
from octoreplay.study.numbers import RUN_COLUMNS, TIMING_COLUMNS, TRUTH_COLUMNS
from octoreplay.study.task import DATA_LOST, FAILED, Row, Task

_TABLE_SECONDS = 2.0
"""Shortest time between two writes of the table while runs finish; writing a large table takes long."""


@dataclass(frozen=True)
class SweepProgress:
    """Progress of a sweep. Finished runs include those of earlier calls; ``seconds_left`` is NaN if unknown."""

    num_finished: int
    num_failed: int
    num_runs: int
    seconds_left: float


@dataclass(frozen=True)
class Sweep:
    """Finished sweep.

    Attributes
    ----------
    folder, table : Path
        Folder of the sweep, and its table as CSV.
    names : tuple of str
        Varied parameters.
    columns : tuple of str
        Columns of the table.
    rows : tuple of dict
        One row for each run, in the order of the combinations.
    num_earlier : int
        Number of runs that had been finished before and were not repeated.
    warnings : tuple of str
        Warnings, one sentence each.
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
        """Rows of the failed runs, with the reason in the column ``error``."""
        return tuple(row for row in self.rows if row["status"] == FAILED)

    def as_table(self) -> Table:
        """Return the rows as a table with ``columns``; values that a failed run does not have are NaN or empty.

        A varied parameter is a column of numbers where all its values are numbers, else of text.
        """
        rows = [{**row, **{name: _value(row[name]) for name in self.names}} for row in self.rows]
        return Table.from_rows(self.columns, rows)

    def result(self, row: Row) -> Path:
        """Path of a run's kept result, in a sweep with ``keep``."""
        return SweepFolder(self.folder).result(_name({name: row[name] for name in ("team", *self.names, "seed")}))

    @property
    def lost_data(self) -> bool:
        """True if a run had a truncated log or a frame that could not be used."""
        return any(row["status"] == DATA_LOST for row in self.rows)


def run_sweep(
    teams: FilePath | Sequence[FilePath],
    variations: Sequence[str],
    output: FilePath,
    *,
    settings: Mapping[str, Any] | None = None,
    num_seeds: int | None = None,
    truth: FilePath | None = None,
    keep: bool = False,
    num_jobs: int | None = None,
    num_threads: int = 1,
    scheduler: str | None = None,
    progress: Callable[[SweepProgress], None] | None = None,
) -> Sweep:
    """Run every combination of team files and variations, and write the table into a folder.

    Each run is a process of its own. A failed run has a row with the reason and does not stop the others.

    ``teams`` are team files, ``variations`` texts such as ``topology=complete,ring`` (docs/sweeps.md), and ``settings``
    the parameters of all runs by name, and ``preset``. ``num_seeds`` runs every combination with ``network_seed`` 0 to
    num_seeds - 1. ``truth`` is the ground truth to evaluate against, relative to each team file or to the working
    folder. Finished runs in the folder ``output`` are not repeated; ``keep`` keeps the results there.

    The runs are executed on this machine, ``num_jobs`` at once (default: processors / ``num_threads``) with
    ``num_threads`` threads each, or on the workers of the dask scheduler at the address ``scheduler``. ``progress`` is
    called whenever a run has finished.

    Raises ConfigError before the first run if any combination is invalid, InputError and OutputError if the team files,
    the truth, the scheduler or the folder cannot be used.
    """
    fixed = {name: value for name, value in (settings or {}).items() if value is not None}
    parsed = [parse_variation(text) for text in variations]
    check_variations(parsed, fixed, num_seeds)
    check_workers(num_jobs, num_threads, scheduler)
    paths = _labels([Path(team) for team in ([teams] if isinstance(teams, str | os.PathLike) else teams)])
    bases = {label: load_team_file(path) for label, path in paths.items()}
    truths = {label: None if truth is None else _truth(Path(truth), path) for label, path in paths.items()}
    runs = list(combinations(bases, parsed, fixed, num_seeds))
    names = tuple(name for variation in parsed for name in variation.names)
    columns = _columns(names, has_truth=truth is not None)
    with SweepFolder.locked(Path(output)) as folder:
        keys = _CacheKeys()
        tasks = [_task(run, truths[run.team], folder, keys, keep=keep, num_threads=num_threads) for run in runs]
        folder.describe(_description(paths, parsed, fixed, num_seeds, truths, tasks))
        table = _Table(folder, tasks, columns, progress)
        left = table.begin()
        if left:
            _fill(table, execute_locally(left, num_jobs) if scheduler is None else _on_cluster(left, scheduler))
        rows = table.ordered()
        write_sweep_figures(rows, [variation.names for variation in parsed], folder.figures)
        mark_written(folder.path)
        return Sweep(
            folder.path, folder.table, names, columns, rows, len(tasks) - len(left), tuple(_warnings(runs, num_seeds))
        )  # fmt: skip


def _value(text: str) -> int | float | str:
    """Number of a text, or the text."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def _fill(table: _Table, finished: Generator[tuple[Task, Row]]) -> None:
    """Add the rows of tasks to the table as they finish; an interrupt's message gives their number."""
    try:
        with closing(finished):
            for task, row in finished:
                table.add(task, row)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; {len(table.rows)} of {table.num_tasks} runs are finished, and the same command continues"
            " with the others"
        ) from None
    finally:
        table.write()


def _on_cluster(tasks: Sequence[Task], scheduler: str) -> Generator[tuple[Task, Row]]:
    """Execute tasks on a cluster; dask is imported only here."""
    from octoreplay.study.cluster import execute_on_cluster

    return execute_on_cluster(tasks, scheduler)


def check_workers(num_jobs: int | None, num_threads: int, scheduler: str | None) -> None:
    """Check the options that say where and how runs are executed. Raises ConfigError."""
    for name, number in (("jobs", num_jobs), ("threads", num_threads)):
        if number is not None and number < 1:
            raise ConfigError(f"{name}: {number} is below the least value 1")
    if scheduler is not None:
        if num_jobs is not None:
            raise ConfigError("--jobs applies to this machine and --scheduler to a cluster; leave one out")
        check_address(scheduler)


class _Table:
    """Rows of the finished runs, written to the table and reported as progress."""

    def __init__(
        self,
        folder: SweepFolder,
        tasks: Sequence[Task],
        columns: Sequence[str],
        progress: Callable[[SweepProgress], None] | None,
    ) -> None:
        self.rows: dict[str, Row] = {}
        self.num_tasks = len(tasks)
        self._folder = folder
        self._tasks = tasks
        self._columns = columns
        self._progress = progress
        self._started = self._written = time.monotonic()
        self._num_earlier = 0

    def begin(self) -> list[Task]:
        """Load the rows of finished runs and return the remaining tasks."""
        for task in self._tasks:
            row = self._folder.row(task.name, task.key)
            has_result = not task.keep or Path(task.result).exists()
            # Rows of failed runs and rows that lack columns are made again.
            if row is not None and set(self._columns) <= {*row, *task.labels} and has_result:
                self.rows[task.name] = {**row, **task.labels}
        self._num_earlier = len(self.rows)
        self.write()
        self._show()
        return [task for task in self._tasks if task.name not in self.rows]

    def add(self, task: Task, row: Row) -> None:
        """Store the row of a finished run."""
        self.rows[task.name] = {**task.labels, **row}
        if not task.keep or row["status"] == FAILED:
            # A result at this path is from an earlier sweep with other settings.
            Path(task.result).unlink(missing_ok=True)
        self._folder.add_row(task.name, task.key, self.rows[task.name])
        if time.monotonic() > self._written + _TABLE_SECONDS:
            self.write()
        self._show()

    def write(self) -> None:
        """Write the table of the finished runs."""
        self._folder.write_table(self._columns, self.ordered())
        self._written = time.monotonic()

    def ordered(self) -> tuple[Row, ...]:
        """Rows in the order of the tasks."""
        return tuple(self.rows[task.name] for task in self._tasks if task.name in self.rows)

    def _show(self) -> None:
        """Report the progress with an estimate from the mean time of the runs of this call."""
        if self._progress is None:
            return
        rows = self.rows.values()
        num_new = len(rows) - self._num_earlier
        pace = (time.monotonic() - self._started) / num_new if num_new else math.nan
        num_failed = sum(row["status"] == FAILED for row in rows)
        left = self.num_tasks - len(rows)
        self._progress(SweepProgress(len(rows), num_failed, self.num_tasks, pace * left if left else 0.0))


class _CacheKeys:
    """Hashes of everything that a run's numbers depend on; each file is read once."""

    def __init__(self) -> None:
        self._files: dict[tuple[InputFile, bool], list[Any]] = {}

    def key(self, config: RunConfig, team: str, truth: Path | None) -> str:
        """Hash of a configuration, its logs, the truth and the program's version."""
        whole = config.output.hash
        logs = [self._identity(path, whole=whole) for robot in config.robots for path in robot.files]
        truths = [] if truth is None else [self._identity(truth.resolve(), whole=whole)]
        return hashlib.sha256(json.dumps([__version__, team, logs, truths]).encode()).hexdigest()

    def _identity(self, path: InputFile, *, whole: bool) -> list[Any]:
        """Fingerprints of a file or of a folder's files, or the reason if unreadable, which the run reports too."""
        if (path, whole) not in self._files:
            try:
                found = [fingerprint(file, whole=whole) for file in log_files(path)]
                self._files[path, whole] = [[str(f.path), f.size, f.method, f.value] for f in found]
            except (InputError, OSError) as error:
                self._files[path, whole] = [str(error)]
        return self._files[path, whole]


def _task(
    run: Combination, truth: Path | None, folder: SweepFolder, keys: _CacheKeys, *, keep: bool, num_threads: int
) -> Task:
    """Task of one combination."""
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
    """Warnings about a valid sweep."""
    if (num_seeds or 1) > 1 and not any(_is_random(run.config) for run in runs):
        yield "no run of this sweep uses random numbers, so --seeds repeats identical runs; leave it out"


def _is_random(config: RunConfig) -> bool:
    """True if a run depends on its seed."""
    overrides = (value for *_, values in config.link_overrides for _, value in values)
    return config.network.topology == "random" or config.link.is_random or any(overrides)


def _name(labels: Mapping[str, Any]) -> str:
    """Name of a run, made of its labels."""
    return ",".join(f"{key}={value}" for key, value in labels.items())


def _labels(teams: Sequence[Path]) -> dict[str, Path]:
    """Team files by label: the file name, preceded by as many folders as make all labels distinct."""
    if not teams:
        raise ConfigError("a sweep needs a team file")
    paths = [path.resolve().with_suffix("") for path in teams]
    if len(set(paths)) < len(paths):
        raise ConfigError("a team file is given twice")
    count = next(n for n in range(1, 1000) if len({path.parts[-n:] for path in paths}) == len(paths))
    return {"/".join(path.parts[-count:]): team for path, team in zip(paths, teams, strict=True)}


def _truth(truth: Path, team: Path) -> Path:
    """Path of the truth, relative to the team file's folder if it exists there. Raises InputError if not found."""
    for path in dict.fromkeys((team.parent / truth, truth)):
        if path.exists():
            return path
    raise InputError(f"{truth}: not found, neither beside {team} nor in the working folder")


def _columns(names: Sequence[str], *, has_truth: bool) -> tuple[str, ...]:
    """Columns of the table."""
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
    """Content of sweep.json."""
    return {
        "octoreplay": __version__,
        "teams": {label: str(path.resolve()) for label, path in paths.items()},
        "vary": {"+".join(v.names): ["+".join(entry) for entry in v.values] for v in variations},
        "seeds": num_seeds,
        "settings": dict(settings),
        "truths": {label: None if path is None else str(path.resolve()) for label, path in truths.items()},
        "runs": [task.name for task in tasks],
    }
