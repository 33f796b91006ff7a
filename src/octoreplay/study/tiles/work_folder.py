"""Folder of the work files of a run in tiles, which an interrupted run leaves for ``--resume``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from octoreplay.errors import ConfigError, InputError, OutputError
from octoreplay.io.output_file import write_whole, writing
from octoreplay.io.results.result_writer import ResultWriter

_DESCRIPTION = "run.json"
_EDGE = "edge"
"""File with the edge of the tiles in a work folder [cell]."""
AGREEMENT = "agreement.json"
"""File with the values with which the tiles in a work folder settle."""


def can_resume_tiles(output: Path) -> bool:
    """Return True where an interrupted run in tiles left its work folder."""
    return (_folder_of(output) / _DESCRIPTION).exists()


def _folder_of(output: Path) -> Path:
    """Work folder of a result."""
    return output.with_name(f"{output.stem}.tiles")


@contextmanager
def work_folder(
    writer: ResultWriter, num_cells: int | None, num_axes: int, *, restart: bool, resume: bool
) -> Iterator[Path]:
    """Make the folder of the work files; after an error it is kept if a part is finished, and a note names it.

    ``num_cells`` is the edge of the tiles, None where it is chosen, and ``num_axes`` the number of axes that are cut.

    Raises OutputError, InputError and ConfigError where an earlier run left a folder that cannot be used.
    """
    folder = _folder_of(writer.path)
    description = {**writer.description, "tiles": {"cells": str(num_cells or "auto"), "axes": str(num_axes)}}
    with writing(folder):
        if folder.exists() and not (restart or resume):
            raise OutputError(
                f"{folder}: an earlier run left these tiles; continue it with --resume, or remove them and start again"
                " with --restart"
            )
        continues = resume and (folder / _DESCRIPTION).exists()
        if not continues:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
    if continues:
        _check_same(writer, folder / _DESCRIPTION, description)
    else:
        write_whole(folder / _DESCRIPTION, json.dumps(description))
    try:
        yield folder
    except BaseException as error:
        if any(folder.glob("robot_*.index")):
            error.add_note(f"the finished parts are in {folder}; --resume continues the run")
        elif not continues:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)


def _check_same(writer: ResultWriter, path: Path, description: Mapping[str, Mapping[str, str]]) -> None:
    """Raise ConfigError where the tiles of an earlier run are those of other settings."""
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        tiles = earlier["tiles"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: cannot be read; run with --restart to start from the beginning") from error
    if tiles != description["tiles"]:
        raise ConfigError(
            f"{writer.path}: cannot be continued: the tiles had another form; use the same --tiles and --tiles-z, or"
            " run with --restart to start from the beginning"
        )
    writer.check_same(earlier)


def keep_tiles_of(folder: Path, num_cells: int) -> None:
    """Remove the work files of tiles with another edge."""
    path, text = folder / _EDGE, str(num_cells)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        with writing(folder):
            for tile in folder.glob("tile_*"):
                tile.unlink()
            (folder / AGREEMENT).unlink(missing_ok=True)
        write_whole(path, text)
