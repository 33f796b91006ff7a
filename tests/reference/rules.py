"""Consensus rules: one iteration at one robot in float64, vectorised over cells only.

All values are deviations from the prior, h - h_0, of shape (M, K): M cells, K = C + 1 classes, column 0 is free space
and stays 0. Source: Alg. 1 of the paper (Asgharivaskasi and Atanasov).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from octoreplay.records import Float64Array


def softmax(log_odds: Float64Array) -> Float64Array:
    """Return the softmax of each row, shifted by the maximum so that nothing overflows."""
    exponent = np.exp(log_odds - log_odds.max(axis=-1, keepdims=True))
    prob: Float64Array = exponent / exponent.sum(axis=-1, keepdims=True)
    return prob


def mix(own: Float64Array, differences: Sequence[tuple[float, Float64Array]], epsilon: float) -> Float64Array:
    """Return h~ = h_i + 2 epsilon sum_j A_ij (h_j - h_i). Alg. 1, line 6.

    ``differences`` are the pairs (A_ij, h_j - h_i).
    """
    total = np.zeros_like(own)
    for weight, difference in differences:
        total += weight * difference
    return own + 2.0 * epsilon * total


def weighted_difference(own: Float64Array, other: Float64Array) -> Float64Array:
    """Return c_j / (c_i + c_j) (h_j - h_i); c is the largest |h| over a cell's classes. 0 where both c are 0."""
    c_i, c_j = (np.abs(values).max(axis=-1, keepdims=True) for values in (own, other))
    total = c_i + c_j
    share: Float64Array = np.divide(c_j, total, out=np.zeros_like(total), where=total > 0.0)
    return share * (other - own)


def gradient_step(mixed: Float64Array, log_likelihood: Float64Array, gamma: float) -> Float64Array:
    """Return h~ + gamma g, g_c = sigma_c (sum_m sigma_m D_m - D_c), D = h~ - log q. Alg. 1, lines 7 to 12."""
    delta = mixed - log_likelihood
    sigma = softmax(mixed)
    gradient = sigma * ((sigma * delta).sum(axis=-1, keepdims=True) - delta)
    return free_is_zero(mixed + gamma * gradient)


def natural_step(mixed: Float64Array, log_likelihood: Float64Array, gamma: float) -> Float64Array:
    """Return h~ + gamma (log q - h~)."""
    return free_is_zero(mixed + gamma * (log_likelihood - mixed))


def with_evidence(log_odds: Float64Array, now: Float64Array, before: Float64Array) -> Float64Array:
    """Return h + (s now - s before)."""
    return free_is_zero(log_odds + (now - before))


def merge_step(
    mixed: Float64Array, now: Float64Array, at_last_iteration: Float64Array, clamp_min: float, clamp_max: float
) -> Float64Array:
    """Return h~ + (s now - s at the last iteration), clamped; h~ = h_i + 2 epsilon sum_j A_ij h_j."""
    return np.clip(with_evidence(mixed, now, at_last_iteration), clamp_min, clamp_max)


def in_turn(senders: Sequence[int], num_maps: int, tick: int) -> list[int]:
    """Return the next ``num_maps`` of the senders: each tick goes on in the circle of senders where the last ended."""
    circle = [senders[(tick * num_maps + step) % len(senders)] for step in range(num_maps) if senders]
    return sorted(set(circle))


def rounded(log_odds: Float64Array, quantum: float) -> Float64Array:
    """Return the nearest multiples of ``quantum``, ties to even; unchanged for 0."""
    return np.rint(log_odds / quantum) * quantum if quantum else log_odds


def free_is_zero(log_odds: Float64Array) -> Float64Array:
    """Return a copy with h[0] = 0. Alg. 1, line 13."""
    result = log_odds.copy()
    result[:, 0] = 0.0
    return result


def gamma_at(gamma: float, iteration: int, power: float, decay: float) -> float:
    """Return gamma_k = gamma / (1 + k / gamma_decay)^gamma_power; k counts the robot's iterations from 0."""
    return float(gamma / (1.0 + iteration / decay) ** power)


def settling_ramp(settling_tick: int, num_ramp_ticks: int) -> float:
    """Return the factor of gamma in settling tick 1, 2, ...: it falls linearly to 0 at tick ``num_ramp_ticks``."""
    return max(0.0, 1.0 - settling_tick / num_ramp_ticks)
