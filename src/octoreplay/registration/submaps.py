"""Submaps: labelled surfaces of a few seconds of one robot's scans, and transforms measured between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from octoreplay.records import BoolArray, Float64Array, Int64Array, UInt8Array
from octoreplay.registration.rigid import moved
from octoreplay.transforms import inverse

# Distance between neighbouring classes in the tree's fourth coordinate, in voxels; no gate reaches it.
_CLASS_DISTANCE = 1e5
_POINTS_PER_VOXEL = 3
# A point is on a plane where the smallest variance of its neighbours is below this share of the second one.
_FLATNESS = 0.12
_NUM_NEIGHBOURS, _MIN_NEIGHBOURS, _NEIGHBOUR_RADIUS = 14, 6, 3.5
_NUM_SAMPLES = 1000
_LEAST_COSINE = 0.75
# Standard deviation of a distance to a plane [voxel], and the number of correspondences that count as one.
_SIGMA, _CORRESPONDENCES_PER_SAMPLE = 0.75, 20.0
_MIN_CORRESPONDENCES = 60
# A registration is refused where fewer correspondences than this share are within the distance to the plane [voxel].
_LEAST_CLOSE_SHARE, _CLOSE = 0.95, 0.6
# Directions without information stay within these deviations of the guess in each Gauss-Newton step [voxel], [rad].
_NUM_STEPS = 2
_STEP_SHIFT, _STEP_ANGLE = 25.0, 0.5
_OVERLAP_CELL, _MIN_OVERLAP_CELLS, _MIN_OVERLAP_SHARE = 5.0, 8, 0.03


@dataclass(frozen=True, eq=False)
class Submap:
    """Surface seen by one robot in a few seconds, in the frame of its anchor: the sensor at ``stamp_ns``.

    - ``T_team_anchor`` (4, 4) float64: recorded pose of the anchor.
    - ``points`` (n, 3) float64 [m], one for each occupied voxel, with ``class_ids`` (n,) uint8.
    - ``normals`` (n, 3) float64, valid where ``is_flat`` (n,).
    - ``samples`` (s,) int64: flat points spread over the directions of normals.
    """

    robot: int
    stamp_ns: int
    T_team_anchor: Float64Array
    points: Float64Array
    class_ids: UInt8Array
    normals: Float64Array
    is_flat: BoolArray
    samples: Int64Array
    voxel: float
    tree: cKDTree

    @classmethod
    def of_points(
        cls, robot: int, stamp_ns: int, T_team_anchor: Float64Array, points: Float64Array, class_ids: UInt8Array,
        voxel: float,
    ) -> Submap:  # fmt: skip
        """Return the submap of measured points (m, 3) in the anchor's frame with their classes (m,).

        Each voxel of the edge ``voxel`` [m] gives the mean of the points of its most frequent class. Points without a
        class (0) are left out.
        """
        points, class_ids = _voxel_means(points, class_ids, voxel)
        normals, is_flat = _normals(points, _NEIGHBOUR_RADIUS * voxel)
        tree = cKDTree(_keys(points, class_ids, voxel))
        samples = _spread_samples(normals, is_flat)
        return cls(
            robot, stamp_ns, T_team_anchor, points, class_ids, normals, is_flat, samples, voxel, tree
        )  # fmt: skip


def _voxel_means(points: Float64Array, class_ids: UInt8Array, voxel: float) -> tuple[Float64Array, UInt8Array]:
    """Mean (n, 3) and class (n,) of the most frequent class in each voxel with enough points of it."""
    labelled = class_ids > 0
    points, class_ids = points[labelled], class_ids[labelled]
    keys = np.floor(points / voxel).astype(np.int64) + (1 << 17)
    codes = ((((keys[:, 0] << 18) | keys[:, 1]) << 18 | keys[:, 2]) << 8) | class_ids
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    starts = np.flatnonzero(np.diff(codes, prepend=-1))
    counts = np.diff(starts, append=codes.size)
    means = np.add.reduceat(points[order], starts, axis=0) / counts[:, None] if starts.size else np.empty((0, 3))
    cells, classes = codes[starts] >> 8, (codes[starts] & 255).astype(np.uint8)
    # The most frequent class of each voxel comes first; ties go to the lower id.
    by_count = np.lexsort((classes, -counts, cells))
    chosen = by_count[np.flatnonzero(np.diff(cells[by_count], prepend=-1))]
    chosen = chosen[counts[chosen] >= _POINTS_PER_VOXEL]
    return means[chosen], classes[chosen]


def _normals(points: Float64Array, radius: float) -> tuple[Float64Array, BoolArray]:
    """Normals (n, 3) of the local planes, and whether (n,) the neighbours within ``radius`` [m] lie on a plane."""
    if len(points) == 0:
        return np.empty((0, 3)), np.empty(0, np.bool_)
    _, neighbours = cKDTree(points).query(points, k=_NUM_NEIGHBOURS, distance_upper_bound=radius)
    exists = neighbours < len(points)
    count = exists.sum(axis=1)
    offsets = np.where(exists[..., None], points[np.where(exists, neighbours, 0)] - points[:, None], 0.0)
    offsets -= (offsets.sum(axis=1) / count[:, None])[:, None] * exists[..., None]
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets) / count[:, None, None])
    is_flat = (count >= _MIN_NEIGHBOURS) & (variances[:, 0] < _FLATNESS * variances[:, 1])
    return axes[:, :, 0], is_flat


def _spread_samples(normals: Float64Array, is_flat: BoolArray) -> Int64Array:
    """Flat points, a third of the samples for each axis that normals are nearest to, so that ground is no majority."""
    nearest_axis = np.abs(normals).argmax(axis=1) if len(normals) else np.empty(0, np.int64)
    chosen = []
    for axis in range(3):
        points = np.flatnonzero(is_flat & (nearest_axis == axis))
        stride = max(1.0, points.size / (_NUM_SAMPLES // 3))
        chosen.append(points[np.arange(0, points.size, stride).astype(np.int64)])
    return np.sort(np.concatenate(chosen))


def _keys(points: Float64Array, class_ids: UInt8Array, voxel: float) -> Float64Array:
    """Coordinates (n, 4) in which points of different classes are far apart."""
    return np.column_stack([points, class_ids * (_CLASS_DISTANCE * voxel)])


@dataclass(frozen=True, eq=False)
class Registration:
    """Measured transform of two submaps: ``T_first_second`` (4, 4), ``information`` (6, 6) as in the pose graph."""

    T_first_second: Float64Array
    information: Float64Array


def register(
    first: Submap, second: Submap, T_first_second: Float64Array, gate: float, *, is_final: bool
) -> Registration | None:
    """Return the transform between two submaps, nearer to the best one than a guess; None where they do not fit.

    Two Gauss-Newton steps on the distances between points of one submap and planes of equal class in the other, in both
    directions (point-to-plane: Chen and Medioni, Image and Vision Computing 1992), weighted by Geman and McClure's
    function. Points correspond within ``gate`` [m]. Where ``is_final``, 95 % of the correspondences must be close to
    their planes.
    """
    voxel, information = first.voxel, np.zeros((6, 6))
    near_guess = np.diag([_STEP_ANGLE**-2.0] * 3 + [(_STEP_SHIFT * voxel) ** -2.0] * 3)
    for _ in range(_NUM_STEPS):
        residuals, jacobian = _both_residuals(first, second, T_first_second, gate)
        if residuals.size < _MIN_CORRESPONDENCES:
            return None
        if is_final and np.mean(np.abs(residuals) < _CLOSE * voxel) < _LEAST_CLOSE_SHARE:
            return None
        weights = 1.0 / (1.0 + np.square(residuals * (3.0 / gate))) ** 2
        weights /= _CORRESPONDENCES_PER_SAMPLE * (_SIGMA * voxel) ** 2
        information = (jacobian * weights[:, None]).T @ jacobian
        step = np.linalg.solve(information + near_guess, -jacobian.T @ (weights * residuals)).astype(np.float64)
        T_first_second = moved(T_first_second[None], step[None])[0]
    return Registration(T_first_second, information)


def _both_residuals(
    first: Submap, second: Submap, T_first_second: Float64Array, gate: float
) -> tuple[Float64Array, Float64Array]:
    """Distances (k,) to planes of either submap, and derivatives (k, 6) by a step of the transform on the left."""
    rotation, origin = T_first_second[:3, :3], T_first_second[:3, 3]
    forward, moved_points, planes = _residuals(second, first, T_first_second, gate)
    backward, fixed_points, moved_planes = _residuals(first, second, inverse(T_first_second), gate)
    # The step moves the second's points towards planes of the first, or planes of the second away from the first.
    arms = np.concatenate([moved_points @ rotation.T, fixed_points - origin])
    normals = np.concatenate([planes, -moved_planes @ rotation.T])
    return np.concatenate([forward, backward]), np.concatenate([np.cross(arms, normals), normals], axis=1)


def _residuals(
    moving: Submap, fixed: Submap, T: Float64Array, gate: float
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Distances (k,) of moving samples to planes under T = T_fixed_moving [m], the samples, and the planes' normals.

    Samples (k, 3) are in the moving submap's frame, normals (k, 3) in the fixed one's.
    """
    points, class_ids = moving.points[moving.samples], moving.class_ids[moving.samples]
    rotation = T[:3, :3]
    in_fixed = points @ rotation.T + T[:3, 3]
    distance, nearest = fixed.tree.query(_keys(in_fixed, class_ids, fixed.voxel), distance_upper_bound=gate)
    found = np.flatnonzero(np.isfinite(distance))
    found = found[fixed.is_flat[nearest[found]]]
    planes = fixed.normals[nearest[found]]
    own = moving.normals[moving.samples[found]] @ rotation.T
    agrees = np.abs(np.einsum("ki,ki->k", planes, own)) > _LEAST_COSINE
    found, planes = found[agrees], planes[agrees]
    residuals = np.einsum("ki,ki->k", planes, in_fixed[found] - fixed.points[nearest[found]])
    return residuals, points[found], planes


