"""Teams of robots with running sums: conservation, convergence and drift."""

from __future__ import annotations

import math

import numpy as np
import pytest

from octoreplay.mapping import running_sums
from octoreplay.mapping.kernels.running_sums import MODULUS
from octoreplay.mapping.running_sums import (
    LEAST_WEIGHT,
    UNIT,
    WHOLE_WEIGHT,
    add_evidence,
    receive,
    recover_map,
    share_out,
    share_weight,
)
from reference import ratio
from reference.ratio import RatioRobot, quantised
from support.long_suite import long, one_in
from support.masses import NUM_CLASSES, log_odds_octree, mass_of, signed, units_of, value_at
from support.octree_factory import cells_of, cube

KEYS = (*cube((0, 0, 0), 2, 0), (2, 2, 2), (5, 1, 0), (9, 9, 9), (-3, 0, 4))


def _dense(octree):
    """Integers (M, C) of a mass at KEYS, 0 where it is unknown."""
    cells = units_of(octree)
    return np.array([value_at(cells, key) for key in KEYS])


def _of_dense(values):
    """The octree of log-odds (M, C) at KEYS."""
    return log_odds_octree(dict(zip(KEYS, values, strict=True)))


class Robot:
    """State of a robot as in a session, and of its reference."""

    def __init__(self):
        self.mass, self.total, self.map = (log_odds_octree({}) for _ in range(3))
        self.weight, self.total_weight = WHOLE_WEIGHT, 0
        self.evidence, self.last_evidence = log_odds_octree({}), log_odds_octree({})
        self.last_received = {}
        self.twin = RatioRobot((len(KEYS), NUM_CLASSES))

    def observe(self, log_odds):
        self.evidence = _of_dense(log_odds)
        add_evidence(self.mass, self.evidence, self.last_evidence, 0, 0)
        self.last_evidence = self.evidence
        self.twin.observe(log_odds)

    def share_out(self, num_receivers):
        share_out(self.mass, self.total, num_receivers, 0)
        share, self.weight = share_weight(self.weight, num_receivers)
        self.total_weight += share
        self.twin.share_out(num_receivers)

    def sums(self):
        """Content of a packet: sigma and eta, and those of the reference."""
        return self.total.copy(), self.total_weight, self.twin.total, self.twin.total_weight

    def start_link(self, sender, sums):
        """A link comes up: earlier shares are not for this receiver."""
        self.last_received[sender], self.twin.last_received[sender] = sums[:2], sums[2:]

    def receive(self, sender, sums):
        old, old_weight = self.last_received.get(sender, (None, 0))
        receive(self.mass, [(sums[0], old)], 0)
        self.weight += sums[1] - old_weight
        self.last_received[sender] = sums[:2]
        self.twin.receive(sender, *sums[2:])

    def recover(self):
        recover_map(self.mass, self.weight, self.map, 0)
        return _map(self.map)


def _map(octree):
    """Log-odds (M, C) float64 at KEYS."""
    cells = cells_of(octree)
    return np.array([np.frombuffer(cells[key], np.float32) for key in KEYS], np.float64)


def _team(rng, size):
    """Robots with evidence in the range of clamped log-odds, and its mean."""
    robots = [Robot() for _ in range(size)]
    evidence = [np.clip(rng.normal(size=(len(KEYS), NUM_CLASSES)) * 5, -5, 5).astype(np.float32) for _ in robots]
    for robot, log_odds in zip(robots, evidence, strict=True):
        robot.observe(log_odds)
    return robots, np.mean(evidence, axis=0, dtype=np.float64)


def _tick(robots, receivers, rng=None, loss=0.0):
    """One tick: all robots share out, then the packets arrive that are not lost."""
    for robot, others in zip(robots, receivers, strict=True):
        robot.share_out(len(others))
    for sender, others in enumerate(receivers):
        for other in others:
            if rng is None or rng.random() >= loss:
                robots[other].receive(sender, robots[sender].sums())


