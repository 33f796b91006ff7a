"""What an exchange of maps did to a robot's own labels: which it put right, and which it made wrong."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.evaluate.truth import Truth
from octoreplay.log_odds import best_labels
from octoreplay.records import NO_CLASS
from octoreplay.result import StoredMap


class Repairs(NamedTuple):
    """Counts of cells that a robot knows by itself.

    ``num_cells`` are those that hold surface in truth or that its own map calls occupied, and ``num_wrong`` of these
    have a wrong label in it. ``num_repaired`` are wrong in its own map and right after the exchange; ``num_spread`` are
    right in its own map and wrong afterwards, free cells that became occupied among them.
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
    own_labels, after_labels = (
        best_labels(spans.deviations + np.float32(stored.prior))
        for spans, stored in ((own_spans, own), (after_spans, after))
    )
    # Everywhere else all three say free.
    codes = np.unique(
        np.concatenate([truth.codes, own_spans.cells_in(own_labels > 0), after_spans.cells_in(after_labels > 0)])
    )
    codes = codes[own_spans.leaves_at(codes) >= 0]
    true, is_known = np.zeros(codes.size, np.uint8), np.ones(codes.size, np.bool_)
    place = np.minimum(np.searchsorted(truth.codes, codes), truth.codes.size - 1)
    is_surface = truth.codes[place] == codes
    true[is_surface] = truth.class_ids[place[is_surface]]
    is_known[is_surface] = true[is_surface] != NO_CLASS
    codes, true, is_surface = codes[is_known], true[is_known], is_surface[is_known]
    before, now = (
        best_labels(spans.deviations_at(codes) + np.float32(stored.prior))
        for spans, stored in ((own_spans, own), (after_spans, after))
    )
    was_right, is_right = before == true, now == true
    counts = is_surface | (before > 0)
    return Repairs(
        int(counts.sum()),
        int((counts & ~was_right).sum()),
        int((~was_right & is_right).sum()),
        int((was_right & ~is_right).sum()),
    )
