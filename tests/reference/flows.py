"""Flows: coarse amounts of log-odds that two robots exchange, equal and opposite at both ends of a link.

Maps are deviations from the prior, (M, K) float64, column 0 zero.
"""

from __future__ import annotations

import numpy as np

from octoreplay.records import Float64Array

BITS_PER_SETTLING_TICK = 2
"""Growth of flow_bits in every settling tick."""
EXTRA_SETTLING_TICKS = 8
"""Addition to the default maximum number of settling ticks."""


def flow_steps(own: Float64Array, other: Float64Array, flow_bits: int, quantum: float) -> Float64Array:
    """Return e (M, 1) of two published maps: max(2^(floor(log2 m) - flow_bits), quantum), m their largest |log-odds|.

    It is ``quantum`` where both maps are 0.
    """
    largest = np.maximum(np.abs(own), np.abs(other)).max(axis=-1, keepdims=True)
    # largest = fraction * 2^exponent with a fraction in [1/2, 1), so that floor(log2 m) is exponent - 1, exactly.
    _, exponent = np.frexp(largest)
    steps = np.ldexp(1.0, exponent - 1 - flow_bits)
    return np.where(largest > 0.0, np.maximum(steps, quantum), quantum)


def flow(own: Float64Array, other: Float64Array, weight: float, steps: Float64Array) -> Float64Array:
    """Return f = e trunc(w (h_j - h_i) / e) with w = 2 epsilon A_ij, towards zero; -f at the other end.

    w and the product w (h_j - h_i) are float32: another precision would give other flows by a whole step.
    """
    amounts = np.float32(weight) * (other - own).astype(np.float32)
    return np.trunc(amounts.astype(np.float64) / steps) * steps
