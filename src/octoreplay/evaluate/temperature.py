"""Temperature that calibrates a map: log-odds divided by it fit the truth best."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.evaluate.truth import Truth
from octoreplay.log_odds import class_probabilities
from octoreplay.records import Float32Array, Float64Array, Int64Array
from octoreplay.stored_map import StoredMap

_LARGEST = 100.0
"""Largest temperature, and inverse of the smallest, that is tried."""


class Calibration(NamedTuple):
    """Fit of a map's probabilities to the truth over its known cells.

    Attributes
    ----------
    log_loss : float
        Mean negative logarithm of the probability of the true class [nat].
    temperature : float
        Divisor of the log-odds with the least log loss, between 0.01 and 100: above 1 for a map that is too certain.
    calibrated_log_loss : float
        Log loss with this divisor.
    """

    log_loss: float
    temperature: float
    calibrated_log_loss: float


def calibrating_temperature(stored: StoredMap, truth: Truth) -> Calibration:
    """Return the fit of a map's probabilities to the truth, and the temperature that fits best.

    Cells of a true class that the map does not have are not counted; cells without surface are free. The method is
    temperature scaling (Guo, Pleiss, Sun and Weinberger, "On Calibration of Modern Neural Networks", ICML 2017).
    """
    return fitted_temperature(*_distinct_cells(stored, truth))


def fitted_temperature(log_odds: Float64Array, counts: Float64Array) -> Calibration:
    """Return the fit of log-odds (P, C) to ``counts`` (P, C + 1), the numbers of their cells by true class."""
    from scipy.optimize import minimize_scalar

    def loss(log_temperature: float) -> float:
        """Mean log loss of the scaled map."""
        chances = class_probabilities(log_odds / np.exp(log_temperature))
        return float(-(counts * np.log(np.maximum(chances, np.finfo(np.float64).tiny))).sum() / counts.sum())

    limit = float(np.log(_LARGEST))
    best = minimize_scalar(loss, bounds=(-limit, limit), method="bounded", options={"xatol": 1e-4})
    return Calibration(loss(0.0), float(np.exp(best.x)), float(best.fun))


def distinct_rows(rows: Float32Array) -> tuple[Float32Array, Int64Array]:
    """Return the distinct rows (U, C) of ``rows`` (P, C), and the place (P,) of each row among them.

    Rows are compared byte by byte, which is several times as fast as number by number.
    """
    whole = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, places = np.unique(whole, return_index=True, return_inverse=True)
    return rows[first], places


def _distinct_cells(stored: StoredMap, truth: Truth) -> tuple[Float64Array, Float64Array]:
    """Distinct rows of log-odds (P, C) in a map, and the number of their cells by true class (P, C + 1)."""
    spans = stored.octree.spans()
    num_classes = spans.deviations.shape[1]
    rows, row_of_leaf = distinct_rows(spans.deviations)
    leaves = spans.leaves_at(truth.codes)
    is_known = leaves >= 0
    num_free = spans.num_cells.astype(np.float64)
    np.subtract.at(num_free, leaves[is_known], 1.0)
    counts = np.zeros((len(rows), num_classes + 1))
    np.add.at(counts[:, 0], row_of_leaf, num_free)
    counted = is_known & truth.is_class
    np.add.at(counts, (row_of_leaf[leaves[counted]], truth.class_ids[counted]), 1.0)
    return rows.astype(np.float64) + stored.prior, counts
