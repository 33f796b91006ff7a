"""Teams whose links, packets and robots fail: what each rule promises all the same, on whole small runs."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.team_file import load_team_file
from octoreplay.errors import ConfigError, InputError
from octoreplay.mapping import codec
from octoreplay.replay import session as session_module
from octoreplay.replay.exchange.messages import Source
from octoreplay.replay.run import replay_team
from octoreplay.replay.session import Session
from octoreplay.replay.warnings import rule_warnings
from octoreplay.result import open_result
from reference.comparison import compare_map
from reference.scenarios import START_NS, TeamShape, make_scenario
from reference.twin import Twin, record

FIXTURES = Path(__file__).parent.parent / "fixtures"

SHAPE = TeamShape(num_robots=4, num_ticks=14, image=(12, 9), resolution=0.4, scan_period=0.5, sensors="mixed")
"""The last robot comes in tick 4, the last but one ends in tick 8."""

PERIOD_NS = 10**9
NUM_LOG_TICKS = 14

FLOOD_TOLERANCE = 1e-4
RATIO_TOLERANCE = 1e-3

PACKETS = {
    "full": {},
    "full, broadcast": {"cast": "broadcast"},
    "delta": {"packets": "delta"},
    "delta, broadcast": {"packets": "delta", "cast": "broadcast"},
    "key frames": {"packets": "delta", "acknowledge": False, "key_frame_every": 4},
    "key frames, broadcast": {"packets": "delta", "acknowledge": False, "key_frame_every": 4, "cast": "broadcast"},
}

BAD_RADIO = {"loss": 0.5, "latency": 1.2, "jitter": 1.0}
ONE_WAY_RING = tuple((f"robot_{i}", f"robot_{(i + 1) % 4}") for i in range(4))


@dataclasses.dataclass(frozen=True)
class FrameList:
    """Frames from memory."""

    content: tuple

    def frames(self):
        return iter(self.content)


@functools.cache
def _scenario():
    return make_scenario(1, SHAPE)


@functools.cache
def _recording():
    return record(_scenario().base_config, _scenario().frames)


def _config(*, robots=None, link_overrides=(), **parameters):
    """The team's configuration; ``robots`` gives fields of some robots."""
    config = _scenario().config(**parameters)
    of_robots = tuple(dataclasses.replace(r, **(robots or {}).get(r.robot_id, {})) for r in config.robots)
    return dataclasses.replace(config, robots=of_robots, link_overrides=link_overrides)


def _session(config, num_threads=1):
    frames = _scenario().frames
    sources = [FrameList(tuple(f for f in frames if f.robot_id == robot.robot_id)) for robot in config.robots]
    return Session(config, sources, ThreadPoolExecutor(num_threads))


def _run(**parameters):
    """A session that has ended, and its last tick."""
    session = _session(_config(**parameters))
    for tick in session.ticks():
        last = tick
    return session, last


def _dense(octree):
    """An octree's deviations (M, C) in every cell that any robot ever sees."""
    return octree.lookup((_recording().keys + 0.5) * octree.resolution)[0].astype(np.float64)


def _known(octree):
    return octree.lookup((_recording().keys + 0.5) * octree.resolution)[1]


def _team_sums(tick):
    """N h_i of every robot, (N, M, C)."""
    return len(tick.maps) * np.array([_dense(octree) for octree in tick.maps])


def _from_oracle(tick):
    """The largest |N h - oracle| of each robot."""
    return np.abs(_team_sums(tick) - _dense(tick.oracle)).max(axis=(1, 2))


def _assert_all_have_the_oracle(tick, tolerance):
    assert _from_oracle(tick).max() < tolerance
    for octree in tick.maps:
        assert (_known(octree) == _known(tick.oracle)).all()


def _evidence(session):
    """Every robot's own evidence now, (N, M, C)."""
    return np.array([_dense(robot.evidence.octree) for robot in session.team.robots])


def _packets(tick):
    """Every packet that was sent in a tick."""
    messages = [message for published in tick.published if published for _, message in published.outbox]
    return [part.data for message in messages for part in message.parts]


