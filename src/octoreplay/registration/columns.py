"""Columns: a map seen from above, for the search of poses between maps whose vertical axes agree."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from octoreplay.records import BoolArray, Float64Array, Int64Array, UInt8Array
from octoreplay.registration.cells import COLUMN_CELLS, FREE, GROUND_WINDOW, lowest_occupied, occupied_cells

# Height up to which free space makes a column open [columns' edges].
_OPEN_HEIGHT = 4
_MIN_OPEN_CELLS = 4


@dataclass(frozen=True, eq=False)
class Columns:
    """A map seen from above, in square columns.

    - ``codes`` (mx, my) int64: 0 unknown; class_id of an obstacle; num_classes + class_id of the ground where the
      column is open: free above the ground and not beside an obstacle.
    - ``ground`` (mx, my) float64: height of the ground [m], NaN where unknown.
    - ``low`` (2,) int64: index of the first column; column i spans [i, i + 1) x ``edge``.
    - ``edge``: edge of a column [m].
    """

    codes: Int64Array
    ground: Float64Array
    low: Int64Array
    edge: float

    @classmethod
    def of_states(cls, states: UInt8Array, low: Int64Array, resolution: float, num_classes: int) -> Columns:
        """Return the columns of a map, given as in ``OwnMap``."""
        # Columns are aligned to multiples of their edge.
        before = low[:2] % COLUMN_CELLS
        after = -(before + states.shape[:2]) % COLUMN_CELLS
        states = np.pad(states, ((before[0], after[0]), (before[1], after[1]), (0, 0)))
        is_occupied = occupied_cells(states)
        num_x, num_y, num_z = states.shape
        shape = num_x // COLUMN_CELLS, num_y // COLUMN_CELLS
        lowest = lowest_occupied(is_occupied).reshape(shape[0], COLUMN_CELLS, shape[1], COLUMN_CELLS).min(axis=(1, 3))
        ground = ndimage.minimum_filter(lowest, size=GROUND_WINDOW, mode="nearest")

        def heights(cells: BoolArray) -> tuple[Int64Array, Int64Array, npt.NDArray[np.intp]]:
            """Flat column, height above ground [cell] and position of the cells."""
            indices = np.nonzero(cells)
            x, y = indices[0] // COLUMN_CELLS, indices[1] // COLUMN_CELLS
            return x * shape[1] + y, indices[2] - ground[x, y], np.ravel_multi_index(indices, states.shape)

        size = shape[0] * shape[1]
        column, height, cell = heights(is_occupied)
        class_index = states.ravel()[cell].astype(np.int64) - 1
        is_high = height >= COLUMN_CELLS
        obstacle, has_obstacle = _winner(column[is_high], class_index[is_high], size, num_classes)
        floor, has_floor = _winner(column[~is_high], class_index[~is_high], size, num_classes)
        column, height, _ = heights(states == FREE)
        is_free = (height >= COLUMN_CELLS) & (height <= _OPEN_HEIGHT * COLUMN_CELLS)
        num_free = np.bincount(column[is_free], minlength=size).reshape(shape)
        # A column without ground of its own, such as one below an overhang, has that of a neighbour.
        distance, nearest = ndimage.distance_transform_edt(~has_floor.reshape(shape), return_indices=True)
        floor = floor.reshape(shape)[tuple(nearest)]
        is_beside = ndimage.binary_dilation(has_obstacle.reshape(shape), np.ones((3, 3)))
        is_open = (num_free >= _MIN_OPEN_CELLS) & ~is_beside & (distance < 2) & bool(has_floor.any())
        codes = np.where(is_open, floor + 1 + num_classes, 0)
        codes = np.where(has_obstacle.reshape(shape), obstacle.reshape(shape) + 1, codes)
        height_m = np.where(ground < num_z, (ground + low[2]) * resolution, np.nan)
        return cls(codes, height_m, (low[:2] - before) // COLUMN_CELLS, COLUMN_CELLS * resolution)

    @cached_property
    def known(self) -> tuple[Float64Array, Int64Array, Float64Array]:
        """Centres (n, 2) [m], codes (n,) and ground heights (n,) [m] of the known columns."""
        indices = np.argwhere(self.codes > 0)
        cells = tuple(indices.T)
        centres = np.asarray((indices + self.low + 0.5) * self.edge, np.float64)
        return centres, self.codes[cells], self.ground[cells]


def _winner(
    columns: Int64Array, class_indices: Int64Array, num_columns: int, num_classes: int
) -> tuple[Int64Array, BoolArray]:
    """The most frequent class index of each column (num_columns,), ties to the lower one, and where there is one."""
    votes = np.bincount(columns * num_classes + class_indices, minlength=num_columns * num_classes)
    votes = votes.reshape(num_columns, num_classes)
    return votes.argmax(axis=1), votes.max(axis=1) > 0
