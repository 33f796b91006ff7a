from __future__ import annotations

import numpy as np
import pytest

from reference import metrics

# Four cells, two classes; rows are (free, class 1, class 2).
ORACLE = np.array([[0.0, 3.0, -1.0], [0.0, -2.0, -3.0], [0.0, 1.0, 1.00005], [0.0, 0.0, 0.0]])


def test_squared_distances_by_hand():
    maps = np.array([[[0, 1, 0]], [[0, 0, 2]], [[0, 0, 0]]], dtype=float)
    known = np.array([[True], [True], [False]])
    published = np.array([[[0, 3, 0]], [[0, 0, 0]], [[0, 0, 0]]], dtype=float)
    result = metrics.team_metrics(
        maps, known, np.zeros((1, 3)), [(0, 1), (1, 2)], 0.25, published=published, least_tolerance=0.0
    )
    assert result.total_distance_published == 9.0
    assert result.total_distance == 5.0 + 4.0
    assert result.total_distance_all == 5.0 + 4.0 + 1.0
    assert result.distance_per_cell_and_link == 4.5
    assert result.num_known_cells == 1
    assert result.max_change == 0.25


def test_agreement_counts_ties_and_unknown_cells():
    cells = np.array([True, True, True, False])
    near = metrics.ties(ORACLE, 0.0)
    # Class 1 in cell 2 is within 1e-4 of the oracle's best, so it agrees.
    assert metrics.oracle_agreement(np.array([1, 0, 1, 0]), ORACLE, near, cells) == (1.0, 1.0)
    # The unknown occupied cell 0 is a disagreement: 2 of 3 cells agree, 1 of the 2 occupied ones.
    unknown = metrics.UNKNOWN
    two_of_three = (pytest.approx(2 / 3), 0.5)
    assert metrics.oracle_agreement(np.array([unknown, 0, 2, 0]), ORACLE, near, cells) == two_of_three
    # Free in cell 2 is 1.00005 below.
    assert metrics.oracle_agreement(np.array([1, 0, 0, 0]), ORACLE, near, cells) == two_of_three


def check_ties_are_relative():
    cell = np.array([0.0, 1.0 - 0.9e-4, 1.0])
    other = np.array([0.0, 1.0 - 1.1e-4, 1.0])
    for scale in (1e-3, 1.0, 1e3):
        assert metrics.ties(scale * cell, 0.0).tolist() == [False, True, True]
        assert metrics.ties(scale * other, 0.0).tolist() == [False, False, True]
        # The largest absolute value can be that of another class than the maximum.
        assert metrics.ties(scale * np.array([0.0, -0.9e-4, -1.0]), 0.0).tolist() == [True, True, False]
    assert metrics.ties(np.zeros(3), 0.0).all()


def test_ties_are_relative_to_the_largest_log_odds_of_the_cell():
    check_ties_are_relative()


def test_an_absolute_tie_rule_is_detected(monkeypatch):
    monkeypatch.setattr(
        metrics, "ties", lambda values, least: values >= values.max(axis=-1, keepdims=True) - max(1e-3, least)
    )
    with pytest.raises(AssertionError):
        check_ties_are_relative()


def test_the_difference_of_neighbours_at_rest_is_a_tie():
    assert metrics.ties(other := np.array([0.0, 1.0, 1.01]), 0.0).tolist() == [False, False, True]
    assert metrics.ties(other, 0.02).tolist() == [False, True, True]
    maps = np.array([[[0.0, 1.0, 1.01]], [[0.0, 1.01, 1.0]]])
    known = np.ones((2, 1), dtype=bool)

    def measured(least_tolerance):
        return metrics.team_metrics(
            maps, known, 2 * maps[0], [(0, 1)], 0.0, published=maps, least_tolerance=least_tolerance
        )

    assert (measured(0.0).label_disagreement, measured(0.0).agreement) == (1.0, (1.0, 0.0))
    # The oracle's values are twice as far apart as a robot's.
    assert (measured(0.011).label_disagreement, measured(0.011).agreement) == (0.0, (1.0, 0.0))
    assert (measured(0.021).label_disagreement, measured(0.021).agreement) == (0.0, (1.0, 1.0))


def test_shares_of_no_cells():
    nothing = np.zeros(4, dtype=bool)
    labels = np.zeros(4, dtype=int)
    assert metrics.oracle_agreement(labels, ORACLE, metrics.ties(ORACLE, 0.0), nothing) == (1.0, 1.0)
    assert metrics.label_disagreement(np.array([labels, labels]), np.ones((2, 4, 3), bool), nothing) == 0.0
    assert metrics.mean_entropy(np.zeros((0, 3))) == 0.0


def test_labels_are_the_lowest_class_at_a_tie_or_unknown():
    maps = np.array([[[0.0, 0.0], [0.0, 1.0], [0.0, 1.0]]])
    assert metrics.robot_labels(maps, np.array([[True, True, False]])).tolist() == [[0, 1, metrics.UNKNOWN]]


def test_label_disagreement_counts_unknown_as_a_label():
    labels = np.array([[0, 1, 2, -1], [0, 1, 1, -1], [0, -1, 2, -1]])
    own = np.arange(3) == labels[..., None]
    cells = np.array([True, True, True, False])
    assert metrics.label_disagreement(labels, own, cells) == pytest.approx(2 / 3)
    # Two robots with different labels do not differ where either one has a tie; an unknown cell is never a tie.
    assert metrics.label_disagreement(labels, own | ([[[True]], [[False]], [[False]]]), cells) == pytest.approx(2 / 3)
    ties = own.copy()
    ties[1, 2, 2] = True
    assert metrics.label_disagreement(labels, ties, cells) == pytest.approx(1 / 3)


def test_entropy_in_bits_by_hand():
    assert metrics.mean_entropy(np.zeros((2, 4))) == pytest.approx(2.0)
    # p = (1/4, 3/4): 2 - 3/4 log2 3.
    assert metrics.mean_entropy(np.array([[0.0, np.log(3.0)]])) == pytest.approx(2.0 - 0.75 * np.log2(3.0))
    assert metrics.mean_entropy(np.array([[0.0, 5000.0]])) == 0.0
