from __future__ import annotations

import numpy as np
import pytest

from reference import metrics

# Four cells, two classes; rows are (free, class 1, class 2).
ORACLE = np.array([[0.0, 3.0, -1.0], [0.0, -2.0, -3.0], [0.0, 1.0, 1.0005], [0.0, 0.0, 0.0]])


def test_squared_distances_by_hand():
    maps = np.array([[[0, 1, 0]], [[0, 0, 2]], [[0, 0, 0]]], dtype=float)
    known = np.array([[True], [True], [False]])
    result = metrics.team_metrics(maps, known, np.zeros((1, 3)), [(0, 1), (1, 2)], 0.25)
    assert result.total_distance == 5.0 + 4.0
    assert result.total_distance_all == 5.0 + 4.0 + 1.0
    assert result.distance_per_cell_and_link == 4.5
    assert result.num_known_cells == 1
    assert result.max_change == 0.25


def test_agreement_counts_ties_and_unknown_cells():
    cells = np.array([True, True, True, False])
    # Class 1 in cell 2 is within 1e-3 of the oracle's best, so it agrees.
    assert metrics.oracle_agreement(np.array([1, 0, 1, 0]), ORACLE, cells) == (1.0, 1.0)
    # The unknown occupied cell 0 is a disagreement: 2 of 3 cells agree, 1 of the 2 occupied ones.
    unknown = metrics.UNKNOWN
    assert metrics.oracle_agreement(np.array([unknown, 0, 2, 0]), ORACLE, cells) == (pytest.approx(2 / 3), 0.5)
    # Free in cell 2 is 1.0005 below.
    assert metrics.oracle_agreement(np.array([1, 0, 0, 0]), ORACLE, cells) == (pytest.approx(2 / 3), 0.5)


def test_shares_of_no_cells():
    nothing = np.zeros(4, dtype=bool)
    assert metrics.oracle_agreement(np.zeros(4, dtype=int), ORACLE, nothing) == (1.0, 1.0)
    assert metrics.label_disagreement(np.zeros((2, 4), dtype=int), nothing) == 0.0
    assert metrics.mean_entropy(np.zeros((0, 3))) == 0.0


def test_labels_are_the_lowest_class_at_a_tie_or_unknown():
    maps = np.array([[[0.0, 0.0], [0.0, 1.0], [0.0, 1.0]]])
    assert metrics.robot_labels(maps, np.array([[True, True, False]])).tolist() == [[0, 1, metrics.UNKNOWN]]


def test_label_disagreement_counts_unknown_as_a_label():
    labels = np.array([[0, 1, 2, -1], [0, 1, 1, -1], [0, -1, 2, -1]])
    assert metrics.label_disagreement(labels, np.array([True, True, True, False])) == pytest.approx(2 / 3)


def test_entropy_in_bits_by_hand():
    assert metrics.mean_entropy(np.zeros((2, 4))) == pytest.approx(2.0)
    # p = (1/4, 3/4): 2 - 3/4 log2 3.
    assert metrics.mean_entropy(np.array([[0.0, np.log(3.0)]])) == pytest.approx(2.0 - 0.75 * np.log2(3.0))
    assert metrics.mean_entropy(np.array([[0.0, 5000.0]])) == 0.0
