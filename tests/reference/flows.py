"""Flows: coarse amounts of log-odds that two robots exchange, equal and opposite at both ends of a link.

Maps are deviations from the prior, (M, K) float64, column 0 zero.
"""

from __future__ import annotations

import numpy as np

from octoreplay.records import BoolArray, Float64Array, Int64Array

BITS_PER_SETTLING_TICK = 2
"""Growth of flow_bits in every settling tick."""
BLOCK_EDGE = 4
"""Edge of the blocks that ``flow_gate`` holds back, in cells."""
EXTRA_SETTLING_TICKS = 8
"""Least addition to the default maximum number of settling ticks."""


def num_finer_ticks(maps: Float64Array, flow_bits: int, quantum: float) -> int:
    """Return the number of settling ticks until every step of ``maps`` (N, M, K) is the quantum; 0 without flows."""
    largest = np.abs(maps).max(initial=0.0)
    if not flow_bits or largest == 0.0:
        return 0
    num_ticks = 0
    while flow_step(largest, flow_bits + BITS_PER_SETTLING_TICK * num_ticks) > quantum:
        num_ticks += 1
    return num_ticks


def flow_step(largest: float | Float64Array, flow_bits: int) -> Float64Array:
    """Return 2^(floor(log2 m) - flow_bits) of the largest |log-odds| m; 0 where m is 0."""
    # m = fraction * 2^exponent with a fraction in [1/2, 1), so that floor(log2 m) is exponent - 1, exactly.
    _, exponent = np.frexp(largest)
    return np.where(largest > 0.0, np.ldexp(1.0, exponent - 1 - flow_bits), 0.0)


def link_bits(weight: float) -> int:
    """Return the least b >= 0 with 2^(b + 3) w >= 1: additional bits of a link with w = 2 epsilon A_ij, as float32."""
    bits = 0
    while 2.0 ** (bits + 3) * float(np.float32(weight)) < 1.0:
        bits += 1
    return bits


def flow_steps(own: Float64Array, other: Float64Array, flow_bits: int, quantum: float) -> Float64Array:
    """Return e (M, 1) of two published maps: max(2^(floor(log2 m) - flow_bits), quantum), m their largest |log-odds|.

    ``flow_bits`` are those of the link. It is ``quantum`` where both maps are 0.
    """
    largest = np.maximum(np.abs(own), np.abs(other)).max(axis=-1, keepdims=True)
    return np.maximum(flow_step(largest, flow_bits), quantum)


def is_held_back(own: Float64Array, other: Float64Array, blocks: Int64Array, gate: float) -> BoolArray:
    """Return for each cell whether the gate makes the flow of its block 0, (M, 1).

    A block flows where in one of its cells the classes with the largest value are not the same in both maps, or a class
    differs, by at least gate m, m the largest |log-odds| of both. ``blocks`` (M,) are the cells' blocks. The product is
    float32.
    """
    largest = np.maximum(np.abs(own), np.abs(other)).max(axis=-1)
    change = np.abs(other - own).max(axis=-1)
    differs = (change > 0.0) & (change.astype(np.float32) >= np.float32(gate) * largest.astype(np.float32))
    is_open = np.isin(blocks, blocks[differs | ~have_equal_labels(own, other)])
    return ~is_open[:, np.newaxis]


def have_equal_labels(own: Float64Array, other: Float64Array) -> BoolArray:
    """Return for each cell whether the same classes, free space among them, have the largest value, (M,)."""
    is_largest = [values == values.max(axis=-1, keepdims=True) for values in (own, other)]
    return (is_largest[0] == is_largest[1]).all(axis=-1)


def flow(own: Float64Array, other: Float64Array, weight: float, steps: Float64Array) -> Float64Array:
    """Return f = e trunc(w (h_j - h_i) / e) with w = 2 epsilon A_ij, towards zero; -f at the other end.

    w and the product w (h_j - h_i) are float32: another precision would give other flows by a whole step.
    """
    amounts = np.float32(weight) * (other - own).astype(np.float32)
    return np.trunc(amounts.astype(np.float64) / steps) * steps
