"""Measured points of one robot, summed by voxel and class: surfaces more accurate than the cells' centres."""

from __future__ import annotations

import numpy as np

from octoreplay.config.sensor import SensorConfig
from octoreplay.mapping.scan_points import scan_points
from octoreplay.records import Float64Array, Frame, Int64Array, UInt8Array
from octoreplay.registration.planes import PlanePoints

_POINTS_PER_SCAN = 5000
# Number of groups in batches that are not merged yet.
_MAX_PENDING = 1 << 20
_VOXELS_PER_CELL = 2
_POINTS_PER_VOXEL = 3
_KEY_BITS = 18
_KEY_OFFSET = 1 << (_KEY_BITS - 1)
_CLASS_BITS = 8
_NUM_SAMPLES = 24_000


class MeasuredPoints:
    """Weighted sums of points by voxel and class, added scan by scan.

    A voxel is half a cell of the edge ``resolution`` [m]. Points more than 2^17 voxels from the origin are left out.
    """

    def __init__(self, resolution: float) -> None:
        self._voxel = resolution / _VOXELS_PER_CELL
        self._codes = np.empty(0, np.int64)
        # Sums of the weighted offsets from the voxel's centre, which keep their digits far from the origin, of the
        # weighted directions to the sensor, of the weights, and the number of points.
        self._sums = np.empty((0, 8), np.float32)
        self._pending: list[tuple[Int64Array, Float64Array]] = []

    def add_scan(self, frame: Frame, sensor: SensorConfig) -> None:
        """Add the points of a scan, weighted by 1 / (1 + d^2) at the distance d [m], in the frame of its pose."""
        points, class_ids = scan_points(frame, sensor, max_range=sensor.max_range, max_points=_POINTS_PER_SCAN)
        rotation, origin = frame.T_team_sensor[:3, :3], frame.T_team_sensor[:3, 3]
        views = -points @ rotation.T
        squares = np.einsum("ni,ni->n", points, points)
        self.add(origin - views, class_ids, views, 1.0 / (1.0 + squares))

    def add(self, points: Float64Array, class_ids: UInt8Array, views: Float64Array, weights: Float64Array) -> None:
        """Add points (n, 3) [m] with classes (n,), vectors to the sensor (n, 3) and weights (n,)."""
        keys = np.floor(points / self._voxel)
        inside = np.all(np.abs(keys) < _KEY_OFFSET, axis=1)
        keys, weights = keys[inside], weights[inside, None]
        offsets = points[inside] - (keys + 0.5) * self._voxel
        codes = voxel_codes(keys.astype(np.int64)) << _CLASS_BITS | class_ids[inside]
        values = np.concatenate([offsets * weights, views[inside] * weights, weights, np.ones_like(weights)], axis=1)
        self._pending.append(_sums_by_code(codes, values))
        if sum(codes.size for codes, _ in self._pending) > _MAX_PENDING:
            self._merge()

    def cell_means(self, keys: Int64Array) -> Float64Array:
        """Return the means (n, 3) [m] in the cells with ``keys`` (n, 3); the centre of a cell without points."""
        resolution = self._voxel * _VOXELS_PER_CELL
        centres = np.asarray((keys + 0.5) * resolution, np.float64)
        codes, sums = self._by_cell()
        if codes.size == 0:
            return centres
        wanted = voxel_codes(keys)
        places = np.minimum(np.searchsorted(codes, wanted), codes.size - 1)
        chosen = sums[places]
        has_points = (codes[places] == wanted) & np.all(np.abs(keys) < _KEY_OFFSET // 2, axis=1)
        means = centres + chosen[:, :3] / np.where(has_points, chosen[:, 3], 1.0)[:, None]
        return np.where(has_points[:, None], means, centres)

    def planes(self) -> PlanePoints:
        """Return the planes around the means of the most frequent class in each voxel, where it has enough points.

        Points without a class (0) are left out.
        """
        self._merge()
        class_ids, cells = (self._codes & 255).astype(np.uint8), self._codes >> _CLASS_BITS
        counts = np.where(class_ids > 0, self._sums[:, 7], 0)
        chosen = most_frequent(cells, class_ids, counts)
        chosen = chosen[counts[chosen] >= _POINTS_PER_VOXEL]
        sums = self._sums[chosen].astype(np.float64)
        points = (_keys_of(cells[chosen]) + 0.5) * self._voxel + sums[:, :3] / sums[:, 6:7]
        return PlanePoints.of_points(
            points, class_ids[chosen], self._voxel, num_samples=_NUM_SAMPLES, views=sums[:, 3:6]
        )

    def _by_cell(self) -> tuple[Int64Array, Float64Array]:
        """Codes (m,) of the cells with points; sums (m, 4) of weighted offsets from their centres, and of weights."""
        self._merge()
        keys = _keys_of(self._codes >> _CLASS_BITS)
        cells = keys // _VOXELS_PER_CELL
        in_cell = (keys - cells * _VOXELS_PER_CELL + 0.5 - _VOXELS_PER_CELL / 2) * self._voxel
        weights = self._sums[:, 6:7].astype(np.float64)
        return _sums_by_code(
            voxel_codes(cells), np.concatenate([self._sums[:, :3] + in_cell * weights, weights], axis=1)
        )

    def _merge(self) -> None:
        """Add the pending batches to the sums."""
        if not self._pending:
            return
        codes = np.concatenate([self._codes, *(codes for codes, _ in self._pending)])
        sums = np.concatenate([self._sums, *(sums for _, sums in self._pending)])
        self._codes, merged = _sums_by_code(codes, sums)
        self._sums = merged.astype(np.float32)
        self._pending = []


def voxel_codes(keys: Int64Array) -> Int64Array:
    """Return the codes (n,) of voxels with ``keys`` (n, 3), each in [-2^17, 2^17)."""
    x, y, z = (keys + _KEY_OFFSET).T
    return np.asarray((x << _KEY_BITS | y) << _KEY_BITS | z)


def most_frequent(cells: Int64Array, class_ids: UInt8Array, counts: Float64Array) -> Int64Array:
    """Return the index of the most frequent class of each cell, in the order of cells; ties go to the lower class.

    ``cells``, ``class_ids`` and ``counts`` (n,) have one element for each class of a cell.
    """
    order = np.lexsort((class_ids, -counts, cells))
    return order[np.flatnonzero(np.diff(cells[order], prepend=-1))]


def _keys_of(codes: Int64Array) -> Int64Array:
    """Keys (n, 3) of voxels."""
    mask = (1 << _KEY_BITS) - 1
    return np.stack([codes >> 2 * _KEY_BITS, codes >> _KEY_BITS & mask, codes & mask], axis=1) - _KEY_OFFSET


def _sums_by_code(codes: Int64Array, values: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Distinct codes (m,) in increasing order, and the sums (m, k) of their values (n, k)."""
    distinct, which = np.unique(codes, return_inverse=True)
    return distinct, np.stack([np.bincount(which, column, minlength=distinct.size) for column in values.T], axis=1)
