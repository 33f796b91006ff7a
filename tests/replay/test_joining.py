"""Robots that begin in their own frames and join during a run: exchange of evidence, joins, maps and metrics."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.verify import CellCounts, Verification
from octoreplay.replay.joining import Joining
from octoreplay.replay.session import Session
from octoreplay.transforms import inverse, numbers_of, pose_matrix, transform_of
from reference.scenarios import TeamShape, make_scenario
from support.long_suite import long, one_in
from support.sessions import FrameList

SCENARIO = make_scenario(5, TeamShape(num_robots=3, num_ticks=12, image=(12, 9), resolution=0.4, late_start=0.1))
ROBOTS = SCENARIO.robot_ids
TRUTH = {
    robot_id: transform_of(numbers_of(pose_matrix((3.0 * n, -2.0 * n, 0.1 * n), (0.0, 0.0, np.sin(n), np.cos(n)))))
    for n, robot_id in enumerate(ROBOTS)
}
"""Pose of each robot's map frame in the frame of the scenario, which is that of the first robot."""
JOIN_CELLS = 200
"""Known cells of both maps from which on the alignment of these tests succeeds."""


def own_frames(index, T_team_map=None):
    """Return the frames of a robot as its log gives them with a ``T_team_map`` (default: the identity)."""
    T = np.eye(4) if T_team_map is None else transform_of(T_team_map)
    to_own = inverse(TRUTH[ROBOTS[index]])
    return FrameList(
        tuple(
            dataclasses.replace(frame, T_team_sensor=T @ (to_own @ frame.T_team_sensor))
            for frame in SCENARIO.frames
            if frame.robot_id == ROBOTS[index]
        )
    )


def align_by_truth(joining, robots, attempt, maps):
    """Return the true pose of a pair, accepted where both maps are large enough."""
    del robots, maps
    T_frame = [
        TRUTH[ROBOTS[index]] @ inverse(transform_of(joining.frames.T_frame_map(index)))
        for index in (attempt.first, attempt.second)
    ]
    sizes = [octree.num_cells for octree in attempt.evidence]
    nothing = CellCounts(0, 0, 0)
    return PairAlignment(
        attempt.first, attempt.second, inverse(T_frame[0]) @ T_frame[1], np.eye(6),
        Verification(nothing, nothing, 1.0, float(sum(sizes)), 1.0), "" if min(sizes) >= JOIN_CELLS else "too small",
    )  # fmt: skip


@pytest.fixture
def by_truth(monkeypatch):
    monkeypatch.setattr(Joining, "_align", align_by_truth)


def configured(**parameters):
    values = {"rule": "bayes", "align": "on-air", "align_every": 2.0, **parameters}
    config = SCENARIO.config(**values)
    named = {"depth_topic": "/depth", "pose_topic": "/pose"}
    robots = [ResolvedRobot.from_config(dataclasses.replace(robot, **named), None) for robot in config.robots]
    return ResolvedRun.from_config(config, robots, SCENARIO.class_table)


def session_of(config, T_team_maps=None, num_threads=1):
    """Return a session that begins in the robots' own frames, or in given ones."""
    sources = [own_frames(i, None if T_team_maps is None else T_team_maps[i]) for i in range(len(ROBOTS))]
    return Session(config, sources, ThreadPoolExecutor(num_threads), reopen=own_frames)


def replayed(session):
    """Return a copy of the maps, the evidence and the metrics after each tick."""
    return [
        dataclasses.replace(
            tick, maps=tuple(m.copy() for m in tick.maps), evidence=tuple(e.copy() for e in tick.evidence)
        )
        for tick in session.ticks()
    ]


def values(octree):
    """Return the known cells of an octree and their values."""
    spans = octree.spans()
    cells = spans.cells_in(np.ones(spans.codes.size, np.bool_))
    return cells, np.repeat(spans.deviations, spans.num_cells, axis=0)


def assert_equal(octree, other, atol=0.0):
    cells, deviations = values(octree)
    other_cells, other_deviations = values(other)
    np.testing.assert_array_equal(cells, other_cells)
    np.testing.assert_allclose(deviations, other_deviations, rtol=0, atol=atol)


def given_run(session, **parameters):
    """Return the ticks of a run whose robots have from the beginning the frames that a session found."""
    found = [session.joining.frames.T_frame_map(index) for index in range(len(ROBOTS))]
    return replayed(session_of(SCENARIO.config(**{"rule": "bayes", **parameters}), found))


@long
@pytest.mark.parametrize("parameters", [
    {"rule": "bayes"}, {"rule": "local"}, {"rule": "flood", "packets": "delta", "latency": 1.2},
    pytest.param({"rule": "ratio"}, marks=long), pytest.param({"rule": "flood"}, marks=long),
    pytest.param({"rule": "bayes", "mode": "on-arrival"}, marks=long),
    pytest.param({"rule": "bayes", "evidence": "cell-average"}, marks=long),
    pytest.param({"rule": "bayes", "topology": "line"}, marks=long),
], ids=str)  # fmt: skip
def test_after_joining_maps_and_evidence_equal_those_of_a_run_with_the_found_frames(by_truth, parameters):
    session = session_of(configured(**parameters))
    ticks = replayed(session)
    assert len(session.joining.joins) == 2
    assert ticks[-1].metrics.num_components == 1
    expected = given_run(session, **parameters)
    for mine, other in zip(ticks[-1].evidence, expected[-1].evidence, strict=True):
        assert_equal(mine, other)
    for mine, other in zip(ticks[-1].maps, expected[-1].maps, strict=True):
        assert_equal(mine, other, 2e-3)
    assert_equal(ticks[-1].oracle, expected[-1].oracle)