# --- flood -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["full", "delta", "key frames, broadcast"])
@pytest.mark.parametrize("topology", ["line", "ring"])
def test_flood_brings_evidence_one_hop_per_tick(topology, name):
    session = _session(_config(rule="flood", topology=topology, **PACKETS[name]))
    index = np.arange(4)
    hops = np.abs(index[:, None] - index)
    if topology == "ring":
        hops = np.minimum(hops, 4 - hops)
    history = []
    largest_lag = 0.0
    for tick in session.ticks():
        history.append(_evidence(session))
        sums = _team_sums(tick)
        for i in tick.graph.active:
            # What a neighbour published in this tick is here in it.
            expected = sum(history[max(tick.number - max(hops[i, j] - 1, 0), 0)][j] for j in range(4))
            np.testing.assert_allclose(sums[i], expected, rtol=0, atol=FLOOD_TOLERANCE)
            largest_lag = max(largest_lag, np.abs(expected - history[-1].sum(axis=0)).max())
    assert largest_lag > 1.0
    _assert_all_have_the_oracle(tick, 1e-5)


@pytest.mark.parametrize("parameters", [
    {"topology": "complete"}, {"topology": "star"}, {"topology": "grid"}, {"topology": "ring", "one_way": ONE_WAY_RING},
    {"topology": "random", "prob_link": 0.6}, {"topology": "nearest", "num_nearest": 1},
    {"topology": "edges", "edges": (("robot_2", "robot_0", None), ("robot_0", "robot_3", None),
                                    ("robot_3", "robot_1", None))},
], ids=str)  # fmt: skip
def test_flood_ends_with_the_oracle_on_connected_graphs(parameters):
    session, tick = _run(rule="flood", **parameters)
    assert session.stop_reason == "converged"
    _assert_all_have_the_oracle(tick, 1e-5)


@pytest.mark.parametrize("topology", ["line", "complete"])
@pytest.mark.parametrize("name", PACKETS)
def test_flood_ends_with_the_oracle_over_a_bad_radio(name, topology):
    session = _session(_config(rule="flood", topology=topology, **BAD_RADIO, **PACKETS[name]))
    num_gaps = 0
    for tick in session.ticks():
        num_gaps += sum(link.num_gaps for link in tick.metrics.links)
    assert session.stop_reason == "converged"
    # What builds on a packet that was lost cannot be used; only who does not ask is sent such packets.
    assert (num_gaps > 0) == name.startswith("key frames")
    _assert_all_have_the_oracle(tick, 1e-5)


def test_settling_waits_for_the_next_whole_map_where_nobody_acknowledges():
    """What a lost delta held comes with the next key frame, which may be many ticks without any change away."""
    packets = {"packets": "delta", "acknowledge": False, "key_frame_every": 25}
    for seed in (0, 1, 2):
        session, tick = _run(rule="flood", topology="line", loss=0.1, network_seed=seed, **packets)
        assert session.stop_reason == "converged"
        _assert_all_have_the_oracle(tick, 1e-5)


def test_settling_waits_for_packets_that_take_many_ticks():
    _, tick = _run(rule="flood", topology="ring", packets="delta", rate=500.0)
    _assert_all_have_the_oracle(tick, 1e-5)


@pytest.mark.parametrize("name", ["full", "delta"])
def test_flood_goes_on_with_what_a_robot_that_is_gone_delivered(name):
    schedule = (ScheduleEntry(5.0, robots_off=("robot_1",)),)
    session, tick = _run(rule="flood", topology="ring", schedule=schedule, **PACKETS[name])
    assert tick.graph.active == (0, 2, 3)
    sums = _team_sums(tick)
    gone = Source(1, 0)
    for i in tick.graph.active:
        exchange = session.team.robots[i].exchange
        assert exchange.held[gone].version == 4
        delivered = {source: _dense(held.octree) for source, held in exchange.held.items()}
        assert np.abs(delivered[gone]).max() > 1.0
        delivered[Source(i, 0)] = _evidence(session)[i]
        np.testing.assert_allclose(sums[i], sum(delivered.values()), rtol=0, atol=FLOOD_TOLERANCE)
        np.testing.assert_array_equal(sums[i], sums[0])
    seen = [f for f in _scenario().frames if f.robot_id == "robot_1" and f.stamp_ns < START_NS + 5 * PERIOD_NS]
    assert 0 < tick.metrics.robots[1].num_scans == len(seen) == session.team.robots[1].num_scans
    assert not tick.metrics.robots[1].active
    others = tuple(f for f in _scenario().frames if f.robot_id != "robot_1" or f in seen)
    expected = Twin(_config(rule="local", settle=0), record(_scenario().base_config, others), with_metrics=False)
    *_, last = expected.ticks()
    oracle = np.abs(_dense(tick.oracle)).sum()
    assert oracle == pytest.approx(np.abs(last.oracle).sum(), rel=1e-5)


