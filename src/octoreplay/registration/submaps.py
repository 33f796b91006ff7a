"""Submaps: labelled surfaces of a few seconds of one robot's scans, and transforms measured between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix

from octoreplay.records import Float64Array, UInt8Array
from octoreplay.registration.measured_points import most_frequent, voxel_codes
from octoreplay.registration.planes import PlanePoints, plane_distances
from octoreplay.registration.rigid import moved
from octoreplay.transforms import inverse

_POINTS_PER_VOXEL = 3
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
    - ``planes``: one point for each occupied voxel of the edge ``planes.spacing``.
    """

    robot: int
    stamp_ns: int
    T_team_anchor: Float64Array
    planes: PlanePoints

    @classmethod
    def of_points(
        cls, robot: int, stamp_ns: int, T_team_anchor: Float64Array, points: Float64Array, class_ids: UInt8Array,
        voxel: float,
    ) -> Submap:  # fmt: skip
        """Return the submap of measured points (m, 3) in the anchor's frame with their classes (m,).

        Each voxel of the edge ``voxel`` [m] gives the mean of the points of its most frequent class. Points without a
        class (0) are left out.
        """
        means, classes = _voxel_means(points, class_ids, voxel)
        planes = PlanePoints.of_points(means, classes, voxel, num_samples=_NUM_SAMPLES)
        return cls(robot, stamp_ns, T_team_anchor, planes)


def _voxel_means(points: Float64Array, class_ids: UInt8Array, voxel: float) -> tuple[Float64Array, UInt8Array]:
    """Mean (n, 3) and class (n,) of the most frequent class in each voxel with enough points of it."""
    labelled = class_ids > 0
    points, class_ids = points[labelled], class_ids[labelled]
    codes = voxel_codes(np.floor(points / voxel).astype(np.int64)) << 8 | class_ids
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    starts = np.flatnonzero(np.diff(codes, prepend=-1))
    counts = np.diff(starts, append=codes.size)
    means = np.add.reduceat(points[order], starts, axis=0) / counts[:, None] if starts.size else np.empty((0, 3))
    cells, classes = codes[starts] >> 8, (codes[starts] & 255).astype(np.uint8)
    chosen = most_frequent(cells, classes, counts)
    chosen = chosen[counts[chosen] >= _POINTS_PER_VOXEL]
    return means[chosen], classes[chosen]


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
    voxel, information = first.planes.spacing, np.zeros((6, 6))
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
    T_second_first = inverse(T_first_second)
    forward = plane_distances(second.planes, first.planes, T_first_second, gate, least_cosine=_LEAST_COSINE)
    backward = plane_distances(first.planes, second.planes, T_second_first, gate, least_cosine=_LEAST_COSINE)
    # The step moves the second's points towards planes of the first, or planes of the second away from the first.
    rotation, origin = T_first_second[:3, :3], T_first_second[:3, 3]
    arms = np.concatenate([forward.points - origin, backward.points @ rotation.T])
    normals = np.concatenate([forward.normals, -backward.normals @ rotation.T])
    jacobian = np.concatenate([np.cross(arms, normals), normals], axis=1)
    return np.concatenate([forward.distances, backward.distances]), jacobian


def overlapping_pairs(submaps: Sequence[Submap], poses: Float64Array) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of submaps with common occupied cells under the anchors' poses (n, 4, 4)."""
    cells, owners = [], []
    for index, (submap, pose) in enumerate(zip(submaps, poses, strict=True)):
        points = submap.planes.sample_points @ pose[:3, :3].T + pose[:3, 3]
        keys = np.unique(
            np.floor(points / (_OVERLAP_CELL * submap.planes.spacing)).astype(np.int64) + (1 << 20), axis=0
        )
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
