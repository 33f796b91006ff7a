from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from reference import rules
from support.long_suite import examples

log_odds = arrays(np.float64, (3, 5), elements=st.floats(-6.0, 6.0)).map(rules.free_is_zero)


def _paper_gradient(mixed, log_q, gamma):
    """Lines 7 to 13 of Alg. 1, literally, one cell at a time."""
    result = []
    for h, q in zip(mixed, log_q, strict=True):
        delta = h - q
        ones = np.ones_like(h)
        alpha = (np.exp(h) @ delta) * ones
        beta = (np.exp(h) @ ones) * delta
        g = (alpha - beta) * np.exp(h) / (np.exp(h) @ ones) ** 2
        new = h + gamma * g
        new[0] = 0.0
        result.append(new)
    return np.array(result)


def _objective(h, log_q):
    """sum_m sigma_m(h) log(q(m) / sigma_m(h)) of one cell."""
    sigma = rules.softmax(h)
    return float(sigma @ (np.log(rules.softmax(log_q)) - np.log(sigma)))


def test_gradient_step_by_hand():
    # sigma = (1/2, 1/2), Delta = (0, -1): g_1 = 1/2 (-1/2 + 1) = 1/4.
    step = rules.gradient_step(np.array([[0.0, 0.0]]), np.array([[0.0, 1.0]]), 1.0)
    assert step.tolist() == [[0.0, 0.25]]
    # sigma = (1/4, 3/4), Delta = (0, log 3 - 1): g_1 = 3/4 (3/4 - 1) Delta = -3/16 Delta.
    mixed = np.array([[0.0, np.log(3.0)]])
    step = rules.gradient_step(mixed, np.array([[0.0, 1.0]]), 2.0)
    assert step[0, 1] == pytest.approx(np.log(3.0) - 2.0 * 3.0 / 16.0 * (np.log(3.0) - 1.0))


@examples(100)
@given(mixed=log_odds, log_q=log_odds)
def test_gradient_step_is_the_papers_alpha_beta_form(mixed, log_q):
    np.testing.assert_allclose(
        rules.gradient_step(mixed, log_q, 0.7), _paper_gradient(mixed, log_q, 0.7), rtol=1e-10, atol=1e-10
    )


@examples(100)
@given(mixed=log_odds, log_q=log_odds)
def test_gradient_step_follows_the_derivative_of_the_objective(mixed, log_q):
    step = (rules.gradient_step(mixed, log_q, 1.0) - mixed)[0]
    for c in range(1, mixed.shape[1]):
        plus, minus = mixed[0].copy(), mixed[0].copy()
        plus[c] += 1e-5
        minus[c] -= 1e-5
        slope = (_objective(plus, log_q[0]) - _objective(minus, log_q[0])) / 2e-5
        assert step[c] == pytest.approx(slope, abs=1e-7)


def test_gradient_step_does_not_overflow():
    step = rules.gradient_step(np.array([[0.0, 1000.0, -1000.0]]), np.zeros((1, 3)), 1.0)
    assert np.isfinite(step).all()


def test_mix_by_hand():
    own, other = np.array([[0.0, 1.0]]), np.array([[0.0, 4.0]])
    assert rules.mix(own, [(0.25, other - own), (0.5, -own)], 0.5).tolist() == [[0.0, 1.0 + 0.75 - 0.5]]
    assert rules.mix(own, [], 0.5).tolist() == own.tolist()


def test_natural_step_and_evidence_by_hand():
    mixed, log_q = np.array([[0.0, 1.0]]), np.array([[0.0, 3.0]])
    assert rules.natural_step(mixed, log_q, 0.25).tolist() == [[0.0, 1.5]]
    assert rules.with_evidence(mixed, log_q, np.array([[0.0, 2.5]])).tolist() == [[0.0, 1.5]]


@pytest.mark.parametrize("step", [rules.gradient_step, rules.natural_step])
def test_free_is_zero_and_the_evidence_is_a_fixed_point(step):
    log_q = np.array([[0.0, -2.0, 3.0]])
    np.testing.assert_allclose(step(log_q, log_q, 0.5), log_q, atol=1e-15)
    assert step(np.zeros((1, 3)), log_q, 0.5)[0, 0] == 0.0


def test_unobserved_cells_keep_the_prior_under_every_rule():
    nothing = np.zeros((2, 4))
    mixed = rules.mix(nothing, [(0.5, nothing)], 0.5)
    for result in (
        rules.gradient_step(mixed, nothing, 0.5),
        rules.natural_step(mixed, nothing, 0.5),
        rules.with_evidence(mixed, nothing, nothing),
    ):
        assert not result.any()


def test_rounding_to_the_nearest_multiple():
    values = np.array([[0.0, 0.24, 0.26, -0.74, 0.75, 1.25]])
    assert rules.rounded(values, 0.5).tolist() == [[0.0, 0.0, 0.5, -0.5, 1.0, 1.0]]
    assert rules.rounded(values, 0.0).tolist() == values.tolist()


def test_gamma_schedule_by_hand():
    assert rules.gamma_at(0.5, 1000, 0.0, 1.0) == 0.5
    assert [rules.gamma_at(1.0, k, 1.0, 1.0) for k in range(3)] == [1.0, 1.0 / 2.0, 1.0 / 3.0]
    assert rules.gamma_at(0.5, 10, 0.5, 10.0) == pytest.approx(0.5 / np.sqrt(2.0))


def test_settling_ramp_reaches_zero_in_its_last_tick():
    assert [rules.settling_ramp(n, 4) for n in range(1, 7)] == [0.75, 0.5, 0.25, 0.0, 0.0, 0.0]
