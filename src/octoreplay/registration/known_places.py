"""Poses of map frames from known places: position fixes along a trajectory, and tags that two robots saw.

They are candidates for the alignment of maps. Systematic errors, such as those of satellite positions near walls, are
not modelled, so the maps decide.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from octoreplay.records import Float64Array
from octoreplay.registration.rigid import inverses
from octoreplay.transforms import inverse

_MIN_FIXES = 5
# Time after which the error of a fix counts as independent [s].
_CORRELATION_TIME = 30.0
_LARGEST_ANGLE_SIGMA = math.radians(10.0)
# Rounds of reweighting, and the least residual in them [m].
_ROUNDS, _LEAST_RESIDUAL = 30, 0.01
# Median length of a planar error, and the length that 1 % exceed [standard deviations of a coordinate].
_MEDIAN_LENGTH, _LARGEST_LENGTH = 1.1774, 3.035

# Length of the axes that represent a tag's rotation [m].
_AXIS = 0.5
# Standard deviations of a tag's position [m] and rotation [rad], which are mostly errors of the poses.
_TAG_SIGMA, _TAG_ANGLE_SIGMA = 0.2, math.radians(5.0)
# Distance up to which sightings of a tag agree [m], and the least share that does.
_SAME_PLACE, _LEAST_SHARE = 1.0, 0.8
_MAX_SIGHTINGS = 200


@dataclass(frozen=True, eq=False)
class KnownPose:
    """Pose of a frame from known places.

    Attributes
    ----------
    T : (4, 4) float64 array
        The pose; the identity where it is refused.
    shift_sigma : float
        Standard deviation of a horizontal coordinate, at the known places [m].
    angle_sigma : float
        Standard deviation of the rotation [rad].
    names : tuple of str
        Tags that agree with the pose; empty for position fixes.
    refusal : str
        Reason why the places give no pose; empty where they do.
    """

    T: Float64Array
    shift_sigma: float
    angle_sigma: float
    names: tuple[str, ...] = ()
    refusal: str = ""

    def relative_to(self, other: KnownPose) -> KnownPose:
        """Return this frame's pose in another one, both known in the same frame."""
        sigmas = math.hypot(self.shift_sigma, other.shift_sigma), math.hypot(self.angle_sigma, other.angle_sigma)
        return KnownPose(inverse(other.T) @ self.T, *sigmas)


# --- position fixes --------------------------------------------------------------------------------------------------


def fit_fixes(
    points_map: Float64Array, points_enu: Float64Array, sigmas: Float64Array, seconds: Float64Array
) -> KnownPose:
    """Return T_enu_map of a robot, whose map frame has a vertical z axis, from position fixes along its way.

    ``points_map`` and ``points_enu`` (n, 3) are the antenna's positions by the poses and by the fixes [m], ``sigmas``
    (n, 2) the standard deviations of the fixes along a horizontal axis and the vertical [m], NaN where unknown,
    ``seconds`` (n,) their times.

    Yaw and horizontal shift minimise the weighted distances (L1, by iteratively reweighted least squares), then the
    weighted squares without the outliers. The errors of fixes are correlated in time. ``shift_sigma`` is that of a
    single fix, because all of them may share an error; in ``angle_sigma``, which follows from the residuals, fixes
    within 30 s count as one. Refused where the way is too short for the angle.
    """
    if len(points_map) < _MIN_FIXES:
        return _refused(f"{len(points_map)} position fixes, fewer than {_MIN_FIXES}")
    weights, height_weights = _weights(sigmas[:, 0]), _weights(sigmas[:, 1])
    T = upright_fit(points_enu, points_map, weights)
    for _ in range(_ROUNDS):
        lengths = np.maximum(_residual_lengths(T, points_enu, points_map), _LEAST_RESIDUAL)
        T = upright_fit(points_enu, points_map, np.sqrt(weights) / lengths)
    lengths = _residual_lengths(T, points_enu, points_map)
    scale = max(float(np.median(lengths)) / _MEDIAN_LENGTH, _LEAST_RESIDUAL)
    used = lengths <= _LARGEST_LENGTH * scale
    T = upright_fit(points_enu[used], points_map[used], weights[used])
    heights = (points_enu - points_map)[used, 2]
    T[2, 3] = np.average(heights, weights=height_weights[used])
    lengths = _residual_lengths(T, points_enu[used], points_map[used])
    scatter = max(math.sqrt(float(np.mean(lengths**2)) / 2), _LEAST_RESIDUAL)
    known = sigmas[used, 0][np.isfinite(sigmas[used, 0])]
    planar = points_map[used, :2] - points_map[used, :2].mean(axis=0)
    spread = math.sqrt(float(np.mean((planar**2).sum(axis=1))))
    num_independent = min(1.0 + float(np.ptp(seconds[used])) / _CORRELATION_TIME, float(used.sum()))
    angle_sigma = scatter / max(spread, 1e-9) / math.sqrt(num_independent)
    if angle_sigma > _LARGEST_ANGLE_SIGMA:
        extent = float(np.linalg.norm(np.ptp(planar, axis=0)))
        return _refused(f"a way of {extent:.1f} m is too short for fixes that scatter by {scatter:.2f} m")
    return KnownPose(T, max(scatter, float(np.median(known)) if known.size else 0.0), angle_sigma)


