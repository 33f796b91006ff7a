"""Registration of two maps: candidates, verification, refinement, and acceptance or refusal with the reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.icp import Surface, icp
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.search import Candidate, planar_candidates
from octoreplay.registration.verify import Verification, verify
from octoreplay.transforms import inverse

TILT_SIGMA = math.radians(1.0)
"""Standard deviation of the angle between the vertical axes of two gravity-aligned robots [rad]."""

# Gates of the refinement [cell]: of every candidate, and of those that are not excluded by then.
_COARSE_GATES, _FINE_GATES = (5.0, 3.0, 2.0), (2.0, 1.2)
_NUM_REFINED = 4
# Candidates are refined with one point in this many.
_THINNING = 3
# A refined candidate with more contradicting obstacles than this is wrong.
_EXCLUDING_CONTRA = 0.2


@dataclass(frozen=True)
class AcceptLimits:
    """Limits for the acceptance of a pose; docs/frames.md has the measurements behind them.

    Attributes
    ----------
    min_score : float
        Least log-likelihood ratio L.
    min_cells : int
        Least number of obstacle cells that count.
    max_contra : float
        Largest share q_c of obstacle cells that contradict.
    max_tilt : float
        Largest angle between the vertical axes [rad].
    max_rival : float
        Largest score of another pose that is accepted by itself, relative to the best one.
    """

    min_score: float = 110.0
    min_cells: int = 150
    max_contra: float = 0.05
    max_tilt: float = math.radians(2.5)
    max_rival: float = 0.5


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
    guesses: Sequence[Float64Array] = (),
    limits: AcceptLimits | None = None,
) -> PairAlignment:
    """Return the pose between the maps of two robots whose vertical axes agree, accepted or refused.

    ``guesses`` are further candidates for T_first_second (4, 4), such as surveyed poses.
    """
    limits = limits or AcceptLimits()
    a, b = maps[first], maps[second]
    refined = _refined_candidates(a, b, guesses)
    poses = [_pair(a, b, first, second, *pose, limits) for pose in refined]
    if not poses:
        nothing = verify(a, b, np.eye(4))
        return PairAlignment(first, second, np.eye(4), np.zeros((6, 6)), nothing, "no candidate: too few known columns")
    poses.sort(key=lambda pose: (not pose.is_accepted, -pose.verification.score))
    best = poses[0]
    for rival in poses[1:]:
        if best.is_accepted and rival.is_accepted and _is_distinct(best, rival, a.columns.edge):
            share = rival.verification.score / best.verification.score
            if share > limits.max_rival:
                return _refused(best, f"another pose fits as well (L {rival.verification.score:.0f} of "
                                      f"{best.verification.score:.0f})")  # fmt: skip
    return best


def refusal_of(verification: Verification, tilt_angle: float, limits: AcceptLimits) -> str:
    """Return the number for which a pose is refused, as text; empty where it is accepted."""
    obstacles = verification.obstacles
    if obstacles.total < limits.min_cells:
        return f"overlap: {obstacles.total} obstacle cells, fewer than {limits.min_cells}"
    if obstacles.share_contra > limits.max_contra:
        return f"q_c {obstacles.share_contra:.3f} above {limits.max_contra:g}"
    if tilt_angle > limits.max_tilt:
        return f"tilt {math.degrees(tilt_angle):.1f} degrees, above {math.degrees(limits.max_tilt):.1f}"
    if verification.score < limits.min_score:
        return f"L {verification.score:.0f} below {limits.min_score:.0f}"
    return ""


def _refined_candidates(
    a: OwnMap, b: OwnMap, guesses: Sequence[Float64Array]
) -> list[tuple[Float64Array, Float64Array, Verification]]:
    """Poses with their information and verification: the best candidates after refinement."""
    levelled = [_at_best_height(a, b, candidate) for candidate in planar_candidates(a, b)]
    levelled += [(verify(a, b, guess).score, guess) for guess in guesses]
    levelled.sort(key=lambda candidate: -candidate[0])
    thin_b, thin_a = _thinned(b.surface), _thinned(a.surface)
    refined = []
    for _, T in levelled[:_NUM_REFINED]:
        coarse = _refine(thin_b, thin_a, T, _COARSE_GATES, a.resolution)
        agreement = verify(a, b, coarse[0])
        if agreement.obstacles.share_contra <= _EXCLUDING_CONTRA:
            coarse = _refine(b.surface, a.surface, coarse[0], _FINE_GATES, a.resolution)
            agreement = verify(a, b, coarse[0])
        refined.append((*coarse, agreement))
    return refined


def _at_best_height(a: OwnMap, b: OwnMap, candidate: Candidate) -> tuple[float, Float64Array]:
    """The candidate at its height or one cell above or below, whichever verifies best, with its score."""
    poses = []
    for cells in (0, -1, 1):
        T = candidate.T_first_second.copy()
        T[2, 3] += cells * a.resolution
        poses.append((verify(a, b, T).score, T))
    return max(poses, key=lambda pose: pose[0])


def _refine(
    source: Surface, target: Surface, T: Float64Array, gates: Sequence[float], resolution: float
) -> tuple[Float64Array, Float64Array]:
    """The refined pose and its information."""
    result = icp(source, target, T, gates=[gate * resolution for gate in gates], tilt_sigma=TILT_SIGMA)
    return result.T_target_source, result.information


def _thinned(surface: Surface) -> Surface:
    """One in ``_THINNING`` points of a surface."""
    return surface.subset(np.arange(len(surface.points)) % _THINNING == 0)


def _pair(
    a: OwnMap, b: OwnMap, first: int, second: int, T: Float64Array, information: Float64Array, agreement: Verification,
    limits: AcceptLimits,
) -> PairAlignment:  # fmt: skip
    """The pose of a pair with its verdict."""
    return PairAlignment(first, second, T, information, agreement, refusal_of(agreement, tilt(T), limits))


def _refused(pair: PairAlignment, reason: str) -> PairAlignment:
    """The pair, refused for a reason."""
    return PairAlignment(pair.first, pair.second, pair.T_first_second, pair.information, pair.verification, reason)


def _is_distinct(one: PairAlignment, other: PairAlignment, edge: float) -> bool:
    """True where two poses differ by more than two columns or 8 degrees."""
    difference = inverse(one.T_first_second) @ other.T_first_second
    angle = math.acos(min(1.0, max(-1.0, (float(np.trace(difference[:3, :3])) - 1) / 2)))
    return float(np.linalg.norm(difference[:3, 3])) > 2 * edge or angle > math.radians(8)
