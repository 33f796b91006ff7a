"""Rule flood on small teams whose links, packets and robots fail."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.replay.exchange.messages import Source
from reference.scenarios import START_NS
from reference.twin import Twin, record
from support.faulty_team import (
    FLOOD_TOLERANCE,
    ONE_WAY_RING,
    PACKETS,
    PERIOD_NS,
    assert_all_have_the_oracle,
    configured,
    dense,
    finished_run,
    own_evidence,
    scenario,
    session_of,
    team_sums,
)
from support.long_suite import long, one_in

BAD_RADIO = {"loss": 0.5, "latency": 1.2, "jitter": 1.0}


@pytest.mark.parametrize(("topology", "name"), one_in(3, ["line", "ring"], ["full", "delta", "key frames, broadcast"]))
def test_flood_moves_evidence_one_hop_per_tick(topology, name):
    session = session_of(configured(rule="flood", topology=topology, **PACKETS[name]))
    index = np.arange(4)
    hops = np.abs(index[:, None] - index)
    if topology == "ring":
        hops = np.minimum(hops, 4 - hops)
    history = []
    largest_lag = 0.0
    for tick in session.ticks():
        history.append(own_evidence(session))
        sums = team_sums(tick)
        for i in tick.graph.active:
            # Maps published in a tick arrive in the same tick.
            expected = sum(history[max(tick.number - max(hops[i, j] - 1, 0), 0)][j] for j in range(4))
            np.testing.assert_allclose(sums[i], expected, rtol=0, atol=FLOOD_TOLERANCE)
            largest_lag = max(largest_lag, np.abs(expected - history[-1].sum(axis=0)).max())
    assert largest_lag > 1.0
    assert_all_have_the_oracle(tick, 1e-5)


@pytest.mark.parametrize("parameters", [
    {"topology": "complete"}, {"topology": "star"}, {"topology": "grid"}, {"topology": "ring", "one_way": ONE_WAY_RING},
    {"topology": "random", "prob_link": 0.6}, {"topology": "nearest", "num_nearest": 1},
    {"topology": "edges", "edges": (("robot_2", "robot_0", None), ("robot_0", "robot_3", None),
                                    ("robot_3", "robot_1", None))},
], ids=str)  # fmt: skip
def test_flood_ends_with_the_oracle_on_connected_graphs(parameters):
    session, tick = finished_run(rule="flood", **parameters)
    assert session.stop_reason == "converged"
    assert_all_have_the_oracle(tick, 1e-5)


@pytest.mark.parametrize(("name", "topology"), one_in(3, PACKETS, ["line", "complete"]))
def test_flood_ends_with_the_oracle_over_a_bad_radio(name, topology):
    session = session_of(configured(rule="flood", topology=topology, **BAD_RADIO, **PACKETS[name]))
    num_gaps = 0
    for tick in session.ticks():
        num_gaps += sum(link.num_gaps for link in tick.metrics.links)
    assert session.stop_reason == "converged"
    # A delta on a lost packet cannot be used; it is sent only where packets are not acknowledged.
    assert (num_gaps > 0) == name.startswith("key frames")
    assert_all_have_the_oracle(tick, 1e-5)


@long
def test_without_acknowledgements_settling_waits_for_the_next_key_frame():
    """The content of a lost delta arrives with the next key frame, after up to 25 ticks without a change."""
    packets = {"packets": "delta", "acknowledge": False, "key_frame_every": 25}
    for seed in (0, 1, 2):
        session, tick = finished_run(rule="flood", topology="line", loss=0.1, network_seed=seed, **packets)
        assert session.stop_reason == "converged"
        assert_all_have_the_oracle(tick, 1e-5)


def test_settling_waits_for_packets_that_take_many_ticks():
    _, tick = finished_run(rule="flood", topology="ring", packets="delta", rate=500.0)
    assert_all_have_the_oracle(tick, 1e-5)


@pytest.mark.parametrize("name", ["full", "delta"])
def test_flood_keeps_the_delivered_map_of_a_robot_that_is_off(name):
    schedule = (ScheduleEntry(5.0, robots_off=("robot_1",)),)
    session, tick = finished_run(rule="flood", topology="ring", schedule=schedule, **PACKETS[name])
    assert tick.graph.active == (0, 2, 3)
    sums = team_sums(tick)
    gone = Source(1, 0)
    for i in tick.graph.active:
        exchange = session.team.robots[i].exchange
        assert exchange.held[gone].version == 4
        delivered = {source: dense(held.octree) for source, held in exchange.held.items()}
        assert np.abs(delivered[gone]).max() > 1.0
        delivered[Source(i, 0)] = own_evidence(session)[i]
        np.testing.assert_allclose(sums[i], sum(delivered.values()), rtol=0, atol=FLOOD_TOLERANCE)
        np.testing.assert_array_equal(sums[i], sums[0])
    seen = [f for f in scenario().frames if f.robot_id == "robot_1" and f.stamp_ns < START_NS + 5 * PERIOD_NS]
    assert 0 < tick.metrics.robots[1].num_scans == len(seen) == session.team.robots[1].num_scans
    assert not tick.metrics.robots[1].active
    others = tuple(f for f in scenario().frames if f.robot_id != "robot_1" or f in seen)
    expected = Twin(configured(rule="local", settle=0), record(scenario().base_config, others), with_metrics=False)
    *_, last = expected.ticks()
    oracle = np.abs(dense(tick.oracle)).sum()
    assert oracle == pytest.approx(np.abs(last.oracle).sum(), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "radio"), one_in(3, PACKETS, [{}, {"loss": 0.3, "latency": 0.6, "jitter": 0.5}]), ids=str
)
def test_flood_returns_the_map_of_an_earlier_restart_epoch(name, radio):
    schedule = (ScheduleEntry(5.0, 8.0, robots_off=("robot_1",), forget=True),)
    session, tick = finished_run(rule="flood", topology="ring", schedule=schedule, **PACKETS[name], **radio)
    assert session.team.robots[1].source == Source(1, 1)
    (past,) = session.team._past_evidence
    published = {robot.exchange.held[Source(1, 0)].version for robot in session.team.robots}
    assert len(published) == 1
    # The evidence of its last tick was not published.
    expected = sum(own_evidence(session)) + dense(session.team.robots[0].exchange.held[Source(1, 0)].octree)
    assert np.abs(dense(past.octree)).max() > 1.0
    np.testing.assert_allclose(team_sums(tick), np.broadcast_to(expected, (4, *expected.shape)), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["full", "delta"])
def test_flood_ends_with_the_oracle_if_a_robot_published_everything_before_its_restart(name):
    """With eight ticks a second, every scan is published before the next one."""
    pause = ScheduleEntry(6.0, 8.0, robots_off=("robot_1",), forget=True)
    session, tick = finished_run(rule="flood", schedule=(pause,), publish_period=0.125, **PACKETS[name])
    (past,) = session.team._past_evidence
    assert np.abs(dense(past.octree)).max() > 1.0
    assert_all_have_the_oracle(tick, FLOOD_TOLERANCE)