def upright_fit(target: Float64Array, source: Float64Array, weights: Float64Array) -> Float64Array:
    """Return the rotation about z and the shift, (4, 4), of points ``source`` (n, 3) nearest to ``target`` (n, 3).

    They minimise the squared distances with ``weights`` (n,), in closed form.
    """
    centre, goal = np.average(source, axis=0, weights=weights), np.average(target, axis=0, weights=weights)
    (x, y), (u, v) = (source - centre)[:, :2].T, (target - goal)[:, :2].T
    yaw = math.atan2(float(weights @ (x * v - y * u)), float(weights @ (x * u + y * v)))
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T[:3, 3] = goal - T[:3, :3] @ centre
    return T


def _weights(sigmas: Float64Array) -> Float64Array:
    """Inverse variances (n,); the median of the known ones for unknown ones."""
    is_known = np.isfinite(sigmas)
    usual = float(np.median(sigmas[is_known])) if is_known.any() else 1.0
    return np.asarray(1.0 / np.maximum(np.where(is_known, sigmas, usual), _LEAST_RESIDUAL) ** 2)


def _residual_lengths(T: Float64Array, target: Float64Array, source: Float64Array) -> Float64Array:
    """Horizontal distances (n,) of moved points from their targets [m]."""
    return np.asarray(np.linalg.norm((source @ T[:3, :3].T + T[:3, 3] - target)[:, :2], axis=1))


def _refused(reason: str) -> KnownPose:
    """A pose that the known places do not give."""
    return KnownPose(np.eye(4), math.inf, math.inf, refusal=reason)


# --- tags ------------------------------------------------------------------------------------------------------------


def tag_place(T_map_tag: Float64Array) -> Float64Array | None:
    """Return the mean pose (4, 4) of a tag from its sightings (n, 4, 4), without outliers.

    Returns None where more than a fifth of them is over 1 m from the median: a tag that moved, two tags with one id, or
    poses that drift.
    """
    # Evenly chosen sightings keep the distances between all of them small.
    chosen = T_map_tag[np.linspace(0, len(T_map_tag) - 1, min(len(T_map_tag), _MAX_SIGHTINGS)).round().astype(int)]
    centres = chosen[:, :3, 3]
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    from_median = distances[int(distances.sum(axis=1).argmin())]
    if float(np.mean(from_median <= _SAME_PLACE)) < _LEAST_SHARE:
        return None
    used = chosen[from_median <= max(3.0 * float(np.median(from_median)), 1e-6)]
    place = np.eye(4)
    place[:3, :3] = Rotation.from_matrix(used[:, :3, :3]).mean().as_matrix()
    place[:3, 3] = used[:, :3, 3].mean(axis=0)
    return place


def fit_tags(
    first: Mapping[str, Float64Array], second: Mapping[str, Float64Array], *, is_upright: bool
) -> KnownPose | None:
    """Return T_first_second from the tags that two robots saw; None without a common tag.

    ``first`` and ``second`` are the places T_map_tag (4, 4) by tag. ``is_upright`` is True where both map frames have a
    vertical z axis. The pose agrees with as many tags as possible within 1 m; ``names`` are these tags. It is the
    least-squares fit of their centres and of points on their axes. Refused where two or more tags are common and no
    two agree.
    """
    names = sorted(set(first) & set(second))
    if not names:
        return None
    ones, others = np.array([first[name] for name in names]), np.array([second[name] for name in names])
    # Each tag alone gives a pose; the best one moves most of the other tags to their places.
    alone = ones @ inverses(others)
    moved = np.einsum("kij,lj->kli", alone[:, :3, :3], others[:, :3, 3]) + alone[:, None, :3, 3]
    shifts = np.linalg.norm(moved - ones[None, :, :3, 3], axis=2)
    agrees = shifts <= _SAME_PLACE
    best = int(np.lexsort((shifts.sum(axis=1), -agrees.sum(axis=1)))[0])
    used = agrees[best]
    if len(names) > 1 and used.sum() < 2:
        return _refused(f"no two of the tags {', '.join(names)} agree")
    target, source = _tag_points(ones[used]), _tag_points(others[used])
    if is_upright:
        T = upright_fit(target, source, np.ones(len(source)))
    else:
        T = np.eye(4)
        T[:3, :3] = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))[0].as_matrix()
        T[:3, 3] = target.mean(axis=0) - T[:3, :3] @ source.mean(axis=0)
    centres = ones[used, :3, 3]
    squared_spread = float(np.mean(((centres - centres.mean(axis=0)) ** 2).sum(axis=1)))
    information = int(used.sum()) * (_TAG_ANGLE_SIGMA**-2 + squared_spread / _TAG_SIGMA**2)
    agreeing = tuple(name for name, is_used in zip(names, used, strict=True) if is_used)
    return KnownPose(T, _TAG_SIGMA, 1.0 / math.sqrt(information), agreeing)


def _tag_points(T_map_tag: Float64Array) -> Float64Array:
    """Centres of tags (k, 4, 4) and points on their axes, (4 k, 3)."""
    centres = T_map_tag[:, None, :3, 3]
    return np.asarray(
        np.concatenate([centres, centres + _AXIS * T_map_tag[:, :3, :3].transpose(0, 2, 1)], axis=1)
    ).reshape(-1, 3)
