"""Anchored pull of the rules gradient and natural."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from octoreplay.config.network import ScheduleEntry
from reference import graph, rules
from reference.anchors import Anchor
from reference.hand_made import ray, team_config
from reference.twin import Twin, record

CUT, BACK, LAST = 6, 24, 30
"""Ticks: no link between a and the others in [CUT, BACK), LAST is the last one before settling."""
PARTITION = ScheduleEntry(float(CUT), float(BACK), groups=(("a",), ("b", "c")))

H, Q = np.array([[0.0, 2.0]]), np.array([[0.0, 0.5]])
NOTHING = np.zeros((1, 2))


def _team(rule, *, late=(), schedule=(PARTITION,), **parameters):
    """Return configuration and recording of three robots with evidence in the first ticks; ``late`` are more frames."""
    frames = [ray("a", 0.2, 1), ray("a", 1.3, 1), ray("b", 0.4, 2), ray("b", 2.2, 2), ray("c", 0.1, 2, distance=1.0)]
    frames += [*late, ray("c", LAST - 0.5, 0, distance=0.5)]
    config = team_config("abc", rule=rule, **{"settle": 0, **parameters})
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, schedule=tuple(schedule)))
    return config, record(config, sorted(frames, key=lambda frame: frame.stamp_ns))


def _ticks(config, recording):
    return list(Twin(config, recording, with_metrics=False).ticks())


def _plain_step(config, before, tick, robot):
    """Return the step of Alg. 1 (or its natural form) from the maps of the tick before."""
    robot_ids = [robot.robot_id for robot in config.robots]
    team = graph.team_graph(config.network, config.consensus, robot_ids, tick.active, float(tick.tick))
    maps = before.maps
    mixed = rules.mix(
        maps[robot], [(team.weights[robot, j], maps[j] - maps[robot]) for j in team.neighbours(robot)], team.epsilon
    )
    step = rules.gradient_step if config.consensus.rule == "gradient" else rules.natural_step
    return rules.rounded(step(mixed, tick.evidence[robot], config.consensus.gamma), config.consensus.effective_quantum)


def check_rest_and_return(config, recording):
    """Check that a robot that is cut off keeps its map, and that it follows the plain rule when it is back."""
    ticks = _ticks(config, recording)
    gone = CUT + config.consensus.anchor_after - 1
    for tick in ticks[gone:BACK]:
        np.testing.assert_array_equal(tick.maps[0], ticks[gone - 1].maps[0])
    distance = np.abs(ticks[BACK - 1].maps[0] - ticks[BACK - 1].evidence[0]).max()
    assert distance > 0.02
    connected = [*range(1, gone), *range(BACK, LAST + 1)]
    for number in connected:
        for robot in range(3):
            expected = _plain_step(config, ticks[number - 1], ticks[number], robot)
            np.testing.assert_array_equal(ticks[number].maps[robot], expected if ticks[number].active[robot] else 0.0)
    return ticks


@pytest.mark.parametrize("rule", ["gradient", "natural"])
@pytest.mark.parametrize("anchor_after", [1, 5])
def test_a_robot_that_is_cut_off_keeps_its_map_until_it_is_back(rule, anchor_after):
    ticks = check_rest_and_return(*_team(rule, anchor_after=anchor_after))
    assert len(ticks) == LAST + 1


@pytest.mark.parametrize("rule", ["gradient", "natural"])
def test_only_new_evidence_moves_a_robot_that_is_cut_off(rule):
    # The scan enters in the tick in which a loses the others, or in a later one.
    for tick in (CUT + 4, CUT + 8):
        quiet = _ticks(*_team(rule))
        moved = _ticks(*_team(rule, late=[ray("a", tick - 0.5, 2)]))
        assert all((a.maps == b.maps).all() for a, b in zip(quiet[:tick], moved[:tick], strict=True))
        change = moved[BACK - 1].maps[0] - quiet[BACK - 1].maps[0]
        new = moved[BACK - 1].evidence[0] - quiet[BACK - 1].evidence[0]
        assert (np.sign(change) == np.sign(new)).all()
        if rule == "natural":
            np.testing.assert_allclose(change, new, atol=2 * 2.0**-10)


@pytest.mark.parametrize("rule", ["gradient", "natural"])
@pytest.mark.parametrize("mode", ["sync", "on-arrival"])
def test_a_connected_team_has_no_anchor(rule, mode):
    with_anchor = _ticks(*_team(rule, schedule=(), mode=mode))
    without = _ticks(*_team(rule, schedule=(), mode=mode, anchor_after=0))
    for one, other in zip(with_anchor, without, strict=True):
        np.testing.assert_array_equal(one.maps, other.maps)


def test_without_anchors_a_robot_that_is_cut_off_walks_to_its_evidence():
    last = _ticks(*_team("natural", anchor_after=0))[BACK - 1]
    np.testing.assert_allclose(last.maps[0], last.evidence[0], atol=2 * 2.0**-10)
    kept = _ticks(*_team("natural"))[BACK - 1]
    assert np.abs(kept.maps[0] - kept.evidence[0]).max() > 0.02


def test_bayes_has_no_anchor():
    for one, other in zip(_ticks(*_team("bayes")), _ticks(*_team("bayes", anchor_after=0)), strict=True):
        np.testing.assert_array_equal(one.maps, other.maps)


# --- absent robots ---------------------------------------------------------------------------------------------------


def test_a_robot_is_absent_after_so_many_missing_publications():
    anchor = Anchor((1, 2), 3)
    anchor.update({1, 2}, {1}, H, Q)
    for expected in (False, False, True, True):
        anchor.update({1, 2}, set(), H, Q)
        assert (anchor.absent == {1}) is expected
        assert anchor.offset.tolist() == ((H - Q) if expected else NOTHING).tolist()
    anchor.update({1, 2}, {1}, H, Q)
    assert (anchor.absent, anchor.offset.tolist()) == (frozenset(), NOTHING.tolist())


def test_publications_that_are_not_due_are_not_missing():
    anchor = Anchor((1, 2), 2)
    anchor.update({1}, {1}, H, Q)
    for due, expected in (({1}, 0), (set(), 0), (set(), 0), ({1}, 1)):
        anchor.update(due, set(), H, Q)
        assert len(anchor.absent) == expected


def test_the_offset_is_taken_anew_when_the_absent_robots_change():
    anchor = Anchor((1, 2), 1)
    anchor.update({1, 2}, {1, 2}, H, Q)
    anchor.update({1, 2}, {2}, H, Q)
    assert anchor.offset.tolist() == [[0.0, 1.5]]
    # The set stays {1}.
    anchor.update({1, 2}, {2}, 3 * H, Q)
    assert anchor.offset.tolist() == [[0.0, 1.5]]
    # It gains 2, then loses 1.
    anchor.update({1, 2}, set(), 2 * H, Q)
    assert anchor.offset.tolist() == [[0.0, 3.5]]
    anchor.update({1, 2}, {1}, 3 * H, 2 * Q)
    assert anchor.offset.tolist() == [[0.0, 5.0]]


def test_0_turns_anchors_off():
    anchor = Anchor((1, 2), 0)
    anchor.update({1}, {1}, H, Q)
    anchor.update({1}, set(), H, Q)
    assert not anchor.absent
    assert not anchor.offset.any()


# --- faults that the properties must detect --------------------------------------------------------------------------


def _anchor_is_not_dropped(monkeypatch):
    right = Anchor.offset_of
    monkeypatch.setattr(Anchor, "offset_of", lambda self, h, q: right(self, h, q) if self.absent else self.offset)


def _anchor_is_not_taken(monkeypatch):
    monkeypatch.setattr(Anchor, "offset_of", lambda self, h, q: np.zeros_like(h))


@pytest.mark.parametrize("rule", ["gradient", "natural"])
@pytest.mark.parametrize("fault", [_anchor_is_not_dropped, _anchor_is_not_taken])
def test_faults_of_the_anchor_are_detected(monkeypatch, fault, rule):
    config, recording = _team(rule)
    fault(monkeypatch)
    with pytest.raises(AssertionError):
        check_rest_and_return(config, recording)
