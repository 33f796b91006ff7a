"""Comparison of sessions on octrees with the reference twin, in every tick for every robot."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pytest

from octoreplay.config.rules import RULES
from octoreplay.records import CONVERGED
from octoreplay.replay.session import Session
from octoreplay.replay.settling import NO_SETTLING, SETTLE_MAX
from reference.comparison import compare_map
from reference.scenarios import TeamShape, make_scenario
from reference.twin import STOPPED_CONVERGED, STOPPED_MAX, STOPPED_OFF, Twin, record
from support.sessions import frame_lists

TOLERANCE = 5e-5
"""Largest |log-odds difference| of any class in any cell."""
NEAR_TIE = 1e-4
"""Labels may differ where a map's two largest log-odds are this close."""
STOP_REASONS = {STOPPED_CONVERGED: CONVERGED, STOPPED_MAX: SETTLE_MAX, STOPPED_OFF: NO_SETTLING}
SMALL = TeamShape(num_robots=4, num_ticks=16, image=(12, 9), resolution=0.4, scan_period=0.4, sensors="mixed")
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


@dataclass
class Outcome:
    """Numbers of a comparison, its last ticks, and the largest difference of log-odds."""

    num_ticks: int = 0
    num_settling_ticks: int = 0
    num_compared_maps: int = 0
    max_abs: float = 0.0
    peak_all: float = 0.0
    twin_tick: object = None
    tick: object = None


@functools.lru_cache(maxsize=8)
def scenario_of(seed, shape):
    return make_scenario(seed, shape)


@functools.lru_cache(maxsize=8)
def recording_of(seed, shape, sensor_parameters):
    scenario = scenario_of(seed, shape)
    return record(scenario.config(**dict(sensor_parameters)), scenario.frames)


def sources_of(config, frames):
    return frame_lists([robot.robot_id for robot in config.robots], frames)


def configured(scenario, topology, **parameters):
    """Return the configuration of a scenario with a topology; topology 'edges' has given weights."""
    if topology != "edges":
        return scenario.config(topology=topology, **parameters)
    edges = EDGES[len(scenario.robot_ids)]
    return scenario.config(edges=edges, topology="edges", weights="given", **parameters)


def unrounded(rule):
    """Return the parameters that turn off rounding for a rule that rounds its maps.

    Where float32 and float64 are on different sides of the middle of a quantum, their maps differ by the quantum.
    """
    return {"quantum": 0.0} if RULES[rule].default_quantum and not RULES[rule].has_flows else {}


def compare(
    shape, *, rule="gradient", seed=1, topology="complete", sensor_parameters=None, every=10, with_metrics=False,
    tolerance=TOLERANCE, **parameters,
):  # fmt: skip
    """Run session and twin on a scenario and compare them as compare_frames does; no rounding unless given."""
    scenario = scenario_of(seed, shape)
    sensor_parameters = sensor_parameters or {}
    recording = recording_of(seed, shape, tuple(sensor_parameters.items()))
    parameters = {**unrounded(rule), **parameters}
    config = configured(scenario, topology, rule=rule, **sensor_parameters, **parameters)
    return compare_frames(
        config, scenario.frames, recording, every=every, with_metrics=with_metrics, tolerance=tolerance
    )


def compare_frames(config, frames, recording=None, *, every=1, with_metrics=False, tolerance=TOLERANCE):
    """Run session and twin tick by tick, and raise AssertionError at the first difference.

    Maps are compared in every ``every``-th tick, in the first settling tick and in the last one; everything else in all
    ticks.
    """
    recording = recording or record(config, frames)
    twin = Twin(config, recording, with_metrics=with_metrics)
    # Resolved configurations hold the sensor model of the run's quantum.
    session = Session(
        dataclasses.replace(config, sensor=config.effective_sensor), sources_of(config, frames), ThreadPoolExecutor(1)
    )
    outcome = Outcome()
    was_settling = False
    for expected, tick in itertools.zip_longest(twin.ticks(), session.ticks()):
        assert expected is not None, f"the session continues after tick {outcome.num_ticks - 1}"
        assert tick is not None, f"the session ends before tick {expected.tick}"
        _compare_course(expected, tick)
        if with_metrics:
            theirs = expected.metrics
            outcome.peak_all = max(outcome.peak_all, theirs.total_distance_all, theirs.total_distance_published)
            _compare_metrics(expected, tick.metrics, outcome.peak_all)
        if tick.number % every == 0 or tick.settling != was_settling:
            _compare_maps(recording.keys, expected, tick, config, outcome, tolerance)
        was_settling = tick.settling
        outcome.num_ticks += 1
        outcome.num_settling_ticks += tick.settling
        outcome.twin_tick, outcome.tick = expected, tick
    _compare_maps(recording.keys, outcome.twin_tick, outcome.tick, config, outcome, tolerance)
    assert STOP_REASONS[twin.stop_reason] == session.stop_reason
    return outcome


def _compare_course(expected, tick):
    """Compare everything of a tick but its maps and metrics."""
    assert (tick.number, tick.stamp_ns, tick.settling) == (expected.tick, expected.stamp_ns, expected.settling)
    robots = tick.metrics.robots
    assert tuple(robot.active for robot in robots) == expected.active, f"active robots differ in tick {tick.number}"
    assert tick.graph.pairs == expected.links, f"links differ in tick {tick.number}"
    assert tuple(robot.num_scans for robot in robots) == expected.num_scans, f"scans differ in tick {tick.number}"
    assert tuple(robot.num_iterations for robot in robots) == expected.num_iterations, "iterations differ"


def _compare_maps(keys, expected, tick, config, outcome, tolerance):
    """Compare the map of every robot and the oracle, both ways."""
    for index, octree in enumerate(tick.maps):
        difference = compare_map(keys, expected, index, octree.leaves(expected.prior), config.map.resolution)
        where = f"robot {index}, tick {tick.number}: {difference}"
        assert not difference.missing, f"cells are missing: {where}"
        assert not difference.spurious, f"cells are spurious: {where}"
        assert not difference.overlapping, f"leaves overlap: {where}"
        assert difference.max_abs < tolerance, f"log-odds differ: {where}"
        if config.consensus.effective_quantum and not tick.settling:
            values = octree.leaves().log_odds
            assert not (values % config.consensus.effective_quantum).any(), f"not multiples of the quantum: {where}"
        outcome.max_abs = max(outcome.max_abs, difference.max_abs)
        outcome.num_compared_maps += 1
    coords = (keys + 0.5) * config.map.resolution
    oracle, _, _ = tick.oracle.lookup(coords)
    assert np.abs(oracle - expected.oracle[:, 1:]).max() < TOLERANCE, f"the oracle differs in tick {tick.number}"


def _compare_metrics(expected, metrics, peak_all):
    """Compare the metrics of a tick; labels may differ only where two log-odds are nearly equal."""
    theirs = expected.metrics
    rounding = 1e-10 * peak_all
    assert metrics.total_distance_published == pytest.approx(theirs.total_distance_published, rel=1e-3, abs=rounding)
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
    """Return where the two largest log-odds are within NEAR_TIE."""
    top = np.partition(_absolute(deviation, prior), -2, axis=-1)[..., -2:]
    return top[..., 1] - top[..., 0] < NEAR_TIE
