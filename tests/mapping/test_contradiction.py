"""Contradiction of evidence: by hand, against the twin, and incremental against from scratch."""

from __future__ import annotations

import dataclasses
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.config.sensor import SensorConfig
from octoreplay.mapping.contradiction import CellContradiction, EvidenceComparer, cell_contradictions, state_limits
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.run_metrics import MIN_COMPARED_CELLS, ranked_pairs
from reference.contradiction import cell_states, pair_metrics
from support.long_suite import examples
from support.octree_factory import cube, octree_of

LIMITS = state_limits(SensorConfig())
GROUND, TREE, FREE, UNDECIDED = [2.0, -1.0], [-0.6, 1.0], [-0.3, -0.3], [0.1, -0.3]
FIRMLY_FREE = [-1.5, -1.6]


def compare(*evidence, num_classes=2, threads=None):
    ids = [f"robot_{index}" for index in range(len(evidence))]
    octrees = [octree_of(cells, num_classes=num_classes) for cells in evidence]
    return EvidenceComparer(ids, num_classes, state_limits(SensorConfig())).compare(octrees, 0, threads)


def test_pair_by_hand():
    a = {(0, 0, 0): GROUND, (1, 0, 0): GROUND, (2, 0, 0): FREE, (3, 0, 0): TREE, (4, 0, 0): UNDECIDED, (9, 9, 9): TREE}
    b = {(0, 0, 0): GROUND, (1, 0, 0): FREE, (2, 0, 0): TREE, (3, 0, 0): GROUND, (4, 0, 0): TREE, (5, 0, 0): FREE}
    (pair,) = compare(a, b)
    assert (pair.first, pair.second, pair.overlap_cells) == ("robot_0", "robot_1", 5)
    # The cell that the first has not decided is not compared.
    assert (pair.occupied_cells, pair.contradiction) == (4, 0.5)
    # The first calls cells 0, 1 and 3 occupied, of which the second frees 1; the second 0, 2 and 3.
    assert (pair.contradiction_of_first, pair.contradiction_of_second) == (1 / 3, 1 / 3)
    assert (pair.both_occupied_cells, pair.label_contradiction) == (2, 0.5)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("distance", "is_clear"), [(-2, True), (-1, False), (1, False), (2, True)])
def test_a_contradiction_is_clear_without_an_occupied_cell_beside_it(axis, distance, is_clear):
    for start in range(-4, 5):
        hit, beside = [0, 0, 0], [0, 0, 0]
        hit[axis], beside[axis] = start, start + distance
        (pair,) = compare({tuple(hit): GROUND}, {tuple(hit): FIRMLY_FREE, tuple(beside): GROUND})
        assert (pair.contradiction, pair.clear_contradiction) == (1.0, float(is_clear))


@pytest.mark.parametrize(("value", "is_clear"), [(-1.5, True), (-1.4, False), (-0.3, False)])
def test_a_contradiction_is_clear_where_the_cell_was_freed_several_times(value, is_clear):
    for edge in (1, 8):
        (pair,) = compare(cube((0, 0, 0), edge, GROUND), cube((0, 0, 0), edge, [np.float32(value)] * 2))
        assert (pair.contradiction, pair.clear_contradiction) == (1.0, float(is_clear))


def test_cells_at_the_end_of_the_key_space_have_fewer_neighbours():
    low, high = -(1 << 18), (1 << 18) - 1
    (pair,) = compare({(low, low, low): GROUND}, {(low, low, low): FIRMLY_FREE, (high, low, low): GROUND})
    assert pair.clear_contradiction == 1.0


def test_directions_differ_where_one_robot_frees_what_the_other_hits():
    (pair,) = compare(cube((0, 0, 0), 8, GROUND), cube((0, 0, 0), 8, FREE))
    assert (pair.overlap_cells, pair.occupied_cells, pair.contradiction) == (512, 512, 1.0)
    assert pair.contradiction_of_first == 1.0
    assert math.isnan(pair.contradiction_of_second)
    assert (pair.both_occupied_cells, math.isnan(pair.label_contradiction)) == (0, True)


