"""Ratio consensus on octrees against the reference on dense arrays, bit for bit, and invariants of teams."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octoreplay.mapping import running_sums
from octoreplay.mapping.codec import decode_packet, encode_packet
from octoreplay.mapping.kernels import storage
from octoreplay.mapping.kernels.running_sums import MODULUS
from octoreplay.mapping.running_sums import (
    LEAST_WEIGHT,
    MAX_MASS,
    UNIT,
    WHOLE_WEIGHT,
    add_evidence,
    difference,
    receive,
    receive_team,
    recover_map,
    share_out,
    share_weight,
)
from reference import ratio
from reference.ratio import RatioRobot, quantised
from support.octree_factory import cells_of, cube, octree_of

NUM_CLASSES = 3


def _octree(cells):
    return octree_of(cells, num_classes=NUM_CLASSES)


def _mass(cells):
    """Octree of integers (C,) of any size, stored modulo MODULUS as bits."""
    return _octree({key: np.asarray(units % MODULUS, np.int32).view(np.float32) for key, units in cells.items()})


def _units(octree):
    """{key: integers (C,)} of a mass, in [-MODULUS / 2, MODULUS / 2)."""
    bits = {key: np.frombuffer(value, np.int32).astype(np.int64) for key, value in cells_of(octree).items()}
    assert all(((value >= 0) & (value < MODULUS)).all() for value in bits.values())
    return {key: _signed(value) for key, value in bits.items()}


def _signed(units):
    return (units + MODULUS // 2) % MODULUS - MODULUS // 2


def _random_cells(rng, *, of_log_odds=False):
    """Whole bricks, smaller cubes and single cells, with one value or one for each class; some overlap."""
    cells = {}
    most = rng.choice([1.0, 5.0, 900.0]) if of_log_odds else rng.choice([3, 1 << 17, MAX_MASS])
    for _ in range(rng.integers(0, 5)):
        edge = int(rng.choice([1, 3, 4]))
        corner = (rng.integers(-2, 2, 3) * (4 if edge == 4 else 3)).tolist()
        values = rng.uniform(-most, most, NUM_CLASSES).astype(np.float32)
        values = values if of_log_odds else np.rint(values.astype(np.float64)).astype(np.int64)
        cells.update(cube(corner, edge, values if rng.random() < 0.5 else np.full(NUM_CLASSES, values[0])))
    return cells


def _value(cells, key):
    return cells.get(key, np.zeros(NUM_CLASSES, np.int64))


def _sum(*terms):
    """{key: signed sum of factor x cells} of the cells known in any of the terms (factor, cells)."""
    keys = set().union(*(cells for _, cells in terms))
    return {key: _signed(sum(factor * _value(cells, key) for factor, cells in terms)) for key in keys}


def _assert_equal(found, expected):
    assert found.keys() == expected.keys()
    assert all((found[key] == expected[key]).all() for key in expected)


def _changed_bricks(before, after):
    """Codes of the bricks with a cell that has another value or became known."""
    changed = {key for key in after if key not in before or (before[key] != after[key]).any()}
    return {int(storage.key_to_code(*key)) >> storage.CELL_BITS for key in changed}


def _revised(octree, revision):
    return set(octree.codes[octree.revisions == revision].tolist())


# --- one call ---------------------------------------------------------------------------------------------------------

seeds = st.integers(0, 1_000_000)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, num_receivers=st.integers(0, 7), is_first=st.booleans())
def test_share_out_equals_the_reference(seed, num_receivers, is_first):
    rng = np.random.default_rng(seed)
    masses, totals = _random_cells(rng), {} if is_first else _random_cells(rng)
    mass, total = _mass(masses), _mass(totals)
    share_out(mass, total, num_receivers, 7)
    if num_receivers == 0:
        _assert_equal(_units(mass), masses)
        _assert_equal(_units(total), totals)
        return
    shares = {key: ratio.share_of(value, num_receivers) for key, value in masses.items()}
    _assert_equal(_units(mass), _sum((1, masses), (-num_receivers, shares)))
    _assert_equal(_units(total), _sum((1, totals), (1, shares)))
    assert _revised(total, 7) == _changed_bricks(totals, _units(total))


@pytest.mark.parametrize("num_receivers", [1, 2, 3, 5, 6, 9, 49])
def test_shares_are_rounded_to_nearest(num_receivers):
    """At the ends of the range, around 0, and at halves."""
    parts = num_receivers + 1
    units = np.arange(-40, 41)
    halves = (2 * np.array([1, 1001, 5_000_001]) + 1) * parts // 2
    units = np.concatenate([units, MAX_MASS + units[units <= 0], -MAX_MASS - 1 + units[units >= 0], halves, -halves])
    masses = {(n, 0, 0): np.full(NUM_CLASSES, value) for n, value in enumerate(units)}
    total = _octree({})
    share_out(_mass(masses), total, num_receivers, 1)
    for key, share in _units(total).items():
        assert share[0] == round(Fraction(int(masses[key][0]), parts))


@settings(max_examples=40, deadline=None)
@given(seed=seeds, num_senders=st.integers(0, 4))
def test_receive_equals_the_reference(seed, num_senders):
    rng = np.random.default_rng(seed)
    masses = _random_cells(rng)
    mass = _mass(masses)
    arrivals, terms = [], [(1, masses)]
    for _ in range(num_senders):
        old = _random_cells(rng)
        # Some of the old cells changed.
        new = {key: value + rng.integers(0, 2) * rng.integers(MODULUS) for key, value in old.items()}
        new |= _random_cells(rng)
        arrivals.append((_mass(new), _mass(old) if rng.random() < 0.7 else None))
        terms += [(1, new), (-1, old if arrivals[-1][1] else {})]
    receive(mass, arrivals, 7)
    _assert_equal(_units(mass), _sum(*terms))
    assert _revised(mass, 7) >= _changed_bricks(masses, _units(mass))
    assert _revised(mass, 7) <= {code for new, _ in arrivals for code in new.codes.tolist()}


@settings(max_examples=15, deadline=None)
@given(seed=seeds, with_threads=st.booleans())
def test_receive_team_equals_receive_robot_by_robot(seed, with_threads):
    rng = np.random.default_rng(seed)
    masses = [_mass(_random_cells(rng)) for _ in range(4)]
    old = [_mass(_random_cells(rng)) for _ in range(4)]
    new = [octree.copy() for octree in old]
    for octree in new:
        receive(octree, [(_mass(_random_cells(rng)), None)], 5)
    arrivals = [
        [(new[j], old[j] if rng.random() < 0.7 else None) for j in range(4) if rng.random() < 0.6] for _ in range(4)
    ]
    alone = [mass.copy() for mass in masses]
    for mass, received in zip(alone, arrivals, strict=True):
        receive(mass, received, 7)
    with ThreadPoolExecutor(3) as threads:
        receive_team(list(zip(masses, arrivals, strict=True)), 7, threads if with_threads else None)
    for mass, other in zip(masses, alone, strict=True):
        assert cells_of(mass) == cells_of(other)
        assert _revised(mass, 7) == _revised(other, 7)


@pytest.mark.parametrize("num_classes", [1, 11])
def test_maps_of_any_number_of_classes(num_classes):
    """One class has no class rows; more than eight classes have more than one mask word."""
    rng = np.random.default_rng(num_classes)
    keys = [*cube((0, 0, 0), 3, 0), (4, 0, 0), (9, 2, 1)]
    new, old = (rng.integers(-9, 9, (len(keys), num_classes)) * rng.integers(0, 1 << 20, num_classes) for _ in range(2))
    octrees = [
        octree_of(
            dict(zip(keys, (values % MODULUS).astype(np.int32).view(np.float32), strict=True)), num_classes=num_classes
        )
        for values in (new, old)
    ]
    mass, total, octree = (octree_of({}, num_classes=num_classes) for _ in range(3))
    receive(mass, [(octrees[0], octrees[1]), (octrees[0], None)], 1)
    share_out(mass, total, 3, 1)
    recover_map(mass, WHOLE_WEIGHT, octree, 1)
    masses = 2 * new - old
    shares = ratio.share_of(masses, 3)
    for found, expected in ((mass, masses - 3 * shares), (total, shares)):
        units = _units(found)
        assert (np.array([units[key] for key in keys]) == expected).all()
    log_odds = np.array([np.frombuffer(cells_of(octree)[key], np.float32) for key in keys])
    np.testing.assert_allclose(log_odds, (masses - 3 * shares) * UNIT, rtol=1e-6)


def test_receive_team_without_robots():
    receive_team([], 1)


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
def test_add_evidence_equals_the_reference(seed):
    rng = np.random.default_rng(seed)
    masses, last = _random_cells(rng), _random_cells(rng, of_log_odds=True)
    now = last | _random_cells(rng, of_log_odds=True)
    mass, evidence, last_evidence = _mass(masses), _octree(now), _octree(last)
    evidence.revisions[:] = rng.integers(0, 4, evidence.num_bricks)
    add_evidence(mass, evidence, last_evidence, 2, 7)
    seen = set(evidence.codes[evidence.revisions >= 2].tolist())
    terms = [(1, {key: quantised(value) for key, value in now.items()})]
    terms += [(-1, {key: quantised(value) for key, value in last.items()})]
    steps = {
        key: step
        for key, step in _sum(*terms).items()
        if int(storage.key_to_code(*key)) >> storage.CELL_BITS in seen
    }  # fmt: skip
    _assert_equal(_units(mass), _sum((1, masses), (1, steps)))
    assert _changed_bricks(masses, _units(mass)) == _revised(mass, 7)


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
def test_difference_added_to_the_old_sum_gives_the_new_sum(seed):
    rng = np.random.default_rng(seed)
    old = _random_cells(rng)
    new = old | _random_cells(rng)
    grown = difference(_mass(new), _mass(old))
    _assert_equal(_units(grown), _sum((1, new), (-1, old)))
    total = _mass(old)
    receive(total, [(grown, None)], 2)
    assert cells_of(total) == cells_of(_mass(new))


def test_shares_of_a_weight_add_up_to_it():
    for weight in (WHOLE_WEIGHT, 7, 3, 1, 6 * WHOLE_WEIGHT - 1):
        for num_receivers in (0, 1, 2, 5):
            share, rest = share_weight(weight, num_receivers)
            assert rest + num_receivers * share == weight
            assert rest > 0
            assert share == (weight // (1 + num_receivers) if num_receivers else 0)


# --- the map ----------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(seed=seeds, weight=st.integers(LEAST_WEIGHT, 6 * WHOLE_WEIGHT), tolerance=st.sampled_from([0.0, 1e-3]))
def test_recovered_map_is_mass_over_weight(seed, weight, tolerance):
    rng = np.random.default_rng(seed)
    before, after = _random_cells(rng), _random_cells(rng)
    after = before | {key: value for key, value in after.items() if rng.random() < 0.7}
    octree = _octree({})
    recover_map(_mass(before), weight, octree, 3, tolerance)
    old = {key: np.frombuffer(value, np.float32) for key, value in cells_of(octree).items()}
    change = recover_map(_mass(after), weight, octree, 7, tolerance)
    found = {key: np.frombuffer(value, np.float32) for key, value in cells_of(octree).items()}
    expected = {key: (value * UNIT / (weight / WHOLE_WEIGHT)).astype(np.float32) for key, value in after.items()}
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        np.testing.assert_allclose(found[key], values, rtol=2e-7, atol=tolerance)
    most = max((float(abs(found[key] - old.get(key, 0)).max()) for key in found), default=0.0)
    assert change == pytest.approx(most, rel=1e-6)
    assert change == 0.0 or change > tolerance
    assert _revised(octree, 7) == _changed_bricks(old, found)


def test_a_map_of_one_value_is_pruned():
    mass = _mass(cube((0, 0, 0), 8, np.full(NUM_CLASSES, 5 << 17)) | {(1, 1, 1): np.full(NUM_CLASSES, 9 << 17)})
    octree = _octree({})
    assert recover_map(mass, WHOLE_WEIGHT, octree, 1) == 9.0
    assert len(octree.leaves()) == 7 + 7 + 8
    grown = _mass({(1, 1, 1): np.full(NUM_CLASSES, -4 << 17)})
    receive(mass, [(grown, None)], 2)
    assert recover_map(mass, 2 * WHOLE_WEIGHT, octree, 2) == 9.0 - 2.5
    assert len(octree.leaves()) == 1
    assert (octree.bricks.blocks[: octree.num_bricks] == -1).all()
    assert recover_map(mass, 2 * WHOLE_WEIGHT, octree, 3) == 0.0
    assert (octree.revisions == 2).all()


def test_changes_within_the_tolerance_are_not_written():
    cells = cube((0, 0, 0), 3, np.array([1, 2, 3]) << 17)
    octree = _octree({})
    recover_map(_mass(cells), WHOLE_WEIGHT, octree, 1)
    before = cells_of(octree)
    moved = {key: value + np.array([2, -2, 0]) for key, value in cells.items()}
    assert recover_map(_mass(moved), WHOLE_WEIGHT, octree, 2, tolerance=2 * UNIT) == 0.0
    assert cells_of(octree) == before
    assert (octree.revisions == 1).all()
    assert recover_map(_mass(moved), WHOLE_WEIGHT, octree, 2, tolerance=UNIT) == pytest.approx(2 * UNIT, rel=0.1)


# --- masses as bits of floats -----------------------------------------------------------------------------------------


def test_copies_and_packets_keep_all_bits():
    """Denormals, normal numbers and the largest number: copying does not compute with the values."""
    kinds = [0, 1, 2, (1 << 23) - 1, 1 << 23, (1 << 23) + 1, 1 << 29, (1 << 29) - 1, MODULUS - 1]
    cells = {
        (n, k, 0): np.array([value, (value + k) % MODULUS, value]) for n, value in enumerate(kinds) for k in (0, 1)
    }
    cells |= cube((4, 4, 4), 4, np.full(NUM_CLASSES, 3))
    mass = _mass(cells)
    signed = {key: _signed(value) for key, value in cells.items()}
    grown = _octree({})
    grown.overwrite(mass, np.arange(mass.num_bricks))
    for octree in (mass, mass.copy(), grown, decode_packet(encode_packet(mass))):
        _assert_equal(_units(octree), signed)


def test_brick_of_two_different_denormals_is_not_pruned():
    cells = cube((0, 0, 0), 4, np.full(NUM_CLASSES, 1)) | {(3, 3, 3): np.full(NUM_CLASSES, 2)}
    mass = _mass(cells)
    assert mass.bricks.blocks[0] >= 0
    storage.prune_brick(mass.bricks, 0)
    assert mass.bricks.blocks[0] >= 0
    assert len(mass.leaves()) == 7 + 8


# --- teams ------------------------------------------------------------------------------------------------------------

KEYS = (*cube((0, 0, 0), 2, 0), (2, 2, 2), (5, 1, 0), (9, 9, 9), (-3, 0, 4))


def _dense(octree):
    """Integers (M, C) of a mass at KEYS, 0 where it is unknown."""
    cells = _units(octree)
    return np.array([_value(cells, key) for key in KEYS])


def _of_dense(values):
    """The octree of log-odds (M, C) at KEYS."""
    return _octree(dict(zip(KEYS, values, strict=True)))


class Robot:
    """State of a robot as in a session, and of its reference."""

    def __init__(self):
        self.mass, self.total, self.map = (_octree({}) for _ in range(3))
        self.weight, self.total_weight = WHOLE_WEIGHT, 0
        self.evidence, self.last_evidence = _octree({}), _octree({})
        self.heard = {}
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

    def start_hearing(self, sender, sums):
        """A link comes up: earlier shares are not for this receiver."""
        self.heard[sender], self.twin.heard[sender] = sums[:2], sums[2:]

    def receive(self, sender, sums):
        old, old_weight = self.heard.get(sender, (None, 0))
        receive(self.mass, [(sums[0], old)], 0)
        self.weight += sums[1] - old_weight
        self.heard[sender] = sums[:2]
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


@pytest.mark.parametrize("seed", range(2))
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
                octree, old_weight = robots[receiver].heard.get(sender, (_octree({}), 0))
                masses = masses + _dense(robot.total) - _dense(octree)
                weight += robot.total_weight - old_weight
        evidence = sum(robot.twin.evidence for robot in robots)
        assert (_signed(masses) == evidence).all()
        assert weight == len(robots) * WHOLE_WEIGHT
        for robot in robots:
            assert (_dense(robot.mass) == robot.twin.mass).all()
            assert (_dense(robot.total) == _signed(robot.twin.total)).all()
            assert (robot.weight, robot.total_weight) == (robot.twin.weight, robot.twin.total_weight)


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
            heard = [_of_units(twins[i].heard.get(i - 1, (twins[i].total * 0, 0))[0]) for i in (0, 1, 2)]
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
            receive(octrees[i][0], [(sums, heard[i])], tick)
            heard[i] = sums
        if tick in (39, 43_039, 86_399):
            for twin, (mass, total) in zip(twins, octrees, strict=True):
                assert (_dense(mass) == twin.mass).all()
                assert (_dense(total) == _signed(twin.total)).all()
                num_wraps = int(abs(twin.total).min() // MODULUS)
            octrees = None
    assert num_wraps > 1000
    under_way = [twins[i - 1].total - twins[i].last_received[i - 1][0] for i in range(3)]
    assert (sum(twin.mass for twin in twins) + sum(under_way) == quantised(evidence).sum(axis=0)).all()
    mean = evidence.mean(axis=0, dtype=np.float64)
    errors = [abs(twin.log_odds - mean).max() for twin in twins if twin.weight >= LEAST_WEIGHT]
    assert 0 < max(errors) < 1e-4


def _of_units(values):
    return _mass(dict(zip(KEYS, values, strict=True)))


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
        robots[receiver].start_hearing(sender, robots[sender].sums())
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
