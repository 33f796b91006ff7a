"""Simulated teams and their results in folders, which are used again when complete and unchanged."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from octoreplay._version import __version__
from octoreplay.config.run import RunConfig
from octoreplay.errors import OutputError
from octoreplay.io.output_file import new_folder, write_whole, writing
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.io.robots.discover import resolve
from octoreplay.io.text_files import json_text
from octoreplay.replay.checkpoint import can_resume
from octoreplay.replay.run import Progress, replay_team
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team

SETTINGS_FILE = "simulation.json"
"""File beside a team's logs with the version, the settings and the size of every file."""


def simulated_team(
    folder: Path,
    config: SimulationConfig,
    progress: Callable[[float], None] | None = None,
    *,
    replaces_others: bool = False,
) -> Path:
    """Simulate a team into a folder, unless it holds the team already; return the team file.

    A team is used again when it is complete and was made with the same settings by the same version. ``progress`` is
    called with the finished share, 0 to 1, but not for an existing team. The folder appears when it is complete. With
    ``replaces_others`` it takes the place of a simulated team of other settings or another version. Raises OutputError
    where the folder holds something else or cannot be written, InputError where Open3D cannot be loaded.
    """
    if not is_simulated(folder, config, replaces_others=replaces_others):
        with writing(folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
        with new_folder(folder) as new:
            simulate_team(new.path, config, progress)
            write_whole(new.path / SETTINGS_FILE, json_text(_content(new.path, config)))
            new.put()
    return folder / "team.yaml"


def holds_team(folder: Path) -> bool:
    """True where a folder holds a team of ``simulated_team``, of any settings."""
    return (folder / SETTINGS_FILE).is_file()


def is_simulated(folder: Path, config: SimulationConfig, *, replaces_others: bool = False) -> bool:
    """True where a folder holds the team of these settings; False where it is missing or empty.

    With ``replaces_others`` also False where it holds a simulated team of other settings. Raises OutputError where the
    folder holds anything else.
    """
    try:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return False
        stored = json.loads((folder / SETTINGS_FILE).read_text(encoding="utf-8"))
        present = _content(folder, config)
    except (OSError, ValueError):
        stored = None
    if not isinstance(stored, dict) or set(stored) != set(present):
        raise OutputError(f"{folder}: exists and holds no simulated team; give another folder, or remove this one")
    for reason in _differences(stored, present):
        if replaces_others:
            return False
        raise OutputError(f"{folder}: {reason}; give another folder, or remove this one")
    return True


def replayed_team(config: RunConfig, output: Path, progress: Callable[[Progress], None] | None = None) -> Path:
    """Replay a team into a result, unless it exists already; return the result.

    A result is used again when it is complete, of the same configuration and version, and its logs are unchanged. An
    interrupted replay is continued. Raises OutputError where another result exists, and as ``replay_team`` does.
    """
    config = resolve(config)
    if not is_replayed(config, output):
        resume = can_resume(output)
        replay_team(config, output, progress=progress, resume=resume, restart=not resume)
    return output


def is_replayed(config: RunConfig, output: Path) -> bool:
    """True where a file is the result of this configuration; False where it does not exist.

    Raises OutputError where it is another result, InputError where it is not a result.
    """
    if not output.exists():
        return False
    with ResultReader(output) as reader:
        is_same = reader.is_complete and reader.description["version"] == __version__ and not reader.changed_inputs()
        is_same = is_same and _absolute(reader.config) == _absolute(resolve(config).to_config())
    if not is_same:
        raise OutputError(
            f"{output}: exists and was made from other logs, with other settings or by another version; give another"
            " folder, or remove it"
        )
    return True


def _content(folder: Path, config: SimulationConfig) -> dict[str, Any]:
    """Content of a team's settings file."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and path != folder / SETTINGS_FILE)
    files = {str(path.relative_to(folder)): path.stat().st_size for path in paths}
    settings = json.loads(json_text(config))
    return {"version": __version__, "settings": settings, "files": files}


def _differences(stored: dict[str, Any], wanted: dict[str, Any]) -> Iterator[str]:
    """Differences between a stored team and the wanted one, as clauses."""
    if stored["version"] != wanted["version"]:
        yield f"was simulated by octoreplay {stored['version']}, this is {wanted['version']}"
    for name, value in wanted["settings"].items():
        if stored["settings"].get(name) != value:
            yield f"holds a team with {name} {stored['settings'].get(name)}, not {value}"
    for name, num_bytes in stored["files"].items():
        if wanted["files"].get(name) != num_bytes:
            yield f"'{name}' is missing or has changed since it was simulated"


def _absolute(config: RunConfig) -> RunConfig:
    """The configuration with absolute paths."""
    return dataclasses.replace(config, robots=tuple(robot.with_absolute_paths() for robot in config.robots))
