"""Quantum, flows and the increments that they round."""

from __future__ import annotations

from pathlib import Path

import pytest

from octoreplay.config.consensus import ConsensusConfig
from octoreplay.config.presets import with_options
from octoreplay.config.robot import RobotConfig
from octoreplay.config.rules import RULES
from octoreplay.config.run import RunConfig
from octoreplay.config.sensor import SensorConfig, rounded_sensor
from octoreplay.errors import ConfigError

TEAM = RunConfig(robots=(RobotConfig("a", (Path("a.mcap"),)),))


@pytest.mark.parametrize(
    ("rule", "quantum"),
    [("bayes", 2.0**-16), ("gradient", 2.0**-10), ("natural", 2.0**-10), ("ratio", 0.0), ("flood", 0.0),
     ("merge", 0.0), ("weighted", 2.0**-10), ("latest", 0.0), ("local", 0.0)],
)  # fmt: skip
def test_default_quantum_of_every_rule(rule: str, quantum: float) -> None:
    assert ConsensusConfig(rule=rule).effective_quantum == quantum
    assert ConsensusConfig(rule=rule, evidence="time-average").effective_quantum == 0.0
    assert ConsensusConfig(rule=rule, evidence="cell-average", quantum=0.5).effective_quantum == 0.0


@pytest.mark.parametrize("rule", RULES)
def test_a_given_quantum_applies_to_the_rules_that_have_one(rule: str) -> None:
    has_one = rule in ("bayes", "gradient", "natural", "weighted")
    assert ConsensusConfig(rule=rule, quantum=2.0**-12).effective_quantum == (2.0**-12 if has_one else 0.0)
    assert ConsensusConfig(rule=rule, quantum=0.0).effective_quantum == 0.0


@pytest.mark.parametrize("rule", RULES)
def test_flows_need_a_rule_with_flows_and_a_quantum(rule: str) -> None:
    def flow_bits(**parameters: object) -> int:
        return TEAM.with_parameters({"rule": rule, **parameters}).effective_flow_bits

    assert flow_bits() == (4 if rule == "bayes" else 0)
    assert flow_bits(flow_bits=7) == (7 if rule == "bayes" else 0)
    assert flow_bits(flow_bits=0) == 0
    assert flow_bits(quantum=0.0) == 0
    assert flow_bits(evidence="time-average") == 0


@pytest.mark.parametrize(
    "parameters", [{"content": "int8"}, {"content": "float16"}, {"top_classes": 1}, {"budget": 1000},
                   {"prune_tolerance": 0.1}],
)  # fmt: skip
def test_flows_are_off_by_default_with_packets_that_round(parameters: dict[str, object]) -> None:
    config = TEAM.with_parameters(parameters)
    assert not config.has_exact_packets
    assert config.effective_flow_bits == 0
    assert config.with_parameters({"flow_bits": 4}).effective_flow_bits == 4
    assert TEAM.with_parameters({"packet_compression": "none"}).effective_flow_bits == 4


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"quantum": 0.001}, r"quantum: 0.001 is not a power of two; the nearest is 2\^-10 = 0.0009765625"),
        ({"quantum": 3.0}, r"quantum: 3 is not a power of two; the nearest is 2\^2 = 4.0"),
        ({"quantum": 2.0**-60}, "quantum: 8.67362e-19 is below the least value 1e-15; 0 means none"),
        ({"quantum": -0.5}, "quantum: -0.5 is below the least value 0"),
        ({"quantum": "fine"}, "quantum: expects a number, got 'fine'"),
        ({"flow_bits": -1}, "flow_bits: -1 is below the least value 0"),
        ({"flow_bits": 21}, "flow_bits: 21 is above the largest value 20"),
        ({"anchor_after": -1}, "anchor_after: -1 is below the least value 0"),
        ({"quantum": 2.0}, "quantum: 2 rounds hit 1 to 0; choose a smaller quantum, or 0"),
        ({"rule": "gradient", "miss": -0.0001}, r"quantum: 0.000976562 rounds miss -0.0001 to 0"),
    ],
)
def test_refused_settings(parameters: dict[str, object], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        TEAM.with_parameters(parameters)


def test_rounded_sensor_model() -> None:
    sensor = rounded_sensor(SensorConfig(hit=1.2, miss=-0.3, clamp_min=-5.1, clamp_max=4.9, max_range=7.3), 0.25)
    assert (sensor.hit, sensor.miss, sensor.hit_other) == (1.25, -0.25, None)
    assert (sensor.clamp, sensor.max_range) == ((-5.0, 5.0), 7.3)
    # Ties go to the even multiple.
    assert rounded_sensor(SensorConfig(hit=0.75, hit_other=-1.25), 0.5).hit == 1.0
    assert rounded_sensor(SensorConfig(hit=0.75, hit_other=-1.25), 0.5).hit_other == -1.0
    assert rounded_sensor(SensorConfig(miss=0.0), 2.0**-10).miss == 0.0
    assert rounded_sensor(SensorConfig(), 0.0) == SensorConfig()


def test_effective_sensor_model_of_a_run() -> None:
    bayes = TEAM.with_parameters({"rule": "bayes"})
    assert bayes.effective_sensor.miss == -19661 * 2.0**-16
    assert TEAM.with_parameters({"rule": "local"}).effective_sensor == TEAM.sensor
    assert TEAM.with_parameters({"rule": "bayes", "quantum": 0.0}).effective_sensor == TEAM.sensor
    assert bayes.sensor == TEAM.sensor


def test_preset_paper_rounds_nothing() -> None:
    config = with_options(TEAM, "paper", None, {})
    assert (config.consensus.effective_quantum, config.effective_flow_bits) == (0.0, 0)
    assert (config.consensus.quantum, config.consensus.anchor_after) == (0.0, 0)
    assert with_options(TEAM, "paper", None, {"evidence": "sum"}).consensus.effective_quantum == 0.0
