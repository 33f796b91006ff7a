"""Evidence of one robot in its own frame, in the forms that the registration of maps needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage, spatial

from octoreplay.records import Float64Array, Int64Array, UInt8Array, UInt64Array

UNKNOWN = 0
FREE = 255
UNDECIDED = 254
COLUMN = 2
MAX_BITS = 63


@dataclass(frozen=True, eq=False)
class SurfaceCells:
    points: Float64Array  # (n,3)
    class_ids: UInt8Array


class OwnMap:
    def __init__(self, keys, labels, resolution, num_classes):
        self.resolution = resolution
        self.num_classes = num_classes
        self.low = keys.min(axis=0).astype(np.int64) - 2
        shape = keys.max(axis=0) - self.low + 3
        self.cells = np.zeros(shape, np.uint8)
        k = keys - self.low
        self.cells[k[:, 0], k[:, 1], k[:, 2]] = labels

    @cached_property
    def occupied(self):
        return (self.cells > 0) & (self.cells <= self.num_classes)

    @cached_property
    def ground_height(self):
        """(nx, ny) index of ground level per finest column; large where none."""
        occ = self.occupied
        none = self.cells.shape[2]
        lowest = np.where(occ.any(axis=2), occ.argmax(axis=2), none)
        n = 5 * COLUMN
        return ndimage.minimum_filter(lowest, size=n)

    @cached_property
    def _parts(self):
        idx = np.argwhere(self.occupied)
        above = idx[:, 2] - self.ground_height[idx[:, 0], idx[:, 1]]
        pts = (idx + self.low + 0.5) * self.resolution
        cls = self.cells[idx[:, 0], idx[:, 1], idx[:, 2]]
        obst = above >= COLUMN
        return (SurfaceCells(pts[obst], cls[obst]), SurfaceCells(pts[~obst], cls[~obst]))

    @property
    def obstacles(self):
        return self._parts[0]

    @property
    def ground(self):
        return self._parts[1]

    @cached_property
    def near(self):
        """Bit set of classes within one cell (uint64 grid)."""
        bits = np.zeros(self.cells.shape, np.uint64)
        occ = self.occupied
        bits[occ] = np.uint64(1) << (self.cells[occ].astype(np.uint64) - np.uint64(1)) % np.uint64(MAX_BITS)
        for axis in range(3):
            b = np.moveaxis(bits, axis, 0)
            out = b.copy()
            out[1:] |= b[:-1]
            out[:-1] |= b[1:]
            bits = np.moveaxis(out, 0, axis)
        return np.ascontiguousarray(bits)

    def lookup(self, points):
        """labels and near bits at points (n,3)."""
        idx = np.floor(points * (1 / self.resolution)).astype(np.int64) - self.low
        inside = ((idx >= 0) & (idx < self.cells.shape)).all(axis=1)
        flat = np.where(inside, (idx[:, 0] * self.cells.shape[1] + idx[:, 1]) * self.cells.shape[2] + idx[:, 2], 0)
        return np.where(inside, self.cells.ravel()[flat], 0), np.where(inside, self.near.ravel()[flat], np.uint64(0))

    @cached_property
    def columns(self):
        """(mx,my) codes: 0 unknown, 1..C obstacle class, C+1..2C open over ground class."""
        C = self.num_classes
        occ, cells = self.occupied, self.cells
        # pad so that finest columns group in COLUMN x COLUMN aligned to even keys
        nx, ny, nz = cells.shape
        gx = (np.arange(nx) + self.low[0]) // COLUMN
        gy = (np.arange(ny) + self.low[1]) // COLUMN
        self.column_low = np.array([gx[0], gy[0]])
        gx -= gx[0]
        gy -= gy[0]
        mx, my = gx[-1] + 1, gy[-1] + 1
        lowest = np.where(occ.any(axis=2), occ.argmax(axis=2), nz)
        col_low = np.full((mx, my), nz)
        np.minimum.at(col_low, (gx[:, None] + 0 * gy, gy + 0 * gx[:, None]), lowest)
        ground = ndimage.minimum_filter(col_low, size=5)
        idx = np.argwhere(occ)
        X, Y = gx[idx[:, 0]], gy[idx[:, 1]]
        above = idx[:, 2] - ground[X, Y]
        cls = cells[tuple(idx.T)] - 1
        votes = np.zeros((mx, my, C), np.int32)
        o = above >= COLUMN
        np.add.at(votes, (X[o], Y[o], cls[o]), 1)
        gvotes = np.zeros((mx, my, C), np.int32)
        np.add.at(gvotes, (X[~o], Y[~o], cls[~o]), 1)
        obst = votes.any(axis=2)
        # ground class of nearby columns where own ground unknown
        own = gvotes.any(axis=2)
        d, (ix, iy) = ndimage.distance_transform_edt(~own, return_indices=True)
        gcls = gvotes.argmax(axis=2)[ix, iy]
        has_ground = d <= 1.5
        fidx = np.argwhere(cells == FREE)
        FX, FY = gx[fidx[:, 0]], gy[fidx[:, 1]]
        fabove = fidx[:, 2] - ground[FX, FY]
        f = (fabove >= COLUMN) & (fabove <= 4 * COLUMN)
        fcount = np.zeros((mx, my), np.int32)
        np.add.at(fcount, (FX[f], FY[f]), 1)
        beside = ndimage.binary_dilation(obst, np.ones((3, 3)))
        open_ = (fcount >= 4) & ~beside & has_ground
        codes = np.zeros((mx, my), np.uint16)
        codes[obst] = votes.argmax(axis=2)[obst] + 1
        codes[open_] = gcls[open_] + 1 + C
        self.ground_z = np.where(ground < nz, (ground + self.low[2]) * self.resolution, np.nan)
        return codes