@pytest.mark.parametrize("radio", [{}, {"loss": 0.3, "latency": 0.6, "jitter": 0.5}], ids=["good", "bad"])
@pytest.mark.parametrize("name", PACKETS)
def test_a_robot_that_forgot_gets_its_earlier_life_back_from_the_others(name, radio):
    schedule = (ScheduleEntry(5.0, 8.0, robots_off=("robot_1",), forget=True),)
    session, tick = _run(rule="flood", topology="ring", schedule=schedule, **PACKETS[name], **radio)
    assert session.team.robots[1].source == Source(1, 1)
    (past,) = session._past_lives
    published = {robot.exchange.held[Source(1, 0)].version for robot in session.team.robots}
    assert len(published) == 1
    # What it saw in its last tick, it told nobody.
    expected = sum(_evidence(session)) + _dense(session.team.robots[0].exchange.held[Source(1, 0)].octree)
    assert np.abs(_dense(past.octree)).max() > 1.0
    np.testing.assert_allclose(_team_sums(tick), np.broadcast_to(expected, (4, *expected.shape)), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", ["full", "delta"])
def test_all_have_the_oracle_again_where_a_robot_told_everything_before_it_forgot(name):
    """With eight ticks a second, every scan is published before the next one comes."""
    pause = ScheduleEntry(6.0, 8.0, robots_off=("robot_1",), forget=True)
    session, tick = _run(rule="flood", schedule=(pause,), publish_period=0.125, **PACKETS[name])
    (past,) = session._past_lives
    assert np.abs(_dense(past.octree)).max() > 1.0
    _assert_all_have_the_oracle(tick, FLOOD_TOLERANCE)


# --- ratio -----------------------------------------------------------------------------------------------------------


def test_ratio_is_bayes_where_nothing_fails():
    sessions = [_session(_config(rule=rule, settle=0)) for rule in ("ratio", "bayes")]
    num_joined = []
    for ratio, bayes in zip(*(session.ticks() for session in sessions), strict=True):
        for one, other in zip(ratio.maps, bayes.maps, strict=True):
            np.testing.assert_allclose(_dense(one), _dense(other), rtol=0, atol=RATIO_TOLERANCE)
            np.testing.assert_array_equal(_known(one), _known(other))
        num_joined.append(len(ratio.graph.active))
    assert num_joined[1] == 3
    assert num_joined[-1] == 4
    assert np.abs(_dense(ratio.maps[0])).max() > 2.0


GROUPS = (("robot_0", "robot_1"), ("robot_2", "robot_3"))
RATIO_FAULTS = {
    "loss and latency": {"topology": "ring", "loss": 0.3, "latency": 0.6, "network_seed": 1},
    "bursts and jitter": {"topology": "line", "burst_start": 0.2, "latency": 0.5, "jitter": 0.5, "network_seed": 2},
    "rate": {"topology": "ring", "rate": 8000.0},
    "broadcast": {"topology": "ring", "cast": "broadcast", "loss": 0.3, "network_seed": 1},
    "one-way ring": {"topology": "ring", "one_way": ONE_WAY_RING},
    "partition": {"topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, groups=GROUPS),)},
    "partition, loss and latency": {
        "topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, groups=GROUPS),), "loss": 0.2, "latency": 0.6,
        "network_seed": 1,
    },
    "links that come and go": {
        "topology": "ring", "loss": 0.2, "schedule": (
            ScheduleEntry(3.0, 6.0, links_down=(("robot_0", "robot_1"),)),
            ScheduleEntry(5.0, 9.0, links_up=(("robot_0", "robot_2"),)),
            ScheduleEntry(7.0, 10.0, links_down=(("robot_0", "robot_1"), ("robot_2", "robot_3"))),),
    },
    "silence": {"topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, robots_silent=("robot_1",)),)},
    "a robot was off": {"topology": "ring", "schedule": (ScheduleEntry(4.0, 9.0, robots_off=("robot_1",)),)},
    "newcomer": {"topology": "ring", "schedule": (ScheduleEntry(0.0, 9.0, robots_off=("robot_3",)),)},
    "different periods": {"topology": "ring", "robots": {"robot_1": {"publish_period": 3.0, "publish_phase": 1.0}}},
}  # fmt: skip


@pytest.mark.parametrize("name", RATIO_FAULTS)
def test_ratio_loses_nothing(name):
    _, tick = _run(rule="ratio", **RATIO_FAULTS[name])
    assert tick.graph.active == (0, 1, 2, 3)
    _assert_all_have_the_oracle(tick, RATIO_TOLERANCE)


def test_bayes_loses_where_links_carry_one_way_and_ratio_does_not():
    deviations = {
        rule: _from_oracle(_run(rule=rule, topology="ring", one_way=ONE_WAY_RING)[1]) for rule in ("ratio", "bayes")
    }
    assert (deviations["bayes"] > 10 * deviations["ratio"].max()).all()
    assert (deviations["bayes"] > 0.5).all()


# --- bayes and merge are warned of -----------------------------------------------------------------------------------

PAIR = FIXTURES / "pair" / "team.yaml"


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"rule": "bayes", "loss": 0.2}, "with losses it drifts from the mean; rule 'ratio' or 'flood' does not"),
        ({"rule": "bayes", "latency": 0.3}, "with maps that arrive in a later tick it drifts"),
        ({"rule": "bayes", "rate": 1e6}, "with maps that arrive in a later tick it drifts"),
        (
            {"rule": "bayes", "loss": 0.2, "latency": 0.3},
            "with losses and maps that arrive in a later tick it drifts",
        ),
        ({"rule": "bayes", "packets": "delta", "budget": 9000}, "drifts from the mean; rule 'flood' does not"),
        ({"rule": "merge"}, "rule 'merge' counts received evidence again in every tick"),
    ],
)
def test_a_run_says_what_its_rule_cannot_do(parameters, sentence):
    config = load_team_file(PAIR).with_parameters({"settle": 0, **parameters})
    summary = replay_team(config, None)
    assert sum(sentence in warning for warning in summary.warnings) == 1