def test_pairs_without_common_cells_are_left_out():
    near, far = cube((0, 0, 0), 4, GROUND), cube((40, 0, 0), 4, GROUND)
    pairs = compare(near, far, near, {})
    assert [(pair.first, pair.second) for pair in pairs] == [("robot_0", "robot_2")]
    assert compare(near) == compare({}, {}) == ()


def test_one_hit_occupies_and_one_miss_frees_a_cell():
    hit, miss = np.float32(1.0), np.float32(-0.3)
    (pair,) = compare(
        {(0, 0, 0): [hit, miss], (1, 0, 0): [miss, miss]}, {(0, 0, 0): [miss, miss], (1, 0, 0): [hit, miss]}
    )
    assert (pair.occupied_cells, pair.contradiction) == (2, 1.0)


def test_limits_stay_within_the_clamping():
    assert state_limits(SensorConfig(hit=1.0, miss=-0.25)) == (0.5, -0.25, -1.25)
    assert state_limits(SensorConfig(hit=1.0, miss=-0.25, clamp_min=-1.0)) == (0.5, -0.25, -1.0)
    assert state_limits(SensorConfig(hit=4.0, miss=-2.0, clamp_min=-1.5, clamp_max=1.25)) == (1.25, -1.5, -1.5)


def test_the_teams_number_counts_pairs_with_enough_cells():
    (small,) = compare(cube((0, 0, 0), 4, GROUND), cube((0, 0, 0), 4, FREE))
    (large,) = compare(cube((0, 0, 0), 8, GROUND), cube((0, 0, 0), 8, TREE))
    assert small.occupied_cells < MIN_COMPARED_CELLS <= large.occupied_cells
    assert ranked_pairs([small, large], "contradiction") == [large]
    worse = dataclasses.replace(large, contradiction=0.5)
    assert ranked_pairs([large, worse], "contradiction") == [worse, large]
    assert ranked_pairs([small, worse], "label_contradiction") == [worse]


cells_of_robots = st.integers(1, 12).flatmap(
    lambda num_classes: st.tuples(
        st.just(num_classes),
        st.lists(
            st.dictionaries(
                st.tuples(st.integers(-3, 5), st.integers(-1, 4), st.integers(-2, 1)),
                st.lists(
                    st.sampled_from([-5.0, -1.5, -0.6, float(np.float32(-0.3)), -0.2, 0.0, 0.4, 0.5, 1.0, 5.0]),
                    min_size=num_classes, max_size=num_classes,
                ),
                max_size=40,
            ),
            min_size=2, max_size=4,
        ),
    )
)  # fmt: skip


def dense(evidence, num_classes):
    """The evidence as (N, M, C), the known cells as (N, M) and the keys (M, 3)."""
    keys = sorted(set().union(*evidence))
    values, known = (
        np.zeros((len(evidence), len(keys), num_classes), np.float32),
        np.zeros((len(evidence), len(keys)), bool),
    )
    for robot, cells in enumerate(evidence):
        for index, key in enumerate(keys):
            if key in cells:
                values[robot, index], known[robot, index] = cells[key], True
    return values, known, np.array(keys, np.int64).reshape(-1, 3)


def same(found, expected):
    """True where two tuples of pairs are equal; NaN equals NaN."""
    return repr(found) == repr(expected)


@examples(60)
@given(cells_of_robots)
def test_random_evidence_as_the_twin(team):
    num_classes, evidence = team
    values, known, keys = dense(evidence, num_classes)
    states = cell_states(values, known, *LIMITS)
    expected = pair_metrics([f"robot_{index}" for index in range(len(evidence))], states, keys)
    assert same(compare(*evidence, num_classes=num_classes), expected)


