"""Means of points by cell, compared with a naive twin."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.registration import cell_means
from octoreplay.registration.cell_means import CellMeans
from support.long_suite import examples


@given(st.integers(0, 10**6), st.integers(1, 5))
@examples(40)
def test_means_equal_those_of_the_naive_twin(seed, num_batches):
    rng = np.random.default_rng(seed)
    means = CellMeans(0.5)
    batches = [(rng.normal(0, 2, (30, 3)), rng.uniform(0.1, 3, 30)) for _ in range(num_batches)]
    for points, weights in batches:
        means.add(points, weights)
    points = np.concatenate([points for points, _ in batches])
    weights = np.concatenate([weights for _, weights in batches])
    keys = np.floor(points / 0.5).astype(np.int64)
    for key, found in zip(keys, means.at(keys), strict=True):
        inside = (keys == key).all(axis=1)
        assert np.allclose(found, np.average(points[inside], axis=0, weights=weights[inside]))


def test_a_cell_without_points_stands_at_its_centre():
    keys = np.array([[0, 0, 0], [-3, 2, 7]])
    means = CellMeans(0.2)
    assert np.allclose(means.at(keys), (keys + 0.5) * 0.2)
    means.add(np.array([[0.05, 0.15, 0.1]]), np.ones(1))
    assert np.allclose(means.at(keys), [[0.05, 0.15, 0.1], [-0.5, 0.5, 1.5]])


def test_many_scans_are_merged_on_the_way(monkeypatch):
    monkeypatch.setattr(cell_means, "_MAX_PENDING", 3)
    means = CellMeans(1.0)
    for x in (0.2, 0.4, 0.6, 0.8, 0.5):
        means.add(np.array([[x, 0.5, 0.5], [x + 1, 0.5, 0.5]]), np.ones(2))
    assert np.allclose(means.at(np.array([[0, 0, 0], [1, 0, 0]]))[:, 0], [0.5, 1.5])


def test_points_outside_the_key_space_are_left_out():
    means = CellMeans(0.001)
    means.add(np.array([[1e9, 0.0, 0.0], [np.nan, 0.0, 0.0]]), np.ones(2))
    assert np.allclose(means.at(np.zeros((1, 3), np.int64)), 0.0005)