@pytest.mark.parametrize("rule", ["bayes", "ratio", "flood", "gradient"])
def test_a_run_without_faults_warns_of_no_rule(rule):
    assert rule_warnings(_config(rule=rule), is_symmetric=True) == ()


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
def test_bayes_is_warned_of_by_its_cause(parameters, cause):
    (warning,) = rule_warnings(_config(rule="bayes", **parameters), is_symmetric=True)
    assert f"with {cause} it drifts" in warning
    assert rule_warnings(_config(rule="natural", **parameters), is_symmetric=True) == ()


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
def test_bayes_is_warned_of_links_that_do_not_carry_the_same_both_ways(parameters, is_symmetric):
    config = _config(rule="bayes", settle=0, **parameters)
    session = _session(config)
    for _ in session.ticks():
        pass
    assert session.is_symmetric == is_symmetric
    assert len(rule_warnings(config, session.is_symmetric)) == (not is_symmetric)


@pytest.mark.parametrize("rule", ["flood", "bayes"])
def test_what_is_stored_of_a_robot_that_forgot_is_what_it_has(rule, tmp_path):
    """A delta takes no bricks away: the first state of a new life is a whole map, and its metrics are its own."""
    schedule = (ScheduleEntry(2.0, 3.0, robots_off=("husky_1",), forget=True),)
    config = load_team_file(PAIR)
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=schedule))
    config = config.with_parameters({"rule": rule, "state_every": 1.0, "loss": 1.0, "settle": 0})
    replay_team(config, tmp_path / "result.mcap")
    with open_result(tmp_path / "result.mcap") as result:
        assert len(result.metrics) > 3
        for metrics in result.metrics:
            for robot in metrics.robots:
                stored = result.map(robot.robot_id, tick=metrics.tick).leaves()
                volume = (stored.sizes**3).sum()
                assert volume == pytest.approx(robot.observed_volume, abs=1e-6)
                assert robot.active == (metrics.tick > 0 and (robot.robot_id, metrics.tick) != ("husky_1", 2))


# --- merge -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("topology", ["complete", "line"])
@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
def test_merge_is_its_twin(mode, topology):
    config = _config(rule="merge", mode=mode, topology=topology, settle=0)
    recording = _recording()
    twin = Twin(config, recording, with_metrics=False)
    saturated = 0
    for expected, tick in itertools.zip_longest(twin.ticks(), _session(config).ticks()):
        for robot, octree in enumerate(tick.maps):
            difference = compare_map(recording.keys, expected, robot, octree.leaves(), config.map.resolution)
            assert (difference.missing, difference.spurious, difference.overlapping) == (0, 0, 0)
            assert difference.max_abs < 5e-5
        saturated = int((np.abs(expected.maps) == 5.0).any(axis=2).sum())
    # Evidence that is heard again and again saturates.
    assert saturated > 500


# --- determinism -----------------------------------------------------------------------------------------------------

