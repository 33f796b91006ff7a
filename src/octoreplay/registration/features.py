"""Candidate poses between two maps in any orientation, from local shapes.

Points of both maps are described by fast point feature histograms (FPFH: Rusu, Blodow and Beetz, ICRA 2009), matched by
their nearest descriptors, and poses are drawn from triples of matches whose edges have equal lengths (RANSAC: Fischler
and Bolles 1981). Normals point to free space. Draws are seeded: equal maps give equal candidates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from octoreplay.records import Float64Array, Int64Array

# Largest distance of a match under a right pose [cell].
_INLIER = 3.0
_NUM_NEIGHBOURS = 100
_MIN_POINTS = 20
_NUM_BINS = 11
_MATCHES_PER_POINT = 2
_NUM_TRIPLES = 400_000
_LENGTH_TOLERANCE = 0.85
# Least edge of a triple [cell]: shorter ones give inaccurate rotations.
_MIN_EDGE = 8.0
_NUM_POSES = 3000
_NUM_KEPT = 12
_SAME_ANGLE, _SAME_SHIFT = 15.0, 6.0


@dataclass(frozen=True, eq=False)
class DescribedPoints:
    """Points (n, 3) [m] of a map with descriptors (n, 33)."""

    points: Float64Array
    descriptors: Float64Array

    @classmethod
    def of_points(cls, points: Float64Array, normals: Float64Array, radius: float) -> DescribedPoints:
        """Return points (n, 3) [m] with unit normals (n, 3), described by their neighbours within ``radius`` [m]."""
        return cls(points, _histograms(points, normals, radius))


def feature_candidates(first: DescribedPoints, second: DescribedPoints, cell: float) -> list[Float64Array]:
    """Return poses (4, 4) of the second map's frame in the first one's, most matches first.

    ``cell`` is the edge of the maps' cells [m].
    """
    if min(len(first.points), len(second.points)) < _MIN_POINTS:
        return []
    sources, targets = _matches(second, first)
    source, target = second.points[sources], first.points[targets]
    rng = np.random.default_rng(0)
    triples = rng.integers(0, len(source), (_NUM_TRIPLES, 3))
    is_good = np.ones(len(triples), np.bool_)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        a = np.linalg.norm(source[triples[:, i]] - source[triples[:, j]], axis=1)
        b = np.linalg.norm(target[triples[:, i]] - target[triples[:, j]], axis=1)
        is_good &= (np.minimum(a, b) > _LENGTH_TOLERANCE * np.maximum(a, b)) & (np.minimum(a, b) > _MIN_EDGE * cell)
    triples = triples[is_good][:_NUM_POSES]
    if len(triples) == 0:
        return []
    rotations, shifts = _rigid(source[triples], target[triples])
    counts = np.array(
        [
            np.count_nonzero(((source @ R.T + t - target) ** 2).sum(axis=1) < (_INLIER * cell) ** 2)
            for R, t in zip(rotations, shifts, strict=True)
        ]
    )
    return _distinct(rotations, shifts, counts, source.mean(axis=0), cell)


def _histograms(points: Float64Array, normals: Float64Array, radius: float) -> Float64Array:
    """Fast point feature histograms (n, 33), each third summing to 1."""
    num = len(points)
    tree = cKDTree(points)
    distances, neighbours = tree.query(points, k=min(_NUM_NEIGHBOURS, num), distance_upper_bound=radius)
    exists = np.isfinite(distances) & (distances > 0)
    rows, columns = np.nonzero(exists)
    others, lengths = neighbours[rows, columns], distances[rows, columns]
    # Darboux frame u, v, w at the point; angles alpha, phi, theta to the neighbour's normal.
    d = (points[others] - points[rows]) / lengths[:, None]
    u = normals[rows]
    v = np.cross(d, u)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)
    w = np.cross(u, v)
    n = normals[others]
    alpha, phi = np.einsum("ni,ni->n", v, n), np.einsum("ni,ni->n", u, d)
    theta = np.arctan2(np.einsum("ni,ni->n", w, n), np.einsum("ni,ni->n", u, n)) / np.pi
    simple = np.zeros((num, 3 * _NUM_BINS))
    for part, value in enumerate((alpha, phi, theta)):
        bins = np.clip(((value + 1) / 2 * _NUM_BINS).astype(np.int64), 0, _NUM_BINS - 1)
        flat = np.bincount(rows * _NUM_BINS + bins, minlength=num * _NUM_BINS)
        simple[:, part * _NUM_BINS : (part + 1) * _NUM_BINS] = flat.reshape(num, _NUM_BINS)
    simple /= np.maximum(exists.sum(axis=1), 1)[:, None]
    weights = np.where(exists, 1.0 / np.maximum(distances, 1e-9), 0.0)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    full = simple.copy()
    for k in range(neighbours.shape[1]):
        full += weights[:, k, None] * simple[np.where(exists[:, k], neighbours[:, k], 0)]
    return full / 2


def _matches(source: DescribedPoints, target: DescribedPoints) -> tuple[Int64Array, Int64Array]:
    """Indices of matched points: each point with its nearest descriptors in the other map, both ways."""
    a, b = source.descriptors.astype(np.float32), target.descriptors.astype(np.float32)
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * a @ b.T
    k = min(_MATCHES_PER_POINT, *squares.shape)
    forth = np.argpartition(squares, k - 1, axis=1)[:, :k]
    back = np.argpartition(squares, k - 1, axis=0)[:k]
    pairs = np.concatenate(
        [
            np.stack([np.repeat(np.arange(len(a)), k), forth.ravel()], axis=1),
            np.stack([back.ravel(), np.tile(np.arange(len(b)), k)], axis=1),
        ]
    )
    pairs = np.unique(pairs, axis=0)
    return pairs[:, 0], pairs[:, 1]


def _rigid(source: Float64Array, target: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Rotations (n, 3, 3) and shifts (n, 3) of the least squares fit of points (n, 3, 3) (Kabsch 1976)."""
    a, b = source.mean(axis=1), target.mean(axis=1)
    covariance = np.einsum("nki,nkj->nij", target - b[:, None], source - a[:, None])
    u, _, vt = np.linalg.svd(covariance)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotations = u @ vt
    return rotations, b - np.einsum("nij,nj->ni", rotations, a)


def _distinct(
    rotations: Float64Array, shifts: Float64Array, counts: Int64Array, centre: Float64Array, cell: float
) -> list[Float64Array]:
    """The poses (4, 4) with the most matches that differ from each other."""
    kept: list[Float64Array] = []
    for index in np.argsort(-counts, kind="stable"):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotations[index], shifts[index]
        place = T[:3, :3] @ centre + T[:3, 3]
        if not any(
            np.linalg.norm(place - other[:3, :3] @ centre - other[:3, 3]) < _SAME_SHIFT * cell
            and np.trace(T[:3, :3].T @ other[:3, :3]) > 1 + 2 * np.cos(np.radians(_SAME_ANGLE))
            for other in kept
        ):
            kept.append(T)
        if len(kept) == _NUM_KEPT:
            break
    return kept
