"""Rule latest on small teams, with and without faults, against the reference on dense arrays."""

from __future__ import annotations

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from octoreplay.replay.exchange.messages import Source
from reference.latest import LatestMap
from support.faulty_team import (
    PACKETS,
    configured,
    dense,
    finished_run,
    known_cells,
    own_evidence,
    recording,
    session_of,
)
from support.long_suite import long, one_in

FAULTS = {
    "none": {},
    "ring": {"topology": "ring"},
    "bad radio": {"topology": "ring", "loss": 0.4, "latency": 1.2, "jitter": 1.0, "network_seed": 1},
    "partition": {"topology": "ring", "schedule": (
        ScheduleEntry(4.0, 9.0, groups=(("robot_0", "robot_1"), ("robot_2", "robot_3"))),)},
    "different periods": {"topology": "line", "robots": {"robot_1": {"publish_period": 3.0, "publish_phase": 1.0}}},
    "restart": {"schedule": (ScheduleEntry(5.0, 8.0, robots_off=("robot_1",), forget=True),)},
}  # fmt: skip


def state_of(octree):
    return dense(octree), known_cells(octree)


def states_at(robot, seen):
    """States of evidence that are new to a robot in this tick: its own, and those with a new version."""
    states = {robot.source: state_of(robot.evidence.octree)}
    for source, held in robot.exchange.held.items():
        if source != robot.source and seen.get(source) != held.version:
            states[source] = state_of(held.octree)
            seen[source] = held.version
    return states


@pytest.mark.parametrize(("faults", "packets"), one_in(5, FAULTS, PACKETS))
def test_every_map_equals_the_reference_in_every_tick(faults, packets):
    session = session_of(configured(rule="latest", **FAULTS[faults], **PACKETS[packets]))
    shape = (len(recording().keys), session.config.classes.num_classes)
    twins, seen, largest = {}, {}, 0.0
    for tick in session.ticks():
        for index in tick.graph.active:
            robot = session.team.robots[index]
            twin = twins.setdefault(robot.source, LatestMap(shape))
            twin.take(states_at(robot, seen.setdefault(robot.source, {})))
            np.testing.assert_array_equal(dense(robot.map), twin.values)
            np.testing.assert_array_equal(known_cells(robot.map), twin.known)
        others = [dense(tick.maps[index]) - own_evidence(session)[index] for index in tick.graph.active]
        largest = max(largest, *(np.abs(difference).max() for difference in others)) if others else largest
    assert largest > 1.0, "no robot took anything from another one"
    assert session.stop_reason == "converged"


def test_each_cell_holds_the_evidence_of_one_robot():
    session, tick = finished_run(rule="latest", topology="ring")
    evidence = own_evidence(session)
    known = np.array([known_cells(robot.evidence.octree) for robot in session.team.robots])
    for octree in tick.maps:
        is_of_robot = (dense(octree) == evidence).all(axis=2) & known
        assert (is_of_robot.any(axis=0) == known.any(axis=0)).all()
        np.testing.assert_array_equal(known_cells(octree), known.any(axis=0))


def test_robots_that_heard_all_changes_in_their_ticks_have_equal_maps_and_a_newcomer_does_not():
    session, tick = finished_run(rule="latest")
    maps = [dense(octree) for octree in tick.maps]
    assert (maps[1] == maps[0]).all()
    assert (maps[2] == maps[0]).all()
    # The last robot takes in one tick what the others took in four.
    assert (maps[3] != maps[0]).any()
    assert np.abs(maps[0] - dense(tick.oracle)).max() > 1.0
    assert tick.metrics.robots[0].memory_bytes > session.team.robots[0].map.memory_bytes


def test_of_changes_in_one_tick_that_of_the_last_robot_wins():
    num_contested = 0
    before = np.zeros((4, len(recording().keys), 1))
    for tick in session_of(configured(rule="latest")).ticks():
        evidence = np.array([dense(octree) for octree in tick.evidence])
        changed = (evidence != before).any(axis=2)
        before = evidence
        last = 3 - np.argmax(changed[::-1], axis=0)
        contested = np.flatnonzero(changed.sum(axis=0) > 1)
        num_contested += contested.size
        for index in tick.graph.active:
            np.testing.assert_array_equal(dense(tick.maps[index])[contested], evidence[last[contested], contested])
    assert num_contested > 10


@long
def test_a_robot_that_forgot_gets_the_evidence_of_its_earlier_epoch_back():
    schedule = (ScheduleEntry(5.0, 8.0, robots_off=("robot_1",), forget=True),)
    session, tick = finished_run(rule="latest", topology="ring", schedule=schedule)
    robot = session.team.robots[1]
    past = state_of(robot.exchange.held[Source(1, 0)].octree)[1]
    assert past.any()
    assert known_cells(tick.maps[1])[past].all()
