"""Reference of ratio consensus, by hand."""

from __future__ import annotations

import numpy as np

from reference.ratio import UNIT, WHOLE_WEIGHT, RatioRobot, quantised, share_of


def _pair(first, second):
    robots = [RatioRobot((1,)), RatioRobot((1,))]
    for robot, log_odds in zip(robots, (first, second), strict=True):
        robot.observe(np.array([log_odds]))
    return robots


def test_rounding_is_to_nearest_and_ties_go_to_even():
    assert share_of(np.array([-7, -3, -1, 1, 3, 5, 7]), 1).tolist() == [-4, -2, 0, 0, 2, 2, 4]
    assert quantised(np.array([0.5, 1.5, -2.5, 3.2]) * UNIT).tolist() == [0, 2, -2, 3]


def test_two_robots_agree_after_one_exchange():
    a, b = _pair(3.0, -1.0)
    for robot in (a, b):
        robot.share_out(1)
    a.receive(1, b.total, b.total_weight)
    b.receive(0, a.total, a.total_weight)
    assert a.log_odds == b.log_odds == 1.0
    assert a.weight == b.weight == WHOLE_WEIGHT


def test_next_packet_replaces_a_lost_one():
    a, b = _pair(4.0, 0.0)
    a.share_out(1)
    a.share_out(1)
    b.receive(0, a.total, a.total_weight)
    b.receive(0, a.total, a.total_weight)
    assert b.mass * UNIT == 3.0
    assert b.weight == 1.75 * WHOLE_WEIGHT
    assert a.log_odds == 4.0


def test_evidence_counts_once():
    a, _ = _pair(4.0, 0.0)
    a.observe(np.array([-1.0]))
    a.observe(np.array([-1.0]))
    assert a.log_odds == -1.0
