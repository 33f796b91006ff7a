"""Registration of two maps: candidates, verification, refinement, and acceptance or refusal with the reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.features import feature_candidates
from octoreplay.registration.icp import Surface, icp
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.search import planar_candidates
from octoreplay.registration.verify import Verification, candidate_score, spread_of_normals, verify

TILT_SIGMA = math.radians(1.0)
"""Standard deviation of the angle between the vertical axes of two gravity-aligned robots [rad]."""

FINE_GATES = (2.0, 1.2)
"""Gates of the last stages of a registration [cell]."""

# Gates of the first refinement of every candidate [cell].
_COARSE_GATES = (5.0, 3.0)
_NUM_REFINED = 4
# Candidates are refined with one point in this many.
_THINNING = 3
# Two poses are one up to this shift [cell] and angle [degree]: after the first refinement, and as rivals.
_SAME_POSE, _RIVAL_POSE = (1.0, 1.0), (4.0, 8.0)
_UPWARDS = np.zeros((4, 4))
_UPWARDS[2, 3] = 1.0
# Share of the same ground cells under a right pose, and the score that a pose needs more for each share less, for each
# share of contradicting obstacles, and for each squared standard deviation of tilt.
_USUAL_GROUND_SAME = 0.985
_PER_UNLIKE_GROUND, _PER_CONTRA, _PER_TILT = 500.0, 1400.0, 68.0
# Edge of the cells for which the least score holds [m].
_SCORE_RESOLUTION = 0.3
# A refined candidate with more contradicting obstacles than this is wrong.
_EXCLUDING_CONTRA = 0.2


@dataclass(frozen=True)
class AcceptLimits:
    """Limits for the acceptance of a pose; docs/frames.md has the measurements behind them.

    Attributes
    ----------
    min_score : float
        Least log-likelihood ratio L of maps with a vertical axis, at cells of 0.3 m, where all cells agree. It grows
        with the number of cells on the same surface, with the shares that disagree, and with the tilt.
    min_cells : int
        Least number of obstacle cells that count, both maps together.
    max_contra : float
        Largest share q_c of obstacle cells that contradict.
    max_tilt : float
        Largest angle between the vertical axes [rad].
    min_shape_cells : int
        Least number of cells that count, without a vertical axis, mean of both maps.
    min_shape_same : float
        Least share q of each map's cells that are the same, without a vertical axis.
    min_shape_spread : float
        Least spread of the normals of these cells (``verify.spread_of_normals``): parallel planes fix no pose.
    """

    min_score: float = 170.0
    min_cells: int = 150
    max_contra: float = 0.1
    max_tilt: float = math.radians(2.5)
    min_shape_cells: int = 800
    min_shape_same: float = 0.96
    min_shape_spread: float = 0.1


@dataclass(frozen=True, eq=False)
class PairAlignment:
    """Pose between two robots' maps with the numbers behind it.

    Attributes
    ----------
    first, second : int
        Positions of the robots in the team, first < second.
    T_first_second : (4, 4) float64 array
        Best pose: maps the second robot's frame to the first one's. The identity where no candidate was found.
    information : (6, 6) float64 array
        Inverse covariance of a small motion (rotation [rad], translation [m]) on the left of the pose.
    verification : Verification
        Agreement of both maps under the pose.
    refusal : str
        The number that failed, as text; empty where the pose is accepted.
    """

    first: int
    second: int
    T_first_second: Float64Array
    information: Float64Array
    verification: Verification
    refusal: str

    @property
    def is_accepted(self) -> bool:
        """True where the pose is accepted."""
        return not self.refusal

    @property
    def tilt(self) -> float:
        """Angle between the vertical axes [rad]."""
        return tilt(self.T_first_second)


def tilt(T: Float64Array) -> float:
    """Return the angle between the vertical axes of both frames of a transform (4, 4) [rad]."""
    return math.acos(min(1.0, max(-1.0, float(T[2, 2]))))


def align_pair(
    maps: Sequence[OwnMap],
    first: int,
    second: int,
    *,
    dof: int = 4,
    guesses: Sequence[Float64Array] = (),
    limits: AcceptLimits | None = None,
) -> PairAlignment:
    """Return the pose between the maps of two robots, accepted or refused.

    ``dof`` is 4 where the vertical axes of the maps are known and 6 where they are not. ``guesses`` are further
    candidates for T_first_second (4, 4), such as surveyed poses.
    """
    limits = limits or AcceptLimits()
    matcher = _Matcher(maps[first], maps[second], dof == 4, limits)
    poses = []
    for T, information, agreement in matcher.refined_candidates(guesses):
        refusal = matcher.refusal(agreement, T)
        poses.append(PairAlignment(first, second, T, information, agreement, refusal))
    if not poses:
        nothing = matcher.verify(np.eye(4))
        return PairAlignment(first, second, np.eye(4), np.zeros((6, 6)), nothing, matcher.refusal(nothing, np.eye(4)))
    poses.sort(key=lambda pose: (not pose.is_accepted, -matcher.evidence(pose.verification)))
    best = poses[0]
    for rival in poses[1:]:
        if rival.is_accepted and matcher.is_distinct(best.T_first_second, rival.T_first_second, *_RIVAL_POSE):
            share = matcher.evidence(rival.verification) / matcher.evidence(best.verification)
            return replace(best, refusal=f"ambiguous: another pose fits with {share:.0%} of the evidence")
    return best


class _Matcher:
    """Candidates, refinement and verdict for one pair of maps."""

    def __init__(self, first: OwnMap, second: OwnMap, is_upright: bool, limits: AcceptLimits) -> None:
        self._first, self._second = first, second
        self._is_upright = is_upright
        self._limits = limits
        self._surfaces = [own.upright_surface if is_upright else own.surface for own in (first, second)]

    def verify(self, T: Float64Array) -> Verification:
        """Agreement of the maps under a pose."""
        return verify(self._first, self._second, T, is_upright=self._is_upright)

    def evidence(self, agreement: Verification) -> float:
        """Number by which poses are ranked."""
        return agreement.score if self._is_upright else agreement.least_same**4 * agreement.obstacles.total

    def refined_candidates(
        self, guesses: Sequence[Float64Array]
    ) -> list[tuple[Float64Array, Float64Array, Verification]]:
        """Poses with their information and verification: the best candidates and the guesses after refinement."""
        if len(self._first.occupied) == 0 or len(self._second.occupied) == 0:
            return []
        ranked = sorted(self._candidates(), key=lambda T: -self._rank(T))
        thin = [_thinned(surface) for surface in self._surfaces]
        refined: list[tuple[Float64Array, Float64Array, Verification]] = []
        for candidate in (*ranked[:_NUM_REFINED], *guesses):
            T, information = self._refine(thin, candidate, _COARSE_GATES)
            if any(not self.is_distinct(T, other, *_SAME_POSE) for other, _, _ in refined):
                continue
            agreement = self.verify(T)
            if agreement.obstacles.share_contra <= _EXCLUDING_CONTRA:
                T, information = self._refine(self._surfaces, T, FINE_GATES)
                agreement = self.verify(T)
            refined.append((T, information, agreement))
        return refined

    def refusal(self, agreement: Verification, T: Float64Array) -> str:
        """The number for which a pose is refused, as text; empty where it is accepted."""
        limits, obstacles = self._limits, agreement.obstacles
        min_cells = limits.min_cells if self._is_upright else 2 * limits.min_shape_cells
        if obstacles.total < min_cells:
            return f"overlap: {obstacles.total} obstacle cells, fewer than {min_cells}"
        if obstacles.share_contra > limits.max_contra:
            return f"q_c {obstacles.share_contra:.3f} above {limits.max_contra:g}"
        if not self._is_upright:
            return self._shape_refusal(agreement, T)
        if tilt(T) > limits.max_tilt:
            return f"tilt {math.degrees(tilt(T)):.1f} degrees, above {math.degrees(limits.max_tilt):.1f}"
        min_score = self._min_score(agreement, T)
        return "" if agreement.score >= min_score else f"L {agreement.score:.0f} below {min_score:.0f}"

    def _min_score(self, agreement: Verification, T: Float64Array) -> float:
        """Least score of a pose: the more cells disagree and the more it tilts, the more evidence it needs."""
        doubt = _PER_UNLIKE_GROUND * max(0.0, _USUAL_GROUND_SAME - agreement.ground.share_same)
        doubt += _PER_CONTRA * agreement.obstacles.share_contra + (tilt(T) / TILT_SIGMA) ** 2 * _PER_TILT
        return (self._limits.min_score + doubt) * (_SCORE_RESOLUTION / self._first.resolution) ** 2

    def _shape_refusal(self, agreement: Verification, T: Float64Array) -> str:
        """The number for which a pose without a vertical axis is refused; empty where it is accepted."""
        limits = self._limits
        if agreement.least_same < limits.min_shape_same:
            return f"q {agreement.least_same:.3f} in one direction, below {limits.min_shape_same:g}"
        spread = spread_of_normals(self._first, self._second, T)
        is_fixed = spread >= limits.min_shape_spread
        return (
            "" if is_fixed else f"shared surfaces are parallel: spread {spread:.3f} below {limits.min_shape_spread:g}"
        )

    def is_distinct(self, one: Float64Array, other: Float64Array, num_cells: float, degrees: float) -> bool:
        """True where two poses differ by more than a shift of the second map's centre or an angle."""
        centre = np.append(self._second.occupied.points.mean(axis=0), 1.0)
        shift = float(np.linalg.norm((one - other) @ centre))
        turn = float(np.trace(one[:3, :3].T @ other[:3, :3]))
        return shift > num_cells * self._first.resolution or turn < 1 + 2 * math.cos(math.radians(degrees))

    def _rank(self, T: Float64Array) -> float:
        """Number by which candidates are ranked before their refinement."""
        return candidate_score(self._first, self._second, T) if self._is_upright else self.evidence(self.verify(T))

    def _candidates(self) -> list[Float64Array]:
        """Candidate poses (4, 4)."""
        if not self._is_upright:
            points = self._first.described_points, self._second.described_points
            return feature_candidates(*points, self._first.resolution)
        return [self._at_best_height(T) for T in planar_candidates(self._first, self._second)]

    def _at_best_height(self, candidate: Float64Array) -> Float64Array:
        """The candidate at its height or one cell above or below, whichever verifies best."""
        shifts = (0.0, -self._first.resolution, self._first.resolution)
        poses = [candidate + shift * _UPWARDS for shift in shifts]
        return max(poses, key=self._rank)

    def _refine(
        self, surfaces: Sequence[Surface], T: Float64Array, gates: Sequence[float]
    ) -> tuple[Float64Array, Float64Array]:
        """The refined pose and its information."""
        target, source = surfaces
        sigma = TILT_SIGMA if self._is_upright else None
        result = icp(source, target, T, gates=[gate * self._first.resolution for gate in gates], tilt_sigma=sigma)
        return result.T_target_source, result.information


def _thinned(surface: Surface) -> Surface:
    """One in ``_THINNING`` points of a surface."""
    return surface.subset(np.arange(len(surface.points)) % _THINNING == 0)
