"""Preparation of a data set: the folder with its team file, and with logs where the data set has none."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from octoreplay.config.run import RunConfig
from octoreplay.config.team_template import team_template
from octoreplay.io.datasets.catalogue.data_set import Team, Work
from octoreplay.io.datasets.catalogue.registry import data_set
from octoreplay.io.output_file import new_folder, write_whole, writing

TEAM_FILE = "team.yaml"


@dataclass(frozen=True)
class Prepared:
    """Summary of a preparation: the team file, and ``notes`` on the data set."""

    title: str
    team_file: Path
    team: Team
    notes: tuple[str, ...]


def prepare(
    name: str, folder: Path, output: Path, *, every: int = 1, progress: Callable[[float], None] | None = None
) -> Prepared:
    """Write the team file of a downloaded data set, and its logs where it consists of folders, into ``output``.

    ``output`` appears when it is complete. Raises ConfigError for an unknown name, InputError where ``folder`` does not
    hold the data set, OutputError where ``output`` cannot be written; then nothing is left.
    """
    found = data_set(name)
    with writing(output):
        output.parent.mkdir(parents=True, exist_ok=True)
    with new_folder(output) as new:
        team = found.team(Work(folder, new.path, output, every, progress))
        config = RunConfig(team.robots, classes=team.classes).with_parameters(dict(found.parameters))
        notes = (f"{found.title}: {', '.join(found.sources)}", *found.notes)
        place = Path(os.path.realpath(output))
        write_whole(new.path / TEAM_FILE, team_template(config, team.missing, place, notes={"": notes}))
        new.put()
    return Prepared(found.title, output / TEAM_FILE, team, found.notes)