RANDOM_RADIO = {"loss": 0.3, "latency": 1.1, "jitter": 0.9, "corruption": 0.1, "settle": 3, "settle_max": 5}


@pytest.mark.parametrize(
    ("rule", "packets"),
    [("flood", "delta"), ("flood", "key frames, broadcast"), ("bayes", "delta"), ("ratio", "full")],
)
def test_the_same_seed_gives_the_same_run_in_any_number_of_threads(rule, packets):
    def run(seed, num_threads):
        config = _config(rule=rule, topology="ring", network_seed=seed, **RANDOM_RADIO, **PACKETS[packets])
        return [(t.metrics, _packets(t)) for t in _session(config, num_threads).ticks()]

    one = run(0, 1)
    assert run(0, 1) == one
    assert run(0, 2) == one
    other = run(1, 1)
    assert [metrics for metrics, _ in other] != [metrics for metrics, _ in one]
    assert sum(link.num_lost for metrics, _ in one for link in metrics.links) > 5


# --- what packets hold -----------------------------------------------------------------------------------------------

LOSSY = {
    "int8": {"content": "int8"},
    "float16": {"content": "float16"},
    "top classes": {"top_classes": 2},
    "pruned": {"prune_tolerance": 0.1},
    "all": {"content": "int8", "top_classes": 2, "prune_tolerance": 0.05},
}


@pytest.mark.parametrize("packets", ["full", "delta"])
@pytest.mark.parametrize("name", LOSSY)
def test_what_packets_round_away_is_not_lost_to_the_team(name, packets):
    session = _session(_config(rule="bayes", settle_max=8, **LOSSY[name], **PACKETS[packets]))
    rounded = 0.0
    for tick in session.ticks():
        total = sum(_dense(octree) for octree in tick.maps)
        np.testing.assert_allclose(total, _evidence(session).sum(axis=0), rtol=0, atol=RATIO_TOLERANCE)
        spread = _team_sums(tick)
        rounded = max(rounded, np.abs(spread - spread[0]).max())
    assert rounded > 1e-3
    assert all(robot.agreement > 0.99 and robot.agreement_occupied > 0.99 for robot in tick.metrics.robots)


@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
@pytest.mark.parametrize("rule", ["gradient", "bayes", "natural", "merge"])
def test_deltas_give_the_very_maps_of_whole_packets(rule, mode):
    parameters = {"rule": rule, "mode": mode, "topology": "ring", "settle": 3, "settle_max": 4}
    sessions = [_session(_config(**parameters, **PACKETS[name])) for name in ("full", "delta", "key frames, broadcast")]
    for ticks in zip(*(session.ticks() for session in sessions), strict=True):
        for maps in zip(*(tick.maps for tick in ticks), strict=True):
            expected, *others = [(octree.leaves().centers.tobytes(), octree.leaves().log_odds.tobytes())
                                 for octree in maps]  # fmt: skip
            assert others == [expected, expected]
    kinds = [{codec.read_header(data).kind for data in _packets(tick)} for tick in ticks]
    assert kinds[:2] == [{codec.FULL}, {codec.DELTA}]


# --- the budget ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radio", [{}, {"loss": 0.4, "network_seed": 2}], ids=["good", "bad"])
@pytest.mark.parametrize(
    "packets", [{"budget": 2200}, {"budget": 640, "content": "int8", "int8_step": 0.1}], ids=["float32", "int8"]
)
@pytest.mark.parametrize("topology", ["complete", "line"])
def test_within_a_budget_all_evidence_floods_in_the_end(topology, packets, radio):
    session = _session(_config(rule="flood", topology=topology, packets="delta", **packets, **radio))
    whole = _session(_config(rule="flood", topology=topology))
    lag = 0.0
    for tick, at_once in itertools.zip_longest(session.ticks(), whole.ticks()):
        assert tick is not None
        messages = [m for published in tick.published if published for _, m in published.outbox]
        assert all(message.num_bytes <= packets["budget"] for message in messages)
        if at_once is not None:
            lag = max(lag, np.abs(_team_sums(tick) - _team_sums(at_once)).max())
    assert lag > 1.0 or packets["budget"] > 2000
    # All evidence of the default sensor is a multiple of 0.1, which is int8's step here.
    _assert_all_have_the_oracle(tick, 1e-4)