def overlapping_pairs(submaps: Sequence[Submap], poses: Float64Array) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of submaps with common occupied cells under the anchors' poses (n, 4, 4)."""
    cells, owners = [], []
    for index, (submap, pose) in enumerate(zip(submaps, poses, strict=True)):
        points = submap.points[submap.samples] @ pose[:3, :3].T + pose[:3, 3]
        keys = np.unique(np.floor(points / (_OVERLAP_CELL * submap.voxel)).astype(np.int64) + (1 << 20), axis=0)
        cells.append((keys[:, 0] << 42) | (keys[:, 1] << 21) | keys[:, 2])
        owners.append(np.full(len(keys), index))
    _, columns = np.unique(np.concatenate(cells), return_inverse=True)
    rows = np.concatenate(owners)
    shape = (len(submaps), int(columns.max(initial=-1)) + 1)
    occupied = coo_matrix((np.ones(rows.size, np.int64), (rows, columns)), shape).tocsr()
    common = (occupied @ occupied.T).tocoo()
    size = np.asarray(occupied.sum(axis=1)).ravel()
    least = np.maximum(_MIN_OVERLAP_SHARE * np.minimum(size[common.row], size[common.col]), _MIN_OVERLAP_CELLS)
    chosen = (common.row < common.col) & (common.data >= least)
    return sorted(zip(common.row[chosen].tolist(), common.col[chosen].tolist(), strict=True))
