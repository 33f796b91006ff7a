"""Mean of the measured points in each cell: surfaces more accurate than the cells' centres."""

from __future__ import annotations

import numpy as np

from octoreplay.config.sensor import SensorConfig
from octoreplay.mapping.octree import KEY_OFFSET, keys_to_codes
from octoreplay.mapping.scan_points import scan_points
from octoreplay.records import Float64Array, Frame, Int64Array

_POINTS_PER_SCAN = 5000
# Number of cells in batches that are not merged yet.
_MAX_PENDING = 1 << 20


class CellMeans:
    """Weighted means of points by cell, added scan by scan. ``resolution`` is the edge of a cell [m]."""

    def __init__(self, resolution: float) -> None:
        self._resolution = resolution
        self._codes = np.empty(0, np.int64)
        # Sums of the weighted offsets from the centre, which keep their digits far from the origin, and of the weights.
        self._sums = np.empty((0, 4))
        self._pending: list[tuple[Int64Array, Float64Array]] = []

    def add_scan(self, frame: Frame, sensor: SensorConfig) -> None:
        """Add the points of a scan, weighted by 1 / (1 + d^2) at the distance d [m], in the frame of its pose."""
        points, _ = scan_points(frame, sensor, max_range=sensor.max_range, max_points=_POINTS_PER_SCAN)
        T = frame.T_team_sensor
        self.add(points @ T[:3, :3].T + T[:3, 3], 1.0 / (1.0 + np.einsum("ni,ni->n", points, points)))

    def add(self, points: Float64Array, weights: Float64Array) -> None:
        """Add points (n, 3) [m] with weights (n,)."""
        keys = np.floor(points / self._resolution)
        inside = np.all(np.abs(keys) < KEY_OFFSET, axis=1)
        offsets = points[inside] - (keys[inside] + 0.5) * self._resolution
        codes, which = np.unique(keys_to_codes(keys[inside].astype(np.int64)), return_inverse=True)
        self._pending.append((codes, _sums(which, offsets, weights[inside], codes.size)))
        if sum(codes.size for codes, _ in self._pending) > _MAX_PENDING:
            self._merge()

    def at(self, keys: Int64Array) -> Float64Array:
        """Return the means (n, 3) [m] of the cells with ``keys`` (n, 3); the centre of a cell without points."""
        self._merge()
        codes = keys_to_codes(keys)
        centres = np.asarray((keys + 0.5) * self._resolution, np.float64)
        if self._codes.size == 0:
            return centres
        places = np.minimum(np.searchsorted(self._codes, codes), self._codes.size - 1)
        sums = self._sums[places]
        has_points = (self._codes[places] == codes) & (sums[:, 3] > 0)
        means = centres + sums[:, :3] / np.where(has_points, sums[:, 3], 1.0)[:, None]
        return np.where(has_points[:, None], means, centres)

    def _merge(self) -> None:
        """Add the pending batches to the sums."""
        if not self._pending:
            return
        codes = np.concatenate([self._codes, *(codes for codes, _ in self._pending)])
        sums = np.concatenate([self._sums, *(sums for _, sums in self._pending)])
        self._codes, which = np.unique(codes, return_inverse=True)
        self._sums = np.stack([np.bincount(which, column, minlength=self._codes.size) for column in sums.T], axis=1)
        self._pending = []


def _sums(which: Int64Array, offsets: Float64Array, weights: Float64Array, num: int) -> Float64Array:
    """Sums (num, 4) of the weighted offsets (n, 3) and of the weights, by group ``which`` (n,)."""
    columns = (*(offsets * weights[:, None]).T, weights)
    return np.stack([np.bincount(which, column, minlength=num) for column in columns], axis=1)