@pytest.mark.parametrize("rule", one_in(3, ["gradient", "natural", "merge"]))
def test_other_rules_have_the_evidence_and_the_known_cells_of_a_run_with_the_found_frames(by_truth, rule):
    session = session_of(configured(rule=rule))
    ticks = replayed(session)
    expected = given_run(session, rule=rule)
    for mine, other in zip(ticks[-1].evidence, expected[-1].evidence, strict=True):
        assert_equal(mine, other)
    for mine, other in zip(ticks[-1].maps, expected[-1].maps, strict=True):
        np.testing.assert_array_equal(values(mine)[0], values(other)[0])


@pytest.mark.parametrize("latency", one_in(2, [1.2, 0.0]))
def test_robots_mix_only_with_robots_in_their_frame(by_truth, latency):
    """Until the first join, each map is the robot's own evidence; after it, the known cells are the component's."""
    seen = set()
    for tick in replayed(session_of(configured(latency=latency))):
        index_of = {robot_id: index for index, robot_id in enumerate(ROBOTS)}
        for component in tick.metrics.components:
            members = [index_of[robot_id] for robot_id in component]
            known = np.unique(np.concatenate([values(tick.evidence[i])[0] for i in members]))
            for index in members:
                assert np.isin(values(tick.maps[index])[0], known).all()
            if len(members) == 1:
                assert_equal(tick.maps[members[0]], tick.evidence[members[0]], 1e-5)
        seen.add(len(tick.metrics.components))
    assert seen == {1, 2, 3}


def test_scans_before_a_join_are_integrated_again(by_truth):
    session = session_of(configured())
    ticks = replayed(session)
    for join in session.joining.joins:
        before, after = ticks[join.tick - 1], ticks[join.tick]
        for robot_id in join.moved:
            index = ROBOTS.index(robot_id)
            assert after.metrics.robots[index].num_scans >= before.metrics.robots[index].num_scans > 0
            assert after.metrics.frame_of(robot_id) == join.frame_id != before.metrics.frame_of(robot_id)
            assert not np.array_equal(values(after.evidence[index])[0], values(before.evidence[index])[0])


def test_the_found_frames_are_those_of_the_team_whatever_the_order_of_the_joins(by_truth):
    session = session_of(configured())
    list(session.ticks())
    root = session.joining.frames.frame_id(0).removesuffix("/map")
    for index, robot_id in enumerate(ROBOTS):
        expected = inverse(TRUTH[root]) @ TRUTH[robot_id]
        found = transform_of(session.joining.frames.T_frame_map(index))
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_team_that_never_joins_keeps_its_frames_and_ends(monkeypatch):
    def refuse(joining, robots, attempt, maps):
        return dataclasses.replace(align_by_truth(joining, robots, attempt, maps), refusal="no")

    monkeypatch.setattr(Joining, "_align", refuse)
    session = session_of(configured())
    ticks = replayed(session)
    assert session.stop_reason
    assert ticks[-1].metrics.components == tuple((robot_id,) for robot_id in ROBOTS)
    assert ticks[-1].metrics.pairs == ()
    assert ticks[-1].metrics.total_distance_all == 0
    for octree, evidence in zip(ticks[-1].maps, ticks[-1].evidence, strict=True):
        assert_equal(octree, evidence, 1e-5)


def test_evidence_is_sent_every_align_every_seconds_and_costs_bytes(monkeypatch):
    monkeypatch.setattr(Joining, "search", lambda self, robots, *, is_last: None)
    for tick in replayed(session_of(configured(align_every=3.0))):
        if not tick.settling:
            sent = sum(link.sent_bytes for link in tick.metrics.links)
            assert (sent > 0) == (tick.number > 0 and tick.number % 3 == 0) or tick.number == 0
            assert all(published is None or not published.outbox for published in tick.published)


@long
def test_the_result_does_not_depend_on_the_number_of_threads(by_truth):
    one, four = (replayed(session_of(configured(rule="gradient"), num_threads=n)) for n in (1, 4))
    assert [tick.metrics for tick in one] == [tick.metrics for tick in four]
    for mine, other in zip(one[-1].maps, four[-1].maps, strict=True):
        assert_equal(mine, other)


@long
def test_lost_evidence_delays_a_join(by_truth):
    prompt, lossy = session_of(configured()), session_of(configured(loss=0.8))
    list(prompt.ticks()), list(lossy.ticks())
    assert all(one.tick <= other.tick for one, other in zip(prompt.joining.joins, lossy.joining.joins, strict=False))
    assert prompt.joining.joins != lossy.joining.joins


def test_robots_with_a_given_frame_begin_as_one_team_that_keeps_it(by_truth):
    config = configured()
    robots = list(config.robots)
    for index in (1, 2):
        robots[index] = dataclasses.replace(robots[index], T_team_map=numbers_of(TRUTH[ROBOTS[index]]))
    config = dataclasses.replace(config, robots=tuple(robots))
    given = [None, *(robot.T_team_map for robot in robots[1:])]
    session = session_of(config, given)
    ticks = replayed(session)
    assert ticks[0].metrics.components == (ROBOTS[1:], ROBOTS[:1])
    assert ticks[0].metrics.frame_of(ROBOTS[1]) == "team"
    assert [join.moved for join in session.joining.joins] == [ROBOTS[:1]]
    assert {place.frame_id for place in ticks[-1].metrics.places} == {"team"}
