"""What log-odds say: class posteriors, labels, and the team posterior of an agreed map."""

from __future__ import annotations

import numpy as np

from octoreplay.records import FloatArray, UInt8Array


def class_probabilities(log_odds: FloatArray) -> FloatArray:
    """Probabilities of free and the classes 1..C: (P, C + 1) in the precision of ``log_odds`` (P, C).

    The softmax of [0, log_odds], shifted by the row's maximum so that nothing overflows.
    """
    full = np.zeros((log_odds.shape[0], log_odds.shape[1] + 1), dtype=log_odds.dtype)
    full[:, 1:] = log_odds
    full -= full.max(axis=1, keepdims=True)
    np.exp(full, out=full)
    full /= full.sum(axis=1, keepdims=True)
    return full


def best_labels(log_odds: FloatArray) -> UInt8Array:
    """The most probable class_id per row, 0 for free: (P,) uint8 from (P, C). A tie goes to the lower id."""
    if log_odds.shape[1] == 0:
        return np.zeros(len(log_odds), dtype=np.uint8)
    best = np.argmax(log_odds, axis=1)
    occupied = log_odds[np.arange(len(log_odds)), best] > 0
    return np.where(occupied, best + 1, 0).astype(np.uint8)


def label_probabilities(log_odds: FloatArray) -> FloatArray:
    """The probability of each row's most probable class: (P,) from (P, C)."""
    largest = np.maximum(log_odds.max(axis=1, initial=0.0), 0.0)
    total: FloatArray = np.exp(-largest) + np.exp(log_odds - largest[:, None]).sum(axis=1)
    return 1.0 / total


def team_log_odds(log_odds: FloatArray, prior: float, num_robots: int) -> FloatArray:
    """h_0 + N (h - h_0): the evidence of N robots from the mean that consensus leaves at each, same shape and dtype."""
    return prior + num_robots * (log_odds - prior)
