"""The consensus rules: one iteration at one robot, in float64, vectorised over cells only.

Everything here is a deviation from the prior, h - h_0, of shape (M, K): M cells, K = C + 1 classes, column 0 is free
space and stays 0. Source: Alg. 1 of the paper (Asgharivaskasi and Atanasov).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from octoreplay.records import Float64Array


def softmax(log_odds: Float64Array) -> Float64Array:
    """The categorical distribution of each row, shifted by the maximum so that nothing overflows."""
    exponent = np.exp(log_odds - log_odds.max(axis=-1, keepdims=True))
    prob: Float64Array = exponent / exponent.sum(axis=-1, keepdims=True)
    return prob


def mix(own: Float64Array, differences: Sequence[tuple[float, Float64Array]], epsilon: float) -> Float64Array:
    """h~ = h_i + 2 epsilon sum_j A_ij (h_j - h_i) with ``differences`` the pairs (A_ij, h_j - h_i). Alg. 1, line 6."""
    total = np.zeros_like(own)
    for weight, difference in differences:
        total += weight * difference
    return own + 2.0 * epsilon * total


def gradient_step(mixed: Float64Array, log_likelihood: Float64Array, gamma: float) -> Float64Array:
    """h~ + gamma g with g_c = sigma_c (sum_m sigma_m Delta_m - Delta_c), Delta = h~ - log q. Alg. 1, lines 7 to 12."""
    delta = mixed - log_likelihood
    sigma = softmax(mixed)
    gradient = sigma * ((sigma * delta).sum(axis=-1, keepdims=True) - delta)
    return free_is_zero(mixed + gamma * gradient)


def natural_step(mixed: Float64Array, log_likelihood: Float64Array, gamma: float) -> Float64Array:
    """h~ + gamma (log q - h~)."""
    return free_is_zero(mixed + gamma * (log_likelihood - mixed))


def bayes_step(mixed: Float64Array, now: Float64Array, at_last_iteration: Float64Array) -> Float64Array:
    """h~ + (s now - s at the last iteration)."""
    return free_is_zero(mixed + (now - at_last_iteration))


def merge_step(
    mixed: Float64Array, now: Float64Array, at_last_iteration: Float64Array, clamp_min: float, clamp_max: float
) -> Float64Array:
    """h~ + (s now - s at the last iteration), clamped; h~ = h_i + 2 epsilon sum_j A_ij h_j."""
    return np.clip(bayes_step(mixed, now, at_last_iteration), clamp_min, clamp_max)


def free_is_zero(log_odds: Float64Array) -> Float64Array:
    """h[0] = 0, in a copy. Alg. 1, line 13."""
    result = log_odds.copy()
    result[:, 0] = 0.0
    return result


def gamma_at(gamma: float, iteration: int, power: float, decay: float) -> float:
    """gamma_k = gamma / (1 + k / gamma_decay)^gamma_power; k is the number of iterations that the robot did before."""
    return float(gamma / (1.0 + iteration / decay) ** power)


def settling_ramp(settling_tick: int, num_ramp_ticks: int) -> float:
    """The factor of gamma in settling tick 1, 2, ...: falls linearly and is 0 from tick ``num_ramp_ticks`` on."""
    return max(0.0, 1.0 - settling_tick / num_ramp_ticks)
