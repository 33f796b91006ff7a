"""Rule weighted on small teams whose links and robots fail."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from support.faulty_team import configured, dense, finished_run, own_evidence, recording, session_of, team_sums
from support.long_suite import one_in

FAULTS = {
    "none": {},
    "losses": {"topology": "ring", "loss": 0.5, "network_seed": 1},
    "bad radio": {"topology": "line", "loss": 0.3, "latency": 1.2, "jitter": 1.0, "network_seed": 2},
    "one-way link": {"topology": "ring", "one_way": (("robot_0", "robot_1"),)},
    "restart": {"schedule": (ScheduleEntry(5.0, 8.0, robots_off=("robot_1",), forget=True),)},
    "partition": {"schedule": (ScheduleEntry(4.0, 9.0, groups=(("robot_0", "robot_1"), ("robot_2", "robot_3"))),)},
    "different periods": {"robots": {"robot_1": {"publish_period": 3.0, "publish_phase": 1.0}}},
}
ROUNDING = 0.05
"""Bound of what rounding to the quantum adds up to in a run."""


def excess(session):
    """Largest amount by which a log-odds of any tick exceeds what weighted means of the changes of evidence can reach.

    In each tick a weighted mean is at most the largest change of any robot's evidence, and at least the least one.
    """
    shape = (4, len(recording().keys), session.config.classes.num_classes)
    before, most, least = np.zeros(shape), np.zeros(shape[1:]), np.zeros(shape[1:])
    epochs, largest = [0] * 4, 0.0
    for tick in session.ticks():
        evidence = own_evidence(session)
        for index, robot in enumerate(session.team.robots):
            if robot.source.epoch != epochs[index]:
                before[index], epochs[index] = 0.0, robot.source.epoch
        change, before = evidence - before, evidence
        most += np.maximum(change.max(axis=0), 0.0)
        least += np.minimum(change.min(axis=0), 0.0)
        for octree in tick.maps:
            values = dense(octree)
            largest = max(largest, (values - most).max(), (least - values).max())
    assert np.abs(values).max() > 2.0
    return largest


@pytest.mark.parametrize(("name", "mode"), one_in(4, FAULTS, ["sync", "on-arrival"]))
def test_evidence_is_counted_at_most_once_whatever_fails(name, mode):
    config = configured(rule="weighted", mode=mode, settle=2, settle_max=6, **FAULTS[name])
    assert excess(session_of(config)) < ROUNDING


def test_merge_counts_evidence_more_than_once():
    assert excess(session_of(configured(rule="merge"))) > 1.0


@pytest.mark.parametrize("topology", ["complete", "line"])
def test_maps_settle_in_agreement_and_not_at_the_mean(topology):
    session, tick = finished_run(rule="weighted", topology=topology)
    assert session.stop_reason == "converged"
    maps = [dense(octree) for octree in tick.maps]
    assert max(np.abs(values - maps[0]).max() for values in maps) < 1e-3
    assert np.abs(team_sums(tick)[0] - dense(tick.oracle)).max() > 1.0


def test_a_cell_that_one_robot_saw_fades_less_than_in_the_mean():
    seen_once = None
    sizes = {}
    for rule in ("weighted", "bayes"):
        session, tick = finished_run(rule=rule)
        evidence = np.abs(own_evidence(session)).max(axis=2)
        seen_once = (evidence > 1.0).sum(axis=0) == (evidence > 0.0).sum(axis=0)
        seen_once &= (evidence > 0.0).sum(axis=0) == 1
        sizes[rule] = np.abs(dense(tick.maps[0])).max(axis=1)[seen_once].mean()
    assert seen_once.sum() > 100
    assert sizes["weighted"] > 1.5 * sizes["bayes"]
