from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.config.presets import PRESETS
from octoreplay.errors import ConfigError, InputError
from reference import rules
from reference.hand_made import START_NS, ray, team_config
from reference.scenarios import TeamShape, make_scenario
from reference.twin import STOPPED_CONVERGED, STOPPED_MAX, STOPPED_OFF, Twin, record

HIT_CELL = (2, 0, 0)
ALL_RULES = ("gradient", "bayes", "natural", "local", "weighted")


def _run(frames, robot_ids="ab", **parameters):
    """All ticks of a hand-made team."""
    config = team_config(robot_ids, **{"rule": "gradient", **parameters})
    twin = Twin(config, record(config, frames))
    return list(twin.ticks()), twin


def _at(tick, robot, key=HIT_CELL, keys=((0, 0, 0), (1, 0, 0), (2, 0, 0))):
    """One robot's deviation from the prior in one cell of the ray's row."""
    return tick.maps[robot, keys.index(key), 1:].tolist()


@pytest.fixture(scope="module")
def small():
    """Three robots, one late and one ending early, 14 ticks, a few hundred cells: (scenario, recording)."""
    shape = TeamShape(num_robots=3, num_ticks=14, image=(10, 8), resolution=0.5, scan_period=0.4, sensors="mixed")
    scenario = make_scenario(5, shape)
    return scenario, record(scenario.config(), scenario.frames)


# --- cells and evidence ----------------------------------------------------------------------------------------------


def test_recording_lists_every_touched_cell_once():
    config = team_config("ab")
    recording = record(config, [ray("b", 1.0, 2, distance=3.0), ray("a", 0.0, 1)])
    assert recording.keys.tolist() == [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]
    assert [scan.robot for scan in recording.scans] == [0, 1]
    assert recording.scans[1].freed.tolist() == [0, 1, 2]
    assert recording.scans[1].hit.tolist() == [3]


def test_evidence_is_clamped_after_each_scan():
    # Seven hits of class 1 clamp at 5 (and -2.1); then a hit of class 2 gives 4.7 and -1.1.
    frames = [ray("a", 0.01 * i, 1) for i in range(7)] + [ray("a", 0.5, 2)]
    ticks, twin = _run(frames, "a", rule="local", settle=0)
    np.testing.assert_allclose(ticks[-1].evidence[0, 2], [0.0, 4.7, -1.1])
    np.testing.assert_allclose(twin.sums[0].total[2], [0.0, 6.7, -1.1])
    np.testing.assert_allclose(ticks[-1].evidence[0, 0], [0.0, -2.4, -2.4])


def test_hit_other_applies_to_the_other_classes_of_a_hit_cell():
    ticks, _ = _run([ray("a", 0.0, 2)], "a", rule="local", settle=0, hit_other=-0.7, miss=-0.2, hit=1.5)
    assert _at(ticks[-1], 0) == [-0.7, 1.5]
    assert _at(ticks[-1], 0, key=(1, 0, 0)) == [-0.2, -0.2]


@pytest.mark.parametrize(("model", "of_others"), [("hit", -0.7), ("tempered", -0.7 * 0.2)])
def test_hits_are_weighted_by_their_strength(model, of_others):
    sure = np.array([[51]], np.uint8)
    frames = [dataclasses.replace(ray("a", 0.0, 2), confidence_image=sure), ray("a", 0.1, 2)]
    ticks, twin = _run(frames, "a", rule="local", settle=0, hit=1.5, hit_other=-0.7, confidence_model=model)
    np.testing.assert_allclose(_at(ticks[-1], 0), [-0.7 + of_others, 1.5 + 0.3])
    assert twin.sums[0].num_touching_scans.tolist() == [2, 2, 2]


def test_average_readings_by_hand():
    # Three scans: two hit cell 2 as class 1, the third reaches cell 1 only.
    frames = [ray("a", 0.0, 1), ray("a", 0.1, 1), ray("a", 0.2, 2, distance=1.0)]
    time_average, _ = _run(frames, "a", rule="local", evidence="time-average", settle=0)
    np.testing.assert_allclose(_at(time_average[-1], 0), [2.0 / 3.0, -0.6 / 3.0])
    cell_average, _ = _run(frames, "a", rule="local", evidence="cell-average", settle=0)
    np.testing.assert_allclose(_at(cell_average[-1], 0), [1.0, -0.3])
    np.testing.assert_allclose(_at(cell_average[-1], 0, key=(1, 0, 0)), [-0.9 / 3.0, 0.4 / 3.0])