@examples(20)
@given(cells_of_robots, st.randoms(use_true_random=False))
def test_updates_as_from_scratch(team, random):
    num_classes, evidence = team
    ids = [str(index) for index in range(len(evidence))]
    comparer = EvidenceComparer(ids, num_classes, LIMITS)
    octrees = [SemanticOctree(0.25, num_classes) for _ in evidence]
    seen = [{} for _ in evidence]
    with ThreadPoolExecutor(2) as threads:
        for tick in range(1, 5):
            for cells, shown, octree in zip(evidence, seen, octrees, strict=True):
                for key in random.sample(sorted(cells), len(cells) // 2):
                    shown[key] = random.choice([cells[key], [-1.0] * num_classes])
                source = octree_of(shown, num_classes=num_classes)
                same_codes = octree.find(source.codes)
                is_new = np.array([
                    index < 0 or octree.known[index] != known
                    for index, known in zip(same_codes, source.known, strict=True)
                ], bool)  # fmt: skip
                octree.overwrite(source, np.flatnonzero(is_new | (random.random() < 0.5)), tick)
            found = comparer.compare(octrees, tick, threads)
            assert same(found, EvidenceComparer(ids, num_classes, LIMITS).compare(octrees, 0))


def test_forgetting_compares_all_bricks_again():
    ids, limits = ("a", "b"), LIMITS
    ground, free = octree_of(cube((0, 0, 0), 4, GROUND)), octree_of(cube((0, 0, 0), 4, FREE))
    comparer = EvidenceComparer(ids, 2, limits)
    assert len(comparer.compare([ground, free], 1)) == 1
    comparer.forget()
    assert comparer.compare([ground, SemanticOctree(0.25, 2)], 2) == ()
    (pair,) = comparer.compare([ground, free], 1)
    assert pair.contradiction == 1.0


@pytest.mark.parametrize("num_classes", [1, 3, 4, 200, 255])
def test_labels_of_any_number_of_classes(num_classes):
    first, last = np.full((2, num_classes), -0.3, np.float32)
    first[0], last[-1] = 1.0, 1.0
    (pair,) = compare({(0, 0, 0): first, (1, 0, 0): last}, {(0, 0, 0): last, (1, 0, 0): last}, num_classes=num_classes)
    assert pair.label_contradiction == (0.5 if num_classes > 1 else 0.0)


# --- single cells ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_kinds_of_cells_add_up_to_the_shares_of_the_pair(seed):
    random = np.random.default_rng(seed)
    values = [GROUND, TREE, FREE, UNDECIDED, FIRMLY_FREE]
    evidence = [
        {tuple(key): values[random.integers(len(values))] for key in random.integers(-6, 6, (900, 3)).tolist()}
        for _ in range(2)
    ]
    (pair,) = compare(*evidence)
    keys = np.array(list(np.ndindex(14, 14, 14))) - 7
    octrees = [octree_of(cells, num_classes=2) for cells in evidence]
    kinds = cell_contradictions(octrees, (keys + 0.5) * octrees[0].resolution, LIMITS)
    counts = np.bincount(kinds, minlength=len(CellContradiction))
    assert counts[CellContradiction.CLEAR] == round(pair.clear_contradiction * pair.occupied_cells) > 0
    contradicting = counts[CellContradiction.CLEAR] + counts[CellContradiction.CONTRADICTION]
    assert contradicting == round(pair.contradiction * pair.occupied_cells)
    assert counts[CellContradiction.OTHER_LABEL] == round(pair.label_contradiction * pair.both_occupied_cells) > 0
    # The cells that both call free are compared too.
    assert counts[CellContradiction.NONE] > pair.both_occupied_cells - counts[CellContradiction.OTHER_LABEL]
    assert counts[CellContradiction.UNCOMPARED] > 0


def test_the_strongest_relation_of_all_pairs_counts():
    evidence = [{(0, 0, 0): GROUND}, {(0, 0, 0): TREE}, {(0, 0, 0): FIRMLY_FREE}, {(1, 0, 0): GROUND}]
    octrees = [octree_of(cells, num_classes=2) for cells in evidence]
    coords = (np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]]) + 0.5) * octrees[0].resolution
    expected = [CellContradiction.CLEAR, CellContradiction.UNCOMPARED, CellContradiction.UNCOMPARED]
    assert cell_contradictions(octrees, coords, LIMITS).tolist() == expected
    assert cell_contradictions(octrees[:2], coords[:1], LIMITS).tolist() == [CellContradiction.OTHER_LABEL]
