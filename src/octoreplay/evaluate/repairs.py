"""Labels of a robot's own map that an exchange of maps corrected or made wrong."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from octoreplay.evaluate.truth import Truth
from octoreplay.log_odds import best_labels
from octoreplay.records import NO_CLASS
from octoreplay.stored_map import StoredMap


class Repairs(NamedTuple):
    """Counts of cells that a robot knows from its own evidence.

    Attributes
    ----------
    num_cells : int
        Cells that hold surface in truth or that the robot's own map calls occupied.
    num_wrong : int
        Cells of these with a wrong label in its own map.
    num_repaired : int
        Cells that are wrong in its own map and right after the exchange.
    num_spread : int
        Cells that are right in its own map and wrong after the exchange, including free cells that became occupied.
    """

    num_cells: int
    num_wrong: int
    num_repaired: int
    num_spread: int


def repairs(own: StoredMap, after: StoredMap, truth: Truth) -> Repairs:
    """Compare a robot's own map with its map after an exchange, both with the truth's resolution.

    A cell without surface is truly free. Cells of a true class that the maps do not have are not counted.
    """
    own_spans, after_spans = own.octree.spans(), after.octree.spans()
    own_labels, after_labels = (
        best_labels(spans.deviations + np.float32(stored.prior))
        for spans, stored in ((own_spans, own), (after_spans, after))
    )
    # All other cells are free in both maps and in truth.
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


def erased_cells(own: StoredMap, after: StoredMap) -> tuple[int, int]:
    """Return the number of cells that a robot's own evidence calls occupied, and of these that its map calls free.

    ``own`` is the robot's evidence or its map without an exchange, ``after`` its map after an exchange.
    """
    own_spans, after_spans = own.octree.spans(), after.octree.spans()
    codes = own_spans.cells_in(best_labels(own_spans.deviations + np.float32(own.prior)) > 0)
    labels = best_labels(after_spans.deviations_at(codes) + np.float32(after.prior))
    return codes.size, int((labels == 0).sum())
