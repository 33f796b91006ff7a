"""Runs that the tests of 'check' and 'compare' read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.io.robots.discover import resolve
from octoreplay.replay.run import replay_team
from support.fixture_paths import PAIR_TEAM, TRIO_TEAM

# A run of two robots, its repetition, runs with a smaller step, without flows and with finer cells, and a run of three
# robots.
RUNS = {
    "pair": (PAIR_TEAM, {}), "again": (PAIR_TEAM, {}), "slower": (PAIR_TEAM, {"epsilon": 0.1, "settle": 0}),
    "near": (PAIR_TEAM, {"flow_bits": 0}), "finer": (PAIR_TEAM, {"resolution": 0.4}), "trio": (TRIO_TEAM, {}),
}  # fmt: skip


@pytest.fixture(scope="session")
def runs(shared_file: Callable[..., Path]) -> dict[str, Path]:
    """Results of RUNS, by name."""

    def make(folder: Path) -> None:
        folder.mkdir()
        for name, (team, parameters) in RUNS.items():
            replay_team(resolve(load_team_file(team).with_parameters(parameters)), folder / f"{name}.mcap")

    folder = shared_file("runs", make)
    return {name: folder / f"{name}.mcap" for name in RUNS}
