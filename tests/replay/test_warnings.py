"""Warnings of faults that a rule does not tolerate."""

from __future__ import annotations

import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import load_team_file
from octoreplay.replay.run import replay_team
from octoreplay.replay.warnings import packet_warnings, rule_warnings
from support.faulty_team import (
    ONE_WAY_RING,
    configured,
    session_of,
)
from support.fixture_paths import PAIR_TEAM


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"rule": "bayes", "loss": 0.2}, "with losses it drifts from the mean; use --rule ratio or flood"),
        ({"rule": "bayes", "latency": 0.3}, "with maps that arrive in a later tick it drifts"),
        ({"rule": "bayes", "rate": 1e6}, "with maps that arrive in a later tick it drifts"),
        (
            {"rule": "bayes", "loss": 0.2, "latency": 0.3},
            "with losses and maps that arrive in a later tick it drifts",
        ),
        ({"rule": "bayes", "packets": "delta", "budget": 9000}, "drifts from the mean; use --rule flood"),
        ({"rule": "merge"}, "rule 'merge' counts received evidence again in every tick"),
        ({"rule": "weighted"}, "rule 'weighted' does not keep the sum of the team's evidence"),
        ({"rule": "latest"}, "rule 'latest' keeps the evidence of one robot in each cell"),
    ],
)
def test_a_run_warns_of_faults_that_its_rule_does_not_tolerate(parameters, sentence):
    config = load_team_file(PAIR_TEAM).with_parameters({"settle": 0, **parameters})
    summary = replay_team(config, None)
    assert sum(sentence in warning for warning in summary.warnings) == 1


@pytest.mark.parametrize(
    "parameters", [{"content": "int8"}, {"top_classes": 2}, {"prune_tolerance": 0.1}], ids=str
)  # fmt: skip
def test_flows_with_packets_that_round_give_a_warning_where_they_are_asked_for(parameters):
    assert rule_warnings(configured(rule="bayes", **parameters), is_symmetric=True) == ()
    (warning,) = rule_warnings(configured(rule="bayes", flow_bits=3, **parameters), is_symmetric=True)
    assert warning.startswith(
        "flow_bits 3 with packets that do not hold the maps exactly: the maps do not come to rest;"
    )
    assert rule_warnings(configured(rule="gradient", flow_bits=3, **parameters), is_symmetric=True) == ()


@pytest.mark.parametrize(
    ("parameters", "needed"),
    [
        ({"int8_step": 0.02}, "0.04"),
        ({"int8_step": 0.02, "clamp_max": 2.0}, "0.04"),
        ({"int8_step": 0.05, "clamp_min": -8.0}, "0.063"),
        ({"int8_step": 0.02, "clamp_min": -2.0, "clamp_max": 2.5}, None),
        ({"int8_step": 0.04}, None),
        ({"int8_step": 0.02, "content": "float16"}, None),
        ({"int8_step": 0.02, "evidence": "time-average", "rule": "gradient"}, None),
        ({"int8_step": 0.02, "rule": "local"}, None),
    ],
)
def test_packets_that_cannot_hold_the_clamps_give_a_warning(parameters, needed):
    warnings = packet_warnings(configured(**{"rule": "bayes", "content": "int8", **parameters}))
    assert len(warnings) == (needed is not None)
    if needed is not None:
        assert f"use --int8-step {needed} or more" in warnings[0]
        assert packet_warnings(configured(**{**parameters, "content": "int8", "int8_step": float(needed)})) == ()


def test_a_run_with_packets_that_cannot_hold_the_clamps_ends_with_the_warning():
    config = load_team_file(PAIR_TEAM).with_parameters({"settle": 0, "content": "int8", "int8_step": 0.01})
    assert sum("holds log-odds up to 1.27" in warning for warning in replay_team(config, None).warnings) == 1


@pytest.mark.parametrize("rule", ["bayes", "ratio", "flood", "gradient"])
def test_a_run_without_faults_has_no_warning(rule):
    assert rule_warnings(configured(rule=rule), is_symmetric=True) == ()


@pytest.mark.parametrize(
    ("parameters", "cause"),
    [
        ({"corruption": 0.1}, "losses"),
        ({"burst_start": 0.1}, "losses"), ({"loss": 0.1}, "losses"),
        ({"schedule": (ScheduleEntry(1.0, robots_off=("robot_0",)),)}, "robots that go off"),
        ({"robots": {"robot_0": {"publish_period": 2.0}}}, "robots that publish at different times"),
        ({"link_overrides": (("robot_0", "robot_1", (("loss", 0.1),)),)}, "losses"),
        ({"packets": "delta", "budget": 4096}, "maps that a budget holds back"),
    ],
)  # fmt: skip
def test_the_warning_of_bayes_names_the_cause(parameters, cause):
    (warning,) = rule_warnings(configured(rule="bayes", **parameters), is_symmetric=True)
    assert f"with {cause} it drifts" in warning
    assert rule_warnings(configured(rule="natural", **parameters), is_symmetric=True) == ()


@pytest.mark.parametrize(
    ("parameters", "is_symmetric"),
    [
        ({}, True),
        ({"topology": "line"}, True),
        ({"topology": "line", "weights": "degree"}, False),
        ({"one_way": ONE_WAY_RING[:1]}, False),
        ({"schedule": (ScheduleEntry(1.0, robots_silent=("robot_0",)),)}, False),
    ],
)
def test_bayes_is_warned_of_asymmetric_weights(parameters, is_symmetric):
    config = configured(rule="bayes", settle=0, **parameters)
    session = session_of(config)
    for _ in session.ticks():
        pass
    assert session.is_symmetric == is_symmetric
    assert len(rule_warnings(config, session.is_symmetric)) == (not is_symmetric)
