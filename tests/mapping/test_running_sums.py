"""Ratio consensus on octrees against the reference on dense arrays, bit for bit."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from reference.ratio import quantised
from support.long_suite import examples
from support.masses import (
    NUM_CLASSES,
    assert_equal,
    changed_bricks,
    log_odds_octree,
    mass_of,
    random_cells,
    revised_bricks,
    signed,
    sum_of,
    units_of,
)
from support.octree_factory import cells_of, cube, octree_of

# --- one call ---------------------------------------------------------------------------------------------------------

seeds = st.integers(0, 1_000_000)


@examples(40)
@given(seed=seeds, num_receivers=st.integers(0, 7), is_first=st.booleans())
def test_share_out_equals_the_reference(seed, num_receivers, is_first):
    rng = np.random.default_rng(seed)
    masses, totals = random_cells(rng), {} if is_first else random_cells(rng)
    mass, total = mass_of(masses), mass_of(totals)
    share_out(mass, total, num_receivers, 7)
    if num_receivers == 0:
        assert_equal(units_of(mass), masses)
        assert_equal(units_of(total), totals)
        return
    shares = {key: ratio.share_of(value, num_receivers) for key, value in masses.items()}
    assert_equal(units_of(mass), sum_of((1, masses), (-num_receivers, shares)))
    assert_equal(units_of(total), sum_of((1, totals), (1, shares)))
    assert revised_bricks(total, 7) == changed_bricks(totals, units_of(total))


@pytest.mark.parametrize("num_receivers", [1, 2, 3, 5, 6, 9, 49])
def test_shares_are_rounded_to_nearest(num_receivers):
    """At the ends of the range, around 0, and at halves."""
    parts = num_receivers + 1
    units = np.arange(-40, 41)
    halves = (2 * np.array([1, 1001, 5_000_001]) + 1) * parts // 2
    units = np.concatenate([units, MAX_MASS + units[units <= 0], -MAX_MASS - 1 + units[units >= 0], halves, -halves])
    masses = {(n, 0, 0): np.full(NUM_CLASSES, value) for n, value in enumerate(units)}
    total = log_odds_octree({})
    share_out(mass_of(masses), total, num_receivers, 1)
    for key, share in units_of(total).items():
        assert share[0] == round(Fraction(int(masses[key][0]), parts))


@examples(40)
@given(seed=seeds, num_senders=st.integers(0, 4))
def test_receive_equals_the_reference(seed, num_senders):
    rng = np.random.default_rng(seed)
    masses = random_cells(rng)
    mass = mass_of(masses)
    arrivals, terms = [], [(1, masses)]
    for _ in range(num_senders):
        old = random_cells(rng)
        # Some of the old cells changed.
        new = {key: value + rng.integers(0, 2) * rng.integers(MODULUS) for key, value in old.items()}
        new |= random_cells(rng)
        arrivals.append((mass_of(new), mass_of(old) if rng.random() < 0.7 else None))
        terms += [(1, new), (-1, old if arrivals[-1][1] else {})]
    receive(mass, arrivals, 7)
    assert_equal(units_of(mass), sum_of(*terms))
    assert revised_bricks(mass, 7) >= changed_bricks(masses, units_of(mass))
    assert revised_bricks(mass, 7) <= {code for new, _ in arrivals for code in new.codes.tolist()}


@examples(15)
@given(seed=seeds, with_threads=st.booleans())
def test_receive_team_equals_receive_robot_by_robot(seed, with_threads):
    rng = np.random.default_rng(seed)
    masses = [mass_of(random_cells(rng)) for _ in range(4)]
    old = [mass_of(random_cells(rng)) for _ in range(4)]
    new = [octree.copy() for octree in old]
    for octree in new:
        receive(octree, [(mass_of(random_cells(rng)), None)], 5)
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
        assert revised_bricks(mass, 7) == revised_bricks(other, 7)


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
        units = units_of(found)
        assert (np.array([units[key] for key in keys]) == expected).all()
    log_odds = np.array([np.frombuffer(cells_of(octree)[key], np.float32) for key in keys])
    np.testing.assert_allclose(log_odds, (masses - 3 * shares) * UNIT, rtol=1e-6)


def test_receive_team_without_robots():
    receive_team([], 1)


@examples(40)
@given(seed=seeds)
def test_add_evidence_equals_the_reference(seed):
    rng = np.random.default_rng(seed)
    masses, last = random_cells(rng), random_cells(rng, of_log_odds=True)
    now = last | random_cells(rng, of_log_odds=True)
    mass, evidence, last_evidence = mass_of(masses), log_odds_octree(now), log_odds_octree(last)
    evidence.revisions[:] = rng.integers(0, 4, evidence.num_bricks)
    add_evidence(mass, evidence, last_evidence, 2, 7)
    seen = set(evidence.codes[evidence.revisions >= 2].tolist())
    terms = [(1, {key: quantised(value) for key, value in now.items()})]
    terms += [(-1, {key: quantised(value) for key, value in last.items()})]
    steps = {
        key: step
        for key, step in sum_of(*terms).items()
        if int(storage.key_to_code(*key)) >> storage.CELL_BITS in seen
    }  # fmt: skip
    assert_equal(units_of(mass), sum_of((1, masses), (1, steps)))
    assert changed_bricks(masses, units_of(mass)) == revised_bricks(mass, 7)


@examples(40)
@given(seed=seeds)
def test_difference_added_to_the_old_sum_gives_the_new_sum(seed):
    rng = np.random.default_rng(seed)
    old = random_cells(rng)
    new = old | random_cells(rng)
    grown = difference(mass_of(new), mass_of(old))
    assert_equal(units_of(grown), sum_of((1, new), (-1, old)))
    total = mass_of(old)
    receive(total, [(grown, None)], 2)
    assert cells_of(total) == cells_of(mass_of(new))


def test_shares_of_a_weight_add_up_to_it():
    for weight in (WHOLE_WEIGHT, 7, 3, 1, 6 * WHOLE_WEIGHT - 1):
        for num_receivers in (0, 1, 2, 5):
            share, rest = share_weight(weight, num_receivers)
            assert rest + num_receivers * share == weight
            assert rest > 0
            assert share == (weight // (1 + num_receivers) if num_receivers else 0)


# --- the map ----------------------------------------------------------------------------------------------------------


@examples(40)
@given(seed=seeds, weight=st.integers(LEAST_WEIGHT, 6 * WHOLE_WEIGHT), tolerance=st.sampled_from([0.0, 1e-3]))
def test_recovered_map_is_mass_over_weight(seed, weight, tolerance):
    rng = np.random.default_rng(seed)
    before, after = random_cells(rng), random_cells(rng)
    after = before | {key: value for key, value in after.items() if rng.random() < 0.7}
    octree = log_odds_octree({})
    recover_map(mass_of(before), weight, octree, 3, tolerance)
    old = {key: np.frombuffer(value, np.float32) for key, value in cells_of(octree).items()}
    change = recover_map(mass_of(after), weight, octree, 7, tolerance)
    found = {key: np.frombuffer(value, np.float32) for key, value in cells_of(octree).items()}
    expected = {key: (value * UNIT / (weight / WHOLE_WEIGHT)).astype(np.float32) for key, value in after.items()}
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        np.testing.assert_allclose(found[key], values, rtol=2e-7, atol=tolerance)
    most = max((float(abs(found[key] - old.get(key, 0)).max()) for key in found), default=0.0)
    assert change == pytest.approx(most, rel=1e-6)
    assert change == 0.0 or change > tolerance
    assert revised_bricks(octree, 7) == changed_bricks(old, found)


def test_a_map_of_one_value_is_pruned():
    mass = mass_of(cube((0, 0, 0), 8, np.full(NUM_CLASSES, 5 << 17)) | {(1, 1, 1): np.full(NUM_CLASSES, 9 << 17)})
    octree = log_odds_octree({})
    assert recover_map(mass, WHOLE_WEIGHT, octree, 1) == 9.0
    assert len(octree.leaves()) == 7 + 7 + 8
    grown = mass_of({(1, 1, 1): np.full(NUM_CLASSES, -4 << 17)})
    receive(mass, [(grown, None)], 2)
    assert recover_map(mass, 2 * WHOLE_WEIGHT, octree, 2) == 9.0 - 2.5
    assert len(octree.leaves()) == 1
    assert (octree.bricks.blocks[: octree.num_bricks] == -1).all()
    assert recover_map(mass, 2 * WHOLE_WEIGHT, octree, 3) == 0.0
    assert (octree.revisions == 2).all()


def test_changes_within_the_tolerance_are_not_written():
    cells = cube((0, 0, 0), 3, np.array([1, 2, 3]) << 17)
    octree = log_odds_octree({})
    recover_map(mass_of(cells), WHOLE_WEIGHT, octree, 1)
    before = cells_of(octree)
    moved = {key: value + np.array([2, -2, 0]) for key, value in cells.items()}
    assert recover_map(mass_of(moved), WHOLE_WEIGHT, octree, 2, tolerance=2 * UNIT) == 0.0
    assert cells_of(octree) == before
    assert (octree.revisions == 1).all()
    assert recover_map(mass_of(moved), WHOLE_WEIGHT, octree, 2, tolerance=UNIT) == pytest.approx(2 * UNIT, rel=0.1)


# --- masses as bits of floats -----------------------------------------------------------------------------------------


def test_copies_and_packets_keep_all_bits():
    """Denormals, normal numbers and the largest number: copying does not compute with the values."""
    kinds = [0, 1, 2, (1 << 23) - 1, 1 << 23, (1 << 23) + 1, 1 << 29, (1 << 29) - 1, MODULUS - 1]
    cells = {
        (n, k, 0): np.array([value, (value + k) % MODULUS, value]) for n, value in enumerate(kinds) for k in (0, 1)
    }
    cells |= cube((4, 4, 4), 4, np.full(NUM_CLASSES, 3))
    mass = mass_of(cells)
    expected = {key: signed(value) for key, value in cells.items()}
    grown = log_odds_octree({})
    grown.overwrite(mass, np.arange(mass.num_bricks))
    for octree in (mass, mass.copy(), grown, decode_packet(encode_packet(mass))):
        assert_equal(units_of(octree), expected)


def test_brick_of_two_different_denormals_is_not_pruned():
    cells = cube((0, 0, 0), 4, np.full(NUM_CLASSES, 1)) | {(3, 3, 3): np.full(NUM_CLASSES, 2)}
    mass = mass_of(cells)
    assert mass.bricks.blocks[0] >= 0
    storage.prune_brick(mass.bricks, 0)
    assert mass.bricks.blocks[0] >= 0
    assert len(mass.leaves()) == 7 + 8
