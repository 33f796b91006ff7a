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


def test_preset_paper_is_the_letter_of_the_paper() -> None:
    """Settings that the map states depend on, whatever the defaults and the team file are."""
    config = presets.with_options(base().with_parameters({"rule": "flood", "topology": "ring"}), "paper", None, {})
    consensus, network = config.consensus, config.network
    assert (consensus.rule, consensus.evidence, consensus.mode) == ("gradient", "time-average", "on-arrival")
    assert (consensus.gamma, consensus.gamma_power, consensus.gamma_per_arrival, consensus.epsilon) == (
        1.0, 0.0, "full", None,
    )  # fmt: skip
    assert (network.topology, network.weights, network.publish_period) == ("complete", "degree", 1.0)
    assert (config.effective_flow_bits, consensus.effective_quantum) == (0, 0.0)
    assert (consensus.settle, consensus.anchor_after) == (0, 0)
    assert config.effective_packet.packets == "full"
    assert config.effective_sensor == config.sensor


def test_preset_roam_adds_one_map_every_five_seconds_with_a_constant_weight() -> None:
    config = presets.with_options(base(), "roam", None, {})
    assert (config.consensus.rule, config.consensus.merge_weight, config.consensus.merge_maps) == ("merge", 0.2, 1)
    assert (config.network.publish_period, config.network.topology, config.consensus.settle) == (5.0, "complete", 0)
    assert config.effective_packet.packets == "full"
    heavier = presets.with_options(base(), "roam", None, {"merge_weight": 0.8, "publish_period": 10.0})
    assert (heavier.consensus.merge_weight, heavier.network.publish_period) == (0.8, 10.0)


def test_a_rule_takes_the_packets_that_it_can_send() -> None:
    for rule, kind in (("bayes", "delta"), ("gradient", "delta"), ("ratio", "full"), ("flood", "delta")):
        config = base().with_parameters({"rule": rule})
        assert config.effective_packet.packets == kind
        assert config.packet.packets is None
    assert base().with_parameters({"packets": "full"}).effective_packet.packets == "full"
    with pytest.raises(ConfigError, match=r"rule: 'ratio' sends running sums.*use packets 'full'"):
        base().with_parameters({"rule": "ratio", "packets": "delta"})


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
