"""Search for the pose between two maps whose vertical axes agree: columns, correlation over all yaws, hill climbing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft

from octoreplay.records import Float64Array, Int64Array
from octoreplay.registration.columns import Columns
from octoreplay.registration.own_map import OwnMap

# Share of columns whose code differs although the pose is right.
_ERROR_SHARE = 0.2
_MIN_FREQUENCY = 1e-4
_NUM_YAWS = 72
_PEAKS_PER_YAW = 3
_NUM_CLIMBED = 16
_NUM_KEPT = 8
# Edge of a cell of the correlation [columns].
_COARSE = 2
# Steps of the hill climbing: yaw [degree], shift [column].
_STEPS = ((5.0, 2.0), (2.5, 1.0), (1.0, 0.5))
_MAX_CLIMB = 8
# Candidates climb with one column in this many.
_CLIMB_THINNING = 2
# Two poses are one where they are closer than this: yaw [degree], shift [column].
_SAME_YAW, _SAME_SHIFT = 8.0, 4.0


def planar_candidates(first: OwnMap, second: OwnMap) -> list[Float64Array]:
    """Return the most likely poses (4, 4) of the second map in the first one's frame, best first.

    The score is the log-likelihood ratio of the columns' codes: ln((1 - e) / P_c + e) where two known columns have the
    same code c, ln e where they differ. P_c is the mean frequency of the code in both maps, e = 0.2.
    """
    a, b = first.columns, second.columns
    if a.known[1].size == 0 or b.known[1].size == 0:
        return []
    table = _score_table(a, b, 2 * first.num_classes)
    found = _correlation_peaks(a, b, table)[:_NUM_CLIMBED]
    climbed = sorted((_climbed(a, b, table, planar) for planar in found), key=lambda p: -p.score)
    kept: list[_Planar] = []
    for planar in climbed:
        if len(kept) < _NUM_KEPT and not any(planar.is_close_to(other, a.edge) for other in kept):
            kept.append(planar)
    return [planar.pose(_height_difference(a, b, planar)) for planar in kept]


def climbed_pose(first: OwnMap, second: OwnMap, T_first_second: Float64Array) -> Float64Array:
    """Return the most likely upright pose (4, 4) near another one, by hill climbing, at the height of the ground.

    Returns the pose unchanged where a map has no known column.
    """
    a, b = first.columns, second.columns
    points = b.known[0]
    if a.known[1].size == 0 or points.size == 0:
        return T_first_second
    centre = points.mean(axis=0)
    yaw = math.atan2(T_first_second[1, 0], T_first_second[0, 0])
    target = _rotation(yaw) @ centre + T_first_second[:2, 3]
    table = _score_table(a, b, 2 * first.num_classes)
    climbed = _climbed(a, b, table, _Planar(yaw, centre, target))
    return climbed.pose(_height_difference(a, b, climbed))


def column_score(first: OwnMap, second: OwnMap, T_first_second: Float64Array) -> float:
    """Return the score of a pose (4, 4): the sum over the second map's known columns, as for candidates."""
    a, b = first.columns, second.columns
    points, codes, ground = b.known
    if a.known[1].size == 0 or codes.size == 0:
        return 0.0
    table = _score_table(a, b, 2 * first.num_classes)
    spatial = np.column_stack([points, np.nan_to_num(ground)])
    moved = spatial @ T_first_second[:2, :3].T + T_first_second[:2, 3]
    cells = np.floor(moved / a.edge).astype(np.int64) - a.low
    inside = np.all((cells >= 0) & (cells < a.codes.shape), axis=1)
    return float(table[a.codes[tuple(cells[inside].T)], codes[inside]].sum())


@dataclass(frozen=True, eq=False)
class _Planar:
    """Pose in the plane: a point c of the second frame goes to R(yaw) (c - centre) + target."""

    yaw: float
    centre: Float64Array
    target: Float64Array
    score: float = -math.inf

    def apply(self, points: Float64Array) -> Float64Array:
        """Points (n, 2) in the first frame."""
        return (points - self.centre) @ _rotation(self.yaw).T + self.target

    def is_close_to(self, other: _Planar, edge: float) -> bool:
        """True where both poses are one."""
        turn = (self.yaw - other.yaw + math.pi) % (2 * math.pi) - math.pi
        shift = float(np.hypot(*(self.target - other.target)))
        return abs(turn) < math.radians(_SAME_YAW) and shift < _SAME_SHIFT * edge

    def pose(self, height: float) -> Float64Array:
        """The pose (4, 4) at a height [m]."""
        result = np.eye(4)
        result[:2, :2] = _rotation(self.yaw)
        result[:2, 3] = self.target - _rotation(self.yaw) @ self.centre
        result[2, 3] = height
        return result


def _rotation(yaw: float) -> Float64Array:
    """Rotation matrix (2, 2)."""
    return np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])


def _score_table(a: Columns, b: Columns, num_codes: int) -> Float64Array:
    """Score of each pair of codes (num_codes + 1, num_codes + 1); 0 where one is unknown."""
    counts = [np.bincount(columns.known[1], minlength=num_codes + 1)[1:] for columns in (a, b)]
    frequency = sum(count / count.sum() for count in counts) / 2
    table = np.full((num_codes + 1, num_codes + 1), math.log(_ERROR_SHARE))
    table[0], table[:, 0] = 0.0, 0.0
    codes = np.arange(1, num_codes + 1)
    table[codes, codes] = np.log((1 - _ERROR_SHARE) / np.maximum(frequency, _MIN_FREQUENCY) + _ERROR_SHARE)
    return table


