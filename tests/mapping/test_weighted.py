"""Mixing by certainty, on octrees against the reference, and its properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.consensus import Step, Update, team_step
from reference import rules
from support.long_suite import examples
from support.masses import NUM_CLASSES, log_odds_octree, random_cells
from support.octree_factory import cells_of, cube

SEEDS = st.integers(0, 1_000_000)


def mixed(own, neighbours, step_weights, quantum=0.0):
    """Cells {key: values (C,)} of a map after one step with the maps of its neighbours."""
    octree = log_odds_octree(own)
    step = Step(octree, [log_odds_octree(cells) for cells in neighbours], step_weights, log_odds_octree({}), 0.0)
    team_step([step], update=Update.WEIGHTED, revision=2, quantum=quantum)
    return {key: np.frombuffer(values, np.float32).astype(np.float64) for key, values in cells_of(octree).items()}


def row_of(cells, key):
    """Values (1, K) of a cell with the 0 of free space, 0 where it is unknown."""
    return np.append(0.0, cells.get(key, np.zeros(NUM_CLASSES))).astype(np.float64)[None]


@examples(60)
@given(seed=SEEDS, num_neighbours=st.integers(0, 4))
def test_a_step_equals_the_reference_and_is_a_weighted_mean(seed, num_neighbours):
    rng = np.random.default_rng(seed)
    own, *neighbours = (random_cells(rng, of_log_odds=True) for _ in range(num_neighbours + 1))
    weights = rng.dirichlet(np.ones(num_neighbours + 1))[:num_neighbours]
    found = mixed(own, neighbours, weights.tolist())
    assert found.keys() == own.keys() | set().union(*neighbours)
    for key, values in found.items():
        rows = [row_of(cells, key) for cells in (own, *neighbours)]
        differences = [(weight, rules.weighted_difference(rows[0], row))
                       for weight, row in zip(weights, rows[1:], strict=True)]  # fmt: skip
        expected = rules.mix(rows[0], differences, 0.5)[0, 1:]
        scale = max(1.0, np.abs(rows).max())
        np.testing.assert_allclose(values, expected, rtol=0, atol=2e-6 * scale)
        # A log-odds never leaves the range of the maps that are mixed.
        assert (values >= np.min(rows, axis=0)[0, 1:] - 2e-6 * scale).all()
        assert (values <= np.max(rows, axis=0)[0, 1:] + 2e-6 * scale).all()


@pytest.mark.parametrize(
    ("own", "other", "expected"),
    [
        ([0, 0, 0], [4, -2, 0], [2, -1, 0]),  # Unknown to the receiver: the whole step.
        ([4, -2, 0], [0, 0, 0], [4, -2, 0]),  # Unknown to the neighbour: no step.
        ([4, 0, 0], [0, -4, 0], [3, -1, 0]),  # Equally certain: half of the step.
        ([1, 0, 0], [3, 0, 0], [1.75, 0, 0]),  # Three quarters of the step.
        ([-1, -1, -1], [3, -1, -1], [0.5, -1, -1]),
    ],
)
def test_a_neighbour_counts_by_its_certainty(own, other, expected):
    keys = cube((0, 0, 0), 2, None)
    own_cells, other_cells = (dict.fromkeys(keys, np.float32(values)) for values in (own, other))
    found = mixed(own_cells, [other_cells], [0.5])
    for key in keys:
        np.testing.assert_allclose(found[key], expected, atol=1e-6)


def test_with_step_weight_1_two_maps_meet_at_their_certainty_weighted_mean():
    own, other = np.float32([2, -1, 0]), np.float32([-6, 3, 1])
    first, second = (mixed({(0, 0, 0): a}, [{(0, 0, 0): b}], [1.0])[0, 0, 0] for a, b in ((own, other), (other, own)))
    np.testing.assert_allclose(first, (2 * own + 6 * other) / 8, atol=1e-6)
    np.testing.assert_allclose(second, first, atol=1e-6)


def test_values_are_multiples_of_the_quantum():
    found = mixed({(0, 0, 0): np.float32([1, 0, 0])}, [{(0, 0, 0): np.float32([2.5, 0, 0])}], [0.3], quantum=0.125)
    assert found[0, 0, 0].tolist() == [1.375, 0, 0]