def _ring(size):
    return [[(robot + 1) % size, (robot - 1) % size] for robot in range(size)]


@long
@pytest.mark.parametrize("seed", one_in(2, range(2)))
def test_mass_is_conserved_over_links_that_lose_delay_repeat_and_reorder(seed):
    """At every tick, with changing evidence, masses and shares under way add up to the evidence exactly."""
    rng = np.random.default_rng(seed)
    robots, _ = _team(rng, 5)
    # A one-way ring, which connects all robots, and some more links.
    receivers = [sorted({(i + 1) % 5, *rng.choice(5, 2).tolist()} - {i}) for i in range(5)]
    packets, newest = [], {}
    for tick in range(30):
        for robot in robots:
            if rng.random() < 0.3:
                robot.observe(np.clip(rng.normal(size=(len(KEYS), NUM_CLASSES)) * 4, -5, 5).astype(np.float32))
        for sender, robot in enumerate(robots):
            robot.share_out(len(receivers[sender]))
            for receiver in receivers[sender]:
                copies = rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])
                packets += [(tick + rng.integers(0, 4), tick, sender, receiver, robot.sums()) for _ in range(copies)]
        rng.shuffle(packets)
        for due, sent, sender, receiver, sums in packets:
            if due == tick and sent > newest.get((sender, receiver), -1):
                newest[sender, receiver] = sent
                robots[receiver].receive(sender, sums)
        packets = [packet for packet in packets if packet[0] > tick]
        masses, weight = sum(_dense(robot.mass) for robot in robots), sum(robot.weight for robot in robots)
        for sender, robot in enumerate(robots):
            for receiver in receivers[sender]:
                octree, old_weight = robots[receiver].last_received.get(sender, (log_odds_octree({}), 0))
                masses = masses + _dense(robot.total) - _dense(octree)
                weight += robot.total_weight - old_weight
        evidence = sum(robot.twin.evidence for robot in robots)
        assert (signed(masses) == evidence).all()
        assert weight == len(robots) * WHOLE_WEIGHT
        for robot in robots:
            assert (_dense(robot.mass) == robot.twin.mass).all()
            assert (_dense(robot.total) == signed(robot.twin.total)).all()
            assert (robot.weight, robot.total_weight) == (robot.twin.weight, robot.twin.total_weight)


@long
def test_ring_with_a_third_of_the_packets_lost_converges_to_the_mean():
    rng = np.random.default_rng(0)
    robots, mean = _team(rng, 6)
    num_compared = 0
    for tick in range(120):
        _tick(robots, _ring(6), rng, 0.3)
        if tick >= 60:
            errors = [abs(robot.recover() - mean).max() for robot in robots if robot.weight >= LEAST_WEIGHT]
            assert max(errors) < 1e-4
            num_compared += len(errors)
    assert num_compared > 0.9 * 6 * 60
    for _ in range(40):
        _tick(robots, _ring(6))
    assert max(abs(robot.recover() - mean).max() for robot in robots) < 1e-4


def test_team_follows_changing_evidence():
    rng = np.random.default_rng(1)
    robots, first = _team(rng, 4)
    for _ in range(10):
        for robot in robots:
            evidence = rng.uniform(-5, 5, (len(KEYS), NUM_CLASSES)).astype(np.float32)
            robot.observe(evidence)
        _tick(robots, _ring(4), rng, 0.3)
    mean = sum(robot.twin.evidence for robot in robots) * UNIT / 4
    assert abs(mean - first).max() > 1.0
    for _ in range(40):
        _tick(robots, _ring(4))
    assert max(abs(robot.recover() - mean).max() for robot in robots) < 1e-4


