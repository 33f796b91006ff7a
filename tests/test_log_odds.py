import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from octoreplay.log_odds import (
    best_labels,
    class_probabilities,
    label_probabilities,
    shifted_exp_sum,
)
from support.long_suite import examples

tables = st.tuples(st.integers(1, 6), st.integers(1, 5)).flatmap(
    lambda shape: arrays(np.float64, shape, elements=st.floats(-800, 800))
)


@examples(100)
@given(tables)
def test_probabilities_sum_to_one_and_have_the_log_odds(log_odds: np.ndarray) -> None:
    prob = class_probabilities(log_odds)
    np.testing.assert_allclose(prob.sum(axis=1), 1.0, rtol=1e-12)
    likely = (prob[:, 1:] > 1e-200) & (prob[:, :1] > 1e-200)
    ratio = np.log(np.where(likely, prob[:, 1:], 1.0)) - np.log(np.where(likely, prob[:, :1], 1.0))
    np.testing.assert_allclose(ratio[likely], log_odds[likely], atol=1e-9)


@examples(100)
@given(tables)
def test_labels_and_label_probabilities_are_those_of_the_most_probable_class(log_odds: np.ndarray) -> None:
    full = np.concatenate([np.zeros((len(log_odds), 1)), log_odds], axis=1)
    labels = best_labels(log_odds)
    assert labels.tolist() == [row.tolist().index(max(row)) for row in full]
    largest = class_probabilities(log_odds).max(axis=1)
    np.testing.assert_allclose(label_probabilities(log_odds), largest, rtol=1e-12)
    np.testing.assert_allclose(1.0 / shifted_exp_sum(log_odds.T, class_axis=0), largest, rtol=1e-12)


def test_ties_go_to_free_and_then_to_the_lower_class() -> None:
    assert best_labels(np.array([[0.0, 0.0], [-1.0, 0.0], [0.5, 0.5]])).tolist() == [0, 0, 1]


def test_dtype_is_kept() -> None:
    log_odds = np.zeros((2, 3), dtype=np.float32)
    assert class_probabilities(log_odds).dtype == np.float32
    assert label_probabilities(log_odds).dtype == np.float32
