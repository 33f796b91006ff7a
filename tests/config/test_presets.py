"""Presets and options on top of a configuration."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.config import presets
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError


def base() -> RunConfig:
    return RunConfig(robots=tuple(RobotConfig(name, (Path(f"{name}.mcap"),)) for name in ("a", "b", "c")))


def test_options_override_the_preset_and_the_preset_overrides_the_file() -> None:
    file = base().with_parameters({"evidence": "cell-average", "gamma": 0.125, "hit": 2.0})
    config = presets.with_options(file, "paper", None, {"gamma": 0.75})
    assert config.consensus.evidence == "time-average"
    assert config.consensus.gamma == 0.75
    assert config.sensor.hit == 2.0
    assert presets.with_options(file, None, None, {}) == file


def test_edges_set_the_topology_and_the_weights() -> None:
    config = presets.with_options(base(), None, "a:b, b:c", {})
    assert (config.network.topology, config.network.weights) == ("edges", "metropolis")
    assert config.network.edges == (("a", "b", None), ("b", "c", None))
    weighted = presets.with_options(base(), None, "a:b:0.25,b:c:0.5", {"epsilon": 0.1})
    assert (weighted.network.weights, weighted.network.edges[1]) == ("given", ("b", "c", 0.5))
    back = presets.with_options(weighted, None, None, {"topology": "ring"})
    assert (back.network.topology, back.network.weights, back.network.edges) == ("ring", "metropolis", ())
    kept = presets.with_options(weighted, None, None, {"hit": 2.0})
    assert kept.network == weighted.network


@pytest.mark.parametrize(
    ("edges", "sentence"),
    [("a", "'a' is not A:B or A:B:WEIGHT"), ("a:b:c:d", "is not A:B"), ("a:b:x", "the weight in 'a:b:x' is not a"),
     ("a:z", "robot 'z' is not in the team"), ("a:a", "cannot have a link to itself"), ("a::1", "is not A:B")],
)  # fmt: skip
def test_refused_edges(edges: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        presets.with_options(base(), None, edges, {})
