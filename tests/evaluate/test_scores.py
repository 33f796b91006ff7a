"""Scores over intervals of cells, against a cell-by-cell twin and by hand."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.evaluate.morton_intervals import Region
from octoreplay.evaluate.scores import agreements, truth_counts
from octoreplay.evaluate.truth import Truth
from octoreplay.mapping.octree import SemanticOctree, keys_to_codes
from support import dense_scores
from support.long_suite import examples
from support.octree_factory import cells_of, cube, octree_of

FREE, GROUND, TREE, UNSURE = (-2.0, -2.0), (3.0, -1.5), (-1.2, 2.3), (-0.3, -0.4)
VALUES = (FREE, GROUND, TREE, UNSURE, (0.25, 0.7), (-0.9, 0.35))


def truth_of(classes):
    """A truth from {key: class_id}; -1 is a class that the result does not have."""
    keys = np.array(list(classes), np.int64).reshape(-1, 3)
    codes, numbers = keys_to_codes(keys), np.array([max(number, 0) for number in classes.values()], np.uint8)
    order = np.argsort(codes)
    return Truth(Path("truth.ply"), codes[order], numbers[order])


def counts_of(cells, classes, *, prior=0.0, team=None, observed=None):
    """Counts of a map of some cells; the team knows the cells ``team``, and ``observed`` at the end."""
    octree, truth = octree_of(cells), truth_of(classes)
    region = Region([octree_of(cells if team is None else team).spans()])
    at_end = region if observed is None else Region([octree_of(observed).spans()])
    return truth_counts(octree.spans(), prior, truth, region, at_end.holds(truth.codes))


def scores_of(cells, classes, **known):
    """Scores of a map of some cells, as ``counts_of``."""
    return counts_of(cells, classes, **known).scores(int(truth_of(classes).is_class.sum()))


@st.composite
def scenes(draw):
    """Random cells of a map, of its team and of its team at the end, and a random truth; some leaves are large."""
    key = st.tuples(*[st.integers(-3, 6)] * 3)
    cells, team, observed = {}, {}, {}
    for content in (cells, team, observed):
        for corner, edge, values in draw(
            st.lists(st.tuples(key, st.sampled_from((1, 1, 2, 4)), st.sampled_from(VALUES)), min_size=1, max_size=6)
        ):
            content |= cube([edge * (k // edge) for k in corner], edge, values)
    if draw(st.booleans()):
        team |= cells
    known = sorted(cells)
    places = draw(st.lists(st.one_of(st.sampled_from(known), key), min_size=1, max_size=40))
    classes = {place: draw(st.sampled_from((1, 1, 2, 2, -1))) for place in places}
    return cells, team, observed, classes


@examples(80)
@given(scenes(), st.sampled_from((0.0, -0.8)))
def test_the_iou_of_occupied_cells_is_that_of_scikit_learn(scene, prior):
    cells, team, observed, classes = scene
    counts = counts_of(cells, classes, prior=prior, team=team, observed=observed)
    expected = dense_scores.occupied_iou(cells, team, classes, prior)
    np.testing.assert_allclose(counts.occupied_iou, expected, equal_nan=True)
    assert counts.mean_iou == pytest.approx(
        scores_of(cells, classes, prior=prior, team=team, observed=observed).mean_iou, nan_ok=True
    )


def mean_of_true_classes(iou, region, classes):
    """Mean over the classes that occur in truth in the region; NaN without any."""
    true = sorted({classes[key] for key in region if classes.get(key, 0) > 0})
    return np.mean([iou[class_id - 1] for class_id in true]) if true else np.nan


@examples(80)
@given(scenes(), st.sampled_from((0.0, -0.8, 0.15)))
def test_scores_equal_those_of_scikit_learn_over_cells(scene, prior):
    cells, team, observed, classes = scene
    found = scores_of(cells, classes, prior=prior, team=team, observed=observed)
    iou = dense_scores.iou(cells, team, classes, prior)
    iou_known = dense_scores.iou(cells, cells, classes, prior)
    accuracies = dense_scores.accuracies(cells, classes, prior)
    expected = (
        *iou,
        mean_of_true_classes(iou, team, classes),
        mean_of_true_classes(iou_known, cells, classes),
        *accuracies,
        dense_scores.coverage(cells, observed, classes, prior),
        dense_scores.coverage(cells, classes, classes, prior),
        *(dense_scores.calibration_error(cells, classes, prior, 1, occupied=occupied) for occupied in (False, True)),
    )
    found_iou, *found_numbers = dataclasses.astuple(found)
    np.testing.assert_allclose((*found_iou, *found_numbers), expected, atol=1e-6)


@examples(30)
@given(scenes(), st.sampled_from((0.0, -0.8)))
def test_agreement_equals_that_over_cells(scene, prior):
    cells, reference, _, _ = scene
    both = {**reference, **cells}
    labels = {
        key: [
            int(np.argmax(dense_scores.probabilities(c[key], prior, 1))) if key in c else -1 for c in (cells, reference)
        ]
        for key in both
    }
    occupied = [pair for pair in labels.values() if pair[1] > 0]
    expected = (
        np.mean([a == b for a, b in labels.values()]),
        np.mean([a == b for a, b in occupied]) if occupied else 1.0,
    )
    found = agreements(octree_of(cells).spans(), prior, octree_of(reference).spans(), prior, len(both)).shares
    np.testing.assert_allclose(found, expected)


def test_a_tie_in_the_reference_is_agreement():
    here = octree_of({(0, 0, 0): (1.0, 2.0), (1, 0, 0): FREE})
    for scale in (1.0, 0.01):
        tied = {(0, 0, 0): (2.0 * scale, 1.99985 * scale), (1, 0, 0): (0.00015 * scale, -2.0 * scale)}
        assert agreements(here.spans(), 0.0, octree_of(tied).spans(), 0.0, 2).shares == (1.0, 1.0)
        apart = {(0, 0, 0): (2.0 * scale, 1.99975 * scale), (1, 0, 0): (0.00025 * scale, -2.0 * scale)}
        assert agreements(here.spans(), 0.0, octree_of(apart).spans(), 0.0, 2).shares == (0.0, 0.0)


def test_a_perfect_map_scores_one():
    cells = cube((0, 0, 0), 8, FREE) | cube((0, 0, 0), 4, GROUND) | {(4, 4, 4): TREE}
    classes = dict.fromkeys(cube((0, 0, 0), 4, GROUND), 1) | {(4, 4, 4): 2}
    found = scores_of(cells, classes)
    assert (found.iou, found.mean_iou, found.mean_iou_known) == ((1.0, 1.0), 1.0, 1.0)
    assert (found.occupied_accuracy, found.free_accuracy, found.coverage, found.world_coverage) == (1, 1, 1, 1)
    sure = dense_scores.probabilities(FREE, 0.0, 1).max() * 447, dense_scores.probabilities(GROUND, 0.0, 1).max() * 64
    tree = dense_scores.probabilities(TREE, 0.0, 1).max()
    assert found.calibration_error == pytest.approx(1 - (sum(sure) + tree) / 512, abs=1e-6)
    assert found.calibration_error_occupied == pytest.approx(1 - (sure[1] + tree) / 65, abs=1e-6)


def test_scores_of_nine_cells_by_hand():
    # Six cells of ground: three found, one called tree, one called free, one unknown; two free cells called ground.
    cells = {(k, 0, 0): values for k, values in enumerate((GROUND, GROUND, GROUND, TREE, FREE))}
    cells |= {(0, 1, 0): GROUND, (1, 1, 0): GROUND, (2, 1, 0): FREE, (3, 1, 0): FREE}
    classes = {(k, 0, 0): 1 for k in range(6)} | {(9, 9, 9): 2}
    team = cells | {(5, 0, 0): FREE}
    found = scores_of(cells, classes, team=team)
    assert found.iou == (3 / 8, 0.0)
    # In the region only the map has a tree, so its IoU is not part of the mean.
    assert found.mean_iou == 3 / 8
    # This leaves out the cell that the map does not know.
    assert found.mean_iou_known == 3 / 7
    assert (found.occupied_accuracy, found.free_accuracy) == (4 / 5, 2 / 4)
    assert (found.coverage, found.world_coverage) == (4 / 6, 4 / 7)


def test_a_class_in_neither_truth_nor_map_has_no_iou():
    found = scores_of({(0, 0, 0): GROUND, (1, 0, 0): FREE}, {(0, 0, 0): 1})
    assert found.iou[0] == 1.0
    assert np.isnan(found.iou[1])
    assert found.mean_iou == 1.0


def test_surface_of_a_class_that_the_result_does_not_have_is_not_counted():
    cells = {(0, 0, 0): GROUND, (1, 0, 0): TREE, (2, 0, 0): FREE, (3, 0, 0): FREE}
    without = {key: value for key, value in cells.items() if key not in ((1, 0, 0), (2, 0, 0))}
    found = scores_of(cells, {(0, 0, 0): 1, (1, 0, 0): -1, (2, 0, 0): -1})
    expected = scores_of(without, {(0, 0, 0): 1})
    assert dataclasses.astuple(found)[2:] == dataclasses.astuple(expected)[2:]


def test_calibration_by_hand():
    # Two cells with probability 0.9, one of them right; two with 0.6, both right: (2 |0.5 - 0.9| + 2 |1 - 0.6|) / 4.
    sure, unsure = (np.log(18.0), 0.0), (np.log(3.0), 0.0)
    cells = {(0, 0, 0): sure, (2, 0, 0): sure, (4, 0, 0): unsure, (6, 0, 0): unsure}
    found = scores_of(cells, {(0, 0, 0): 1, (2, 0, 0): 2, (4, 0, 0): 1, (6, 0, 0): 1})
    assert found.calibration_error == pytest.approx(0.4, abs=1e-6)
    assert found.calibration_error == found.calibration_error_occupied


def test_a_posterior_is_calibrated_where_the_mean_is_not():
    # Odds of a million to one; the mean over ten robots has a tenth of these log-odds.
    values = np.log(1e6), -30.0
    posterior, mean = (cube((0, 0, 0), 4, tuple(value / n for value in values)) for n in (1, 10))
    assert scores_of(mean, dict.fromkeys(mean, 1)).calibration_error > 0.15
    assert scores_of(posterior, dict.fromkeys(posterior, 1)).calibration_error < 1e-5


def test_calibration_has_fifteen_bins():
    # 0.93 and 0.90 are both in the bin from 13/15 to 14/15; with one right and one wrong cell: |1 - 1.83| / 2.
    cells = {(2 * k, 0, 0): (np.log(2 * p / (1 - p)), 0.0) for k, p in enumerate((0.9, 0.93))}
    confidences = [dense_scores.probabilities(values, 0.0, 1).max() for values in cells.values()]
    assert [int(15 * confidence) for confidence in confidences] == [13, 13]
    found = scores_of(cells, {(0, 0, 0): 1, (2, 0, 0): 2})
    assert found.calibration_error == pytest.approx(abs(1 - sum(confidences)) / 2, abs=1e-6)


def test_a_shifted_map_has_lower_scores():
    keys = list(itertools.product(range(8), range(8), range(8)))
    cells = {key: GROUND if key[2] < 4 else FREE for key in keys}
    classes = {key: 1 for key in keys if key[2] < 4}
    shifted = {(x, y, z + 1): values for (x, y, z), values in cells.items()}
    right, wrong = (scores_of(moved, classes, team=cells) for moved in (cells, shifted))
    assert right.mean_iou == 1.0
    assert wrong.mean_iou == 3 / 5
    assert (wrong.coverage, wrong.free_accuracy) == (3 / 4, 4 / 5)
    spans = [octree_of(content).spans() for content in (cells, shifted)]
    assert agreements(spans[0], 0.0, spans[0], 0.0, 512).shares == (1.0, 1.0)
    assert agreements(spans[1], 0.0, spans[0], 0.0, 576).shares == (6 * 64 / 576, 3 / 4)


def test_scores_of_an_empty_map():
    empty = SemanticOctree(0.25, 2).spans()
    truth = truth_of({(0, 0, 0): 1})
    region = Region([octree_of({(0, 0, 0): GROUND}).spans()])
    found = truth_counts(empty, 0.0, truth, region, np.array([True])).scores(int(truth.is_class.sum()))
    assert (found.iou[0], found.mean_iou, found.coverage, found.world_coverage) == (0.0, 0.0, 0.0, 0.0)
    assert np.isnan([found.mean_iou_known, found.occupied_accuracy, found.calibration_error]).all()
    assert agreements(empty, 0.0, empty, 0.0, 0).shares == (1.0, 1.0)
    assert Region([empty]).num_cells == 0
    assert Region([]).num_inside(octree_of({(0, 0, 0): GROUND}).spans()).tolist() == [0]


@examples(30)
@given(scenes())
def test_a_region_is_the_union_of_the_known_cells(scene):
    maps = [octree_of(content) for content in scene[:3]]
    known = set().union(*map(cells_of, maps))
    region = Region([octree.spans() for octree in maps])
    assert region.num_cells == len(known)
    around = list(itertools.product(range(-5, 9), repeat=3))
    assert region.holds(keys_to_codes(np.array(around, np.int64))).tolist() == [key in known for key in around]
    spans = octree_of(scene[0]).spans()
    assert Region([maps[1].spans()]).num_inside(spans).sum() == len(set(scene[0]) & set(scene[1]))
    leaves = spans.leaves_at(keys_to_codes(np.array(around, np.int64)))
    is_known = leaves >= 0
    assert is_known.tolist() == [key in scene[0] for key in around]
    assert (np.bincount(leaves[is_known], minlength=spans.codes.size) == spans.num_cells).all()
