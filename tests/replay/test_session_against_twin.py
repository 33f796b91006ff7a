"""The octree run against the reference twin: the same frames into both, compared tick by tick and robot by robot."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest

from octoreplay.config.presets import PRESETS
from octoreplay.mapping import sensor
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import storage
from octoreplay.records import CONVERGED
from octoreplay.replay import session as session_module
from octoreplay.replay.measure import TickMeasurer
from octoreplay.replay.robots import consensus as consensus_module
from octoreplay.replay.robots import robot as robot_module
from octoreplay.replay.session import Session
from octoreplay.replay.settling import NO_SETTLING, SETTLE_MAX
from reference import rules
from reference.comparison import compare_map
from reference.hand_made import cloud, ray, team_config
from reference.scenarios import TeamShape, make_scenario
from reference.twin import STOPPED_CONVERGED, STOPPED_MAX, STOPPED_OFF, Twin, record
from support.octree_factory import class_rows

TOLERANCE = 5e-5
"""Largest |log-odds difference| of any class in any cell."""

NEAR_TIE = 1e-4
"""Labels may differ where a map's two largest log-odds are this close."""

RULES = ("gradient", "bayes", "natural", "local")
MODES = ("sync", "on-arrival")
TOPOLOGIES = ("complete", "ring", "line", "star", "edges")
STOP_REASONS = {STOPPED_CONVERGED: CONVERGED, STOPPED_MAX: SETTLE_MAX, STOPPED_OFF: NO_SETTLING}

SMALL = TeamShape(num_robots=4, num_ticks=16, image=(12, 9), resolution=0.4, scan_period=0.4, sensors="mixed")
FOUR = TeamShape(num_robots=4, sensors="mixed")
SIX = TeamShape(num_robots=6, scan_period=0.8, sensors="mixed")

