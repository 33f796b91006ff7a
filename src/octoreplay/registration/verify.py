"""Verification of a pose between two maps: cells of one map that the other one confirms or contradicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.cells import FREE, OccupiedCells, class_bits
from octoreplay.registration.own_map import FIRST_GROUND_CODE, OwnMap
from octoreplay.registration.search import column_score
from octoreplay.transforms import inverse

# Log-likelihood ratio of a right pose against the best wrong ones, for each cell that is the same, other or contra. It
# ranks candidates before their refinement.
_OBSTACLE_WEIGHTS = (0.094, -0.65, -2.26)
_GROUND_WEIGHTS = (0.018, -0.27, -0.35)
# Candidates are ranked with one cell in this many.
_THINNING = 3
# The same for refined poses, by the distance from a cell's point to the nearest point of the same class in the other
# map [cell]: up to each edge, then beyond the last one, then contra. Measured on simulated villages, and scaled by 0.15
# for obstacles and 0.1 for ground, because neighbouring cells and the columns tell the same.
_DISTANCE_EDGES = (0.33, 0.5, 0.67, 1.17, 1.33, 1.67, 2.33)
_OBSTACLE_RATIOS = (0.111, 0.098, 0.072, 0.0, -0.061, -0.093, -0.171, -0.261, -0.261)
_GROUND_RATIOS = (0.0308, 0.014, -0.0032, -0.0296, -0.03, -0.044, -0.056, -0.124, -0.136)


@dataclass(frozen=True)
class CellCounts:
    """Occupied cells of both maps by what the other map holds there.

    - ``same``: an occupied cell of the same class within one cell.
    - ``other``: occupied cells of other classes only within one cell.
    - ``contra``: known free, and no occupied cell within one cell.

    Cells in unknown space of the other map do not count.
    """

    same: int
    other: int
    contra: int

    def __add__(self, other: CellCounts) -> CellCounts:
        return CellCounts(self.same + other.same, self.other + other.other, self.contra + other.contra)

    @property
    def total(self) -> int:
        """Number of cells that count."""
        return self.same + self.other + self.contra

    @property
    def share_same(self) -> float:
        """Share of the cells that are the same; 0 without cells."""
        return self.same / max(self.total, 1)

    @property
    def share_contra(self) -> float:
        """Share of the cells that contradict; 0 without cells."""
        return self.contra / max(self.total, 1)

    def weighted(self, same: float, other: float, contra: float) -> float:
        """Return the weighted sum of the counts."""
        return same * self.same + other * self.other + contra * self.contra


@dataclass(frozen=True)
class Verification:
    """Agreement of two maps under a pose.

    Attributes
    ----------
    obstacles, ground : CellCounts
        Counts of the obstacles' and of the ground's cells, both maps together. Without a vertical axis all occupied
        cells are obstacles.
    least_same : float
        Share of the obstacles that are the same, of the map where it is less.
    score : float
        L: log-likelihood ratio of a right pose against the best wrong ones, from columns and cells. Without a vertical
        axis from the counts alone.
    overlap : float
        Obstacle cells that count, as a share of the map where it is less.
    """

    obstacles: CellCounts
    ground: CellCounts
    least_same: float
    score: float
    overlap: float


def verify(first: OwnMap, second: OwnMap, T_first_second: Float64Array, *, is_upright: bool = True) -> Verification:
    """Return the agreement of two maps, where ``T_first_second`` (4, 4) maps the second frame to the first.

    ``is_upright``: the vertical axis of each map is known.
    """
    obstacles, ground = _both_counts(first, second, T_first_second, is_upright)
    sizes = (len(own.obstacles if is_upright else own.occupied) for own in (first, second))
    score = sum((counts.weighted(*_OBSTACLE_WEIGHTS) for counts in obstacles), 0.0)
    if is_upright:
        score = _columns(first, second, T_first_second) + _distance_score(first, second, T_first_second)
    return Verification(
        obstacles=sum(obstacles, CellCounts(0, 0, 0)),
        ground=sum(ground, CellCounts(0, 0, 0)),
        least_same=min(counts.share_same for counts in obstacles),
        score=score,
        overlap=min(counts.total / max(size, 1) for counts, size in zip(obstacles, sizes, strict=True)),
    )


def candidate_score(first: OwnMap, second: OwnMap, T_first_second: Float64Array) -> float:
    """Return a score for the order of candidates before their refinement, of maps with a vertical axis.

    It takes one cell in ``_THINNING`` of each map.
    """
    obstacles, ground = _both_counts(first, second, T_first_second, is_upright=True, thinning=_THINNING)
    score = sum(counts.weighted(*_OBSTACLE_WEIGHTS) for counts in obstacles)
    score += sum(counts.weighted(*_GROUND_WEIGHTS) for counts in ground)
    return _THINNING * score + _columns(first, second, T_first_second)


def spread_of_normals(first: OwnMap, second: OwnMap, T_first_second: Float64Array) -> float:
    """Return how far the surfaces that both maps share fix a pose: 0 for planes in one direction, 1/3 for a sphere.

    It is the smallest eigenvalue of the mean of n n^T over the normals n of the cells that are the same.
    """
    scatter, num = np.zeros((3, 3)), 0
    for own, T, other in ((first, inverse(T_first_second), second), (second, T_first_second, first)):
        _, nearby = other.at(own.occupied.points @ T[:3, :3].T + T[:3, 3])
        is_same = (nearby & class_bits(own.occupied.class_ids)) != 0
        _, axes = np.linalg.eigh(own.surface.covariances[is_same])
        # In the first map's frame.
        normals = axes[:, :, 0] if own is first else axes[:, :, 0] @ T[:3, :3].T
        scatter += normals.T @ normals
        num += len(normals)
    return float(np.linalg.eigvalsh(scatter / max(num, 1))[0])


def _columns(first: OwnMap, second: OwnMap, T_first_second: Float64Array) -> float:
    """Score of the pose over the maps' columns, mean of both directions."""
    back = inverse(T_first_second)
    return (column_score(first, second, T_first_second) + column_score(second, first, back)) / 2


