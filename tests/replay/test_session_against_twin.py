"""Sessions on octrees against the reference twin."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from octoreplay.config.presets import PRESETS
from octoreplay.records import CloudFrame
from octoreplay.replay.robots import consensus as consensus_module
from octoreplay.replay.session import Session
from reference.hand_made import cloud, ray, team_config
from reference.scenarios import TeamShape
from support.long_suite import long, one_in
from support.scans import with_confidences
from support.sessions import sent_packets
from support.twin_comparison import SMALL, compare, compare_frames, scenario_of, sources_of, unrounded

RULES = ("gradient", "bayes", "natural", "local", "weighted")
MODES = ("sync", "on-arrival")
TOPOLOGIES = ("complete", "ring", "line", "star", "edges")
FOUR = TeamShape(num_robots=4, sensors="mixed")
SIX = TeamShape(num_robots=6, scan_period=0.8, sensors="mixed")


@long
@pytest.mark.parametrize(
    ("rule", "mode", "topology"),
    [
        ("gradient", "sync", "ring"), ("gradient", "on-arrival", "edges"), ("bayes", "sync", "edges"),
        ("bayes", "on-arrival", "line"), ("natural", "sync", "star"), ("natural", "on-arrival", "complete"),
        ("local", "sync", "complete"), ("local", "on-arrival", "ring"),
    ],
)  # fmt: skip
def test_four_robots(rule, mode, topology):
    with_metrics = (rule, mode) == ("gradient", "sync")
    outcome = compare(FOUR, topology=topology, rule=rule, mode=mode, settle=0, every=25, with_metrics=with_metrics)
    assert outcome.num_ticks >= 100
    assert len(outcome.twin_tick.oracle) >= 20_000
    assert outcome.num_compared_maps >= 20


@long
@pytest.mark.parametrize(
    ("rule", "mode", "topology"),
    [("gradient", "sync", "complete"), ("bayes", "on-arrival", "ring"), ("natural", "sync", "line")],
)
def test_six_robots(rule, mode, topology):
    outcome = compare(SIX, topology=topology, rule=rule, mode=mode, settle=0, every=40)
    assert outcome.num_ticks >= 100
    assert len(outcome.twin_tick.oracle) >= 20_000
    saturated = (np.abs(outcome.twin_tick.evidence[..., 1:]) >= 5.0).any(axis=2)
    assert (saturated.sum(axis=1) > 250).all()
    assert (outcome.twin_tick.known.sum(axis=0) >= 2).mean() > 0.3


@long
@pytest.mark.parametrize(("gate", "mode", "topology"), one_in(8, [0.5, 1.0], MODES, ["line", "star"]))
def test_flows_with_a_gate(gate, mode, topology):
    outcome = compare(
        SMALL, rule="bayes", mode=mode, topology=topology, flow_gate=gate, flow_bits=6, every=5, with_metrics=True
    )
    assert outcome.twin_tick.settling


@pytest.mark.parametrize("mode", MODES)
def test_flows_over_links_of_small_weight(mode):
    compare(SMALL, rule="bayes", mode=mode, topology="complete", epsilon=0.05, settle=0, every=1)


@pytest.mark.parametrize(("rule", "mode", "topology"), one_in(13, RULES, MODES, TOPOLOGIES))
def test_every_rule_mode_and_topology(rule, mode, topology):
    """The tolerance is far above the rounding of float32, so that both stop settling in the same tick."""
    outcome = compare(
        SMALL, topology=topology, rule=rule, mode=mode, settle=6, settle_tolerance=1e-3, every=4, with_metrics=True
    )
    assert outcome.num_settling_ticks >= 1
    assert outcome.num_compared_maps >= 4 * 6
    if rule != "local":
        assert outcome.tick.metrics.total_distance_all < 1e-3 * outcome.peak_all


@pytest.mark.parametrize(("settle_max", "num_settling_ticks"), [(7, 7), (1, 1)])
def test_settling_ends_at_its_maximum(settle_max, num_settling_ticks):
    outcome = compare(SMALL, topology="line", rule="natural", settle=5, settle_max=settle_max)
    assert outcome.num_settling_ticks == num_settling_ticks


@pytest.mark.parametrize(
    ("rule", "mode", "topology"), one_in(5, ["gradient", "natural"], MODES, ["ring", "line", "complete"])
)
def test_maps_rounded_to_the_quantum(rule, mode, topology):
    """Near the middle of two multiples float32 and float64 round apart; the rule's contraction keeps that small."""
    quantum = 2.0**-10
    outcome = compare(
        SMALL, topology=topology, rule=rule, mode=mode, settle=0, every=1, quantum=quantum, tolerance=4.5 * quantum
    )
    assert outcome.num_compared_maps >= 4 * 16


