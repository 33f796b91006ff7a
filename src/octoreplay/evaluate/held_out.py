"""Prediction of what one robot measured by the evidence of the others, for recordings without a true map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from octoreplay.evaluate.scores import calibration_bins, calibration_error
from octoreplay.evaluate.temperature import distinct_rows, fitted_temperature
from octoreplay.log_odds import best_labels, label_probabilities
from octoreplay.mapping.contradiction import StateLimits
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import Float32Array, UInt8Array


class Prediction(NamedTuple):
    """Fit of the others' maps to what each robot measured, over the cells of all robots.

    Attributes
    ----------
    num_cells : int
        Cells that a robot measured and another robot knows.
    iou : float
        Cells that a robot and the others' map call occupied, divided by those that either does.
    calibration_error : float
        Expected calibration error of the others' probabilities, with 15 bins.
    log_loss : float
        Mean negative logarithm of the probability of the measured state [nat].
    temperature : float
        Divisor of the log-odds with the least log loss.
    """

    num_cells: int
    iou: float
    calibration_error: float
    log_loss: float
    temperature: float


def prediction(
    evidence: Sequence[SemanticOctree], prior: float, measured: Sequence[SemanticOctree], limits: StateLimits
) -> Prediction | None:
    """Leave each robot out, and compare the posterior of the others' evidence with what it measured.

    None where no robot measured an occupied cell that another one knows.

    ``evidence`` are the octrees s_i of the sensor model that is tested, and ``prior`` its h_0. ``measured`` are those
    of one fixed sensor model, so that all models are compared with the same states: a cell is occupied with its most
    probable class from ``limits.occupied_from`` on, and free up to ``limits.firm_to``; others are not counted.
    """
    found = [_predicted([*evidence[:robot], *evidence[robot + 1 :]], own, limits) for robot, own in enumerate(measured)]
    log_odds = np.concatenate([values for values, _ in found]) + np.float32(prior)
    states = np.concatenate([own for _, own in found])
    if not (states > 0).any():
        return None
    rows, row_of_cell = distinct_rows(log_odds)
    counts = np.zeros((len(rows), rows.shape[1] + 1))
    np.add.at(counts, (row_of_cell, states), 1.0)
    labels = best_labels(rows)
    is_occupied = labels > 0
    num_correct = counts[np.arange(len(rows)), labels]
    bins = calibration_bins(label_probabilities(rows), num_correct, counts.sum(axis=1))
    fit = fitted_temperature(rows.astype(np.float64), counts)
    return Prediction(
        states.size,
        float(counts[is_occupied, 1:].sum() / (counts[is_occupied].sum() + counts[~is_occupied, 1:].sum())),
        calibration_error(bins),
        fit.log_loss,
        fit.temperature,
    )


def _predicted(
    others: Sequence[SemanticOctree], measured: SemanticOctree, limits: StateLimits
) -> tuple[Float32Array, UInt8Array]:
    """Sum of the others' evidence (P, C) in the cells that a robot measured, and the states (P,) that it measured."""
    spans = measured.spans()
    largest = spans.deviations.max(axis=1)
    is_occupied = largest >= limits.occupied_from
    codes = spans.cells_in(is_occupied | (largest <= limits.firm_to))
    of_others = [other.spans() for other in others]
    codes = codes[np.any([other.leaves_at(codes) >= 0 for other in of_others], axis=0)]
    states = np.where(is_occupied, best_labels(spans.deviations), 0).astype(np.uint8)[spans.leaves_at(codes)]
    total = np.zeros((codes.size, spans.deviations.shape[1]), np.float32)
    for other in of_others:
        total += other.deviations_at(codes)
    return total, states
