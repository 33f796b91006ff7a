"""Counts of confirmed and contradicting cells, compared with a naive twin; grids of cells."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.octree import SemanticOctree
from octoreplay.registration.cells import FREE, UNDECIDED, UNKNOWN, halved
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.verify import CellCounts, verify
from support.long_suite import examples
from support.octree_factory import octree_of

RESOLUTION = 0.5


def _random_map(seed):
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-4, 5, (150, 3)), axis=0)
    return keys, rng.choice([1, 2, 3, FREE, FREE, UNDECIDED], len(keys)).astype(np.uint8)


def _naive_counts(keys, states, other_keys, other_states, shift):
    """Counts (same, other, contra) of the occupied cells, moved by a whole number of cells."""
    other = dict(zip(map(tuple, other_keys.tolist()), other_states.tolist(), strict=True))
    counts = [0, 0, 0]
    for key, state in zip(keys.tolist(), states.tolist(), strict=True):
        if state >= UNDECIDED:
            continue
        place = [k + s for k, s in zip(key, shift, strict=True)]
        near = {other.get(tuple(p + d for p, d in zip(place, step, strict=True)), UNKNOWN)
                for step in itertools.product((-1, 0, 1), repeat=3)} - {UNKNOWN, UNDECIDED, FREE}  # fmt: skip
        if state in near:
            counts[0] += 1
        elif near:
            counts[1] += 1
        elif other.get(tuple(place), UNKNOWN) == FREE:
            counts[2] += 1
    return CellCounts(*counts)


@given(st.integers(0, 10**6), st.tuples(*[st.integers(-3, 3)] * 3))
@examples(100)
def test_counts_equal_those_of_the_naive_twin(seed, shift):
    first, second = _random_map(seed), _random_map(seed + 1)
    T = np.eye(4)
    T[:3, 3] = np.array(shift) * RESOLUTION
    maps = [OwnMap.of_cells(*cells, RESOLUTION, 3) for cells in (first, second)]
    expected = _naive_counts(*second, *first, shift) + _naive_counts(*first, *second, [-s for s in shift])
    assert verify(*maps, T, is_upright=False).obstacles == expected


def test_upright_maps_split_into_obstacles_and_ground():
    keys, states = _random_map(5)
    own = OwnMap.of_cells(keys, states, RESOLUTION, 3)
    agreement = verify(own, own, np.eye(4))
    num_occupied = int((states < UNDECIDED).sum())
    assert agreement.obstacles.total + agreement.ground.total == 2 * num_occupied
    assert agreement.obstacles.share_same == agreement.ground.share_same == 1.0
    assert agreement.overlap == 1.0


def test_shares_of_no_cells_are_zero():
    nothing = CellCounts(0, 0, 0)
    assert (nothing.total, nothing.share_same, nothing.share_contra) == (0, 0.0, 0.0)


def test_states_follow_the_contradiction_of_evidence():
    # hit 1, miss -0.3: occupied from 0.5 on, free up to -0.3.
    cells = {
        (0, 0, 0): [0.5, -1.0],
        (0, 0, 1): [0.49, 0.0],
        (0, 0, 2): [-0.3, -0.3],
        (0, 0, 3): [-0.29, -1.0],
        (0, 0, 4): [1.0, 2.0],
    }
    own = OwnMap.of_evidence(octree_of(cells), hit=1.0, miss=-0.3)
    points = (np.array(list(cells)) + 0.5) * own.resolution
    assert own.at(points)[0].tolist() == [1, UNDECIDED, FREE, UNDECIDED, 2]
    assert own.at(np.array([[50.0, 0.0, 0.0]]))[0].tolist() == [UNKNOWN]


def test_a_map_of_no_evidence_is_empty():
    own = OwnMap.of_evidence(SemanticOctree(0.1, 2), hit=1.0, miss=-0.3)
    assert len(own.occupied) == 0
    assert own.columns.known[1].size == 0


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([1, 2, 2, FREE], 2),
        ([2, 1, 2, 1], 1),
        ([FREE, FREE, 3], 3),
        ([FREE, UNDECIDED], FREE),
        ([UNDECIDED], UNDECIDED),
    ],
)
def test_halved_cells(parts, expected):
    keys = np.array(list(itertools.product((-2, -1), repeat=3))[: len(parts)])
    found_keys, found_states = halved(keys, np.array(parts, np.uint8))
    assert found_keys.tolist() == [[-1, -1, -1]]
    assert found_states.tolist() == [expected]
