"""Points on locally plane surfaces, and their distances to the planes of other surfaces.

Distances between points and planes leave the directions along a plane free (point-to-plane: Chen and Medioni, Image and
Vision Computing 1992).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from octoreplay.records import BoolArray, Float64Array, Int64Array, UInt8Array

# Distance between neighbouring classes in the tree's fourth coordinate, in spacings; no gate reaches it.
_CLASS_DISTANCE = 1e5
# A point is on a plane where the smallest variance of its neighbours is below this share of the second one.
_FLATNESS = 0.12
_NUM_NEIGHBOURS, _MIN_NEIGHBOURS, _NEIGHBOUR_RADIUS = 14, 6, 3.5


@dataclass(frozen=True, eq=False)
class PlanePoints:
    """Labelled points of a surface with the planes around them.

    - ``points`` (n, 3) float64 [m], about ``spacing`` [m] apart, with ``class_ids`` (n,) uint8.
    - ``normals`` (n, 3) float64, valid where ``is_flat`` (n,); if ``is_oriented``, they point to the side that was
      seen.
    - ``samples`` (s,) int64: flat points spread over the directions of normals.
    """

    points: Float64Array
    class_ids: UInt8Array
    normals: Float64Array
    is_flat: BoolArray
    is_oriented: bool
    samples: Int64Array
    spacing: float
    tree: cKDTree

    @classmethod
    def of_points(
        cls, points: Float64Array, class_ids: UInt8Array, spacing: float, *, num_samples: int,
        views: Float64Array | None = None,
    ) -> PlanePoints:  # fmt: skip
        """Return the planes around points (n, 3) with classes (n,), which are about ``spacing`` [m] apart.

        ``views`` (n, 3) point from the points towards the sensor. They orient the normals, and flat points are moved
        onto the plane through the mean of their neighbours. At most ``num_samples`` points are samples.
        """
        normals, heights, is_flat = _local_planes(points, _NEIGHBOUR_RADIUS * spacing)
        if views is not None:
            points = points + normals * np.where(is_flat, heights, 0.0)[:, None]
            normals = np.where(np.einsum("ni,ni->n", normals, views)[:, None] < 0, -normals, normals)
        samples = _spread_samples(normals, is_flat, num_samples)
        tree = cKDTree(_keys(points, class_ids, spacing))
        return cls(points, class_ids, normals, is_flat, views is not None, samples, spacing, tree)

    @property
    def sample_points(self) -> Float64Array:
        """Points (s, 3) of the samples."""
        return self.points[self.samples]

    def with_samples(self, samples: Int64Array) -> PlanePoints:
        """Return the same planes with other samples (s,)."""
        return replace(self, samples=samples)

    def nearest(self, points: Float64Array, class_ids: UInt8Array, gate: float) -> tuple[Float64Array, Int64Array]:
        """Return distance (m,) and index (m,) of the nearest point of equal class; inf beyond ``gate`` [m]."""
        distances, indices = self.tree.query(_keys(points, class_ids, self.spacing), distance_upper_bound=gate)
        return distances, indices


class PlaneDistances(NamedTuple):
    """Distances of samples to planes.

    ``distances`` (k,) [m], the ``points`` (k, 3) and the planes' ``normals`` (k, 3), both in the planes' frame.
    """

    distances: Float64Array
    points: Float64Array
    normals: Float64Array


def plane_distances(
    moving: PlanePoints, fixed: PlanePoints, T_fixed_moving: Float64Array, gate: float, *, least_cosine: float
) -> PlaneDistances:
    """Return the distances of samples of ``moving`` to the nearest planes of ``fixed`` of equal class.

    Samples count where a plane is within ``gate`` [m] and the angle between both normals has at least ``least_cosine``.
    """
    rotation = T_fixed_moving[:3, :3]
    points = moving.sample_points @ rotation.T + T_fixed_moving[:3, 3]
    distances, nearest = fixed.nearest(points, moving.class_ids[moving.samples], gate)
    found = np.flatnonzero(np.isfinite(distances))
    found = found[fixed.is_flat[nearest[found]]]
    normals = fixed.normals[nearest[found]]
    cosines = np.einsum("ki,ki->k", normals, moving.normals[moving.samples[found]] @ rotation.T)
    if not (moving.is_oriented and fixed.is_oriented):
        cosines = np.abs(cosines)
    agrees = cosines > least_cosine
    found, normals = found[agrees], normals[agrees]
    along = np.einsum("ki,ki->k", normals, points[found] - fixed.points[nearest[found]])
    return PlaneDistances(along, points[found], normals)


def _local_planes(points: Float64Array, radius: float) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Normals (n, 3) of the planes around points, heights (n,) of the planes above them, and whether they are flat."""
    if len(points) == 0:
        return np.empty((0, 3)), np.empty(0), np.empty(0, np.bool_)
    _, neighbours = cKDTree(points).query(points, k=_NUM_NEIGHBOURS, distance_upper_bound=radius)
    exists = neighbours < len(points)
    count = exists.sum(axis=1)
    offsets = np.where(exists[..., None], points[np.where(exists, neighbours, 0)] - points[:, None], 0.0)
    means = offsets.sum(axis=1) / count[:, None]
    offsets -= means[:, None] * exists[..., None]
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets) / count[:, None, None])
    is_flat = (count >= _MIN_NEIGHBOURS) & (variances[:, 0] < _FLATNESS * variances[:, 1])
    return axes[:, :, 0], np.einsum("ni,ni->n", axes[:, :, 0], means), is_flat


def _spread_samples(normals: Float64Array, is_flat: BoolArray, num_samples: int) -> Int64Array:
    """Flat points, a third of the samples for each axis that normals are nearest to, so that ground is no majority."""
    nearest_axis = np.abs(normals).argmax(axis=1) if len(normals) else np.empty(0, np.int64)
    chosen = []
    for axis in range(3):
        points = np.flatnonzero(is_flat & (nearest_axis == axis))
        stride = max(1.0, points.size / (num_samples // 3))
        places = np.arange(0, points.size, stride).astype(np.int64)
        chosen.append(points[places[places < points.size]])
    return np.sort(np.concatenate(chosen))


def _keys(points: Float64Array, class_ids: UInt8Array, spacing: float) -> Float64Array:
    """Coordinates (n, 4) in which points of different classes are far apart."""
    return np.column_stack([points, class_ids * (_CLASS_DISTANCE * spacing)])
