"""Flows of the rule bayes in sessions: the exact sum, rest, and settling; anchored pull after a partition."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.replay.robots import consensus as consensus_module
from support.faulty_team import configured, dense, session_of
from support.long_suite import long, one_in
from support.sessions import sent_packets

GROUPS = ScheduleEntry(3.0, 7.0, groups=(("robot_0", "robot_1"), ("robot_2", "robot_3")))
QUANTUM = 2.0**-16


def _sums(octrees):
    """Sum over octrees, which float64 holds exactly."""
    return np.sum([dense(octree) for octree in octrees], axis=0)


TEAMS = (
    {"topology": "ring"},
    {"topology": "line", "packets": "delta", "flow_bits": 1},
    {"topology": "random", "network_seed": 3, "flow_bits": 7, "quantum": 2.0**-12},
    {"topology": "range", "radio_range": 4.0, "packets": "delta"},
    {"topology": "complete", "schedule": (GROUPS,), "packets": "delta"},
    {"topology": "ring", "schedule": (ScheduleEntry(4.0, 8.0, robots_off=("robot_1",)),)},
    {"topology": "ring", "packets": "delta", "content": "int8", "flow_bits": 4},
    {"topology": "line", "period": 3.0},
    {"topology": "ring", "packets": "delta", "flow_gate": 1.0},
)


@pytest.mark.parametrize(("parameters", "mode"), one_in(7, TEAMS, ["sync", "on-arrival"]), ids=str)
def test_the_sum_of_the_maps_is_the_sum_of_the_evidence_in_every_tick(parameters, mode):
    parameters = dict(parameters)
    period = parameters.pop("period", None)
    names = [f"robot_{number}" for number in range(4)]
    robots = {name: {"publish_period": period, "publish_phase": 1.0} for name in names if period is not None}
    config = configured(rule="bayes", mode=mode, settle=2, settle_max=12, robots=robots, **parameters)
    num_mixed = 0
    for tick in session_of(config).ticks():
        total = _sums(tick.evidence)
        np.testing.assert_array_equal(_sums(tick.maps), total, err_msg=f"tick {tick.number}")
        assert not (total % config.consensus.effective_quantum).any()
        num_mixed += any((dense(a) != dense(b)).any() for a, b in zip(tick.maps, tick.evidence, strict=True))
    assert tick.settling
    assert num_mixed > tick.number / 2


def _num_moved(flow_bits, flow_gate=0.0):
    """Bricks of all maps that changed in a tick of a ring, summed over the ticks of the logs."""
    config = configured(rule="bayes", topology="ring", flow_bits=flow_bits, flow_gate=flow_gate, settle=0)
    return sum(
        np.count_nonzero(octree.revisions == tick.number) for tick in session_of(config).ticks() for octree in tick.maps
    )


def test_fewer_bricks_move_with_flows_than_without():
    assert _num_moved(4) < 0.9 * _num_moved(0)


@long
def test_fewer_bricks_move_with_a_gate():
    assert _num_moved(6, 1.0) < _num_moved(6, 0.5) < _num_moved(6)


def test_neighbours_at_rest_differ_by_less_than_the_bound():
    for tick in session_of(configured(rule="bayes", topology="ring")).ticks():
        maps = [dense(octree) for octree in tick.maps]
    assert tick.metrics.max_change == 0.0
    for i, j in tick.graph.pairs:
        assert np.abs(maps[i] - maps[j]).max() < QUANTUM / tick.graph.weights[i, j]


@pytest.mark.parametrize(
    "parameters",
    one_in(
        3, [{"topology": "ring"}, {"topology": "line", "schedule": (GROUPS,)}, {"topology": "line", "flow_gate": 0.5}]
    ),
    ids=str,
)
def test_skipping_bricks_at_rest_does_not_change_a_byte_of_the_deltas(parameters, monkeypatch):
    config = configured(rule="bayes", packets="delta", settle=2, **parameters)
    right, num_skipping, runs = consensus_module.team_step, 0, []

    def counted(steps, **kwargs):
        nonlocal num_skipping
        num_skipping += sum(step.since is not None for step in steps if step.neighbours)
        return right(steps, **kwargs)

    def whole(steps, **kwargs):
        return right([dataclasses.replace(step, since=None) for step in steps], **kwargs)

    for function in (counted, whole):
        monkeypatch.setattr(consensus_module, "team_step", function)
        runs.append(
            [
                (sent_packets(tick), tick.metrics.total_distance_all, tick.metrics.max_change)
                for tick in session_of(config).ticks()
            ]
        )
    assert num_skipping > 4
    assert runs[0] == runs[1]


def _kept_after(cut, rule, mode, anchor_after):
    """For each robot whether cells without new evidence keep their values after ``cut``, where all links end."""
    apart = ScheduleEntry(cut, 1e9, groups=tuple((f"robot_{number}",) for number in range(4)))
    config = configured(rule=rule, mode=mode, schedule=(apart,), anchor_after=anchor_after, settle=0)
    states = [
        [(dense(octree), dense(own)) for octree, own in zip(tick.maps, tick.evidence, strict=True)]
        for tick in session_of(config).ticks()
    ]
    before, last = states[int(cut) + max(anchor_after, 1) - 2], states[-1]
    kept = []
    for (old_map, old_evidence), (new_map, new_evidence) in zip(before, last, strict=True):
        is_old = (old_evidence == new_evidence).all(axis=1) & old_map.any(axis=1)
        assert is_old.sum() > 50
        kept.append(bool((old_map[is_old] == new_map[is_old]).all()))
    return kept


@long
@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
@pytest.mark.parametrize("rule", ["gradient", "natural"])
def test_a_robot_that_receives_nothing_keeps_what_it_learned(rule, mode):
    assert all(_kept_after(9.0, rule, mode, anchor_after=1))
    assert all(_kept_after(7.0, rule, mode, anchor_after=3))
    assert not any(_kept_after(9.0, rule, mode, anchor_after=0))
