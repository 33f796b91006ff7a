"""Teams of real logs: those that recordings of depth images give, and those of team files."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from octoreplay.study.given_teams import GivenTeam, check_given
from octoreplay.study.recorded_teams import RecordedTeam, recorded_parts

RealTeam = RecordedTeam | GivenTeam


def teams_of(data: Sequence[Path], frames: Sequence[str]) -> dict[str, RealTeam]:
    """Return the teams of the data by label, each with each of these kinds of frames.

    A file or a path to ``*.yaml`` is a team file, and a folder has the recordings of ``recorded_parts``. Raises the
    errors of ``check_given`` and ``recorded_parts``.
    """
    found = [team for path in data for team in _teams(path)]
    return {f"{kind}_{seed}": team(kind, seed) for seed, team in enumerate(found) for kind in frames}


def _teams(path: Path) -> Iterator[Callable[[str, int], RealTeam]]:
    """Teams of a file or a folder, each as a function of its frames and its seed."""
    if path.is_file() or path.suffix == ".yaml":
        check_given(path)
        yield functools.partial(GivenTeam, path)
    else:
        yield from (functools.partial(RecordedTeam, parts) for parts in recorded_parts([path]))
