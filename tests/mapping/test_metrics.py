"""Team metrics of hand-made octrees, and incremental comparisons against new ones."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping.metrics import MapComparer
from reference.metrics import team_metrics
from support.long_suite import examples
from support.octree_factory import cube, octree_of

EMPTY = {}


def _compare(maps, oracle, links=((0, 1),), prior=0.0, **options):
    octrees = [octree_of(cells) for cells in maps]
    return MapComparer(len(maps), prior).compare(octrees, octree_of(oracle), links, 0, **options)


def test_distances_by_hand():
    a = {(0, 0, 0): [1.0, -2.0], (9, 0, 0): [3.0, 3.0]}
    b = {(0, 0, 0): [0.0, 0.0], (0, 0, 1): [-1.0, -1.0]}
    c = {(0, 0, 0): [1.0, -1.0]}
    found = _compare([a, b, c], a, links=[(0, 1)])
    # Cells known to one end count as the prior at the other: (1 + 4) + (9 + 9) + (1 + 1).
    assert found.total_distance == pytest.approx(5 + 18 + 2)
    # a - c: 1 + 18; b - c: 2 + 2.
    assert found.total_distance_all == pytest.approx(25 + 19 + 4)
    assert found.num_known_cells == 3
    assert found.num_link_cells == 3
    assert found.num_cells.tolist() == [2, 2, 1]


def test_each_link_counts_the_cells_known_to_either_end():
    a, b, c = cube((0, 0, 0), 2, [0.0, 0.0]), cube((0, 0, 0), 8, [-1.0, -1.0]), {(30, 0, 0): [1.0, 0.0]}
    assert _compare([a, b, c], b, links=[(0, 1), (0, 2)]).num_link_cells == 512 + 9
    found = _compare([a, b, c], b, links=[])
    assert (found.num_link_cells, found.total_distance) == (0, 0.0)
    assert found.total_distance_all == pytest.approx(512 * 2 + 1 + (512 * 2 + 1), rel=1e-5)


def test_agreement_by_hand():
    oracle = {(0, 0, 0): [2.0, 1.0], (1, 0, 0): [-1.0, -1.0], (2, 0, 0): [0.5, 3.0], (3, 0, 0): [-1.0, -2.0]}
    a = {(0, 0, 0): [0.1, 0.0], (1, 0, 0): [-0.1, -9.0], (2, 0, 0): [1.0, 0.5]}  # right, right, wrong, unknown
    b = dict(oracle)
    found = _compare([a, b], oracle)
    assert found.agreement.tolist() == [0.5, 1.0]
    assert found.agreement_occupied.tolist() == [0.5, 1.0]
    # Unknown counts as a label.
    assert found.label_disagreement == 0.5


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
@pytest.mark.parametrize(("margin", "agrees"), [(0.0, True), (0.00009, True), (0.00011, False)])
def test_labels_within_the_tie_tolerance_of_the_oracle_agree(margin, agrees, scale):
    found = _compare([{(0, 0, 0): [0.0, 1.0]}], {(0, 0, 0): [scale, scale * (1.0 - margin)]}, links=[])
    assert found.agreement.tolist() == found.agreement_occupied.tolist() == [float(agrees)]
    found = _compare([{(0, 0, 0): [-1.0, -1.0]}], {(0, 0, 0): [scale * margin, -scale]}, links=[])
    assert found.agreement.tolist() == [float(agrees)]


@pytest.mark.parametrize(("least_tie", "agrees"), [(0.0, False), (0.019, False), (0.021, True)])
def test_ties_have_a_least_tolerance(least_tie, agrees):
    maps, oracle = [{(0, 0, 0): [0.0, 1.0]}, {(0, 0, 0): [1.02, 1.0]}], {(0, 0, 0): [1.02, 1.0]}
    octrees = [octree_of(cells) for cells in maps]
    comparer = MapComparer(2, 0.0)
    comparer.compare(octrees, octree_of(oracle), [(0, 1)], 0)
    # Another tolerance compares unchanged bricks again.
    found = comparer.compare(octrees, octree_of(oracle), [(0, 1)], 9, least_tie=least_tie)
    assert found.agreement.tolist() == [float(agrees), 1.0]
    assert found.label_disagreement == float(not agrees)


def test_ties_of_a_map_go_to_free_and_then_to_the_lower_class():
    oracle = {(0, 0, 0): [-1.0, -1.0], (1, 0, 0): [1.0, -1.0]}
    found = _compare([{(0, 0, 0): [0.0, 0.0], (1, 0, 0): [2.0, 2.0]}], oracle, links=[])
    assert found.agreement.tolist() == [1.0]


def test_entropy_by_hand():
    found = _compare([{(0, 0, 0): [0.0, 0.0], (50, 0, 0): [80.0, -80.0]}, EMPTY], EMPTY)
    assert found.entropy_bits.tolist() == [pytest.approx(np.log2(3) / 2), 0.0]
    # With the prior, p = (0.5, 0.25, 0.25) where the deviation is 0.
    found = _compare([{(0, 0, 0): [0.0, 0.0]}], EMPTY, links=[], prior=float(np.log(0.5)))
    assert found.entropy_bits.tolist() == [pytest.approx(1.5, rel=1e-6)]


@pytest.mark.parametrize("magnitude", [1e-30, 1.0, 86.0, 88.0, 1e4, 1e9])
@pytest.mark.parametrize("prior", [0.0, -2.5])
def test_metrics_of_log_odds_of_any_magnitude(magnitude, prior):
    values = np.array([[1.0, -1.0], [0.5, 0.5], [-1.0, -1.0], [0.0, 1.0]]) * magnitude
    cells = {(i, 0, 0): row.tolist() for i, row in enumerate(values)} | {(9, 0, 0): [-magnitude] * 2}
    maps = [cells, {(2, 0, 0): [magnitude, 0.0]}, EMPTY]
    found = _compare(maps, cells, [(0, 1), (1, 2)], prior)
    expected = _reference(maps, cells, prior, [(0, 1), (1, 2)])
    assert found.total_distance == pytest.approx(expected.total_distance, rel=1e-5)
    assert found.total_distance_all == pytest.approx(expected.total_distance_all, rel=1e-5)
    assert found.entropy_bits.tolist() == pytest.approx(expected.entropy_bits, rel=1e-5, abs=1e-6)
    assert found.agreement.tolist() == pytest.approx(expected.agreement)


def test_maps_without_known_cells():
    found = _compare([EMPTY, EMPTY], EMPTY)
    assert (found.num_known_cells, found.total_distance, found.total_distance_all) == (0, 0.0, 0.0)
    assert found.label_disagreement == 0.0
    assert found.agreement.tolist() == found.agreement_occupied.tolist() == [1.0, 1.0]
    assert found.entropy_bits.tolist() == [0.0, 0.0]


def test_oracle_without_occupied_cells():
    found = _compare([{(0, 0, 0): [1.0, 0.0]}, EMPTY], {(0, 0, 0): [-1.0, -1.0]})
    assert found.agreement.tolist() == [0.0, 0.0]
    assert found.agreement_occupied.tolist() == [1.0, 1.0]


def test_distances_of_close_maps_with_large_values_are_exact():
    a = cube((0, 0, 0), 8, [1e4, -1e4])
    b = a | {(3, 3, 3): [1e4 + 0.0078125, -1e4]}
    found = _compare([a, b, a], a)
    assert found.total_distance == pytest.approx(0.0078125**2, rel=1e-6)
    assert found.total_distance_all == pytest.approx(2 * 0.0078125**2, rel=1e-4)


def _random_cells(rng):
    cells = {}
    for _ in range(rng.integers(0, 5)):
        corner, edge = rng.integers(-10, 10, 3).tolist(), int(rng.choice([1, 2, 8]))
        values = rng.choice([-5.0, -0.3, 0.7, 4.0], 2) + (rng.random(2) if rng.random() < 0.5 else 0.0)
        cells.update(cube(corner, edge, values if rng.random() < 0.6 else [values[0]] * 2))
    return cells


def _dense(maps, oracle, prior):
    """Dense arrays for the reference: maps (N, M, K), masks (N, M) and the oracle (M, K)."""
    keys = sorted(set(itertools.chain(oracle, *maps)))
    known = np.array([[key in cells for key in keys] for cells in maps], dtype=bool).reshape(len(maps), -1)
    dense = np.zeros((len(maps) + 1, len(keys), 3))
    for row, cells in enumerate([*maps, oracle]):
        for column, key in enumerate(keys):
            dense[row, column, 1:] = np.float32(cells.get(key, (0.0, 0.0)))
    dense[..., 1:] += prior
    return dense[:-1], known, dense[-1]


def _reference(maps, oracle, prior, links, num_averaged=None):
    """Metrics of the reference."""
    dense, known, of_oracle = _dense(maps, oracle, prior)
    labelled = dense.copy()
    for values, count in zip(labelled, num_averaged or [1] * len(maps), strict=True):
        values[:, 1:] += prior / count - prior
    return team_metrics(dense, known, of_oracle, links, 0.0, published=dense, least_tolerance=0.0, labelled=labelled)


@examples(40)
@given(seed=st.integers(0, 10_000), prior=st.sampled_from([0.0, -1.2, 0.8]), is_mean=st.booleans())
def test_random_maps_against_the_reference(seed, prior, is_mean):
    rng = np.random.default_rng(seed)
    maps = [_random_cells(rng) for _ in range(rng.integers(1, 5))]
    oracle = {key: np.sum([cells.get(key, np.zeros(2)) for cells in maps], axis=0) for key in set().union(*maps)}
    links = [pair for pair in itertools.combinations(range(len(maps)), 2) if rng.random() < 0.6]
    num_averaged = rng.integers(1, 7, len(maps)).tolist() if is_mean else None
    found = _compare(maps, oracle, links, prior, num_averaged=num_averaged)
    expected = _reference(maps, oracle, prior, links, num_averaged)
    assert found.total_distance == pytest.approx(expected.total_distance, rel=1e-5)
    assert found.total_distance_all == pytest.approx(expected.total_distance_all, rel=1e-5, abs=1e-9)
    assert found.num_known_cells == expected.num_known_cells
    assert found.num_cells.tolist() == list(expected.num_cells)
    assert found.entropy_bits.tolist() == pytest.approx(expected.entropy_bits, rel=1e-5, abs=1e-6)
    assert found.label_disagreement == pytest.approx(expected.label_disagreement)
    assert found.agreement.tolist() == pytest.approx(expected.agreement)
    assert found.agreement_occupied.tolist() == pytest.approx(expected.agreement_occupied)


def test_the_mean_of_robots_has_the_labels_of_their_posterior():
    sums = {(0, 0, 0): [6.0, -1.0], (1, 0, 0): [2.0, -1.0]}
    mean = {key: [value / 6 for value in values] for key, values in sums.items()}
    found = _compare([mean, mean], sums, prior=-3.0, num_averaged=[6, 6])
    assert (found.agreement.tolist(), found.agreement_occupied.tolist()) == ([1.0, 1.0], [1.0, 1.0])
    assert _compare([mean, mean], sums, prior=-3.0).agreement_occupied.tolist() == [0.0, 0.0]


def test_another_number_of_robots_compares_all_bricks_again():
    sums = {(0, 0, 0): [6.0, -1.0]}
    octrees, comparer = [octree_of({(0, 0, 0): [1.0, -1 / 6]})], MapComparer(1, -3.0)
    oracle = octree_of(sums)
    assert comparer.compare(octrees, oracle, [], 0, num_averaged=[6]).agreement.tolist() == [1.0]
    assert comparer.compare(octrees, oracle, [], 5, num_averaged=[2]).agreement.tolist() == [0.0]


@examples(25)
@given(seed=st.integers(0, 10_000))
def test_incremental_comparison_equals_a_new_one(seed):
    rng = np.random.default_rng(seed)
    octrees = [octree_of(_random_cells(rng)) for _ in range(3)]
    oracle = octree_of(_random_cells(rng))
    comparer = MapComparer(3, -0.5)
    links = [(0, 1), (1, 2)]
    comparer.compare(octrees, oracle, links, 0)
    for revision in range(2, 8):
        target = octrees[rng.integers(3)] if rng.random() < 0.8 else oracle
        source = octree_of(_random_cells(rng))
        target.overwrite(source, np.arange(source.num_bricks), revision)
        if rng.random() < 0.3:
            links = links[:1] if len(links) == 2 else [(0, 1), (1, 2)]
        if rng.random() < 0.5:
            before = MapComparer(3, -0.5).compare(octrees, oracle, links, 0).total_distance
            assert comparer.link_distance(octrees, links, revision) == pytest.approx(before, rel=1e-12)
            again = octree_of(_random_cells(rng))
            octrees[0].overwrite(again, np.arange(again.num_bricks), revision)
        updated = comparer.compare(octrees, oracle, links, revision)
        fresh = MapComparer(3, -0.5).compare(octrees, oracle, links, 0)
        for name in vars(fresh):
            # The order of summation follows the order in which bricks were added.
            np.testing.assert_allclose(getattr(updated, name), getattr(fresh, name), rtol=1e-12, err_msg=name)


def test_all_bricks_are_compared_after_forget():
    octree, empty = octree_of({(0, 0, 0): [1.0, 2.0]}), octree_of({})
    comparer = MapComparer(2, 0.0)
    assert comparer.compare([octree, octree], octree, [(0, 1)], 0).num_cells.tolist() == [1, 1]
    comparer.forget()
    comparison = comparer.compare([octree, empty], octree, [(0, 1)], 9)
    assert comparison.num_cells.tolist() == [1, 0]
    assert comparison.total_distance == 5.0
