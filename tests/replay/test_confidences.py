"""Runs of a simulated team whose labels have confidences."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.records import CENTRAL
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.study.tiles.run import replay_tiles
from support.command_line import assert_fails, octoreplay
from support.interrupted import resumed
from support.long_suite import long

MODELS = ("none", "hit", "tempered", "mixture")


@pytest.fixture(scope="module")
def team_file(tmp_path_factory) -> Path:
    pytest.importorskip("open3d", exc_type=ImportError)
    folder = tmp_path_factory.mktemp("team") / "team"
    simulation = SimulationConfig(
        num_robots=2, duration=4.0, rate=2.0, seed=1, image=(48, 36), world_size=24.0, label_noise=0.3, confidences=1.0
    )
    return simulate_team(folder, simulation).team_file


def team(path: Path, model: str) -> RunConfig:
    return load_team_file(path).with_parameters({"confidence_model": model})


def evidence(path: Path) -> np.ndarray:
    """Log-odds of the leaves of the centralised map of a result."""
    with open_result(path) as result:
        return result.map(CENTRAL).octree.leaves().log_odds


def test_models_give_different_maps_and_none_is_a_run_without_confidences(team_file, tmp_path):
    maps = {}
    for model in MODELS:
        replay_team(team(team_file, model), tmp_path / f"{model}.mcap")
        maps[model] = evidence(tmp_path / f"{model}.mcap")
    assert len({values.tobytes() for values in maps.values()}) == len(MODELS)
    config = team(team_file, "hit")
    robots = tuple(dataclasses.replace(robot, confidence_topic="") for robot in config.robots)
    replay_team(dataclasses.replace(config, robots=robots), tmp_path / "plain.mcap")
    np.testing.assert_array_equal(evidence(tmp_path / "plain.mcap"), maps["none"])


@long
@pytest.mark.parametrize("model", ["tempered", "mixture"])
def test_tiles_and_interrupted_runs_give_the_same_result(team_file, tmp_path, model):
    config = team(team_file, model)
    replay_team(config, tmp_path / "whole.mcap")
    replay_tiles(config, tmp_path / "tiled.mcap", 9.6)
    np.testing.assert_array_equal(evidence(tmp_path / "tiled.mcap"), evidence(tmp_path / "whole.mcap"))
    resumed(config, tmp_path / "again.mcap", 1, 3)
    assert (tmp_path / "again.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()


def test_the_command_sets_the_model_and_the_result_holds_it(team_file, tmp_path):
    octoreplay("run", team_file, "-o", "a.mcap", "--confidence-model", "mixture", folder=tmp_path)
    with ResultReader(tmp_path / "a.mcap") as reader:
        assert reader.config.sensor.confidence_model == "mixture"
    replay_team(team(team_file, "mixture"), tmp_path / "b.mcap")
    np.testing.assert_array_equal(evidence(tmp_path / "a.mcap"), evidence(tmp_path / "b.mcap"))
    assert_fails(
        2, "'softmax' is not one of", "run", team_file, "-o", tmp_path / "c.mcap", "--confidence-model", "softmax"
    )
