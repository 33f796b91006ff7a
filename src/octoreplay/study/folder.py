"""Folder of a sweep: a row file for each finished run, kept results, and the table."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from octoreplay._version import __version__
from octoreplay.errors import OutputError
from octoreplay.io.output_file import FOLDER_LOCK, locked, write_whole, writing
from octoreplay.io.text_files import json_text
from octoreplay.study.task import Row, from_json, to_json

_UNFINISHED = "unfinished-"
_LONGEST_NAME = 150


def file_name(name: str) -> str:
    """File name of a run: special characters are replaced and long names cut; changed names get a hash."""
    safe = re.sub(r"[^A-Za-z0-9._=,+-]", "_", name)[:_LONGEST_NAME]
    return safe if safe == name else f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


class SweepFolder:
    """Folder of a sweep, opened with ``locked``. Methods raise OutputError if a file cannot be written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table = path / "table.csv"
        self.figures = path / "figures"
        self._rows = path / "rows"
        self._runs = path / "runs"
        # Workers of a killed sweep may still write. They end when they find their own folder removed.
        # Beside the folder of kept results, so that the paths in a result hold when it is moved there.
        self._unfinished = path / f"{_UNFINISHED}{uuid.uuid4().hex[:12]}"

    @classmethod
    @contextmanager
    def locked(cls, path: Path) -> Iterator[SweepFolder]:
        """Create or open the folder and lock it against other sweeps.

        Raises OutputError if another sweep has locked it, or if the folder holds other files than a sweep's.
        """
        folder = cls(path)
        with locked(path, is_folder=True):
            with writing(path):
                if {entry.name for entry in path.iterdir()} - {FOLDER_LOCK} and not folder._is_sweep():
                    raise OutputError(f"{path}: is not empty and holds no sweep; use another folder")
                folder._begin()
            try:
                yield folder
            finally:
                folder._end()

    def result(self, name: str) -> Path:
        """Path of a run's kept result."""
        return self._runs / f"{file_name(name)}.mcap"

    def unfinished(self, name: str) -> Path:
        """Path of a run's result while it is written, in a folder that is removed when the sweep ends."""
        return self._unfinished / f"{file_name(name)}.mcap"

    def describe(self, content: Mapping[str, Any]) -> None:
        """Write ``sweep.json``, the description of the sweep."""
        write_whole(self.path / "sweep.json", json_text(content))

    def row(self, name: str, key: str) -> Row | None:
        """Stored row of a finished run; None if there is none or if its key is another."""
        try:
            stored = json.loads(self._row_path(name).read_text(encoding="utf-8"))
            return from_json(stored["row"]) if stored["key"] == key else None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None

    def add_row(self, name: str, key: str, row: Row) -> None:
        """Store the row of a finished run."""
        write_whole(self._row_path(name), json_text({"name": name, "key": key, "row": to_json(row)}))

    def write_table(self, columns: Sequence[str], rows: Sequence[Row]) -> None:
        """Write ``table.csv`` with exact numbers, ``nan`` for undefined ones and empty cells for failed runs."""
        write_whole(self.table, table_csv(columns, rows))

    def _row_path(self, name: str) -> Path:
        return self._rows / f"{file_name(name)}.json"

    def _is_sweep(self) -> bool:
        """True if the folder holds a sweep."""
        try:
            return "octoreplay" in json.loads((self.path / "sweep.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, TypeError):
            return False

    def _begin(self) -> None:
        """Create the subfolders and remove what killed sweeps left."""
        # First, because this file marks the folder as a sweep's.
        if not self._is_sweep():
            self.describe({"octoreplay": __version__})
        for folder in (self._rows, self._runs):
            folder.mkdir(exist_ok=True)
        self._remove_unfinished()
        self._unfinished.mkdir()

    def _end(self) -> None:
        """Remove unfinished results and empty subfolders."""
        self._remove_unfinished()
        with contextlib.suppress(OSError):
            self._runs.rmdir()

    def _remove_unfinished(self) -> None:
        """Remove unfinished results, of this sweep and of killed ones."""
        for folder in self.path.glob(f"{_UNFINISHED}*"):
            shutil.rmtree(folder, ignore_errors=True)


def table_csv(columns: Sequence[str], rows: Sequence[Row]) -> str:
    """CSV text of rows in their order, with only these columns."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