def test_averages_are_of_the_unclamped_sum():
    frames = [ray("a", 0.01 * i, 1) for i in range(20)]
    ticks, _ = _run(frames, "a", rule="local", evidence="cell-average", settle=0)
    np.testing.assert_allclose(_at(ticks[-1], 0), [1.0, -0.3])


# --- ticks -----------------------------------------------------------------------------------------------------------


def test_a_scan_on_a_tick_belongs_to_the_next_one():
    ticks, _ = _run([ray("a", 0.0, 1), ray("b", 1.0, 2), ray("a", 1.5, 1)], settle=0)
    assert [tick.stamp_ns for tick in ticks] == [START_NS, START_NS + 10**9, START_NS + 2 * 10**9]
    assert [tick.num_scans for tick in ticks] == [(0, 0), (1, 0), (2, 1)]
    assert [tick.active for tick in ticks] == [(False, False), (True, False), (True, True)]
    assert [tick.num_iterations for tick in ticks] == [(0, 0), (1, 0), (2, 1)]
    assert [tick.links for tick in ticks] == [(), (), ((0, 1),)]


def test_a_log_shorter_than_a_period_still_gives_a_map():
    ticks, _ = _run([ray("a", 0.0, 1)], "a", rule="bayes", settle=0, quantum=0.0)
    assert len(ticks) == 2
    assert _at(ticks[1], 0) == [1.0, -0.3]


def test_the_last_scan_on_a_tick_gets_one_more_tick():
    ticks, _ = _run([ray("a", 0.0, 1), ray("a", 2.0, 1)], "a", settle=0)
    assert len(ticks) == 4
    assert ticks[-1].num_scans == (2,)


def test_bayes_by_hand():
    # Tick 1: a alone has (1, -0.3). Tick 2: a adds (1, -0.3) and b (-0.3, 1), then both have the mean.
    frames = [ray("a", 0.0, 1), ray("b", 1.0, 2), ray("a", 1.5, 1)]
    ticks, _ = _run(frames, rule="bayes", settle=0, quantum=0.0)
    assert _at(ticks[1], 0) == [1.0, -0.3]
    assert _at(ticks[1], 1) == [0.0, 0.0]
    np.testing.assert_allclose(_at(ticks[2], 0), [0.85, 0.2])
    np.testing.assert_allclose(_at(ticks[2], 1), [0.85, 0.2])


def test_gradient_by_hand():
    # One class, alone: sigma = 1/2 at h = 0, s = 1, so h = gamma/4; then Delta = 1/8 - 1.
    ticks, _ = _run([ray("a", 0.0, 1), ray("a", 1.5, 0)], "a", num_classes=1, gamma=0.5, settle=0, quantum=0.0)
    assert _at(ticks[1], 0) == [0.125]
    sigma = np.exp(0.125) / (1.0 + np.exp(0.125))
    np.testing.assert_allclose(_at(ticks[2], 0), [0.125 + 0.5 * sigma * (1.0 - sigma) * 0.875])


def test_sync_mixes_maps_published_before_any_iteration():
    # natural, gamma 1/2, weights 1/2: tick 2 sees h_a = 0.5 and h_b = 0 as published: both mix to 0.25.
    frames = [ray("a", 0.0, 1), ray("b", 1.0, 1)]
    ticks, _ = _run([*frames, ray("a", 1.0, 0)], rule="natural", settle=0)
    assert _at(ticks[1], 0)[0] == 0.5
    np.testing.assert_allclose([_at(ticks[2], 0)[0], _at(ticks[2], 1)[0]], [0.25 + 0.5 * 0.75, 0.25 + 0.5 * 0.75])


def test_on_arrival_by_hand():
    # Three robots with s = 1, maps published as 0, weights 1/3, two arrivals each with gamma / 2 = 1/4:
    # h = 1/4, then mixed 1/4 - 1/3 * 1/4 = 1/6, h = 1/6 + 1/4 * 5/6 = 3/8.
    frames = [ray(robot, 0.0, 1) for robot in "abc"]
    ticks, _ = _run(frames, "abc", rule="natural", mode="on-arrival", settle=0)
    np.testing.assert_allclose([_at(ticks[1], robot)[0] for robot in range(3)], [0.375] * 3)
    assert ticks[1].num_iterations == (2, 2, 2)


