"""Scores of one map, counted exactly over finest cells without expanding larger leaves (docs/evaluation.md)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octoreplay.evaluate.morton_intervals import Region, common_intervals
from octoreplay.evaluate.records import TruthScores
from octoreplay.evaluate.truth import Truth
from octoreplay.log_odds import TIE_TOLERANCE, best_labels, shifted_exp_sum
from octoreplay.mapping.octree import LeafSpans
from octoreplay.records import NO_CLASS, BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, UInt8Array

NUM_BINS = 15
"""Number of bins of the expected calibration error (Guo, Pleiss, Sun and Weinberger, ICML 2017)."""


class TruthCounts(NamedTuple):
    """Counts of a map against the truth. Counts of different cells add up with ``plus``.

    Attributes
    ----------
    known : (C + 1, C + 1) int64
        Cells that the map knows, by truth and label.
    of_team : (C + 1, C + 2) int64
        Cells of the team's region, by truth and label; the last column counts unknown cells.
    num_seen, num_observed, num_seen_observed : int
        Surface cells that the map calls occupied, that the team observed, and both.
    calibration, calibration_occupied : (3, NUM_BINS) float64
        Of each bin, correct cells, summed confidence and all cells: of known cells, and of occupied ones.
    """

    known: Int64Array
    of_team: Int64Array
    num_seen: int
    num_observed: int
    num_seen_observed: int
    calibration: Float64Array
    calibration_occupied: Float64Array

    def plus(self, other: TruthCounts) -> TruthCounts:
        """Return the counts of the cells of both."""
        return TruthCounts(**{name: value + getattr(other, name) for name, value in self._asdict().items()})

    @property
    def mean_iou(self) -> float:
        """Mean IoU over the classes that the truth has in the team's region; NaN where it has none."""
        return _mean(_intersections_over_unions(self.of_team), self.of_team)

    @property
    def occupied_iou(self) -> float:
        """IoU of the occupied cells, of any class, in the team's region; NaN without such a cell."""
        num_hits = self.of_team[1:, 1:-1].sum()
        return _ratio(num_hits, self.of_team[1:].sum() + self.of_team[0, 1:-1].sum())

    def scores(self, num_surface: int) -> TruthScores:
        """Return the scores against a truth with ``num_surface`` cells of the result's classes."""
        known = self.known
        return TruthScores(
            tuple(_intersections_over_unions(self.of_team).tolist()),
            self.mean_iou,
            _mean(_intersections_over_unions(known), known),
            _ratio(known[1:, 1:].sum(), known[1:].sum()),
            _ratio(known[0, 0], known[0].sum()),
            _ratio(self.num_seen_observed, self.num_observed),
            _ratio(self.num_seen, num_surface),
            calibration_error(self.calibration),
            calibration_error(self.calibration_occupied),
        )


def truth_counts(spans: LeafSpans, prior: float, truth: Truth, region: Region, is_observed: BoolArray) -> TruthCounts:
    """Return the counts of a map with prior h_0 against the truth.

    ``region`` holds the cells that the team's evidence covers at this tick. ``is_observed`` (M,) bool is True for the
    truth's cells that it covers at the end of the run.
    """
    num_classes = spans.deviations.shape[1]
    surface = _surface_in_leaves(spans, truth)
    log_odds = spans.deviations + np.float32(prior)
    labels = best_labels(log_odds)
    known = _confusion(labels, surface, truth.class_ids, spans.num_cells, num_classes)
    # At the end of a run the map often knows all of the region.
    if region.is_same(Region([spans])):
        of_team = np.column_stack([known, np.zeros(num_classes + 1, np.int64)])
    else:
        of_team = _confusion_of_region(labels, surface, spans, truth, region)
    is_seen = np.zeros(truth.codes.size, np.bool_)
    is_seen[surface.is_known] = labels[surface.leaves] > 0
    is_seen &= truth.is_class
    # Classes come first: sums along the short axis would take several times as long.
    by_class = np.ascontiguousarray(log_odds.T)
    return TruthCounts(
        known, of_team, int(is_seen.sum()), int((is_observed & truth.is_class).sum()),
        int((is_seen & is_observed).sum()),
        *_calibrations(by_class, labels, surface, truth.class_ids, spans.num_cells),
    )  # fmt: skip


