"""Files with the maps of a result in tiles: their names, and the list of them in the result."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from octoreplay.errors import InputError
from octoreplay.io.containers.fingerprint import fingerprint
from octoreplay.io.output_file import sync_folder, writing
from octoreplay.io.results.json_records import value_of

RECORD = "tiles"
"""Name of the metadata record that lists the files."""

_NAME = re.compile(r"tile_-?\d+_-?\d+-[0-9a-f]{16}\.mcap")
_REMEDY = "put the file back from a copy, or run the logs again with --result-per-tile"


@dataclass(frozen=True)
class TileFile:
    """File with the maps of one tile.

    Attributes
    ----------
    x, y : int
        Place of the tile in the grid of tiles, in edges of a tile.
    file : str
        Path from the folder of the result that lists it, with '/' between its parts.
    size : int
        Size [byte].
    fingerprint : str
        Fingerprint of the file's summary (``fingerprint``).
    """

    x: int
    y: int
    file: str
    size: int
    fingerprint: str

    def checked_path(self, result: Path) -> Path:
        """Return the path of the file of a result. Raises InputError where the file is missing or another one."""
        path = result.parent / self.file
        if not path.is_file():
            raise InputError(f"{path}: is missing, which holds maps of {result.name}; {_REMEDY}")
        found = fingerprint(path)
        if (found.size, found.value) != (self.size, self.fingerprint):
            raise InputError(f"{path}: is damaged, or not the file that {result.name} was written with; {_REMEDY}")
        return path


@dataclass(frozen=True)
class TileList:
    """Files of a result in tiles; ``num_cells`` is the edge of a tile [cells], a power of two."""

    num_cells: int
    files: tuple[TileFile, ...]

    @property
    def folder(self) -> str:
        """Name of the folder of the files, beside the result."""
        return self.files[0].file.partition("/")[0]

    def values(self) -> dict[str, str]:
        """Return the list as a metadata record."""
        return {"cells": str(self.num_cells), "files": json.dumps([asdict(file) for file in self.files])}

    @classmethod
    def of(cls, values: Mapping[str, str]) -> TileList:
        """Return the list of a metadata record. Raises ValueError and LookupError for another record."""
        num_cells, files = int(values["cells"]), value_of(tuple[TileFile, ...], json.loads(values["files"]))
        if num_cells < 1 or num_cells & (num_cells - 1) or not files:
            raise ValueError("the edge of a tile is no power of two, or there is no tile")
        # A result names no file outside its folder.
        if any(len(parts := Path(file.file).parts) != 2 or ".." in parts for file in files):
            raise ValueError("the path of a tile leaves the folder of the result")
        return cls(num_cells, files)


def maps_folder(result: Path) -> Path:
    """Return the folder of the files of a result in tiles: ``x.maps`` beside ``x.mcap``."""
    return result.with_name(f"{result.stem}.maps")


def put_file(written: Path, result: Path, x: int, y: int) -> TileFile:
    """Move a complete file into the folder of a result, under a name with its hash, and return its entry.

    The files of another result under this name stay. Raises OutputError.
    """
    folder, content = maps_folder(result), fingerprint(written)
    with writing(folder):
        with written.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        folder.mkdir(exist_ok=True)
        path = folder / f"tile_{x}_{y}-{digest[:16]}.mcap"
        written.replace(path)
        sync_folder(folder)
    return TileFile(x, y, f"{folder.name}/{path.name}", content.size, content.value)


def remove_others(result: Path, kept: Collection[TileFile]) -> None:
    """Remove the files of tiles in the folder of a result but those ``kept``, and the folder if it is then empty."""
    folder, names = maps_folder(result), {file.file for file in kept}
    with contextlib.suppress(OSError):
        for path in _tile_paths(folder):
            if f"{folder.name}/{path.name}" not in names:
                path.unlink()
        folder.rmdir()


def _tile_paths(folder: Path) -> Iterator[Path]:
    """Files of tiles in a folder."""
    yield from [path for path in folder.iterdir() if _NAME.fullmatch(path.name)]
