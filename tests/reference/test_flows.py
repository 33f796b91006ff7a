"""Flows of the rule bayes: conservation, decrease, rest and settling."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from octoreplay.config.network import ScheduleEntry
from reference import flows, graph, rules
from reference.evidence import Evidence, IndexedScan
from reference.hand_made import ray, team_config
from reference.random_teams import NUM_CELLS, NUM_CLASSES, random_config, random_recording
from reference.twin import STOPPED_CONVERGED, STOPPED_MAX, Twin, record
from support.long_suite import examples, long

QUANTUM = 2.0**-16

units = arrays(np.int64, (4, 3), elements=st.integers(-(2**20), 2**20) | st.integers(-9, 9))
log_odds = units.map(lambda numbers: rules.free_is_zero(numbers * QUANTUM))
weights = st.floats(1e-3, 0.99)
bits = st.integers(1, 20)


# --- one flow --------------------------------------------------------------------------------------------------------


def test_a_step_is_a_power_of_two_below_the_largest_log_odds_of_both():
    own = np.array([[0.0, 3.9, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 2.0**-16, 0.0]])
    other = np.array([[0.0, 0.0, -4.0], [0.0, -3.9, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    expected = [[4.0 / 16], [2.0 / 16], [QUANTUM], [QUANTUM]]
    assert flows.flow_steps(own, other, 4, QUANTUM).tolist() == expected
    assert flows.flow_steps(own, other, 18, QUANTUM).tolist() == [[QUANTUM]] * 4
    assert flows.flow_steps(own, other, 17, QUANTUM)[0].tolist() == [2 * QUANTUM]


def test_a_flow_is_rounded_towards_zero():
    own, other = np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, 2.9, -1.9]])
    steps = np.array([[0.5]])
    assert flows.flow(own, other, 0.5, steps).tolist() == [[0.0, 0.5, -0.5]]
    assert flows.flow(own, other, 0.2, steps).tolist() == [[0.0, 0.0, 0.0]]


def test_a_link_of_small_weight_has_more_bits():
    weights = [0.9, 1 / 7, 1 / 8, 1 / 9, 1 / 16, 1 / 17, 1 / 32, 1 / 64]
    assert [flows.link_bits(weight) for weight in weights] == [0, 0, 0, 1, 1, 2, 2, 3]


@pytest.mark.parametrize("num_robots", [2, 6, 8, 9, 16, 33, 128])
def test_evidence_of_one_robot_reaches_all_others_on_a_complete_graph(num_robots):
    own, others = np.array([[0.0, -0.3, -0.3]]), np.zeros((1, 3))
    weight = 1 / num_robots
    steps = flows.flow_steps(own, others, 4 + flows.link_bits(weight), QUANTUM)
    amount = flows.flow(others, own, weight, steps)
    # A step is at most a third of the flow that it rounds.
    np.testing.assert_allclose(amount, weight * own, rtol=0.34)
    assert amount[0, 1] < 0


@examples(200)
@given(own=log_odds, other=log_odds, weight=weights, flow_bits=bits)
def test_flows_are_antisymmetric_multiples_of_the_step(own, other, weight, flow_bits):
    steps = flows.flow_steps(own, other, flow_bits, QUANTUM)
    there = flows.flow(own, other, weight, steps)
    np.testing.assert_array_equal(steps, flows.flow_steps(other, own, flow_bits, QUANTUM))
    np.testing.assert_array_equal(there, -flows.flow(other, own, weight, steps))
    assert not (there % steps).any()
    # The product is float32, as the definition says.
    unrounded = (np.float32(weight) * (other - own).astype(np.float32)).astype(np.float64)
    assert (np.abs(there) <= np.abs(unrounded)).all()
    assert (np.abs(unrounded - there) < steps).all()


@examples(200)
@given(own=log_odds, other=log_odds, weight=weights, flow_bits=bits)
def test_a_flow_that_is_not_0_lowers_the_sum_of_squares(own, other, weight, flow_bits):
    amount = flows.flow(own, other, weight, flows.flow_steps(own, other, flow_bits, QUANTUM))
    before, after = _squares(np.array([own, other])), _squares(np.array([own + amount, other - amount]))
    assert after < before if amount.any() else after == before


@examples(200)
@given(own=log_odds, other=log_odds, gate=st.sampled_from([0.0, 0.25, 0.5, 1.0]))
def test_the_gate_is_the_same_at_both_ends(own, other, gate):
    blocks = np.array([0, 0, 1, 1])
    here = flows.is_held_back(own, other, blocks, gate)
    np.testing.assert_array_equal(here, flows.is_held_back(other, own, blocks, gate))
    np.testing.assert_array_equal(here[::2], here[1::2])
    if gate == 0.0:
        np.testing.assert_array_equal(here[:, 0], np.repeat((own == other).all(axis=1).reshape(2, 2).all(axis=1), 2))


def test_a_gate_opens_for_labels_and_for_differences():
    own = np.array([[0.0, 1.0, 0.5], [0.0, 1.0, 0.5], [0.0, 1.0, 0.5], [0.0, -1.0, -1.0], [0.0, 0.0, 0.0]])
    other = np.array([[0.0, 1.0, 1.5], [0.0, 2.0, 1.0], [0.0, 2.0, 1.1], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    each = np.arange(5)
    # Cell 0 has other labels. The others differ by 1/2, 1/2, 1 and 0 of the largest.
    assert flows.is_held_back(own, other, each, 0.5)[:, 0].tolist() == [False, False, False, False, True]
    assert flows.is_held_back(own, other, each, 0.75)[:, 0].tolist() == [False, True, True, False, True]
    assert flows.is_held_back(own, other, each // 2, 0.75)[:, 0].tolist() == [False, False, False, False, True]


# --- teams -----------------------------------------------------------------------------------------------------------


def check_conservation(config, recording):
    """Check that sum_i h_i = sum_i s_i exactly in every tick, in multiples of the quantum."""
    quantum = config.consensus.effective_quantum
    tick = None
    for tick in Twin(config, recording, with_metrics=False).ticks():
        assert not (tick.maps % quantum).any()
        np.testing.assert_array_equal(tick.maps.sum(axis=0), tick.evidence.sum(axis=0))
    return tick


def random_team(seed, num_robots, num_ticks, *, last_evidence=None, **options):
    """Return the configuration and the recording of a random team with rule bayes and flows."""
    rng = np.random.default_rng(seed)
    recording = random_recording(rng, num_robots, num_ticks, last_evidence or num_ticks - 2)
    parameters = {"rule": "bayes", "flow_bits": int(rng.integers(1, 9)), "settle": 0, **options}
    has_failures = parameters.pop("has_failures", True)
    config = random_config(rng, num_robots, num_ticks, has_failures=has_failures, **parameters)
    return config, recording


@long
@examples(50)
@given(
    seed=st.integers(0, 2**32),
    num_robots=st.integers(2, 6),
    mode=st.sampled_from(["sync", "on-arrival"]),
    quantum=st.sampled_from([2.0**-16, 2.0**-12, 2.0**-6]),
    gate=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_the_sum_of_the_maps_is_the_sum_of_the_evidence_in_every_tick(seed, num_robots, mode, quantum, gate):
    config, recording = random_team(seed, num_robots, 220, mode=mode, quantum=quantum, flow_gate=gate)
    tick = check_conservation(config, recording)
    assert tick.tick == 219
    assert tick.maps.any()


@long
@examples(24)
@given(seed=st.integers(0, 2**32), num_robots=st.integers(2, 5))
def test_a_team_at_rest_with_a_gate_has_the_labels_of_its_evidence(seed, num_robots):
    """Classes that are the largest in all maps are the largest in their sum, which is that of the evidence."""
    config, recording = random_team(
        seed, num_robots, 400, last_evidence=10, has_failures=False, flow_bits=20, flow_gate=1.0
    )
    before = None
    for tick in Twin(config, recording, with_metrics=False).ticks():
        is_at_rest = before is not None and (tick.maps == before).all()
        before = tick.maps
    assert is_at_rest
    is_largest = tick.maps == tick.maps.max(axis=-1, keepdims=True)
    is_common = (is_largest == is_largest[0]).all(axis=(0, 2))
    if all(tick.active):
        assert is_common.any()
        total = tick.evidence.sum(axis=0)
        lacks = total.max(axis=-1, keepdims=True) - total
        assert not lacks[is_common][is_largest[0][is_common]].any()
    # Labels differ where the flows are below the quantum.
    team = graph.team_graph(config.network, config.consensus, [r.robot_id for r in config.robots], tick.active)
    for i, j in np.argwhere(team.weights > 0).tolist():
        differs = (is_largest[i] != is_largest[j]).any(axis=-1)
        amounts = 2.0 * team.epsilon * team.weights[i, j] * (tick.maps[j] - tick.maps[i])[differs]
        assert np.abs(amounts).max(initial=0.0) < QUANTUM


@long
@pytest.mark.parametrize("seed", range(2))
def test_the_sum_is_exact_after_ten_thousand_ticks(seed):
    config, recording = random_team(seed, 4, 10_000)
    assert check_conservation(config, recording).tick == 9_999


@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
def test_the_sum_is_exact_while_settling_and_with_a_period_of_three_ticks(mode):
    config, recording = random_team(3, 4, 60, mode=mode, settle=20, settle_max=30)
    robots = tuple(dataclasses.replace(r, publish_period=3.0, publish_phase=1.0) for r in config.robots)
    config = dataclasses.replace(config, robots=robots)
    assert check_conservation(config, recording).settling


@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
def test_a_link_that_carries_in_one_direction_mixes_without_flows(mode):
    # b takes half of its distance to a; a receives nothing.
    config = team_config("ab", rule="bayes", mode=mode, settle=0)
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, one_way=(("a", "b"),)))
    frames = [ray("a", 0.0, 1), ray("b", 0.0, 2)]
    tick = list(Twin(config, record(config, frames)).ticks())[-1]
    hit, miss = config.effective_sensor.hit, config.effective_sensor.miss
    assert tick.maps[0, 2].tolist() == [0.0, hit, miss]
    np.testing.assert_allclose(tick.maps[1, 2], [0.0, (hit + miss) / 2, (hit + miss) / 2], rtol=1e-12)


def test_a_neighbour_that_does_not_publish_mixes_without_flows():
    # b publishes in even ticks. In tick 1 it takes a third of a, unrounded; in tick 2 both take the same flow.
    robots = {"b": {"publish_period": 2.0}}
    config = team_config("ab", rule="bayes", settle=0, weights="metropolis", epsilon=1.0 / 3.0)
    config = dataclasses.replace(
        config, robots=tuple(dataclasses.replace(r, **robots.get(r.robot_id, {})) for r in config.robots)
    )
    frames = [ray("a", 0.0, 1), ray("b", 0.0, 0), ray("a", 1.5, 0)]
    first, second = list(Twin(config, record(config, frames)).ticks())[1:3]
    assert first.maps[:, 2, 1].tolist() == [1.0, pytest.approx(1.0 / 3.0, rel=1e-12)]
    # m = 1, e = 1/16, w (h_b - h_a) = -2/9 = -3.6 e.
    np.testing.assert_allclose(second.maps[:, 2, 1], [1.0 - 3 / 16, 1.0 / 3.0 + 3 / 16], rtol=1e-12)


def check_squares_fall(config, recording):
    """Check that the sum of squares falls in every tick without new evidence in which a map changes."""
    num_falls = 0
    for before, after in itertools.pairwise(Twin(config, recording, with_metrics=False).ticks()):
        if (before.evidence == after.evidence).all():
            has_changed = bool((before.maps != after.maps).any())
            num_falls += has_changed
            fall = _squares(before.maps) - _squares(after.maps)
            assert fall > 0 if has_changed else fall == 0
    return num_falls


@examples(25)
@given(seed=st.integers(0, 2**32), num_robots=st.integers(2, 6), mode=st.sampled_from(["sync", "on-arrival"]))
def test_the_sum_of_squares_falls_until_the_maps_rest(seed, num_robots, mode):
    config, recording = random_team(seed, num_robots, 60, last_evidence=20, mode=mode)
    check_squares_fall(config, recording)


def check_rest(config, recording):
    """Check that the maps come to rest, and that neighbours then differ by less than e / (2 epsilon A_ij)."""
    *_, before, last = Twin(config, recording, with_metrics=False).ticks()
    assert (before.maps == last.maps).all()
    team = graph.team_graph(config.network, config.consensus, [r.robot_id for r in config.robots], last.active)
    settled = 100 if last.settling else 0
    num_bits, quantum = config.effective_flow_bits + settled, config.consensus.effective_quantum
    for i, j in last.links:
        steps = flows.flow_steps(last.maps[i], last.maps[j], num_bits, quantum)
        bound = steps / (2.0 * team.epsilon * team.weights[i, j])
        assert (np.abs(last.maps[i] - last.maps[j]) < bound).all()
    return last


@examples(25)
@given(seed=st.integers(0, 2**32), num_robots=st.integers(2, 5))
def test_neighbours_at_rest_differ_by_less_than_the_bound(seed, num_robots):
    config, recording = random_team(seed, num_robots, 150, last_evidence=20, has_failures=False, quantum=2.0**-8)
    last = check_rest(config, recording)
    assume(all(last.active))
    assert last.links


@examples(10)
@given(seed=st.integers(0, 2**32), num_robots=st.integers(2, 5))
def test_settled_neighbours_differ_by_less_than_the_bound_of_the_quantum(seed, num_robots):
    config, recording = random_team(
        seed, num_robots, 30, last_evidence=20, has_failures=False, settle=5, settle_max=500, flow_bits=2
    )
    assert check_rest(config, recording).settling


@examples(25)
@given(seed=st.integers(0, 2**32), num_robots=st.integers(3, 6))
def test_labels_of_a_settled_team_differ_at_ties_only(seed, num_robots):
    config, recording = random_team(
        seed, num_robots, 15, has_failures=False, settle=5, settle_max=500, quantum=2.0**-5, epsilon=0.2
    )
    *_, last = Twin(config, recording).ticks()
    assume(all(last.active))
    assert last.metrics.label_disagreement == 0.0


# --- without flows ---------------------------------------------------------------------------------------------------


@examples(25)
@given(seed=st.integers(0, 2**32), off=st.sampled_from([{"flow_bits": 0}, {"quantum": 0.0}]))
def test_without_flows_maps_mix_linearly(seed, off):
    config, recording = random_team(seed, 4, 40, **off)
    maps = np.zeros((4, NUM_CELLS, NUM_CLASSES + 1))
    evidence = np.zeros_like(maps)
    robot_ids = [robot.robot_id for robot in config.robots]
    for tick in Twin(config, recording, with_metrics=False).ticks():
        team = graph.team_graph(config.network, config.consensus, robot_ids, tick.active, float(tick.tick))
        step = np.eye(4) - 2.0 * team.epsilon * graph.laplacian(team.weights)
        maps = np.einsum("ij,jmc->imc", step, maps + tick.evidence - evidence)
        evidence = tick.evidence
        np.testing.assert_allclose(tick.maps, maps, atol=1e-12)


def test_one_robot_alone_has_its_evidence_in_every_tick():
    recording = random_recording(np.random.default_rng(0), 1, 40, 38)
    config = team_config("a", NUM_CLASSES, rule="bayes")
    for tick in Twin(config, recording, with_metrics=False).ticks():
        np.testing.assert_array_equal(tick.maps, tick.evidence)


# --- evidence --------------------------------------------------------------------------------------------------------


def test_evidence_is_published_in_the_tick_that_integrates_it():
    # Weights 1/2, difference 1.3: flows of 0.65 in steps of 1/16 are 10/16.
    ticks, _ = _run([ray("a", 0.0, 1), ray("b", 0.0, 2)], settle=0)
    effective = team_config(rule="bayes").effective_sensor
    moved = 10 / 16
    assert ticks[1].known.all()
    assert ticks[1].maps[0, 2].tolist() == [0.0, effective.hit - moved, effective.miss + moved]
    assert ticks[1].maps[1, 2].tolist() == [0.0, effective.miss + moved, effective.hit - moved]
    published = 2 * (effective.hit - effective.miss) ** 2
    assert ticks[1].metrics.total_distance_published == published
    assert ticks[1].metrics.total_distance == pytest.approx(2 * (effective.hit - effective.miss - 2 * moved) ** 2)


def test_evidence_enters_the_map_of_a_robot_that_is_off():
    config = team_config("ab", rule="bayes", settle=0)
    schedule = (ScheduleEntry(2.0, 4.0, robots_off=("b",)),)
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=schedule))
    # The scan at 1.5 s enters in tick 2, the one at 2.5 s is left out.
    frames = [ray("a", 0.0, 0), ray("b", 1.5, 1), ray("b", 2.5, 1), ray("a", 3.5, 0)]
    ticks = list(Twin(config, record(config, frames)).ticks())
    assert [tick.active for tick in ticks] == [
        (False, False),
        (True, False),
        (True, False),
        (True, False),
        (True, True),
    ]
    assert [tick.maps[1, 2, 1] for tick in ticks[:4]] == [0.0, 0.0, 1.0, 1.0]
    assert ticks[2].known[1].all()
    assert [tick.maps[0, 2, 1] for tick in ticks] == [0.0, 0.0, 0.0, 0.0, 0.5]
    assert ticks[4].maps[1, 2, 1] == 0.5


def test_uncertain_hits_are_rounded_to_the_quantum():
    strengths = np.array([255, 200, 100, 1])
    scan = IndexedScan(0, 0, np.zeros(0, int), np.arange(4), np.ones(4, int), strengths)
    config = team_config(rule="bayes", quantum=2.0**-4, hit=1.3, clamp_max=10.0)
    sums = Evidence(4, 2, config.consensus.effective_quantum)
    sums.integrate(scan, config.effective_sensor)
    # 1.3 is 21 / 16; 21 x 200 / 255 = 16.5 - 0.03, 21 x 100 / 255 = 8.2, 21 / 255 = 0.1.
    assert (16 * sums.clamped[:, 1]).tolist() == [21.0, 16.0, 8.0, 0.0]
    # -0.3 is -5 / 16; 5 x 200 / 255 = 3.9, 5 x 100 / 255 = 2.0, 5 / 255 = 0.02.
    assert (16 * sums.clamped[:, 2]).tolist() == [-5.0, -4.0, -2.0, 0.0]


# --- settling --------------------------------------------------------------------------------------------------------


def test_flow_bits_grow_by_two_in_every_settling_tick():
    # 2 <= L < 4 and 4 bits: 13 more bits until the step is the quantum 2^-16, so 7 settling ticks at least.
    frames = [ray("a", 0.01 * i, 1) for i in range(9)] + [ray("b", 0.5, 2)]
    ticks, twin = _run(frames)
    settling = [tick for tick in ticks if tick.settling]
    assert twin.stop_reason == STOPPED_CONVERGED
    assert len(settling) >= 7
    assert np.abs(settling[-1].maps[0] - settling[-1].maps[1]).max() < 2 * QUANTUM
    # Between two robots, w = 1/2: each tick leaves less than twice its step 2^(2 - bits), with |h| below 4.
    assert np.abs(ticks[1].maps).max() < 4.0
    for number, tick in enumerate(settling, start=1):
        step = max(2.0 ** (1 - 4 - 2 * number), QUANTUM)
        assert np.abs(tick.maps[0] - tick.maps[1]).max() < 2 * step


def test_a_coarse_rest_does_not_end_settling():
    # |h| is at most 1, so the step is 1/16 in the log, and the differences left are below 1/8; 2^-16 takes 12 bits.
    ticks, twin = _run([ray("a", 0.0, 1), ray("b", 0.0, 2), ray("a", 4.5, 0)], settle_tolerance=0.5)
    assert (ticks[-8].maps != ticks[-1].maps).any()
    assert sum(tick.settling for tick in ticks) >= 6
    assert twin.stop_reason == STOPPED_CONVERGED


@pytest.mark.parametrize(
    ("largest", "flow_bits", "expected"),
    [
        (0.0, 4, 0), (2.0**-12, 4, 0), (2.0**-11, 4, 1), (3.999, 4, 7), (4.0, 4, 7), (8.0, 4, 8), (8.0, 0, 0),
        (1e9, 4, 21),
    ],
)  # fmt: skip
def test_the_number_of_finer_ticks_is_the_least_whose_step_is_the_quantum(largest, flow_bits, expected):
    maps = np.zeros((2, 3, 4))
    maps[1, 2, 3] = -largest
    assert flows.num_finer_ticks(maps, flow_bits, QUANTUM) == expected


def test_the_default_of_settle_max_has_more_ticks_with_flows():
    # lambda_2 = 0.8: 1 + ceil(12 / -log10 0.8) ticks. Neither run comes to rest in them. |h| is 0.875 at most, so that
    # (49 - 20 - 1) / 2 ticks are finer.
    slow = {"epsilon": 0.1, "settle": 1, "settle_tolerance": 1e-15, "flow_bits": 20}
    frames = [ray("a", 0.0, 1), ray("b", 0.0, 2)]
    for quantum, expected in ((0.0, 125), (2.0**-49, 125 + 14)):
        ticks, twin = _run(frames, quantum=quantum, **slow)
        assert sum(tick.settling for tick in ticks) == expected
        assert twin.stop_reason == STOPPED_MAX


# --- faults that the properties must detect --------------------------------------------------------------------------


def _rounded_at_one_end(monkeypatch):
    right = flows.flow

    def wrong(own, other, weight, steps):
        exact = weight * (other - own)
        return np.where(exact > 0, np.ceil(exact / steps) * steps, right(own, other, weight, steps))

    monkeypatch.setattr(flows, "flow", wrong)


def _step_of_one_robot(monkeypatch):
    right = flows.flow_steps
    monkeypatch.setattr(flows, "flow_steps", lambda own, other, flow_bits, quantum: right(own, own, flow_bits, quantum))


def _rounded_to_nearest(monkeypatch):
    monkeypatch.setattr(
        flows, "flow", lambda own, other, weight, steps: np.rint(weight * (other - own) / steps) * steps
    )


@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
@pytest.mark.parametrize("fault", [_rounded_at_one_end, _step_of_one_robot])
def test_conservation_detects_faults(monkeypatch, fault, mode):
    teams = [random_team(seed, 3, 40, mode=mode) for seed in range(5)]
    fault(monkeypatch)
    for config, recording in teams:
        with pytest.raises(AssertionError):
            check_conservation(config, recording)


def test_the_sum_of_squares_detects_rounding_to_nearest(monkeypatch):
    # 2 epsilon A_ij = 0.9: a difference of one step moves to the other end, for ever.
    teams = [random_team(seed, 2, 60, last_evidence=20, has_failures=False, epsilon=0.9) for seed in range(5)]
    _rounded_to_nearest(monkeypatch)
    for config, recording in teams:
        with pytest.raises(AssertionError):
            check_squares_fall(config, recording)


def _squares(maps):
    """Sum of squares in units of the quantum squared, exactly."""
    return int((np.rint(maps / QUANTUM).astype(np.int64) ** 2).sum())


def _run(frames, **parameters):
    """All ticks of two robots with rule bayes."""
    config = team_config("ab", rule="bayes", **parameters)
    twin = Twin(config, record(config, frames))
    return list(twin.ticks()), twin
