"""Sums over rows of numbers, added up again only where rows changed."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.records import Int64Array

BLOCK_ROWS = 256
"""Number of rows whose sum is kept."""


class BlockSums:
    """Rows of ``width`` numbers, and their sum. The sum does not depend on the order of the updates.

    Attributes
    ----------
    rows : (n, width) array
        The numbers, 0 at first. Call ``update`` after a change.
    """

    def __init__(self, width: int, dtype: npt.DTypeLike, sum_dtype: npt.DTypeLike) -> None:
        self.rows: npt.NDArray[Any] = np.zeros((0, width), dtype)
        self._sums: npt.NDArray[Any] = np.zeros((0, width), sum_dtype)

    def reserve(self, num_rows: int) -> None:
        """Make room for at least ``num_rows`` rows."""
        if num_rows <= len(self.rows):
            return
        num_blocks = -(-max(num_rows, 2 * len(self.rows)) // BLOCK_ROWS)
        old_rows, old_sums = self.rows, self._sums
        # Fresh zeros take no physical memory until they are written.
        self.rows = np.zeros((num_blocks * BLOCK_ROWS, old_rows.shape[1]), old_rows.dtype)
        self._sums = np.zeros((num_blocks, old_sums.shape[1]), old_sums.dtype)
        self.rows[: len(old_rows)], self._sums[: len(old_sums)] = old_rows, old_sums

    def update(self, changed: Int64Array) -> None:
        """Add up the blocks of the rows ``changed`` (m,) int64, which are in ascending order."""
        blocks = np.unique(changed // BLOCK_ROWS)
        for part in np.array_split(blocks, -(-blocks.size // BLOCK_ROWS) or 1):
            rows = self.rows.reshape(-1, BLOCK_ROWS, self.rows.shape[1])[part]
            self._sums[part] = rows.sum(axis=1, dtype=self._sums.dtype)

    def total(self) -> npt.NDArray[Any]:
        """Return the sum (width,) over all rows."""
        total: npt.NDArray[Any] = self._sums.sum(axis=0)
        return total
