"""Faults of the session and of the twin that the comparison has to find."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.mapping import sensor
from octoreplay.mapping.kernels import consensus as consensus_kernels
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.metrics import MapComparer
from octoreplay.replay import session as session_module
from octoreplay.replay.robots import anchor as anchor_module
from octoreplay.replay.robots import consensus as consensus_module
from octoreplay.replay.robots import robot as robot_module
from octoreplay.replay.robots.anchor import Anchor
from octoreplay.replay.session import Session
from reference import flows, rules
from support.long_suite import long
from support.octree_factory import class_rows
from support.twin_comparison import SMALL, compare


def _change_steps(monkeypatch, change):
    """Apply ``change`` to every consensus step."""
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
    """Replace every map that arrived by ``change`` before the robots iterate."""
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
            arrival.held, content=session.team.robots[arrival.source.origin].map
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
    """Keep the step of free space, g_0 = -sum of the others, out of the log-odds of the classes."""
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
        last = type(step.own)(step.own.resolution, step.own.num_classes)
        last.find_or_add(step.log_likelihood.codes)
        return dataclasses.replace(step, last_evidence=last)

    _change_steps(monkeypatch, forget)


def _scans_of_the_tick_come_late(monkeypatch):
    right = Session._integrate
    monkeypatch.setattr(Session, "_integrate", lambda self, number, stamp_ns: right(self, number, stamp_ns - 10**9))


def _hits_add_too_little(monkeypatch):
    right = robot_module.clamped_increments
    monkeypatch.setattr(
        robot_module,
        "clamped_increments",
        lambda sensor, quantum: dataclasses.replace(right(sensor, quantum), hit=sensor.hit - 0.01),
    )


def _clamping_is_forgotten(monkeypatch):
    monkeypatch.setattr(robot_module, "clamped_increments", lambda model, quantum: sensor.unclamped_increments(model))


def _half_a_step(monkeypatch):
    right = session_module.step_weights_of
    monkeypatch.setattr(session_module, "step_weights_of", lambda *args: 0.5 * right(*args))


def _neighbours_cells_are_not_taken(monkeypatch):
    right = consensus_kernels.join_columns

    def wrong(table, columns, needs_update, known, has_block, layout):
        right(table, columns, needs_update, known, has_block, layout)
        known[:] = np.bitwise_or.reduce(table.known[columns[: consensus_kernels.FIRST_NEIGHBOUR]])

    monkeypatch.setattr(consensus_kernels, "join_columns", wrong)


def _flows_are_rounded_at_one_end(monkeypatch):
    right = consensus_module.team_step

    def wrong(steps, **kwargs):
        return right([*steps[:1], *(dataclasses.replace(step, flows=None) for step in steps[1:])], **kwargs)

    monkeypatch.setattr(consensus_module, "team_step", wrong)


def _flows_have_a_bit_more(monkeypatch):
    right = consensus_module.Flows
    monkeypatch.setattr(consensus_module, "Flows", lambda bits, *args: right(bits + 1, *args))


def _flows_are_rounded_to_nearest_in_the_twin(monkeypatch):
    monkeypatch.setattr(flows, "flow", lambda own, other, weight, step: np.rint(weight * (other - own) / step) * step)


def _flow_steps_of_one_robot_in_the_twin(monkeypatch):
    right = flows.flow_steps
    monkeypatch.setattr(flows, "flow_steps", lambda own, other, *args: right(own, own, *args))


def _gate_of(change):
    """Fault in which ``change`` replaces the gate of every flow."""

    def fault(monkeypatch):
        right = consensus_module.Flows
        monkeypatch.setattr(consensus_module, "Flows", lambda bits, has_flow, gate: right(bits, has_flow, change(gate)))

    return fault


def _gate_takes_labels_of_one_cell(monkeypatch):
    """Let a cell flow alone, not its block, in the twin."""
    right = flows.is_held_back
    monkeypatch.setattr(
        flows, "is_held_back", lambda own, other, blocks, gate: right(own, other, np.arange(len(own)), gate)
    )


def _gate_at_one_end(monkeypatch):
    right = consensus_module.team_step

    def without(step):
        return dataclasses.replace(step, flows=step.flows and dataclasses.replace(step.flows, gate=0.0))

    def wrong(steps, **kwargs):
        return right([*steps[:1], *map(without, steps[1:])], **kwargs)

    monkeypatch.setattr(consensus_module, "team_step", wrong)


def _labels_do_not_open_the_gate(monkeypatch):
    """Compare values alone in the twin."""
    monkeypatch.setattr(flows, "have_equal_labels", lambda own, other: np.ones(len(own), np.bool_))


def _evidence_comes_after_publishing(monkeypatch):
    monkeypatch.setattr(consensus_module.ConsensusRobot, "integrate", robot_module.Robot.integrate)


def _anchor_stays(monkeypatch):
    right = Anchor.advance

    def wrong(self, *args):
        last = self.target
        right(self, *args)
        self.target = self.target or last

    monkeypatch.setattr(Anchor, "advance", wrong)


def _anchor_comes_late(monkeypatch):
    right = anchor_module.num_due
    monkeypatch.setattr(anchor_module, "num_due", lambda *args: right(*args) - 1)


def _new_evidence_does_not_move_an_anchored_map(monkeypatch):
    monkeypatch.setattr(anchor_module, "team_step", lambda steps, **kwargs: [])


LOG_ODDS_DIFFER = "log-odds differ"
MAPS_DIFFER = "log-odds differ|cells are missing|cells are spurious|iterations differ"


@long
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
        ("bayes", "sync", _flows_are_rounded_at_one_end, LOG_ODDS_DIFFER),
        ("bayes", "sync", _flows_have_a_bit_more, LOG_ODDS_DIFFER),
        ("bayes", "on-arrival", _flows_have_a_bit_more, LOG_ODDS_DIFFER),
        ("bayes", "sync", _flows_are_rounded_to_nearest_in_the_twin, LOG_ODDS_DIFFER),
        ("bayes", "sync", _flow_steps_of_one_robot_in_the_twin, LOG_ODDS_DIFFER),
        ("bayes", "on-arrival", _flow_steps_of_one_robot_in_the_twin, LOG_ODDS_DIFFER),
        ("bayes", "sync", _evidence_comes_after_publishing, MAPS_DIFFER),
        ("natural", "sync", _anchor_stays, MAPS_DIFFER), ("gradient", "on-arrival", _anchor_stays, MAPS_DIFFER),
        ("natural", "on-arrival", _anchor_comes_late, LOG_ODDS_DIFFER),
        ("natural", "sync", _new_evidence_does_not_move_an_anchored_map, MAPS_DIFFER),
    ],
)  # fmt: skip
def test_the_comparison_fails_with_a_fault(monkeypatch, rule, mode, fault, message):
    _compare_without_fault(rule, mode)
    fault(monkeypatch)
    with pytest.raises(AssertionError, match=message):
        _compare(rule, mode)


def _compare(rule, mode):
    """Compare on a line that is in two parts from 5 s to 9 s."""
    apart = ScheduleEntry(5.0, 9.0, groups=(("robot_0", "robot_1"), ("robot_2", "robot_3")))
    compare(
        SMALL, topology="line", rule=rule, mode=mode, schedule=(apart,), anchor_after=2, gamma=0.5, settle=0, every=5
    )


_compare_without_fault = functools.cache(_compare)


@long
def test_the_comparison_fails_with_ties_that_are_absolute(monkeypatch):
    """Averages of evidence are small."""
    right = MapComparer.compare

    def compare_averages():
        compare(SMALL, topology="line", rule="bayes", evidence="time-average", settle=0, every=50, with_metrics=True)

    def absolute(self, *args, **kwargs):
        return right(self, *args, **{**kwargs, "least_tie": 1e-2})

    compare_averages()
    monkeypatch.setattr(MapComparer, "compare", absolute)
    with pytest.raises(AssertionError):
        compare_averages()


@long
@pytest.mark.parametrize(
    ("gate", "mode", "fault"),
    [
        (0.5, "sync", _gate_of(lambda gate: 0.0)), (0.5, "on-arrival", _gate_of(lambda gate: 0.0)),
        (0.5, "sync", _gate_of(lambda gate: 0.6)), (0.5, "sync", _gate_takes_labels_of_one_cell),
        (0.5, "sync", _gate_at_one_end), (1.0, "sync", _labels_do_not_open_the_gate),
    ],
)  # fmt: skip
def test_the_comparison_fails_with_a_fault_of_the_gate(monkeypatch, gate, mode, fault):
    _compare_gate(gate, mode)
    fault(monkeypatch)
    with pytest.raises(AssertionError, match=LOG_ODDS_DIFFER):
        _compare_gate(gate, mode)


def _compare_gate(gate, mode):
    compare(SMALL, topology="line", rule="bayes", mode=mode, flow_gate=gate, flow_bits=6, settle=0, every=5)


def _each_robot(robots, name, change):
    return tuple(dataclasses.replace(robot, **{name: getattr(robot, name) + change}) for robot in robots)


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
def test_the_comparison_fails_with_a_wrong_metric(monkeypatch, name, wrong):
    right = session_module.tick_metrics

    def measured(*args, **kwargs):
        metrics = right(*args, **kwargs)
        return dataclasses.replace(metrics, **{name: wrong(getattr(metrics, name))})

    monkeypatch.setattr(session_module, "tick_metrics", measured)
    with pytest.raises(AssertionError):
        compare(SMALL, topology="line", rule="gradient", settle=0, every=50, with_metrics=True)
