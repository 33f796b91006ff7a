"""Largest number of settling ticks and number of quiet ticks, with packets that are lost or late."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.network import LinkConfig
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.records import CONVERGED
from octoreplay.replay.network.graph import TeamNetwork, step_size
from octoreplay.replay.settling import (
    FINER_TICKS,
    QUIET_PROB,
    Settling,
    num_finer_ticks,
    num_quiet_ticks,
    num_settle_ticks,
    settle_ticks_max,
)

IDS = ("a", "b", "c", "d")

RAMP = 20


def _team(*, periods=None, link_overrides=(), **parameters):
    """A graph of four robots and the configuration that it is from; rule gradient unless another one is given."""
    robots = tuple(RobotConfig(name, (Path(f"{name}.mcap"),), publish_period=(periods or {}).get(name)) for name in IDS)
    config = RunConfig(robots=robots).with_parameters({"rule": "gradient", **parameters})
    config = dataclasses.replace(config, link_overrides=link_overrides)
    network = TeamNetwork(config.network, config.consensus, IDS)
    return network.at(0.0, [True] * len(IDS), np.full((len(IDS), 3), np.nan)), config


def _on(sender, receiver, **values):
    return (sender, receiver, tuple(values.items()))


def _ticks(rate):
    """Ticks that shrink a disagreement by 1e12 when each leaves ``rate`` of it."""
    return math.ceil(12.0 / -math.log10(rate))


# --- without faults ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["gradient", "bayes", "natural", "ratio", "flood", "merge", "weighted", "latest"])
@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star"])
def test_without_faults_settling_needs_one_quiet_tick_and_the_graph_limits_its_ticks(topology, rule):
    graph, config = _team(topology=topology, rule=rule)
    assert num_quiet_ticks(graph, config) == 1
    expected = settle_ticks_max(graph, config.consensus, step_size(graph, config.consensus))
    assert num_settle_ticks(graph, config) == expected + FINER_TICKS * (rule == "bayes") > RAMP


def test_flows_add_the_ticks_in_which_they_get_finer():
    graph, config = _team(rule="bayes")
    assert num_settle_ticks(graph, config, num_finer=8) == num_settle_ticks(graph, config)
    assert num_settle_ticks(graph, config, num_finer=13) == num_settle_ticks(graph, config) + 13 - FINER_TICKS
    for without in ({"flow_bits": 0}, {"quantum": 0.0}, {"evidence": "time-average"}):
        assert num_settle_ticks(*_team(rule="bayes", **without)) == num_settle_ticks(graph, config) - FINER_TICKS


@pytest.mark.parametrize(
    ("largest", "parameters", "expected"),
    [
        (0.0, {}, 0), (2.0**-12, {}, 0), (2.0**-11, {}, 1), (3.999, {}, 7), (4.0, {}, 7), (8.0, {}, 8), (1e9, {}, 21),
        (4.0, {"flow_bits": 0}, 0), (4.0, {"flow_bits": 18}, 0), (4.0, {"flow_bits": 17}, 1),
        (4.0, {"quantum": 0.5}, 0), (4.0, {"rule": "gradient"}, 0),
    ],
)  # fmt: skip
def test_flows_get_finer_until_their_step_is_the_quantum(largest, parameters, expected):
    _, config = _team(**{"rule": "bayes", **parameters})
    assert num_finer_ticks(config, largest) == expected


def test_settling_does_not_end_before_flows_are_finest():
    graph, config = _team(rule="bayes", settle_tolerance=0.5)
    settling = Settling(graph, config, 0.0, 4.0)
    phases = []
    for phase in settling.phases():
        phases.append(phase)
        settling.note(2.0**-16 if phase.extra_flow_bits == 14 and len(phases) < 10 else 0.0)
    assert [phase.extra_flow_bits for phase in phases] == [2, 4, 6, 8, 10, 12, 14, 14, 14, 14]
    assert settling.stop_reason == CONVERGED


def test_given_numbers_override_the_links():
    for loss in (0.0, 0.5):
        assert num_settle_ticks(*_team(settle_max=7, loss=loss, latency=3.0)) == 7
        assert num_settle_ticks(*_team(settle=0, loss=loss, latency=3.0)) == 0


@pytest.mark.parametrize("rule", ["ratio", "flood", "merge", "latest", "local"])
def test_an_unused_step_size_changes_nothing(rule):
    expected = num_settle_ticks(*_team(rule=rule, topology="line"))
    assert num_settle_ticks(*_team(rule=rule, topology="line", epsilon=5.0)) == expected


# --- losses -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", [0.0005, 0.002, 0.01, 0.3, 0.5, 0.9, 0.99])
def test_a_link_is_rarely_silent_for_all_quiet_ticks(loss):
    num_quiet = num_quiet_ticks(*_team(loss=loss))
    assert loss**num_quiet <= QUIET_PROB * (1 + 1e-9)
    assert num_quiet == 1 or loss ** (num_quiet - 1) > QUIET_PROB


@pytest.mark.parametrize(("loss", "num_quiet"), [(0.3, 6), (0.99, 688)])
def test_losses_lengthen_settling(loss, num_quiet):
    """In a complete graph of four each link has the weight (1 - loss) / 4: a tick leaves ``loss`` of a difference."""
    graph, config = _team(loss=loss)
    assert num_quiet_ticks(graph, config) == num_quiet
    assert num_settle_ticks(graph, config) == RAMP + _ticks(loss) + num_quiet - 1


@pytest.mark.parametrize(
    "parameters",
    [{"loss": 0.3}, {"corruption": 0.3}, {"loss": 0.125, "corruption": 0.2}],
    ids=str,
)
def test_lost_and_damaged_packets_count_alike(parameters):
    assert LinkConfig(**parameters).mean_loss == pytest.approx(0.3)
    graph, config = _team(**parameters)
    assert num_quiet_ticks(graph, config) == 6
    assert num_settle_ticks(graph, config) == num_settle_ticks(*_team(loss=0.3))


def test_long_bursts_lengthen_settling():
    """In a burst that goes on with 0.65, 17 lost packets in a row are one in a thousand."""
    graph, config = _team(burst_start=0.15, burst_end=0.35)
    assert LinkConfig(burst_start=0.15, burst_end=0.35).mean_loss == pytest.approx(0.3)
    assert num_quiet_ticks(graph, config) == 17
    assert num_settle_ticks(graph, config) == num_settle_ticks(*_team(loss=0.3)) + 17 - 6


@pytest.mark.parametrize(("loss", "start", "end", "burst_loss"), [(0.1, 0.2, 0.3, 0.9), (0.4, 0.05, 0.5, 0.6)])
def test_successive_losses_have_the_probability_of_the_links(loss, start, end, burst_loss):
    link = LinkConfig(loss=loss, burst_start=start, burst_end=end, burst_loss=burst_loss)
    lost = np.array([1.0 - start / (start + end), start / (start + end)])
    steps = np.array([[1.0 - start, start], [end, 1.0 - end]])
    chances = []
    for _ in range(40):
        lost = (lost @ steps) * [loss, burst_loss]
        chances.append(lost.sum())
    assert chances[0] == pytest.approx(link.mean_loss)
    assert chances[-1] / chances[-2] == pytest.approx(link.repeated_loss)


def test_the_worst_link_counts():
    graph, config = _team(loss=0.01, link_overrides=(_on("a", "b", loss=0.3),))
    assert num_quiet_ticks(graph, config) == 6
    # A link that is not there does not.
    graph, config = _team(topology="line", loss=0.01, link_overrides=(_on("a", "d", loss=0.9),))
    assert num_quiet_ticks(graph, config) == num_quiet_ticks(*_team(topology="line", loss=0.01)) == 2


def test_links_that_lose_everything_are_ignored():
    graph, config = _team(loss=1.0)
    assert num_quiet_ticks(graph, config) == 1
    assert num_settle_ticks(graph, config) == RAMP + 1
    graph, config = _team(loss=0.3, link_overrides=(_on("a", "b", loss=1.0),))
    assert num_quiet_ticks(graph, config) == 6
    # Without any packet from a to b the others still bring it there, in a few ticks more.
    assert num_settle_ticks(*_team(loss=0.3)) < num_settle_ticks(graph, config) < 200


def test_without_acknowledgements_a_loss_lasts_until_the_next_whole_map():
    key_frames = {"packets": "delta", "acknowledge": False, "key_frame_every": 10}
    assert num_quiet_ticks(*_team(**key_frames)) == 1
    assert num_quiet_ticks(*_team(loss=0.3, **key_frames)) == 60
    assert num_settle_ticks(*_team(loss=0.3, **key_frames)) == RAMP + 10 * _ticks(0.3) + 59
    acknowledged = {**key_frames, "acknowledge": True}
    assert num_quiet_ticks(*_team(loss=0.3, **acknowledged)) == 6


# --- delays and slow robots -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "delay"),
    [({"latency": 0.2}, 1), ({"latency": 1.0}, 1), ({"latency": 2.5, "jitter": 0.5}, 3), ({"latency": 2.5}, 3),
     ({"latency": 0.5, "publish_period": 0.25}, 2), ({"latency": 0.2, "publish_period": 0.05}, 4)],
    ids=str,
)  # fmt: skip
def test_delays_lengthen_settling(parameters, delay):
    graph, config = _team(**parameters)
    assert num_quiet_ticks(graph, config) == 1 + delay
    assert num_settle_ticks(graph, config) == RAMP + (1 + delay) + delay


def test_the_longest_publish_period_counts():
    graph, config = _team(periods={"b": 3.0, "c": 2.0})
    assert num_quiet_ticks(graph, config) == 3
    assert num_settle_ticks(graph, config) == RAMP + 3 + 2
    graph, config = _team(periods={"b": 3.0}, loss=0.3, latency=1.5)
    assert num_quiet_ticks(graph, config) == 6 * 3 + 2
    assert num_settle_ticks(graph, config) == RAMP + _ticks(0.3) * 3 * 3 + 19