def test_on_arrival_full_gamma_and_the_schedule_count_arrivals():
    # gamma_0 = 1/2, gamma_1 = 1/4: h = 1/2, mixed 1/3, h = 1/3 + 1/4 * 2/3 = 1/2.
    frames = [ray(robot, 0.0, 1) for robot in "abc"]
    ticks, _ = _run(
        frames, "abc", rule="natural", mode="on-arrival", gamma_per_arrival="full", gamma_power=1.0, settle=0
    )
    np.testing.assert_allclose([_at(ticks[1], robot)[0] for robot in range(3)], [0.5] * 3)


def test_on_arrival_bayes_takes_the_difference_of_the_published_maps():
    # Tick 2: a published 1, b and c 0, weights 1/3. a: 1 - 1/3 - 1/3; b: 1/3 from a, 0 from c.
    frames = [ray("a", 0.0, 1), ray("b", 1.0, 0), ray("c", 1.0, 0)]
    ticks, _ = _run(frames, "abc", rule="bayes", mode="on-arrival", settle=0, quantum=0.0)
    np.testing.assert_allclose([_at(ticks[2], robot)[0] for robot in range(3)], [1 / 3, 1 / 3, 1 / 3])
    assert ticks[2].num_iterations == (3, 2, 2)


def test_on_arrival_without_an_arrival_iterates_once_with_the_full_gamma():
    alone, _ = _run([ray("a", 0.0, 1)], "ab", rule="natural", mode="on-arrival", settle=0)
    assert _at(alone[1], 0)[0] == 0.5
    assert alone[1].num_iterations == (1, 0)


def test_maps_arrive_in_the_order_of_their_senders():
    # c receives a (1/2) before b (0), weights 1/3, own evidence 0, gamma 1/4: 1/2 * 1/3 * 3/4 = 1/8, then 2/3 * 3/4 of
    # it, 1/16. In the other order the result would be 1/8.
    frames = [ray("a", 0.0, 1), ray("b", 1.0, 0), ray("c", 1.0, 0)]
    ticks, _ = _run(frames, "abc", rule="natural", mode="on-arrival", settle=0)
    np.testing.assert_allclose(_at(ticks[2], 2)[0], 1 / 16)


def test_known_cells_are_those_of_own_scans_and_arrived_maps():
    # b's first tick is 2; it knows its own cell 0..1 then, and a's cell 2 since a published it in that tick.
    ticks, _ = _run([ray("a", 0.0, 1), ray("b", 1.2, 1, distance=1.0), ray("a", 3.5, 1)], settle=0)
    assert [tick.known.sum(axis=1).tolist() for tick in ticks[:3]] == [[0, 0], [3, 0], [3, 3]]
    local, _ = _run([ray("a", 0.0, 1), ray("b", 1.2, 1, distance=1.0), ray("a", 3.5, 1)], rule="local", settle=0)
    assert local[-1].known.sum(axis=1).tolist() == [3, 2]


def test_new_evidence_is_in_the_map_that_is_published_one_tick_later():
    # Both see their first scan before tick 1 and publish empty maps in it.
    ticks, _ = _run([ray("a", 0.0, 1), ray("b", 0.0, 1, distance=1.0), ray("a", 1.5, 1)], settle=0)
    assert [tick.known.sum(axis=1).tolist() for tick in ticks] == [[0, 0], [3, 2], [3, 3]]


# --- dormant robots and the end --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("after_end", "active"), [("stay", [0, 1, 1, 1, 1, 1]), ("leave", [0, 1, 1, 0, 0, 0])])
def test_a_robot_that_leaves_is_in_the_team_up_to_the_tick_after_its_last_scan(after_end, active):
    frames = [ray("a", 0.0, 1), ray("a", 1.5, 1), ray("b", 0.0, 1), ray("b", 4.5, 1)]
    ticks, _ = _run(frames, after_end=after_end, settle=0, rule="natural")
    assert [int(tick.active[0]) for tick in ticks] == active
    assert ticks[-1].num_scans == (2, 2)
    if after_end == "leave":
        assert ticks[-1].maps[0].tolist() == ticks[2].maps[0].tolist()
        assert ticks[-1].links == ()


def test_robot_without_scans_is_never_active():
    ticks, _ = _run([ray("a", 0.0, 1)], "abc", rule="bayes")
    assert not any(tick.active[1] or tick.active[2] for tick in ticks)
    assert not ticks[-1].known[1:].any()