def _correlation_peaks(a: Columns, b: Columns, table: Float64Array) -> list[_Planar]:
    """Peaks of the score over all yaws and shifts, best first, by FFT over the codes that both maps hold."""
    edge = _COARSE * a.edge
    points_a, codes_a, _ = a.known
    points_b, codes_b, _ = b.known
    shared = np.intersect1d(codes_a, codes_b)
    cells_a = np.floor(points_a / edge).astype(np.int64)
    low_a = cells_a.min(axis=0)
    cells_a -= low_a
    centre = points_b.mean(axis=0)
    reach = float(np.hypot(*(points_b - centre).T).max())
    num_b = math.ceil(2 * reach / edge) + 2
    shape = tuple(int(fft.next_fast_len(int(n) + 1 + num_b, real=True)) for n in cells_a.max(axis=0))
    miss = math.log(_ERROR_SHARE)
    weights = np.append(table[shared, shared] - miss, miss)
    spectrum_a = np.conj(fft.rfft2(_layers(cells_a, codes_a, shared, shape))) * weights[:, None, None]
    spectrum_a = spectrum_a.astype(np.complex64)
    found = []
    for yaw in np.arange(_NUM_YAWS) * (2 * math.pi / _NUM_YAWS):
        turned = (points_b - centre) @ _rotation(yaw).T + reach
        layers = _layers(np.floor(turned / edge).astype(np.int64), codes_b, shared, shape)
        scores = fft.irfft2((spectrum_a * fft.rfft2(layers)).sum(axis=0), s=shape)
        for _ in range(_PEAKS_PER_YAW):
            peak = np.array(np.unravel_index(int(scores.argmax()), shape))
            shift = np.where(peak < num_b, peak, peak - shape)
            score = float(scores[tuple(peak)])
            found.append(_Planar(float(yaw), centre, (low_a - shift) * edge + reach, score))
            rows, columns = ((peak[k] + np.arange(-2, 3)) % shape[k] for k in (0, 1))
            scores[np.ix_(rows, columns)] = -np.inf
    return sorted(found, key=lambda planar: -planar.score)


def _layers(
    cells: Int64Array, codes: Int64Array, shared: Int64Array, shape: tuple[int, ...]
) -> np.typing.NDArray[np.float32]:
    """Share of the known columns of each cell that have each shared code, and where any is known: (k + 1, nx, ny)."""
    size = math.prod(shape)
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    count = np.bincount(flat, minlength=size)
    layers = np.empty((shared.size + 1, size), np.float32)
    for layer, code in zip(layers, shared, strict=False):
        layer[:] = np.bincount(flat[codes == code], minlength=size)
    layers[:-1] /= np.maximum(count, 1)
    layers[-1] = count > 0
    return layers.reshape(-1, *shape)


def _climbed(a: Columns, b: Columns, table: Float64Array, planar: _Planar) -> _Planar:
    """The pose after hill climbing on the columns."""
    points, codes = b.known[0][::_CLIMB_THINNING], b.known[1][::_CLIMB_THINNING].astype(np.int32)
    moves = np.array([(u, v, w) for u in (-1, 0, 1) for v in (-1, 0, 1) for w in (-1, 0, 1) if (u, v, w) != (0, 0, 0)])
    # Every position outside of the map is clipped to an unknown border.
    padded = np.pad(a.codes, 1).astype(np.int32)
    flat_table, num_codes = table.astype(np.float32).ravel(), len(table)
    x, y = ((points - planar.centre) / a.edge).T.astype(np.float32)
    offset = 1.0 - a.low

    def score(yaws: Float64Array, targets: Float64Array) -> Float64Array:
        """Scores (h,) of yaws (h,) and targets (h, 2)."""
        cosine, sine = np.cos(yaws)[:, None].astype(np.float32), np.sin(yaws)[:, None].astype(np.float32)
        shift = (targets / a.edge + offset).astype(np.float32)
        i = np.clip(cosine * x - sine * y + shift[:, :1], 0, padded.shape[0] - 1).astype(np.int32)
        j = np.clip(sine * x + cosine * y + shift[:, 1:], 0, padded.shape[1] - 1).astype(np.int32)
        found = padded.ravel()[i * padded.shape[1] + j]
        scores: Float64Array = flat_table[found * num_codes + codes].sum(axis=1, dtype=np.float64)
        return scores

    yaw, target = planar.yaw, planar.target
    best = float(score(np.array([yaw]), target[None])[0])
    for turn, shift in _STEPS:
        for _ in range(_MAX_CLIMB):
            yaws = yaw + moves[:, 0] * math.radians(turn)
            targets = target + moves[:, 1:] * (shift * a.edge)
            scores = score(yaws, targets)
            top = int(scores.argmax())
            if scores[top] <= best:
                break
            best, yaw, target = float(scores[top]), float(yaws[top]), targets[top]
    return _Planar(yaw, planar.centre, target, best)


def _height_difference(a: Columns, b: Columns, planar: _Planar) -> float:
    """Median difference of the ground's height where both maps know it [m]; 0 where they share no ground."""
    points, _, ground = b.known
    cells = np.floor(planar.apply(points) / a.edge).astype(np.int64) - a.low
    inside = ((cells >= 0) & (cells < a.codes.shape)).all(axis=1)
    cells = cells[inside]
    heights = np.where(a.codes[tuple(cells.T)] > 0, a.ground[tuple(cells.T)], np.nan)
    differences = heights - ground[inside]
    differences = differences[np.isfinite(differences)]
    return float(np.median(differences)) if differences.size else 0.0
