"""Points on triangles and class votes in cells, against naive implementations."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from octoreplay.mapping import surface
from octoreplay.mapping.surface import CellVotes, num_cuts, points_on_triangles
from support.long_suite import examples


def barycentric(point, corners):
    """Weights (3,) of a triangle's corners at a point in its plane."""
    weights, *_ = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(point, 1.0), rcond=None)
    return weights


@pytest.mark.parametrize("batch", [surface.BATCH, 7])
def test_points_are_on_their_triangle_and_cover_it(monkeypatch, batch):
    monkeypatch.setattr(surface, "BATCH", batch)
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (6, 3, 3))
    spacing = 0.25
    found = [np.empty((0, 3)) for _ in corners]
    for points, triangles in points_on_triangles(corners, spacing):
        assert len(points) == len(triangles)
        for index in np.unique(triangles):
            found[index] = np.concatenate([found[index], points[triangles == index]])
    for points, triangle, cuts in zip(found, corners, num_cuts(corners, spacing), strict=True):
        assert len(points) == len(np.unique(points.round(9), axis=0)) == cuts**2
        weights = np.array([barycentric(point, triangle) for point in points])
        np.testing.assert_allclose(weights @ triangle, points, atol=1e-9)
        assert (weights > 0).all()
        np.testing.assert_allclose(points.mean(axis=0), triangle.mean(axis=0), atol=1e-9)
        # Every place on the triangle has a point within the spacing.
        places = rng.dirichlet(np.ones(3), 200) @ triangle
        gaps = np.linalg.norm(places[:, None] - points[None], axis=2).min(axis=1)
        assert gaps.max() < spacing


def test_number_of_cuts_follows_from_the_longest_edge():
    corners = np.array([[[0, 0, 0], [1.0, 0, 0], [0, 0.1, 0]], [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]])
    assert num_cuts(corners, 0.3).tolist() == [4, 1]


@examples(100)
@given(st.lists(st.tuples(st.integers(-5, 5), st.integers(0, 4)), max_size=60), st.integers(1, 20))
def test_majority_wins_and_ties_go_to_the_lower_id(votes, batch):
    counted = CellVotes()
    for start in range(0, len(votes), batch):
        part = votes[start : start + batch]
        counted.add(np.array([cell for cell, _ in part], np.int64), np.array([c for _, c in part], np.uint8))
    by_cell = defaultdict(Counter)
    for cell, class_id in votes:
        by_cell[cell][class_id] += 1
    expected = {
        cell: min(counts, key=lambda class_id, counts=counts: (-counts[class_id], class_id))
        for cell, counts in by_cell.items()
    }
    cells, winners = counted.winners()
    assert dict(zip(cells.tolist(), winners.tolist(), strict=True)) == expected
    assert cells.tolist() == sorted(expected)
    # winners() does not change the counts.
    assert counted.winners()[1].tolist() == winners.tolist()


def test_waiting_votes_are_merged_beyond_the_batch_size(monkeypatch):
    monkeypatch.setattr(surface, "BATCH", 2)
    votes = CellVotes()
    for class_ids in ([1, 2], [2, 2], [1, 1], [1, 3]):
        votes.add(np.array([0, 9], np.int64), np.array(class_ids, np.uint8))
    cells, winners = votes.winners()
    assert (cells.tolist(), winners.tolist()) == ([0, 9], [1, 2])