# --- settling --------------------------------------------------------------------------------------------------------


def test_settling_uses_the_last_graph_with_a_falling_gamma():
    # One robot, natural, gamma 1/2, ramp over 2: h = 1/2, then gamma 1/4: 1/2 + 1/8, then gamma 0: no change, stop.
    ticks, twin = _run([ray("a", 0.0, 1)], "a", rule="natural", settle=2)
    assert [tick.settling for tick in ticks] == [False, False, True, True]
    np.testing.assert_allclose([_at(tick, 0)[0] for tick in ticks], [0.0, 0.5, 0.625, 0.625])
    assert [tick.tick for tick in ticks] == [0, 1, 2, 3]
    assert ticks[-1].stamp_ns == START_NS + 3 * 10**9
    assert ticks[-1].metrics.max_change == 0.0
    assert twin.stop_reason == STOPPED_CONVERGED


def test_settling_stops_at_its_maximum_and_can_be_disabled():
    frames = [ray("a", 0.0, 1)]
    ticks, twin = _run(frames, "a", rule="natural", settle_max=1)
    assert (len(ticks), twin.stop_reason) == (3, STOPPED_MAX)
    ticks, twin = _run(frames, "a", rule="natural", settle=0)
    assert (len(ticks), twin.stop_reason) == (2, STOPPED_OFF)


def test_local_is_settled_after_one_tick():
    ticks, twin = _run([ray("a", 0.0, 1)], rule="local")
    assert (len(ticks), twin.stop_reason) == (3, STOPPED_CONVERGED)


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star"])
@pytest.mark.parametrize(("rule", "flow_bits"), [("gradient", 0), ("natural", 0), ("bayes", 0), ("bayes", 4)])
def test_settling_removes_the_disagreement(small, rule, flow_bits, topology):
    scenario, recording = small
    config = scenario.config(rule=rule, topology=topology, flow_bits=flow_bits)
    ticks = list(Twin(config, recording).ticks())
    peak, last = max(tick.metrics.total_distance_all for tick in ticks), ticks[-1].metrics
    if flow_bits:
        # Root mean square per known cell and pair.
        assert last.total_distance_all < 1e-3**2 * 3 * last.num_known_cells
    else:
        assert last.total_distance_all < 1e-9 * peak
    assert last.label_disagreement < 0.01


# --- invariants ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("topology", ["complete", "ring", "line", "star"])
@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
@pytest.mark.parametrize("evidence", ["sum", "time-average", "cell-average"])
def test_bayes_conserves_the_mean_of_the_maps(small, evidence, mode, topology):
    scenario, recording = small
    config = scenario.config(rule="bayes", mode=mode, topology=topology, evidence=evidence)
    tick = None
    for tick in Twin(config, recording, with_metrics=False).ticks():
        np.testing.assert_allclose(tick.maps.mean(axis=0), tick.evidence.mean(axis=0), atol=1e-12)
    assert tick.active == (True, True, True)
    np.testing.assert_allclose(3 * tick.maps[0], tick.oracle, atol=1e-4)


@pytest.mark.parametrize("rule", ALL_RULES)
@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
def test_one_robot_alone_ends_at_its_own_evidence(small, rule, mode):
    scenario, _ = small
    config = dataclasses.replace(
        scenario.config(rule=rule, mode=mode, gamma=1.0), robots=scenario.base_config.robots[:1]
    )
    own = [frame for frame in scenario.frames if frame.robot_id == scenario.robot_ids[0]]
    ticks = list(Twin(config, record(config, own)).ticks())
    distance = [np.abs(tick.maps[0] - tick.evidence[0]).max() for tick in ticks[-20:]]
    assert ticks[-1].num_iterations[0] == len(ticks) - 1
    assert ticks[-1].links == ()
    assert distance[-1] <= distance[0] + 1e-12
    if rule in ("bayes", "local"):
        assert distance[-1] < 1e-12
    if rule == "natural":
        assert distance[-1] < 1e-4


def test_mean_of_the_oracle_is_a_fixed_point_of_gradient_with_equal_evidence():
    frames = [ray(robot, 0.0, 1) for robot in "abc"]
    ticks, _ = _run(frames, "abc", num_classes=1, gamma=1.0, settle=2000, settle_tolerance=1e-14)
    np.testing.assert_allclose(3 * ticks[-1].maps[:, 2, 1], ticks[-1].oracle[2, 1], atol=1e-6)
    assert min(ticks[-1].metrics.agreement) == 1.0


