"""Content of packets in whole runs: rounding, deltas, budgets and damage."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from octoreplay.errors import ConfigError
from octoreplay.mapping import codec
from octoreplay.replay.exchange.packet_codec import PacketCodec
from support.faulty_team import (
    PACKETS,
    RATIO_TOLERANCE,
    assert_all_have_the_oracle,
    configured,
    dense,
    own_evidence,
    session_of,
    team_sums,
)
from support.long_suite import long, one_in
from support.sessions import sent_packets

LOSSY = {
    "int8": {"content": "int8"},
    "float16": {"content": "float16"},
    "top classes": {"top_classes": 2},
    "pruned": {"prune_tolerance": 0.1},
    "all": {"content": "int8", "top_classes": 2, "prune_tolerance": 0.05},
}


@pytest.mark.parametrize(("name", "packets"), one_in(5, LOSSY, ["full", "delta"]))
def test_rounding_in_packets_conserves_the_evidence_of_the_team(name, packets):
    session = session_of(configured(rule="bayes", settle_max=8, **LOSSY[name], **PACKETS[packets]))
    rounded = 0.0
    for tick in session.ticks():
        total = sum(dense(octree) for octree in tick.maps)
        np.testing.assert_allclose(total, own_evidence(session).sum(axis=0), rtol=0, atol=RATIO_TOLERANCE)
        spread = team_sums(tick)
        rounded = max(rounded, np.abs(spread - spread[0]).max())
    assert rounded > 1e-3
    assert all(robot.agreement > 0.99 and robot.agreement_occupied > 0.99 for robot in tick.metrics.robots)


@pytest.mark.parametrize(
    ("rule", "mode"), one_in(5, ["gradient", "bayes", "natural", "merge", "weighted"], ["sync", "on-arrival"])
)
def test_deltas_give_the_same_maps_as_whole_packets(rule, mode):
    parameters = {"rule": rule, "mode": mode, "topology": "ring", "settle": 3, "settle_max": 4}
    sessions = [
        session_of(configured(**parameters, **PACKETS[name])) for name in ("full", "delta", "key frames, broadcast")
    ]
    for ticks in zip(*(session.ticks() for session in sessions), strict=True):
        for maps in zip(*(tick.maps for tick in ticks), strict=True):
            expected, *others = [(octree.leaves().centers.tobytes(), octree.leaves().log_odds.tobytes())
                                 for octree in maps]  # fmt: skip
            assert others == [expected, expected]
    kinds = [{codec.read_header(data).kind for data in sent_packets(tick)} for tick in ticks]
    assert kinds[:2] == [{codec.FULL}, {codec.DELTA}]


@pytest.mark.parametrize(
    ("rule", "radio"),
    one_in(
        4, ["flood", "gradient", "bayes", "merge", "weighted", "latest"],
        [{"latency": 1.5, "loss": 0.3, "network_seed": 2}, {"content": "int8"}],
    ),
    ids=str,
)  # fmt: skip
def test_receivers_that_share_the_senders_state_have_the_maps_of_receivers_that_decode(monkeypatch, rule, radio):
    def maps_of(decodes):
        monkeypatch.setattr(PacketCodec, "always_decodes", decodes)
        session = session_of(configured(rule=rule, topology="ring", settle=2, settle_max=3, **radio))
        return [[dense(octree) for octree in tick.maps] for tick in session.ticks()]

    for shared, decoded in zip(maps_of(False), maps_of(True), strict=True):
        # Decoded bricks may have other class rows, and the gradient's sums then other rounding.
        np.testing.assert_allclose(shared, decoded, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("topology", "packets", "radio"),
    one_in(
        7, ["complete", "line"], [{"budget": 2200}, {"budget": 640, "content": "int8", "int8_step": 0.1}],
        [{}, {"loss": 0.4, "network_seed": 2}],
    ),
    ids=str,
)  # fmt: skip
def test_flood_ends_with_the_oracle_within_a_budget(topology, packets, radio):
    session = session_of(configured(rule="flood", topology=topology, packets="delta", **packets, **radio))
    whole = session_of(configured(rule="flood", topology=topology))
    lag = 0.0
    for tick, at_once in itertools.zip_longest(session.ticks(), whole.ticks()):
        assert tick is not None
        messages = [m for published in tick.published if published for _, m in published.outbox]
        assert all(message.num_bytes <= packets["budget"] for message in messages)
        if at_once is not None:
            lag = max(lag, np.abs(team_sums(tick) - team_sums(at_once)).max())
    assert lag > 1.0 or packets["budget"] > 2000
    # All evidence of the default sensor is a multiple of 0.1, the step of int8 here.
    assert_all_have_the_oracle(tick, 1e-4)


@long
@pytest.mark.parametrize(
    ("packets", "rule"),
    one_in(4, [{"budget": 2200}, {"budget": 640, "content": "int8"}], ["bayes", "natural", "gradient"]),
    ids=str,
)
def test_maps_converge_within_a_budget(packets, rule):
    """Waiting changes make received maps older: log-odds stay near the bounds, and the distances fall."""
    session = session_of(configured(rule=rule, packets="delta", settle_max=50, **packets))
    peak = 0.0
    for tick in session.ticks():
        for octree in tick.maps if tick.number % 4 == 0 else ():
            assert np.abs(octree.leaves().log_odds).max(initial=0.0) < 5.0 + 0.5
        peak = max(peak, tick.metrics.total_distance_all)
    # The gradient changes uncertain cells for a long time, so that changes keep waiting.
    assert tick.metrics.total_distance_all < (0.15 if rule == "gradient" else 0.05) * peak
    assert all(robot.agreement > 0.8 for robot in tick.metrics.robots)


def test_a_budget_smaller_than_one_brick_is_refused():
    for packets in ({"budget": 512}, {"budget": 512, "content": "int8"}):
        with pytest.raises(ConfigError, match=r"budget: 512 bytes may not hold one brick .* give at least \d+"):
            session_of(configured(packets="delta", **packets))


@pytest.mark.parametrize("name", one_in(3, PACKETS))
def test_damaged_packets_are_counted_and_never_used(name):
    session = session_of(configured(rule="flood", topology="ring", corruption=0.3, network_seed=1, **PACKETS[name]))
    num_damaged = 0
    history = []
    for tick in session.ticks():
        num_damaged += sum(link.num_damaged for link in tick.metrics.links)
        history.append(own_evidence(session))
        for robot in session.team.robots:
            for source, held in robot.exchange.held.items():
                np.testing.assert_array_equal(dense(held.octree), history[held.version][source.origin])
    assert num_damaged > 5
    assert_all_have_the_oracle(tick, 1e-5)