class Agreements(NamedTuple):
    """Cells in which a map has a reference's label, of all cells and of those that the reference calls occupied.

    Counts of different cells add up.
    """

    num_equal: int
    num_equal_occupied: int
    num_cells: int
    num_occupied: int

    def plus(self, other: Agreements) -> Agreements:
        """Return the counts of the cells of both."""
        return Agreements(**{name: value + getattr(other, name) for name, value in self._asdict().items()})

    @property
    def shares(self) -> tuple[float, float]:
        """Shares of equal labels, of all cells and of the occupied ones; a share of no cells is 1."""
        return (
            self.num_equal / self.num_cells if self.num_cells else 1.0,
            self.num_equal_occupied / self.num_occupied if self.num_occupied else 1.0,
        )


def agreements(
    spans: LeafSpans, prior: float, reference: LeafSpans, reference_prior: float, num_cells: int
) -> Agreements:
    """Return the numbers of cells in which a map has the reference's label, of ``num_cells`` cells.

    A cell that only one of the maps knows is a disagreement.
    """
    intervals = common_intervals(spans, reference)
    both = (intervals.leaves_a >= 0) & (intervals.leaves_b >= 0)
    leaf, other = intervals.leaves_a[both], intervals.leaves_b[both]
    labels = best_labels(spans.deviations + np.float32(prior))[leaf]
    values = reference.deviations + np.float32(reference_prior)
    best = values.max(axis=1, initial=0.0)[other]
    tolerance = np.float32(TIE_TOLERANCE) * np.abs(values).max(axis=1, initial=0.0)[other]
    of_label = np.where(labels > 0, values[other, np.maximum(labels, 1) - 1], 0.0)
    agrees = of_label >= best - tolerance
    is_occupied = best_labels(values) > 0
    weights = intervals.num_cells[both] * agrees
    return Agreements(
        int(weights.sum()), int(weights[is_occupied[other]].sum()), num_cells,
        int(reference.num_cells[is_occupied].sum()),
    )  # fmt: skip


class _Surface(NamedTuple):
    """The truth's cells that a map knows.

    Attributes
    ----------
    is_known : (M,) bool
        True for the truth's cells that the map knows.
    leaves : (k,) int64
        Leaf of each known cell.
    num_cells, num_void : (L,) int64
        Number of the truth's cells in each leaf, and of those without a class of the result.
    """

    is_known: BoolArray
    leaves: Int64Array
    num_cells: Int64Array
    num_void: Int64Array


def _surface_in_leaves(spans: LeafSpans, truth: Truth) -> _Surface:
    """Locate the truth's cells in a map."""
    leaves = spans.leaves_at(truth.codes)
    is_known = leaves >= 0
    leaves, size = leaves[is_known], spans.codes.size
    void = leaves[~truth.is_class[is_known]]
    return _Surface(is_known, leaves, np.bincount(leaves, minlength=size), np.bincount(void, minlength=size))


def _confusion(
    labels: UInt8Array, surface: _Surface, class_ids: UInt8Array, num_cells: Int64Array, num_classes: int
) -> Int64Array:
    """Cells by truth and label, (C + 1, C + 1), of leaves with ``labels`` and ``num_cells`` (L,)."""
    size = num_classes + 1
    pairs = class_ids[surface.is_known].astype(np.int64) * size + labels[surface.leaves]
    confusion = np.bincount(pairs, minlength=size * size).reshape(size, size)
    # Row 0 held the surface cells without a class; it becomes the row of truly free cells.
    confusion[NO_CLASS] = _sums(labels, num_cells - surface.num_cells, size)
    return confusion


