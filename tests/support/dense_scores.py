"""The scores of a map counted cell by cell with scikit-learn: the obvious twin of octoreplay.evaluate.scores."""

from __future__ import annotations

from functools import cache

import numpy as np
from sklearn.calibration import calibration_curve
from sklearn.metrics import jaccard_score, recall_score

NUM_BINS = 15


@cache
def probabilities(values, prior, num_robots):
    """The distribution over free and the classes of a cell with deviations ``values`` (C,), in float64."""
    log_odds = prior + num_robots * np.asarray(values, np.float64)
    odds = np.exp(np.concatenate([[0.0], log_odds]))
    return odds / odds.sum()


def iou(cells, classes, truth, prior):
    """The Jaccard index of each class over some cells, NaN where it does not occur in truth or map."""
    num_classes = len(next(iter(cells.values())))
    judged = [key for key in sorted(classes) if truth.get(key, 0) >= 0]
    true = np.array([truth.get(key, 0) for key in judged], np.int64)
    found = np.array(
        [np.argmax(probabilities(cells[key], prior, 1)) if key in cells else num_classes + 1 for key in judged],
        np.int64,
    )
    scores = np.full(num_classes, np.nan)
    for class_id in range(1, num_classes + 1):
        if class_id in true or class_id in found:
            scores[class_id - 1] = jaccard_score(true == class_id, found == class_id)
    return scores


def occupied_iou(cells, keys, truth, prior):
    """The Jaccard index of the occupied cells, of any class, among ``keys``; NaN where no cell is occupied."""
    judged = [key for key in sorted(keys) if truth.get(key, 0) >= 0]
    true = np.array([truth.get(key, 0) > 0 for key in judged], np.bool_)
    found = np.array([key in cells and np.argmax(probabilities(cells[key], prior, 1)) > 0 for key in judged], np.bool_)
    return jaccard_score(true, found) if (true | found).any() else np.nan


def accuracies(cells, truth, prior):
    """The recall of occupied and of free cells among the known ones; NaN where there are none."""
    known = [key for key in sorted(cells) if truth.get(key, 0) >= 0]
    true = np.array([truth.get(key, 0) > 0 for key in known])
    found = np.array([np.argmax(probabilities(cells[key], prior, 1)) > 0 for key in known])
    return tuple(
        recall_score(true, found, pos_label=is_occupied) if (true == is_occupied).any() else np.nan
        for is_occupied in (True, False)
    )


def coverage(cells, keys, truth, prior):
    """The share of the truth's cells among ``keys`` that the map calls occupied; NaN where there are none."""
    surface = [key for key in keys if truth.get(key, 0) > 0]
    found = [key in cells and np.argmax(probabilities(cells[key], prior, 1)) > 0 for key in surface]
    return np.mean(found) if found else np.nan


def calibration_error(cells, truth, prior, num_robots, *, occupied=False):
    """The expected calibration error over the known cells, or over those occupied in map or truth."""
    correct, confidence = [], []
    for key, values in cells.items():
        distribution, true = probabilities(values, prior, num_robots), truth.get(key, 0)
        label = int(np.argmax(distribution))
        if true >= 0 and (not occupied or label > 0 or true > 0):
            correct.append(label == true)
            confidence.append(distribution[label])
    if not correct:
        return np.nan
    share, mean = calibration_curve(np.array(correct), np.array(confidence), n_bins=NUM_BINS)
    edges = np.linspace(0.0, 1.0, NUM_BINS + 1)
    sizes = np.bincount(np.searchsorted(edges[1:-1], confidence))
    return float(np.sum(sizes[sizes > 0] * np.abs(share - mean)) / len(correct))
