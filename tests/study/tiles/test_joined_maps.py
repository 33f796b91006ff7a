"""Maps of a whole run from those of its tiles."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.io.results import octomap_trees
from octoreplay.study.tiles import run
from support.fixture_paths import PAIR_TEAM
from support.here_workers import requests

__all__ = ["requests"]


def test_warnings_of_the_workers_are_given_in_the_order_of_the_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, requests
) -> None:
    monkeypatch.setattr(octomap_trees, "DEPTH", 3)
    config = load_team_file(PAIR_TEAM).with_parameters(
        {"resolution": 1.2, "duration": 1.0, "settle": 0, "octomap_every": 1.0}
    )
    with caplog.at_level(logging.WARNING):
        run.replay_tiles(config, tmp_path / "out.mcap", 40.0)
    assert [name for kind, name in requests if kind == "encode_map"] == [
        "map of husky_1", "map of husky_2", "map of central",
    ]  # fmt: skip
    robots = [
        record.getMessage().split("'")[1] for record in caplog.records if "no OctoMap tree" in record.getMessage()
    ]
    assert robots == sorted(robots)
    assert set(robots) == {"husky_1", "husky_2"}