EDGES = {
    4: (
        ("robot_0", "robot_1", 0.4), ("robot_1", "robot_2", 0.25), ("robot_3", "robot_1", 0.3),
        ("robot_0", "robot_2", 0.1),
    ),
    6: (
        ("robot_0", "robot_1", 0.3), ("robot_1", "robot_2", 0.2), ("robot_2", "robot_3", 0.45),
        ("robot_4", "robot_1", 0.35), ("robot_5", "robot_4", 0.5), ("robot_5", "robot_0", 0.15),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class FrameList:
    """Frames from memory."""

    content: tuple

    def frames(self):
        return iter(self.content)


@dataclass
class Outcome:
    """What a comparison went through: ticks, the last of both, and the largest difference of any log-odds."""

    num_ticks: int = 0
    num_settling_ticks: int = 0
    num_compared_maps: int = 0
    max_abs: float = 0.0
    peak_all: float = 0.0
    twin_tick: object = None
    tick: object = None


@functools.lru_cache(maxsize=8)
def _scenario(seed, shape):
    return make_scenario(seed, shape)


@functools.lru_cache(maxsize=8)
def _recording(seed, shape, sensor_parameters):
    scenario = _scenario(seed, shape)
    return record(scenario.config(**dict(sensor_parameters)), scenario.frames)


def _sources(config, frames):
    return [FrameList(tuple(f for f in frames if f.robot_id == robot.robot_id)) for robot in config.robots]


def _configured(scenario, topology, **parameters):
    """The scenario's configuration with a topology; a list of edges comes with given weights."""
    if topology != "edges":
        return scenario.config(topology=topology, **parameters)
    edges = EDGES[len(scenario.robot_ids)]
    return scenario.config(edges=edges, topology="edges", weights="given", **parameters)


def _compare(shape, *, seed=1, topology="complete", sensor_parameters=None, every=10, with_metrics=False, **parameters):
    """Run both on a scenario and compare them; see _compare_frames."""
    scenario = _scenario(seed, shape)
    sensor_parameters = sensor_parameters or {}
    recording = _recording(seed, shape, tuple(sensor_parameters.items()))
    config = _configured(scenario, topology, **sensor_parameters, **parameters)
    return _compare_frames(config, scenario.frames, recording, every=every, with_metrics=with_metrics)


def _compare_frames(config, frames, recording=None, *, every=1, with_metrics=False):
    """Run both in step. Raises AssertionError at the first difference; maps are compared in every ``every``-th tick, in
    the first settling tick and in the last, everything else in all of them."""
    recording = recording or record(config, frames)
    twin = Twin(config, recording, with_metrics=with_metrics)
    session = Session(config, _sources(config, frames), ThreadPoolExecutor(1))
    outcome = Outcome()
    was_settling = False
    for expected, tick in itertools.zip_longest(twin.ticks(), session.ticks()):
        assert expected is not None, f"the octree run goes on after tick {outcome.num_ticks - 1}"
        assert tick is not None, f"the octree run ends before tick {expected.tick}"
        _compare_course(expected, tick)
        if with_metrics:
            outcome.peak_all = max(outcome.peak_all, expected.metrics.total_distance_all)
            _compare_metrics(expected, tick.metrics, outcome.peak_all)
        if tick.number % every == 0 or tick.settling != was_settling:
            _compare_maps(recording.keys, expected, tick, config, outcome)
        was_settling = tick.settling
        outcome.num_ticks += 1
        outcome.num_settling_ticks += tick.settling
        outcome.twin_tick, outcome.tick = expected, tick
    _compare_maps(recording.keys, outcome.twin_tick, outcome.tick, config, outcome)
    assert STOP_REASONS[twin.stop_reason] == session.stop_reason
    return outcome


def _compare_course(expected, tick):
    """What a tick consists of, its maps apart."""
    assert (tick.number, tick.stamp_ns, tick.settling) == (expected.tick, expected.stamp_ns, expected.settling)
    robots = tick.metrics.robots
    assert tuple(robot.active for robot in robots) == expected.active, f"active robots differ in tick {tick.number}"
    assert tick.graph.pairs == expected.links, f"links differ in tick {tick.number}"
    assert tuple(robot.num_scans for robot in robots) == expected.num_scans, f"scans differ in tick {tick.number}"
    assert tuple(robot.num_iterations for robot in robots) == expected.num_iterations, "iterations differ"


def _compare_maps(keys, expected, tick, config, outcome):
    """Every robot's map and the oracle, both ways."""
    for index, octree in enumerate(tick.maps):
        difference = compare_map(keys, expected, index, octree.leaves(expected.prior), config.map.resolution)
        where = f"robot {index}, tick {tick.number}: {difference}"
        assert not difference.missing, f"cells are missing: {where}"
        assert not difference.spurious, f"cells are spurious: {where}"
        assert not difference.overlapping, f"leaves overlap: {where}"
        assert difference.max_abs < TOLERANCE, f"log-odds differ: {where}"
        outcome.max_abs = max(outcome.max_abs, difference.max_abs)
        outcome.num_compared_maps += 1
    coords = (keys + 0.5) * config.map.resolution
    oracle, _, _ = tick.oracle.lookup(coords)
    assert np.abs(oracle - expected.oracle[:, 1:]).max() < TOLERANCE, f"the oracle differs in tick {tick.number}"


def _compare_metrics(expected, metrics, peak_all):
    """The tick's metrics. Labels may differ only where two log-odds are all but equal."""
    theirs = expected.metrics
    rounding = 1e-10 * peak_all
    assert metrics.total_distance == pytest.approx(theirs.total_distance, rel=1e-3, abs=rounding)
    assert metrics.total_distance_all == pytest.approx(theirs.total_distance_all, rel=1e-3, abs=rounding)
    assert metrics.distance_per_cell_and_link == pytest.approx(
        theirs.distance_per_cell_and_link, rel=1e-3, abs=rounding / max(theirs.num_known_cells, 1)
    )
    assert metrics.num_known_cells == theirs.num_known_cells
    assert metrics.max_change == pytest.approx(theirs.max_change, rel=1e-3, abs=1e-5)
    close = _near_ties(expected.maps, expected.prior) & expected.known
    close_oracle = _near_ties(expected.oracle, expected.prior) & expected.known.any(axis=0)
    known = max(theirs.num_known_cells, 1)
    assert metrics.label_disagreement == pytest.approx(theirs.label_disagreement, abs=close.any(axis=0).sum() / known)
    num_occupied = max(int((_absolute(expected.oracle, expected.prior).argmax(axis=1) > 0).sum()), 1)
    for index, robot in enumerate(metrics.robots):
        doubtful = (close[index] | close_oracle).sum()
        assert robot.num_cells == theirs.num_cells[index]
        assert robot.agreement == pytest.approx(theirs.agreement[index], abs=close[index].sum() / known + 1e-12)
        assert robot.agreement_occupied == pytest.approx(
            theirs.agreement_occupied[index], abs=2 * doubtful / num_occupied + 1e-12
        )
        assert robot.entropy_bits == pytest.approx(theirs.entropy_bits[index], rel=1e-4, abs=1e-5)


def _absolute(deviation, prior):
    absolute = deviation.copy()
    absolute[..., 1:] += prior
    return absolute


def _near_ties(deviation, prior):
    """Where the two largest log-odds are within NEAR_TIE."""
    top = np.partition(_absolute(deviation, prior), -2, axis=-1)[..., -2:]
    return top[..., 1] - top[..., 0] < NEAR_TIE


# --- large teams: at least 100 ticks and 20,000 cells ----------------------------------------------------------------


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
    outcome = _compare(FOUR, topology=topology, rule=rule, mode=mode, settle=0, every=25, with_metrics=with_metrics)
    assert outcome.num_ticks >= 100
    assert len(outcome.twin_tick.oracle) >= 20_000
    assert outcome.num_compared_maps >= 20


@pytest.mark.parametrize(
    ("rule", "mode", "topology"),
    [("gradient", "sync", "complete"), ("bayes", "on-arrival", "ring"), ("natural", "sync", "line")],
)
def test_six_robots(rule, mode, topology):
    outcome = _compare(SIX, topology=topology, rule=rule, mode=mode, settle=0, every=40)
    assert outcome.num_ticks >= 100
    assert len(outcome.twin_tick.oracle) >= 20_000
    saturated = (np.abs(outcome.twin_tick.evidence[..., 1:]) >= 5.0).any(axis=2)
    assert (saturated.sum(axis=1) > 250).all()
    assert (outcome.twin_tick.known.sum(axis=0) >= 2).mean() > 0.3


# --- every rule, mode and topology, with settling and metrics --------------------------------------------------------


@pytest.mark.parametrize("topology", TOPOLOGIES)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rule", RULES)
def test_every_rule_mode_and_topology(rule, mode, topology):
    """The tolerance is far above float32's rounding, so that both stop settling in the same tick."""
    outcome = _compare(
        SMALL, topology=topology, rule=rule, mode=mode, settle=6, settle_tolerance=1e-3, every=4, with_metrics=True
    )
    assert outcome.num_settling_ticks >= 1
    assert outcome.num_compared_maps >= 4 * 6
    if rule != "local":
        assert outcome.tick.metrics.total_distance_all < 1e-3 * outcome.peak_all


@pytest.mark.parametrize(("settle_max", "num_settling_ticks"), [(7, 7), (1, 1)])
def test_settling_ends_at_its_maximum(settle_max, num_settling_ticks):
    outcome = _compare(SMALL, topology="line", rule="natural", settle=5, settle_max=settle_max)
    assert outcome.num_settling_ticks == num_settling_ticks


# --- readings, priors, regions, sensors, schedules -------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("evidence", ["time-average", "cell-average"])
@pytest.mark.parametrize("rule", RULES)
def test_average_readings(rule, evidence, mode):
    _compare(SMALL, topology="line", rule=rule, mode=mode, evidence=evidence, settle=0, with_metrics=True, every=5)


@pytest.mark.parametrize("rule", RULES)
def test_a_prior(rule):
    prior = {"prob_free": 0.35}
    outcome = _compare(SMALL, topology="ring", rule=rule, settle=0, with_metrics=True, every=5, sensor_parameters=prior)
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


@pytest.mark.parametrize("rule", ["gradient", "bayes"])
@pytest.mark.parametrize("variant", SENSOR_VARIANTS)
def test_sensor_models(variant, rule):
    outcome = _compare(SMALL, rule=rule, settle=0, every=8, sensor_parameters=SENSOR_VARIANTS[variant])
    assert outcome.twin_tick.known.any()


@pytest.mark.parametrize("sensors", ["depth16", "depth32", "cloud"])
def test_kinds_of_sensors(sensors):
    shape = dataclasses.replace(SMALL, sensors=sensors)
    _compare(shape, seed=4, topology="line", rule="gradient", settle=0, every=8)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("topology", ["complete", "star"])
@pytest.mark.parametrize("rule", RULES)
def test_robots_that_leave(rule, topology, mode):
    outcome = _compare(
        SMALL, topology=topology, rule=rule, mode=mode, after_end="leave", settle=4, settle_tolerance=1e-3, every=3,
        with_metrics=True,
    )  # fmt: skip
    assert outcome.twin_tick.active == (True, True, False, True)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "parameters",
    [
        {"weights": "degree"}, {"weights": "degree", "epsilon": 0.21}, {"epsilon": 0.9}, {"gamma": 1.0},
        {"gamma": 0.9, "gamma_power": 1.0, "gamma_decay": 3.0}, {"gamma_per_arrival": "full"}, {"publish_period": 0.37},
        {"publish_period": 5.0}, {"packet_compression": "none"},
    ],
    ids=str,
)  # fmt: skip
def test_steps_and_schedules(parameters, mode):
    _compare(SMALL, topology="star", rule="natural", mode=mode, settle=0, every=9, **parameters)
    _compare(SMALL, topology="star", rule="gradient", mode=mode, settle=0, every=9, **parameters)


def test_the_papers_preset():
    parameters = {key: value for key, value in PRESETS["paper"].items() if key != "topology"}
    _compare(SMALL, with_metrics=True, every=3, **parameters)


@pytest.mark.parametrize("rule", RULES)
def test_one_robot_alone(rule):
    scenario = _scenario(1, SMALL)
    config = dataclasses.replace(scenario.config(rule=rule, settle=0), robots=scenario.base_config.robots[:1])
    frames = [frame for frame in scenario.frames if frame.robot_id == "robot_0"]
    outcome = _compare_frames(config, frames, every=4, with_metrics=True)
    assert outcome.tick.graph.pairs == ()


# --- by hand ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rule", RULES)
def test_a_robot_that_never_scans(rule, mode):
    frames = [ray("a", 0.0, 1), ray("b", 0.4, 2), ray("a", 2.0, 1, distance=1.0)]
    _compare_frames(team_config("abc", rule=rule, mode=mode, settle=2), frames, with_metrics=True)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("evidence", ["sum", "time-average", "cell-average"])
def test_a_scan_that_touches_nothing_counts(rule, evidence):
    empty = dataclasses.replace(cloud(np.zeros((0, 3)), []), stamp_ns=ray("a", 2.3, 1).stamp_ns)
    frames = [ray("a", 0.0, 1), ray("b", 0.4, 2), ray("b", 1.0, 2), empty, ray("b", 5.0, 1)]
    outcome = _compare_frames(team_config("ab", rule=rule, evidence=evidence, settle=0), frames, with_metrics=True)
    assert outcome.twin_tick.num_scans == (2, 3)


@pytest.mark.parametrize("evidence", ["sum", "time-average", "cell-average"])
def test_scans_on_the_tick_and_the_last_tick(evidence):
    frames = [ray("a", 0.0, 1), ray("b", 1.0, 2), ray("a", 1.0, 2), ray("b", 3.0, 1)]
    outcome = _compare_frames(team_config("ab", rule="bayes", evidence=evidence, settle=0), frames, with_metrics=True)
    assert outcome.num_ticks == 5


@pytest.mark.parametrize("num_classes", [1, 2, 254])
@pytest.mark.parametrize("rule", RULES)
def test_numbers_of_classes(rule, num_classes):
    frames = [ray("a", 0.0, 1), ray("b", 0.5, num_classes), ray("a", 1.5, 1), ray("b", 2.5, num_classes, distance=1.0)]
    config = team_config("ab", num_classes, rule=rule, settle=2, settle_tolerance=1e-3)
    _compare_frames(config, frames, with_metrics=True)


# --- threads ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rule", "mode"), [("gradient", "sync"), ("bayes", "on-arrival"), ("local", "sync")])
def test_threads_do_not_change_a_byte(rule, mode):
    scenario = _scenario(1, SMALL)
    config = scenario.config(rule=rule, mode=mode, topology="ring", settle=2)
    runs = []
    for num_threads in (1, 2, 4):
        session = Session(config, _sources(config, scenario.frames), ThreadPoolExecutor(num_threads))
        run = []
        for tick in session.ticks():
            run.append((tick.metrics, _packets(tick)))
        runs.append((run, [octree.leaves().log_odds.tobytes() for octree in tick.maps]))
    assert any(packets for _, packets in runs[0][0]) == (rule != "local")
    assert runs[0] == runs[1] == runs[2]


def _packets(tick):
    """Every packet that was sent in a tick."""
    messages = [message for published in tick.published if published for _, message in published.outbox]
    return [part.data for message in messages for part in message.parts]


@pytest.mark.parametrize("rule", ["gradient", "bayes", "natural"])
@pytest.mark.parametrize("topology", ["complete", "line"])
def test_leaving_out_bricks_at_rest_does_not_change_a_byte(rule, topology, monkeypatch):
    scenario = _scenario(1, SMALL)
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
        session = Session(config, _sources(config, scenario.frames), ThreadPoolExecutor(2))
        runs.append([_packets(tick) for tick in session.ticks()])
    assert runs[0] == runs[1]
    assert sum(since is not None for since in since_of_steps) > len(since_of_steps) / 3


# --- faults that the comparison must see -----------------------------------------------------------------------------


def _change_steps(monkeypatch, change):
    """Every robot's iterations are done as ``change`` describes them."""
    right = consensus_module.team_step

    def wrong(steps, **kwargs):
        return right([change(step) for step in steps], **kwargs)

    monkeypatch.setattr(consensus_module, "team_step", wrong)


def _wrong_sign(monkeypatch):
    _change_steps(
        monkeypatch,
        lambda step: dataclasses.replace(step, step_weights=[-0.1 * weight for weight in step.step_weights]),
    )


def _wrong_gradient_sign(monkeypatch):
    _change_steps(monkeypatch, lambda step: dataclasses.replace(step, gamma=-0.1 * step.gamma))


def _change_arrivals(monkeypatch, change):
    """Before anybody iterates, ``change`` says of every map that arrived which one it is."""
    right = Session._iterate

    def wrong(self, graph, factor, number):
        for robot in self.team.robots:
            robot._arrived = [a._replace(held=change(self, robot, a)) for a in robot._arrived]
        return right(self, graph, factor, number)

    monkeypatch.setattr(Session, "_iterate", wrong)


def _current_maps_in_place_of_published_ones(monkeypatch):
    _change_arrivals(
        monkeypatch,
        lambda session, robot, arrival: dataclasses.replace(
            arrival.held, octree=session.team.robots[arrival.source.origin].map
        ),
    )


def _maps_of_the_tick_before(monkeypatch):
    last = {}

    def before(session, robot, arrival):
        key = (robot.index, arrival.source)
        old = last.get(key, arrival.held)
        last[key] = arrival.held
        return old

    _change_arrivals(monkeypatch, before)


def _free_is_not_reset(monkeypatch):
    """Free's own step g_0 = -sum of the others' stays in h[0], and the classes' log-odds against free miss it."""
    right = consensus_module.team_step

    def wrong(steps, **kwargs):
        mixed = [dataclasses.replace(step, own=step.own.copy(), gamma=0.0) for step in steps]
        right(mixed, **kwargs)
        changes = right(steps, **kwargs)
        for own, without in ((step.own, other.own) for step, other in zip(steps, mixed, strict=True)):
            codes = own.codes[own.bricks.masks[: own.num_bricks].any(axis=1)]
            rows, others = class_rows(own, own.find(codes)), class_rows(without, without.find(codes))
            is_there = rows >= 0
            after, before = np.zeros((2, *rows.shape, storage.OCTETS), np.float32)
            after[is_there], before[is_there] = own.bricks.rows[rows[is_there]], without.bricks.rows[others[is_there]]
            after += (after - before).sum(axis=1, keepdims=True)
            own.bricks.rows[rows[is_there]] = after[is_there]
        return changes

    monkeypatch.setattr(consensus_module, "team_step", wrong)


def _free_is_not_reset_in_the_twin(monkeypatch):
    monkeypatch.setattr(rules, "free_is_zero", lambda log_odds: log_odds)


def _evidence_of_the_last_iteration_is_forgotten(monkeypatch):
    def forget(step):
        return dataclasses.replace(step, last_log_likelihood=type(step.own)(step.own.resolution, step.own.num_classes))

    _change_steps(monkeypatch, forget)


def _scans_of_the_tick_come_late(monkeypatch):
    right = Session._integrate
    monkeypatch.setattr(Session, "_integrate", lambda self, number, stamp_ns: right(self, number, stamp_ns - 10**9))


def _hits_add_too_little(monkeypatch):
    right = robot_module.clamped_increments
    monkeypatch.setattr(
        robot_module, "clamped_increments", lambda config: dataclasses.replace(right(config), hit=config.hit - 0.01)
    )


def _clamping_is_forgotten(monkeypatch):
    monkeypatch.setattr(robot_module, "clamped_increments", sensor.unclamped_increments)


def _half_a_step(monkeypatch):
    right = session_module.step_size
    monkeypatch.setattr(session_module, "step_size", lambda *args: 0.5 * right(*args))


def _neighbours_cells_are_not_taken(monkeypatch):
    right = consensus_kernels.join_columns

    def wrong(table, columns, needs_update, known, has_block, layout):
        right(table, columns, needs_update, known, has_block, layout)
        known[:] = np.bitwise_or.reduce(table.known[columns[: consensus_kernels.FIRST_NEIGHBOUR]])

    monkeypatch.setattr(consensus_kernels, "join_columns", wrong)


LOG_ODDS_DIFFER = "log-odds differ"
MAPS_DIFFER = "log-odds differ|cells are missing|cells are spurious|iterations differ"


@pytest.mark.parametrize(
    ("rule", "mode", "fault", "message"),
    [
        ("gradient", "sync", _wrong_sign, LOG_ODDS_DIFFER), ("gradient", "on-arrival", _wrong_sign, LOG_ODDS_DIFFER),
        ("natural", "sync", _wrong_sign, LOG_ODDS_DIFFER), ("bayes", "sync", _wrong_sign, LOG_ODDS_DIFFER),
        ("bayes", "on-arrival", _wrong_sign, LOG_ODDS_DIFFER),
        ("gradient", "sync", _wrong_gradient_sign, LOG_ODDS_DIFFER),
        ("gradient", "sync", _current_maps_in_place_of_published_ones, MAPS_DIFFER),
        ("gradient", "on-arrival", _current_maps_in_place_of_published_ones, MAPS_DIFFER),
        ("natural", "sync", _current_maps_in_place_of_published_ones, MAPS_DIFFER),
        ("bayes", "sync", _current_maps_in_place_of_published_ones, MAPS_DIFFER),
        ("bayes", "on-arrival", _current_maps_in_place_of_published_ones, MAPS_DIFFER),
        ("gradient", "sync", _maps_of_the_tick_before, MAPS_DIFFER),
        ("bayes", "on-arrival", _maps_of_the_tick_before, MAPS_DIFFER),
        ("gradient", "sync", _free_is_not_reset, LOG_ODDS_DIFFER),
        ("gradient", "on-arrival", _free_is_not_reset, LOG_ODDS_DIFFER),
        ("gradient", "sync", _free_is_not_reset_in_the_twin, LOG_ODDS_DIFFER),
        ("bayes", "sync", _evidence_of_the_last_iteration_is_forgotten, LOG_ODDS_DIFFER),
        ("gradient", "sync", _scans_of_the_tick_come_late, "scans differ|active robots differ"),
        ("local", "sync", _hits_add_too_little, LOG_ODDS_DIFFER),
        ("gradient", "sync", _hits_add_too_little, LOG_ODDS_DIFFER),
        ("local", "sync", _clamping_is_forgotten, LOG_ODDS_DIFFER), ("gradient", "sync", _half_a_step, LOG_ODDS_DIFFER),
        ("natural", "sync", _neighbours_cells_are_not_taken, "cells are missing"),
    ],
)  # fmt: skip
def test_a_fault_turns_the_comparison_red(monkeypatch, rule, mode, fault, message):
    parameters = {"topology": "line", "rule": rule, "mode": mode, "settle": 0, "every": 5}
    _compare(SMALL, **parameters)
    fault(monkeypatch)
    with pytest.raises(AssertionError, match=message):
        _compare(SMALL, **parameters)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("total_distance", lambda value: value * 1.01), ("total_distance_all", lambda value: value * 0.99),
        ("num_known_cells", lambda value: value + 1), ("max_change", lambda value: value + 0.1),
        ("label_disagreement", lambda value: value + 0.1),
        ("robots", lambda robots: _each_robot(robots, "agreement", 0.05)),
        ("robots", lambda robots: _each_robot(robots, "agreement_occupied", -0.05)),
        ("robots", lambda robots: _each_robot(robots, "entropy_bits", 0.001)),
        ("robots", lambda robots: _each_robot(robots, "num_cells", 1)),
    ],
)  # fmt: skip
def test_a_wrong_metric_turns_the_comparison_red(monkeypatch, name, wrong):
    right = TickMeasurer.measure

    def measure(self, *args, **kwargs):
        metrics = right(self, *args, **kwargs)
        return dataclasses.replace(metrics, **{name: wrong(getattr(metrics, name))})

    monkeypatch.setattr(TickMeasurer, "measure", measure)
    with pytest.raises(AssertionError):
        _compare(SMALL, topology="line", rule="gradient", settle=0, every=50, with_metrics=True)


def _each_robot(robots, name, change):
    return tuple(dataclasses.replace(robot, **{name: getattr(robot, name) + change}) for robot in robots)