@pytest.mark.parametrize(("rule", "evidence", "mode"), one_in(7, RULES, ["time-average", "cell-average"], MODES))
def test_average_readings(rule, evidence, mode):
    compare(SMALL, topology="line", rule=rule, mode=mode, evidence=evidence, settle=0, with_metrics=True, every=5)


@pytest.mark.parametrize("rule", RULES)
def test_a_prior(rule):
    prior = {"prob_free": 0.35}
    outcome = compare(SMALL, topology="ring", rule=rule, settle=0, with_metrics=True, every=5, sensor_parameters=prior)
    assert outcome.twin_tick.prior == pytest.approx(np.log(0.65 / 5 / 0.35))


SENSOR_VARIANTS = {
    "height band": {"bounds": (-0.3, 0.7)},
    "box": {"bounds": (-2.1, -1.3, -0.5, 3.0, 2.6, 1.0)},
    "one ray per point": {"rays": "all"},
    "one ray per point in a box": {"rays": "all", "bounds": (-2.0, -1.4, -0.4, 3.0, 2.4, 1.0)},
    "increments": {"hit": 1.7, "miss": -0.45, "hit_other": -0.9},
    "tight clamping": {"clamp_min": -0.5, "clamp_max": 1.5},
    "no clamping": {"clamp_min": -1e9, "clamp_max": 1e9},
    "no free space": {"miss": 0.0, "hit_other": -0.2},
    "long minimum": {"min_range": 1.5, "max_range": 3.1},
    "no return": {"no_return_depth": (65535.0,)},
    "invalid": {"invalid_depth": (0.0, 1234.0)},
    "fine": {"resolution": 0.13},
    "coarse": {"resolution": 1.0},
}


@pytest.mark.parametrize(("rule", "variant"), one_in(7, ["gradient", "bayes"], SENSOR_VARIANTS))
def test_sensor_models(variant, rule):
    outcome = compare(SMALL, rule=rule, settle=0, every=8, sensor_parameters=SENSOR_VARIANTS[variant])
    assert outcome.twin_tick.known.any()


@pytest.mark.parametrize(
    ("model", "rule", "evidence"),
    one_in(3, ["none", "hit", "tempered", "mixture"], ["gradient", "bayes"], ["sum", "cell-average"]),
)
def test_confidence_models(model, rule, evidence):
    scenario, rng = scenario_of(3, SMALL), np.random.default_rng(0)
    frames = []
    for frame in scenario.frames:
        shape = frame.points.shape[:1] if isinstance(frame, CloudFrame) else frame.depth_image.shape
        frames.append(with_confidences(frame, rng.integers(0, 256, shape)))
    parameters = {"rule": rule, "evidence": evidence, "settle": 0, "confidence_model": model, **unrounded(rule)}
    compare_frames(scenario.config(**parameters), frames, every=8)


@pytest.mark.parametrize("sensors", ["depth16", "depth32", "cloud"])
def test_kinds_of_sensors(sensors):
    shape = dataclasses.replace(SMALL, sensors=sensors)
    compare(shape, seed=4, topology="line", rule="gradient", settle=0, every=8)


@pytest.mark.parametrize(("rule", "topology", "mode"), one_in(9, RULES, ["complete", "star"], MODES))
def test_robots_that_leave(rule, topology, mode):
    outcome = compare(
        SMALL, topology=topology, rule=rule, mode=mode, after_end="leave", settle=4, settle_tolerance=1e-3, every=3,
        with_metrics=True,
    )  # fmt: skip
    assert outcome.twin_tick.active == (True, True, False, True)


STEPS_AND_SCHEDULES = (
    {"weights": "degree"}, {"weights": "degree", "epsilon": 0.21}, {"epsilon": 0.9}, {"gamma": 1.0},
    {"gamma": 0.9, "gamma_power": 1.0, "gamma_decay": 3.0}, {"gamma_per_arrival": "full"}, {"publish_period": 0.37},
    {"publish_period": 5.0}, {"packet_compression": "none"},
)  # fmt: skip


@pytest.mark.parametrize(("mode", "parameters"), one_in(9, MODES, STEPS_AND_SCHEDULES), ids=str)
def test_steps_and_schedules(parameters, mode):
    compare(SMALL, topology="star", rule="natural", mode=mode, settle=0, every=9, **parameters)
    compare(SMALL, topology="star", rule="gradient", mode=mode, settle=0, every=9, **parameters)


