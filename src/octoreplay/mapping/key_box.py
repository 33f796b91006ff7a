"""Boxes of finest cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from octoreplay.mapping.kernels import storage
from octoreplay.records import BoolArray, Int64Array


class KeyBox(NamedTuple):
    """Finest cells with keys from ``low`` up to, but not including, ``high``: (3,) int64 each."""

    low: Int64Array
    high: Int64Array

    @classmethod
    def of(cls, region: Sequence[float], resolution: float) -> KeyBox:
        """Return the cells with centres in a region (xmin, ymin, zmin, xmax, ymax, zmax) [m], as in a run with bounds.

        A centre on a minimum is inside, one on a maximum is outside. ``resolution`` is the edge of a cell [m].
        """
        return cls(first_keys(region[:3], resolution), first_keys(region[3:], resolution))

    @property
    def is_empty(self) -> bool:
        """True for a box without a cell."""
        return bool((self.low >= self.high).any())

    def overlaps(self, codes: Int64Array, num_cells: npt.ArrayLike) -> BoolArray:
        """Return True (n,) for nodes of the octree with a cell in the box.

        ``codes`` (n,) are the Morton codes of their first cells, and ``num_cells`` their numbers of cells, 8^k.
        """
        keys = np.empty((codes.size, 3), np.int64)
        storage.codes_to_keys(codes, keys)
        edges = np.rint(np.cbrt(num_cells)).astype(np.int64)[..., None]
        return np.asarray(((keys < self.high) & (keys + edges > self.low)).all(axis=1))


def first_keys(coords: npt.ArrayLike, resolution: float) -> Int64Array:
    """Return the lowest key (n,) of the cells whose centre is at or above each coordinate (n,) [m] of an axis.

    Coordinates beyond the key space give its limits, -2^18 and 2^18.
    """
    centers = (np.arange(-storage.KEY_OFFSET, storage.KEY_OFFSET) + 0.5) * resolution
    keys: Int64Array = np.searchsorted(centers, coords) - storage.KEY_OFFSET
    return keys