@pytest.mark.parametrize("rule", ["bayes", "natural", "gradient"])
@pytest.mark.parametrize("packets", [{"budget": 2200}, {"budget": 640, "content": "int8"}], ids=["float32", "int8"])
def test_a_budget_does_not_drive_maps_apart(packets, rule):
    """What waits makes the others' maps older, not wrong: nobody goes far beyond the evidence, and all come closer."""
    session = _session(_config(rule=rule, packets="delta", settle_max=50, **packets))
    peak = 0.0
    for tick in session.ticks():
        for octree in tick.maps if tick.number % 4 == 0 else ():
            assert np.abs(octree.leaves().log_odds).max(initial=0.0) < 5.0 + 0.5
        peak = max(peak, tick.metrics.total_distance_all)
    # The gradient moves what it is unsure of for long, and with it what waits.
    assert tick.metrics.total_distance_all < (0.15 if rule == "gradient" else 0.05) * peak
    assert all(robot.agreement > 0.8 for robot in tick.metrics.robots)


def test_a_budget_that_holds_no_brick_is_refused():
    for packets in ({"budget": 512}, {"budget": 512, "content": "int8"}):
        with pytest.raises(ConfigError, match=r"budget: 512 bytes may not hold one brick .* give at least \d+"):
            _session(_config(packets="delta", **packets))


# --- damage ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PACKETS)
def test_damaged_packets_are_counted_and_never_used(name):
    session = _session(_config(rule="flood", topology="ring", corruption=0.3, network_seed=1, **PACKETS[name]))
    num_damaged = 0
    history = []
    for tick in session.ticks():
        num_damaged += sum(link.num_damaged for link in tick.metrics.links)
        history.append(_evidence(session))
        for robot in session.team.robots:
            for source, held in robot.exchange.held.items():
                np.testing.assert_array_equal(_dense(held.octree), history[held.version][source.origin])
    assert num_damaged > 5
    _assert_all_have_the_oracle(tick, 1e-5)


# --- who publishes when ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["natural", "flood", "ratio"])
def test_robots_publish_when_they_are_due(rule):
    robots = {"robot_0": {"publish_period": 3.0, "publish_phase": 1.0}, "robot_1": {"publish_period": 2.0}}
    session = _session(_config(rule=rule, robots=robots, settle=3, settle_max=6))
    for tick in session.ticks():
        due = {0: tick.number % 3 == 1, 1: tick.number % 2 == 0, 2: True, 3: True}
        for index in range(4):
            is_due = due[index] and index in tick.graph.active
            assert (tick.published[index] is not None) == is_due
            sent = {link.num_sent for link in tick.metrics.links if link.sender == f"robot_{index}"}
            assert sent <= ({0, int(is_due)} if rule == "flood" else {int(is_due)})
    assert tick.number > 6


@pytest.mark.parametrize("rule", ["natural", "bayes", "flood", "ratio"])
def test_a_silent_robot_hears_and_says_nothing(rule):
    schedule = (ScheduleEntry(3.0, 9.0, robots_silent=("robot_1",)),)
    session = _session(_config(rule=rule, schedule=schedule, settle=0))
    during = None
    for tick in session.ticks():
        is_silent = 3 <= tick.number < 9
        links = tick.metrics.links
        sent = sum(link.num_sent for link in links if link.sender == "robot_1")
        heard = sum(link.num_delivered for link in links if link.receiver == "robot_1")
        if is_silent:
            assert sent == 0
            assert all(1 not in tick.graph.senders(other) for other in range(4))
        if tick.number >= 1:
            assert heard == len(tick.graph.senders(1)) > 0
            assert is_silent or sent > 0
        if tick.number == 8:
            during = _team_sums(tick)
    others = _dense(session.team.robots[0].evidence.octree) != 0
    assert np.abs(during[1] - during[0]).max() > 1.0
    assert (during[1] != 0)[others].mean() > 0.5
    if rule == "flood":
        assert _from_oracle(tick).max() < FLOOD_TOLERANCE


# --- stamps ----------------------------------------------------------------------------------------------------------


def test_frames_that_are_ages_away_end_the_run_instead_of_idle_ticks(monkeypatch):
    monkeypatch.setattr(session_module, "MAX_TICKS", 50)
    config = _config(settle=0)
    frames = [frame for frame in _scenario().frames if frame.robot_id == config.robots[0].robot_id]
    ages_later = dataclasses.replace(frames[-1], stamp_ns=START_NS + 60 * PERIOD_NS)
    sources = [FrameList((*frames, ages_later)), *(FrameList(()) for _ in config.robots[1:])]
    with pytest.raises(InputError, match=r"span more than 50 ticks of 1 s; check the stamps, or give clock"):
        list(Session(config, sources, ThreadPoolExecutor(1)).ticks())