def _both_counts(
    first: OwnMap, second: OwnMap, T_first_second: Float64Array, is_upright: bool, thinning: int = 1
) -> tuple[list[CellCounts], list[CellCounts]]:
    """Counts of one in ``thinning`` cells of each map's obstacles and ground.

    Without a vertical axis all occupied cells are obstacles.
    """
    obstacles, ground = [], []
    for own, T, other in ((first, inverse(T_first_second), second), (second, T_first_second, first)):
        obstacles.append(_counts((own.obstacles if is_upright else own.occupied).thinned(thinning), T, other))
        if is_upright:
            ground.append(_counts(own.ground.thinned(thinning), T, other))
    return obstacles, ground


def _distance_score(first: OwnMap, second: OwnMap, T_first_second: Float64Array) -> float:
    """Sum of the log-likelihood ratios of all cells in space that the other map knows."""
    score = 0.0
    for own, T, other in ((first, inverse(T_first_second), second), (second, T_first_second, first)):
        for cells, first_code, ratios in (
            (own.obstacles, 0, _OBSTACLE_RATIOS),
            (own.ground, FIRST_GROUND_CODE, _GROUND_RATIOS),
        ):
            points = cells.points @ T[:3, :3].T + T[:3, 3]
            states, nearby = other.at(points)
            near = nearby != 0
            codes = cells.class_ids[near] + np.int64(first_code)
            distances = other.upright_surface.distances(points[near], codes, _DISTANCE_EDGES[-1] * other.resolution)
            steps = np.searchsorted(_DISTANCE_EDGES, distances / other.resolution, side="left")
            score += float(np.take(ratios, steps).sum())
            score += ratios[-1] * np.count_nonzero(~near & (states == FREE))
    return score


def _counts(cells: OccupiedCells, T: Float64Array, other: OwnMap) -> CellCounts:
    """Counts of cells against another map, where T maps to the other map's frame."""
    states, nearby = other.at(cells.points @ T[:3, :3].T + T[:3, 3])
    is_same = (nearby & class_bits(cells.class_ids)) != 0
    is_near = nearby != 0
    counts = (is_same, is_near & ~is_same, ~is_near & (states == FREE))
    return CellCounts(*(int(np.count_nonzero(count)) for count in counts))
