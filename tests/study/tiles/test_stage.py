"""Progress of tiles, and the values with which they settle."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.config.team_file import load_team_file
from octoreplay.io.robots.discover import resolve
from octoreplay.study.tiles import run, tile_run
from octoreplay.study.tiles.scans import scan_bytes
from octoreplay.study.tiles.stage import Agreement, Stage, load_stage
from support.fixture_paths import TRIO_TEAM
from support.here_workers import requests
from support.long_suite import long

__all__ = ["requests"]

EDGE = 9.6
"""Least edge of tiles of the fixture, 32 cells [m]."""


@pytest.fixture(scope="module")
def config():
    return resolve(load_team_file(TRIO_TEAM))


def stage(largest, num_finer, num_settling) -> Stage:
    return Stage(40, num_settling, (1, 2), largest, num_finer, "converged", True, [{0: 3}])


def test_a_stage_is_stored_and_read(tmp_path) -> None:
    stage(1.5, None, 3).save(tmp_path / "tile.json")
    assert load_stage(tmp_path / "tile.json") == stage(1.5, None, 3)
    assert load_stage(tmp_path / "other.json") is None
    (tmp_path / "tile.json").write_text("{")
    assert load_stage(tmp_path / "tile.json") is None


def test_an_agreement_is_stored_and_read(tmp_path) -> None:
    assert Agreement.load(tmp_path) is None
    Agreement(2.5, 7).save(tmp_path)
    assert Agreement.load(tmp_path) == Agreement(2.5, 7)


def test_only_tiles_that_settled_with_the_same_flows_count(config) -> None:
    small, large = Agreement(0.01, 0).num_finer(config), Agreement(4.0, 0).num_finer(config)
    assert small < large
    stages = [stage(0.01, small, 30), stage(4.0, large, 9), stage(3.0, large, 12), stage(1.0, None, 0)]
    agreement = Agreement.of(config, stages)
    assert agreement == (4.0, 12)
    assert [each.is_complete(config, agreement) for each in stages] == [False, False, True, False]


def test_a_tile_with_larger_log_odds_begins_a_new_agreement(config) -> None:
    agreement = Agreement(2.1, 12)
    assert agreement.with_tile(config, 1.0) == agreement
    assert agreement.with_tile(config, 2.2) == (2.2, 12)
    assert agreement.with_tile(config, 100.0) == (100.0, 0)


def test_runs_that_do_not_settle_have_no_finer_flows() -> None:
    config = resolve(load_team_file(TRIO_TEAM).with_parameters({"settle": 0}))
    assert Agreement(100.0, 0).num_finer(config) == 0


def test_all_tiles_but_the_first_settle_with_their_logs(tmp_path: Path, requests) -> None:
    run.replay_tiles(load_team_file(TRIO_TEAM), tmp_path / "tiled.mcap", EDGE)
    settled = {name for kind, name in requests if kind == "settle"}
    replayed = [name for kind, name in requests if kind == "replay"]
    assert replayed[0] in settled
    assert len(settled) < len(replayed)


@long
@pytest.mark.parametrize("largest", [1e-6, 1e6])
def test_tiles_that_settled_with_other_values_are_replayed_again(tmp_path, monkeypatch, requests, largest) -> None:
    config = load_team_file(TRIO_TEAM)
    run.replay_tiles(config, tmp_path / "right.mcap", EDGE)
    num_right = len(requests)
    monkeypatch.setattr(tile_run.Agreement, "load", lambda _: Agreement(largest, 0))
    run.replay_tiles(config, tmp_path / "wrong.mcap", EDGE)
    assert len(requests) > num_right
    assert (tmp_path / "wrong.mcap").read_bytes() == (tmp_path / "right.mcap").read_bytes()


@long
def test_the_order_of_the_tiles_does_not_matter(tmp_path, monkeypatch, requests) -> None:
    config = load_team_file(TRIO_TEAM)
    run.replay_tiles(config, tmp_path / "right.mcap", EDGE)
    monkeypatch.setattr(run, "scan_bytes", lambda *arguments: [-num_bytes for num_bytes in scan_bytes(*arguments)])
    run.replay_tiles(config, tmp_path / "wrong.mcap", EDGE)
    assert (tmp_path / "wrong.mcap").read_bytes() == (tmp_path / "right.mcap").read_bytes()
