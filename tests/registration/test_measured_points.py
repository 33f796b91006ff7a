"""Means of measured points by cell and by voxel, compared with naive twins."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.registration import measured_points
from octoreplay.registration.measured_points import MeasuredPoints
from support.long_suite import examples

UP = np.array([0.0, 0.0, 1.0])


def add(measured, points, class_ids=None, weights=None):
    """Add points (n, 3), seen from above, of class 1 and weight 1 unless given."""
    points = np.asarray(points, np.float64)
    class_ids = np.ones(len(points), np.uint8) if class_ids is None else class_ids
    measured.add(points, class_ids, np.tile(UP, (len(points), 1)), np.ones(len(points)) if weights is None else weights)


@given(st.integers(0, 10**6), st.integers(1, 5))
@examples(40)
def test_cell_means_equal_those_of_the_naive_twin(seed, num_batches):
    rng = np.random.default_rng(seed)
    measured = MeasuredPoints(0.5)
    batches = [
        (rng.normal(0, 2, (30, 3)), rng.integers(0, 4, 30).astype(np.uint8), rng.uniform(0.1, 3, 30))
        for _ in range(num_batches)
    ]
    for batch in batches:
        add(measured, *batch)
    points = np.concatenate([points for points, _, _ in batches])
    weights = np.concatenate([weights for _, _, weights in batches])
    keys = np.floor(points / 0.5).astype(np.int64)
    for key, found in zip(keys, measured.cell_means(keys), strict=True):
        inside = (keys == key).all(axis=1)
        np.testing.assert_allclose(found, np.average(points[inside], axis=0, weights=weights[inside]), atol=1e-6)


@given(st.integers(0, 10**6))
@examples(40)
def test_planes_have_the_most_frequent_class_of_each_voxel(seed):
    rng = np.random.default_rng(seed)
    points, class_ids = rng.uniform(-0.6, 0.6, (200, 3)), rng.integers(0, 4, 200).astype(np.uint8)
    weights = rng.uniform(0.1, 3, 200)
    measured = MeasuredPoints(0.8)
    add(measured, points, class_ids, weights)
    keys = np.floor(points / 0.4).astype(np.int64)
    expected = []
    for key in np.unique(keys, axis=0):
        inside = (keys == key).all(axis=1)
        counts = np.bincount(class_ids[inside], minlength=4)
        most = int(counts[1:].argmax()) + 1
        if counts[most] >= 3:
            chosen = inside & (class_ids == most)
            expected.append((*np.average(points[chosen], axis=0, weights=weights[chosen]), most))
    planes = measured.planes()
    # Flat points are moved along their normals; these points fill space, so that few are flat.
    found = np.column_stack([planes.points, planes.class_ids])[~planes.is_flat]
    for row in found:
        assert np.abs(np.array(expected) - row).max(axis=1).min() < 1e-6
    assert len(planes.points) == len(expected)


def test_a_cell_without_points_has_its_centre():
    keys = np.array([[0, 0, 0], [-3, 2, 7]])
    measured = MeasuredPoints(0.2)
    np.testing.assert_allclose(measured.cell_means(keys), (keys + 0.5) * 0.2)
    add(measured, [[0.05, 0.15, 0.1]])
    np.testing.assert_allclose(measured.cell_means(keys), [[0.05, 0.15, 0.1], [-0.5, 0.5, 1.5]], atol=1e-7)


def test_many_scans_are_merged_on_the_way(monkeypatch):
    monkeypatch.setattr(measured_points, "_MAX_PENDING", 3)
    measured = MeasuredPoints(1.0)
    for x in (0.2, 0.4, 0.6, 0.8, 0.5):
        add(measured, [[x, 0.5, 0.5], [x + 1, 0.5, 0.5]])
    means = measured.cell_means(np.array([[0, 0, 0], [1, 0, 0]]))
    np.testing.assert_allclose(means[:, 0], [0.5, 1.5], atol=1e-6)


def test_points_outside_the_key_space_are_left_out():
    measured = MeasuredPoints(0.001)
    add(measured, [[1e9, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    assert len(measured.planes().points) == 0
    np.testing.assert_allclose(measured.cell_means(np.zeros((1, 3), np.int64)), 0.0005)


def test_cells_outside_the_key_space_have_their_centres():
    measured = MeasuredPoints(1.0)
    add(measured, [[0.2, 0.2, 0.2]])
    far = np.array([[1 << 17, 0, 0]])
    np.testing.assert_allclose(measured.cell_means(far), far + 0.5)