@long
def test_no_drift_over_a_day_of_ticks():
    """The reference runs for 86,400 ticks; octrees are compared for a while at the start, in the middle and at the end.

    The reference uses Python integers. With evidence of hundreds, the octrees' sums wrap around every few dozen ticks.
    """
    rng = np.random.default_rng(3)
    evidence = rng.uniform(200, 400, (3, len(KEYS), NUM_CLASSES)).astype(np.float32) * rng.choice([-1, 1], NUM_CLASSES)
    twins = [RatioRobot(evidence.shape[1:]) for _ in range(3)]
    for twin, log_odds in zip(twins, evidence, strict=True):
        twin.observe(log_odds)
    octrees, num_wraps = None, 0
    for tick in range(86_400):
        if tick in (0, 43_000, 86_360):
            octrees = [(_of_units(twin.mass), _of_units(twin.total)) for twin in twins]
            last_received = [
                _of_units(twins[i].last_received.get(i - 1, (twins[i].total * 0, 0))[0]) for i in (0, 1, 2)
            ]
        arrives = rng.random(3) >= 0.3
        for twin in twins:
            twin.share_out(1)
        for i in np.flatnonzero(arrives):
            sender = twins[i - 1]
            twins[i].receive(i - 1, sender.total, sender.total_weight)
        if octrees is None:
            continue
        for mass, total in octrees:
            share_out(mass, total, 1, tick)
        for i in np.flatnonzero(arrives):
            sums = octrees[i - 1][1].copy()
            receive(octrees[i][0], [(sums, last_received[i])], tick)
            last_received[i] = sums
        if tick in (39, 43_039, 86_399):
            for twin, (mass, total) in zip(twins, octrees, strict=True):
                assert (_dense(mass) == twin.mass).all()
                assert (_dense(total) == signed(twin.total)).all()
                num_wraps = int(abs(twin.total).min() // MODULUS)
            octrees = None
    assert num_wraps > 1000
    under_way = [twins[i - 1].total - twins[i].last_received[i - 1][0] for i in range(3)]
    assert (sum(twin.mass for twin in twins) + sum(under_way) == quantised(evidence).sum(axis=0)).all()
    mean = evidence.mean(axis=0, dtype=np.float64)
    errors = [abs(twin.log_odds - mean).max() for twin in twins if twin.weight >= LEAST_WEIGHT]
    assert 0 < max(errors) < 1e-4


def _of_units(values):
    return mass_of(dict(zip(KEYS, values, strict=True)))


def test_newcomer_converges_at_the_rate_of_lambda_2():
    """lambda_2 is the second largest |eigenvalue| of the share matrix, column i with 1 / (1 + D_i) at i's receivers.

    In one step all robots share out and all packets arrive. The error is relative to that before the first step.
    """
    rng = np.random.default_rng(5)
    robots, mean = _team(rng, 6)
    without = [[j for j in others if j != 5] for others in _ring(6)]
    without[5] = []
    for _ in range(60):
        _tick(robots, without)
    receivers = _ring(6)
    matrix = np.zeros((6, 6))
    for i, others in enumerate(receivers):
        matrix[[i, *others], i] = 1 / (1 + len(others))
    second = np.sort(abs(np.linalg.eigvals(matrix)))[-2]
    num_ticks = math.ceil(math.log(0.01) / math.log(second))
    assert num_ticks == 12
    for sender, receiver in ((0, 5), (4, 5), (5, 0), (5, 4)):
        robots[receiver].start_link(sender, robots[sender].sums())
    start = abs(robots[5].recover() - mean).max()
    assert start > 1.0
    for _ in range(num_ticks):
        _tick(robots, receivers)
    assert abs(robots[5].recover() - mean).max() < 0.01 * start
    assert sum(robot.weight for robot in robots) == 6 * WHOLE_WEIGHT
    for robot in robots:
        assert (_dense(robot.mass) == robot.twin.mass).all()
    for _ in range(30):
        _tick(robots, receivers)
    assert max(abs(robot.recover() - mean).max() for robot in robots) < 1e-4


def test_units_are_those_of_the_reference():
    assert (UNIT, WHOLE_WEIGHT, running_sums.WEIGHT_UNIT) == (ratio.UNIT, ratio.WHOLE_WEIGHT, 1 / ratio.WHOLE_WEIGHT)