def test_rules_act_on_the_deviation_from_the_prior(small):
    scenario, recording = small
    for rule in ALL_RULES:
        uniform = list(Twin(scenario.config(rule=rule), recording, with_metrics=False).ticks())[-1]
        with_prior = list(Twin(scenario.config(rule=rule, prob_free=0.4), recording, with_metrics=False).ticks())[-1]
        np.testing.assert_array_equal(uniform.maps, with_prior.maps)
        expected = uniform.log_odds(1) + np.log(0.6 / 5 / 0.4)
        np.testing.assert_allclose(with_prior.log_odds(1), expected)


def test_unknown_cells_have_the_prior(small):
    scenario, recording = small
    for rule in ALL_RULES:
        for tick in Twin(scenario.config(rule=rule, topology="line"), recording, with_metrics=False).ticks():
            assert not tick.maps[~tick.known].any()


def test_the_papers_preset_runs(small):
    scenario, recording = small
    ticks = list(Twin(scenario.config(**PRESETS["paper"]), recording).ticks())
    assert not any(tick.settling for tick in ticks)
    assert 0.0 < np.abs(ticks[-1].maps).max() < 1.0


# --- faults that the comparison must detect ---------------------------------------------------------------------------


def _wrong_sign(monkeypatch):
    right = rules.mix
    monkeypatch.setattr(rules, "mix", lambda own, differences, epsilon: right(own, differences, -0.1 * epsilon))


def _wrong_gradient_sign(monkeypatch):
    right = rules.gradient_step
    monkeypatch.setattr(rules, "gradient_step", lambda mixed, log_q, gamma: right(mixed, log_q, -0.1 * gamma))


def _free_is_not_reset(monkeypatch):
    monkeypatch.setattr(rules, "free_is_zero", lambda log_odds: log_odds)


def _current_maps_in_place_of_published_ones(monkeypatch):
    right = Twin._iterate_robot

    def wrong(self, robot, exchange, stage):
        right(self, robot, dataclasses.replace(exchange, published=self.maps), stage)

    monkeypatch.setattr(Twin, "_iterate_robot", wrong)


def _old_evidence(monkeypatch):
    right = rules.with_evidence
    monkeypatch.setattr(rules, "with_evidence", lambda log_odds, now, before: right(log_odds, now, 0.999 * before))


@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
@pytest.mark.parametrize(
    ("rule", "fault"),
    [("gradient", _wrong_sign), ("natural", _wrong_sign), ("bayes", _wrong_sign), ("gradient", _wrong_gradient_sign),
     ("gradient", _free_is_not_reset), ("gradient", _current_maps_in_place_of_published_ones),
     ("natural", _current_maps_in_place_of_published_ones), ("bayes", _current_maps_in_place_of_published_ones),
     ("bayes", _old_evidence)],
)  # fmt: skip
def test_faults_change_maps_far_beyond_the_tolerance_of_a_comparison(small, monkeypatch, rule, fault, mode):
    scenario, recording = small
    config = scenario.config(rule=rule, mode=mode, settle=0, quantum=0.0)
    good = list(Twin(config, recording, with_metrics=False).ticks())[-1]
    fault(monkeypatch)
    bad = list(Twin(config, recording, with_metrics=False).ticks())[-1]
    difference = np.abs(good.maps[..., 1:] - bad.maps[..., 1:]).max(axis=2)
    assert difference.max() > 100 * 5e-5
    assert (difference > 5e-5).mean() > 0.2


# --- bad input -------------------------------------------------------------------------------------------------------


def test_invalid_input_is_refused():
    frames = [ray("a", 0.0, 1)]
    with pytest.raises(InputError, match="no frames"):
        record(team_config(), [])
    with pytest.raises(InputError, match="robot 'z' is not in the team"):
        record(team_config(), [ray("z", 0.0, 1)])
    with pytest.raises(ConfigError, match="class table"):
        record(dataclasses.replace(team_config(), classes=None), frames)
    with pytest.raises(ConfigError, match="lossless"):
        _run(frames, prune_tolerance=0.1)
    with pytest.raises(ConfigError, match="bound"):
        _run(frames, epsilon=1.5)