def test_the_papers_preset():
    parameters = {key: value for key, value in PRESETS["paper"].items() if key != "topology"}
    compare(SMALL, with_metrics=True, every=3, **parameters)


@pytest.mark.parametrize("rule", RULES)
def test_one_robot_alone(rule):
    scenario = scenario_of(1, SMALL)
    config = dataclasses.replace(
        scenario.config(rule=rule, settle=0, **unrounded(rule)), robots=scenario.base_config.robots[:1]
    )
    frames = [frame for frame in scenario.frames if frame.robot_id == "robot_0"]
    outcome = compare_frames(config, frames, every=4, with_metrics=True)
    assert outcome.tick.graph.pairs == ()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rule", RULES)
def test_a_robot_that_never_scans(rule, mode):
    frames = [ray("a", 0.0, 1), ray("b", 0.4, 2), ray("a", 2.0, 1, distance=1.0)]
    compare_frames(team_config("abc", rule=rule, mode=mode, settle=2, **unrounded(rule)), frames, with_metrics=True)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("evidence", ["sum", "time-average", "cell-average"])
def test_an_empty_scan_is_counted(rule, evidence):
    empty = dataclasses.replace(cloud(np.zeros((0, 3)), []), stamp_ns=ray("a", 2.3, 1).stamp_ns)
    frames = [ray("a", 0.0, 1), ray("b", 0.4, 2), ray("b", 1.0, 2), empty, ray("b", 5.0, 1)]
    config = team_config("ab", rule=rule, evidence=evidence, settle=0, **unrounded(rule))
    outcome = compare_frames(config, frames, with_metrics=True)
    assert outcome.twin_tick.num_scans == (2, 3)


@pytest.mark.parametrize("evidence", ["sum", "time-average", "cell-average"])
def test_scans_on_the_tick_and_the_last_tick(evidence):
    frames = [ray("a", 0.0, 1), ray("b", 1.0, 2), ray("a", 1.0, 2), ray("b", 3.0, 1)]
    outcome = compare_frames(team_config("ab", rule="bayes", evidence=evidence, settle=0), frames, with_metrics=True)
    assert outcome.num_ticks == 5


@pytest.mark.parametrize("num_classes", [1, 2, 254])
@pytest.mark.parametrize("rule", RULES)
def test_numbers_of_classes(rule, num_classes):
    frames = [ray("a", 0.0, 1), ray("b", 0.5, num_classes), ray("a", 1.5, 1), ray("b", 2.5, num_classes, distance=1.0)]
    config = team_config("ab", num_classes, rule=rule, settle=2, settle_tolerance=1e-3, **unrounded(rule))
    compare_frames(config, frames, with_metrics=True)


@pytest.mark.parametrize(
    ("rule", "mode"),
    [
        ("bayes", "on-arrival"),
        pytest.param("gradient", "sync", marks=long),
        pytest.param("local", "sync", marks=long),
    ],
)
def test_threads_do_not_change_a_byte(rule, mode):
    scenario = scenario_of(1, SMALL)
    config = scenario.config(rule=rule, mode=mode, topology="ring", settle=2)
    runs = []
    for num_threads in (1, 4):
        session = Session(config, sources_of(config, scenario.frames), ThreadPoolExecutor(num_threads))
        run = []
        for tick in session.ticks():
            run.append((tick.metrics, sent_packets(tick)))
        runs.append((run, [octree.leaves().log_odds.tobytes() for octree in tick.maps]))
    assert any(packets for _, packets in runs[0][0]) == (rule != "local")
    assert runs[0] == runs[1]


@pytest.mark.parametrize(("rule", "topology"), one_in(4, ["gradient", "bayes", "natural"], ["complete", "line"]))
def test_skipping_bricks_at_rest_does_not_change_a_byte(rule, topology, monkeypatch):
    scenario = scenario_of(1, SMALL)
    config = scenario.config(rule=rule, topology=topology, settle=3)
    right, since_of_steps = consensus_module.team_step, []

    def recorded(steps, **kwargs):
        since_of_steps.extend(step.since for step in steps)
        return right(steps, **kwargs)

    def whole(steps, **kwargs):
        return right([dataclasses.replace(step, since=None) for step in steps], **kwargs)

    runs = []
    for function in (recorded, whole):
        monkeypatch.setattr(consensus_module, "team_step", function)
        session = Session(config, sources_of(config, scenario.frames), ThreadPoolExecutor(2))
        runs.append([sent_packets(tick) for tick in session.ticks()])
    assert runs[0] == runs[1]
    assert sum(since is not None for since in since_of_steps) > len(since_of_steps) / 3