def _confusion_of_region(
    labels: UInt8Array, surface: _Surface, spans: LeafSpans, truth: Truth, region: Region
) -> Int64Array:
    """Cells by truth and label, (C + 1, C + 2), of the team's region; the last column counts unknown cells."""
    num_classes = spans.deviations.shape[1]
    is_inside = region.holds(truth.codes)
    leaves = surface.leaves[is_inside[surface.is_known]]
    inside = _Surface(
        surface.is_known & is_inside, leaves, np.bincount(leaves, minlength=labels.size), surface.num_void
    )
    known = _confusion(labels, inside, truth.class_ids, region.num_inside(spans), num_classes)
    unknown = np.bincount(truth.class_ids[is_inside & ~surface.is_known], minlength=num_classes + 1)
    return np.column_stack([known, unknown])


def _intersections_over_unions(confusion: Int64Array) -> Float64Array:
    """IoU (C,) of each class from cells by truth (C + 1 rows) and label; NaN for a class in neither."""
    hits = np.diagonal(confusion)[1:].astype(np.float64)
    unions = confusion.sum(axis=1)[1:] + confusion.sum(axis=0)[1 : len(confusion)] - hits
    iou: Float64Array = np.divide(hits, unions, out=np.full(hits.size, np.nan), where=unions > 0)
    return iou


def _calibrations(
    by_class: Float32Array, labels: UInt8Array, surface: _Surface, class_ids: UInt8Array, num_cells: Int64Array
) -> tuple[Float64Array, Float64Array]:
    """Counts of bins of log-odds (C, L): of all cells, and of those occupied in map or truth."""
    is_hit = class_ids[surface.is_known] == labels[surface.leaves]
    num_hits = np.bincount(surface.leaves[is_hit & (labels[surface.leaves] > 0)], minlength=labels.size)
    is_occupied = labels > 0
    num_correct = np.where(is_occupied, num_hits, num_cells - surface.num_cells)
    num_judged = num_cells - surface.num_void
    # Of a leaf that the map calls free, only the surface in it counts as occupied, and all of it is wrong.
    num_surface = surface.num_cells - surface.num_void
    confidence = 1.0 / shifted_exp_sum(by_class, class_axis=0).astype(np.float64)
    return (
        calibration_bins(confidence, num_correct, num_judged),
        calibration_bins(confidence, num_hits, np.where(is_occupied, num_judged, num_surface)),
    )


def calibration_bins(
    confidence: FloatArray, num_correct: npt.NDArray[np.number], num_cells: npt.NDArray[np.number]
) -> Float64Array:
    """Return the counts (3, NUM_BINS) of each bin of the confidence: correct cells, summed confidence and all cells.

    ``confidence`` (P,) is the probability of the label, ``num_correct`` and ``num_cells`` (P,) are cells with it.
    """
    bins = np.clip(np.ceil(confidence * NUM_BINS).astype(np.int64) - 1, 0, NUM_BINS - 1)
    rows = num_correct, confidence * num_cells, num_cells
    return np.array([np.bincount(bins, weights, NUM_BINS) for weights in rows])


def calibration_error(counts: Float64Array) -> float:
    """Return the expected calibration error of bins: Guo et al., equation 3.

    It is the sum over bins of |correct cells - summed confidence|, divided by the number of cells.
    """
    correct, expected, num_cells = counts
    return _ratio(np.abs(correct - expected).sum(), num_cells.sum())


def _sums(places: npt.NDArray[np.integer], weights: Int64Array, size: int) -> Int64Array:
    """Sum of the weights (n,) at each place; exact below 2^53."""
    sums: Int64Array = np.bincount(places, weights, size).astype(np.int64)
    return sums


def _mean(iou: Float64Array, confusion: Int64Array) -> float:
    """Mean of the IoU (C,) over the classes that occur in truth; NaN where none does."""
    of_truth = iou[confusion.sum(axis=1)[1:] > 0]
    return float(of_truth.mean()) if of_truth.size else math.nan


def _ratio(part: float | np.number, whole: float | np.number) -> float:
    """Quotient of a part and its whole; NaN where the whole is 0."""
    return float(part) / float(whole) if whole else math.nan
