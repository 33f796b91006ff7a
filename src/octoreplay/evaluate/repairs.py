"""What an exchange of maps did to a robot's own labels: which it put right, and which it made wrong."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.evaluate.truth import Truth
from octoreplay.io.results import posterior
from octoreplay.mapping.octree import LeafSpans
from octoreplay.records import NO_CLASS, BoolArray, Int64Array, UInt8Array
from octoreplay.result import StoredMap


class Repairs(NamedTuple):
    """Counts of the cells that a robot knows by itself and that hold surface in truth, or in its own map.

    ``num_wrong`` of the ``num_cells`` have a wrong label in its own map, ``num_repaired`` of these the right one
    after the exchange; ``num_spread`` have the right label in its own map and a wrong one afterwards.
    """

    num_cells: int
    num_wrong: int
    num_repaired: int
    num_spread: int


def repairs(own: StoredMap, after: StoredMap, truth: Truth) -> Repairs:
    """Compare a robot's own map with its map after an exchange, both of the same resolution as the truth.

    A cell without surface is truly free; cells whose true class the maps do not have count for nothing.
    """
    own_spans, after_spans = own.octree.spans(), after.octree.spans()
    own_labels = posterior.labels(own_spans.deviations + np.float32(own.prior))
    codes = np.union1d(truth.codes, _cells(own_spans, own_labels > 0))
    leaves = own_spans.leaves_at(codes)
    codes, before = codes[leaves >= 0], own_labels[leaves[leaves >= 0]]
    true = np.zeros(codes.size, np.uint8)
    place = np.minimum(np.searchsorted(truth.codes, codes), truth.codes.size - 1)
    is_surface = truth.codes[place] == codes
    true[is_surface] = truth.class_ids[place[is_surface]]
    counts = ~is_surface | (true != NO_CLASS)
    was_right = (before == true)[counts]
    is_right = (_labels_at(after_spans, codes, after.prior) == true)[counts]
    return Repairs(
        int(counts.sum()),
        int((~was_right).sum()),
        int((~was_right & is_right).sum()),
        int((was_right & ~is_right).sum()),
    )


def _cells(spans: LeafSpans, chosen: BoolArray) -> Int64Array:
    """The codes (n,) of all finest cells in the chosen leaves (L,)."""
    starts, lengths = spans.codes[chosen], spans.num_cells[chosen]
    first = np.cumsum(lengths) - lengths
    cells: Int64Array = np.arange(lengths.sum()) + np.repeat(starts - first, lengths)
    return cells


def _labels_at(spans: LeafSpans, codes: Int64Array, prior: float) -> UInt8Array:
    """The label (n,) of each cell, that of the prior where it is not known."""
    values = np.full((codes.size, spans.deviations.shape[1]), np.float32(prior))
    leaves = spans.leaves_at(codes)
    is_known = leaves >= 0
    values[is_known] += spans.deviations[leaves[is_known]]
    labels: UInt8Array = posterior.labels(values)
    return labels
