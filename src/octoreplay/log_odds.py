"""Posterior probabilities and labels from log-odds."""

from __future__ import annotations

import numpy as np

from octoreplay.records import FloatArray, UInt8Array

TIE_TOLERANCE = 1e-4
"""Log-odds within this share of the cell's largest |log-odds| of the maximum tie with it."""


def class_probabilities(log_odds: FloatArray) -> FloatArray:
    """Return the probabilities (P, C + 1) of free and of the classes 1..C, from ``log_odds`` (P, C), same dtype.

    They are softmax([0, log_odds]), shifted by the row's maximum so that nothing overflows.
    """
    full = np.zeros((log_odds.shape[0], log_odds.shape[1] + 1), dtype=log_odds.dtype)
    full[:, 1:] = log_odds
    full -= full.max(axis=1, keepdims=True)
    np.exp(full, out=full)
    full /= full.sum(axis=1, keepdims=True)
    return full


def best_labels(log_odds: FloatArray) -> UInt8Array:
    """Return the most probable class_id (P,) uint8, 0 for free, from ``log_odds`` (P, C). Ties go to the lower id."""
    if log_odds.shape[1] == 0:
        return np.zeros(len(log_odds), dtype=np.uint8)
    best = np.argmax(log_odds, axis=1)
    occupied = log_odds[np.arange(len(log_odds)), best] > 0
    return np.where(occupied, best + 1, 0).astype(np.uint8)


def label_probabilities(log_odds: FloatArray) -> FloatArray:
    """Return the probability (P,) of the most probable class, from ``log_odds`` (P, C), same dtype."""
    return 1.0 / shifted_exp_sum(log_odds)


def occupancy_log_odds(log_odds: FloatArray) -> FloatArray:
    """Return log P(occupied) / P(free) (P,) from ``log_odds`` (P, C), same dtype; minus infinity without classes."""
    total: FloatArray = np.logaddexp.reduce(log_odds, axis=1)
    return total


def shifted_exp_sum(log_odds: FloatArray, *, class_axis: int = 1) -> FloatArray:
    """Return the sum (P,) of exp(h_c - max h) over free and the classes: 1 / the probability of the most probable one.

    ``log_odds`` is (P, C), or (C, P) with class_axis 0; the result has its dtype.
    """
    largest = log_odds.max(axis=class_axis, initial=0.0)
    total: FloatArray = np.exp(-largest) + np.exp(log_odds - np.expand_dims(largest, class_axis)).sum(axis=class_axis)
    return total
