"""What a sweep leaves in its folder: one file for every finished run, and the table of all of them."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from octoreplay._version import __version__
from octoreplay.errors import OutputError
from octoreplay.io.text_files import json_text, write_whole
from octoreplay.study.task import Row, from_json, to_json

_LOCK = ".lock"
_LONGEST_NAME = 150


def file_name(name: str) -> str:
    """A run's name as a file's: what a file system or a shell might not like is replaced, and then a hash added."""
    safe = re.sub(r"[^A-Za-z0-9._=,+-]", "_", name)[:_LONGEST_NAME]
    return safe if safe == name else f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


class SweepFolder:
    """The folder of a sweep; ``locked`` makes one. Raises OutputError where something cannot be written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table = path / "table.csv"
        self.figures = path / "figures"
        self._rows = path / "rows"
        self._runs = path / "runs"
        # Runs of an earlier sweep that was killed may still write: they see that theirs is gone.
        self._unfinished = path / "unfinished" / uuid.uuid4().hex[:12]

    @classmethod
    @contextmanager
    def locked(cls, path: Path) -> Iterator[SweepFolder]:
        """The folder, made if need be, while no other sweep has it.

        Raises OutputError where another one does, and where the folder holds something else.
        """
        import fcntl

        folder = cls(path)
        with _writing(path):
            path.mkdir(parents=True, exist_ok=True)
            if {entry.name for entry in path.iterdir()} - {_LOCK} and not folder._is_sweep():
                raise OutputError(f"{path}: is not empty and holds no sweep; give a folder of its own")
            lock = (path / _LOCK).open("a+", encoding="utf-8")
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lock.seek(0)
                owner = lock.read().strip() or "unknown"
                raise OutputError(
                    f"{path}: another sweep is at work here (process {owner}); wait for it, or give another folder"
                ) from None
            with _writing(path):
                lock.truncate(0)
                lock.write(str(os.getpid()))
                lock.flush()
                folder._begin()
            try:
                yield folder
            finally:
                folder._end()

    def result(self, name: str) -> Path:
        """Where a run's result is kept."""
        return self._runs / f"{file_name(name)}.mcap"

    def unfinished(self, name: str) -> Path:
        """Where a run's result is written until it is complete, in a folder that goes when the sweep ends."""
        return self._unfinished / f"{file_name(name)}.mcap"

    def describe(self, content: Mapping[str, Any]) -> None:
        """Say in ``sweep.json`` what is swept."""
        write_whole(self.path / "sweep.json", json_text(content))

    def row(self, name: str, key: str) -> Row | None:
        """What a finished run came to; None where there is none, or where it depended on something else."""
        try:
            stored = json.loads(self._row_path(name).read_text(encoding="utf-8"))
            return from_json(stored["row"]) if stored["key"] == key else None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def add_row(self, name: str, key: str, row: Row) -> None:
        """Store what a run came to."""
        write_whole(self._row_path(name), json_text({"name": name, "key": key, "row": to_json(row)}))

    def write_table(self, columns: Sequence[str], rows: Sequence[Row]) -> None:
        """Write ``table.csv``: numbers are exact, ``nan`` where one is not defined, empty where a run failed."""
        write_whole(self.table, table_csv(columns, rows))

    def _row_path(self, name: str) -> Path:
        return self._rows / f"{file_name(name)}.json"

    def _is_sweep(self) -> bool:
        """Whether a sweep has been at work here."""
        try:
            return "octoreplay" in json.loads((self.path / "sweep.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, TypeError):
            return False

    def _begin(self) -> None:
        """Make the folders, and take away what sweeps that were killed left behind."""
        # This comes first: it says whose folder this is.
        if not self._is_sweep():
            self.describe({"octoreplay": __version__})
        for folder in (self._rows, self._runs):
            folder.mkdir(exist_ok=True)
        shutil.rmtree(self._unfinished.parent, ignore_errors=True)
        self._unfinished.mkdir(parents=True)
        for partial in self._rows.glob("*.partial"):
            partial.unlink()

    def _end(self) -> None:
        """Take away what is empty or of no use any more."""
        shutil.rmtree(self._unfinished.parent, ignore_errors=True)
        with contextlib.suppress(OSError):
            self._runs.rmdir()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """What fails to be written is one sentence."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def table_csv(columns: Sequence[str], rows: Sequence[Row]) -> str:
    """Rows as CSV text, one line each in their order, with only these columns."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
