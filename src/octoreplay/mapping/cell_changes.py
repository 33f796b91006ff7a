"""Cells that differ between two states of a map: rule ``latest``."""

from __future__ import annotations

import numpy as np

from octoreplay.mapping.consensus import expand_to_columns
from octoreplay.mapping.kernels import cell_changes as kernels
from octoreplay.mapping.kernels.storage import BRICK_CELLS
from octoreplay.mapping.octree import SemanticOctree, brick_table, cache_aligned
from octoreplay.records import Int64Array


def take_changes(
    target: SemanticOctree, new: SemanticOctree, old: SemanticOctree, codes: Int64Array, revision: int
) -> None:
    """Overwrite the cells of ``target`` that differ between two states of another map with the new state, in place.

    A cell differs where the log-odds of any class do, or where it is known in ``new`` alone; it then gets the values of
    all classes. Only the bricks ``codes`` (n,) int64 are compared, each given once. ``target`` knows all cells that
    ``old`` knows. Changed bricks get ``revision``.
    """
    table = brick_table([new, old], codes)
    everywhere = np.ones(codes.size, np.bool_)
    indices, masks, known, _ = expand_to_columns(target, codes, table, np.arange(2), everywhere.copy())
    target.expand_bricks(indices, masks, known, everywhere)
    block_size = (target.num_classes + 1) * BRICK_CELLS
    scratch = cache_aligned((kernels.NUM_SCRATCH_BLOCKS, block_size), np.float32)
    kernels.take_changes(target.bricks, indices, table, masks, known, target.num_classes, revision, scratch)
