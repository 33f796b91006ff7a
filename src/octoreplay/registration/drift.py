"""Repair of drift: corrected trajectories of a team from its submaps, by registration and a robust pose graph."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from octoreplay.mapping.octree import Run
from octoreplay.records import Float64Array, Int64Array
from octoreplay.registration.pose_graph import Bias, PoseGraphEdge, PosePrior, solve
from octoreplay.registration.rigid import inverses, rotation_exps, rotation_logs
from octoreplay.registration.submaps import Submap, overlapping_pairs, register
from octoreplay.transforms import inverse

# Largest distances between corresponding points, one round each [voxel].
_GATES = (10.0, 8.0, 6.0, 5.0, 4.0, 3.5, 3.0, 3.0, 3.0)
# Gate from which on registrations must fit [voxel].
_FINAL_GATE = 3.25
# Way after which the random part of the drift has the same variance as the systematic part [m].
_REFERENCE_WAY = 50.0
_SYSTEMATIC_SHARE = 0.8
# Error of a recorded motion that does not depend on its length: interpolation and stamps [m], [rad].
_SHIFT_FLOOR, _ANGLE_FLOOR = 0.005, 0.001
_VERTICAL_WAY = 10.0


@dataclass(frozen=True)
class DriftModel:
    """Standard deviations of the recorded poses' errors.

    Attributes
    ----------
    percent, degrees : float
        Drift: position [% of the way], heading [degrees per 10 m of way].
    frame_shift, frame_angle : float
        Error of T_team_map: position [m] and rotation about each axis [degrees].
    """

    percent: float = 1.0
    degrees: float = 0.5
    frame_shift: float = 0.3
    frame_angle: float = 1.0


@dataclass(frozen=True, eq=False)
class Track:
    """Recorded poses of one robot's sensor: stamps (n,) [ns] and T_team_sensor (n, 4, 4) float64."""

    stamps_ns: Int64Array
    poses: Float64Array


@dataclass(frozen=True, eq=False)
class Repair:
    """Corrected anchors of submaps.

    - ``poses`` (n, 4, 4) float64: T_team_anchor of each submap.
    - ``edges``: measured transforms between submaps that were accepted.
    - ``groups``: robots that such edges connect, by position in the team; a robot without edges is no group's member.
    """

    poses: Float64Array
    edges: tuple[PoseGraphEdge, ...]
    num_rejected: int
    groups: tuple[tuple[int, ...], ...]


def repair_drift(
    submaps: Sequence[Submap],
    tracks: Sequence[Track],
    model: DriftModel,
    *,
    run: Run = map,
    progress: Callable[[float], None] | None = None,
) -> Repair:
    """Return the corrected anchors of all robots' submaps, which are ordered by robot and stamp.

    Rounds of registration from the current poses and of the pose graph, with smaller and smaller distances between
    corresponding points. Odometry joins the submaps of a robot: random errors in proportion to the square root of the
    way, and a scale error and a turn per metre that are constant for each robot (Borenstein and Feng, Measurement and
    Correction of Systematic Odometry Errors in Mobile Robots, T-RA 1996). Priors keep each robot's first pose near the
    given one. ``run`` registers the pairs, one call for each; the result does not depend on it.
    """
    poses = np.array([submap.T_team_anchor for submap in submaps])
    odometry = list(_odometry_edges(submaps, tracks, model))
    priors = _frame_priors(submaps, model)
    bias_information = np.tile(np.eye(2), (len(tracks), 1, 1))
    edges: list[PoseGraphEdge] = []
    weights = np.empty(0)
    for number, gate in enumerate(_GATES):

        def edge_of(pair: tuple[int, int], poses: Float64Array = poses, gate: float = gate) -> PoseGraphEdge | None:
            first, second = submaps[pair[0]], submaps[pair[1]]
            guess = inverse(poses[pair[0]]) @ poses[pair[1]]
            found = register(first, second, guess, gate * first.planes.spacing, is_final=gate < _FINAL_GATE)
            return None if found is None else PoseGraphEdge(*pair, found.T_first_second, found.information)

        found = run(edge_of, overlapping_pairs(submaps, poses))
        edges = [edge for edge in found if edge is not None]
        solution = solve(poses, [*odometry, *edges], priors, bias_information=bias_information)
        poses, weights = solution.poses, solution.weights[len(odometry) :]
        if progress is not None:
            progress((number + 1) / len(_GATES))
    accepted = tuple(edge for edge, weight in zip(edges, weights, strict=True) if weight > 0)
    return Repair(poses, accepted, len(edges) - len(accepted), _groups(submaps, accepted))


def _groups(submaps: Sequence[Submap], edges: Sequence[PoseGraphEdge]) -> tuple[tuple[int, ...], ...]:
    """Robots with edges, grouped by the edges between robots."""
    members: dict[int, set[int]] = {}
    for edge in edges:
        robots = {submaps[edge.first].robot, submaps[edge.second].robot}
        joined = set().union(robots, *(members.get(robot, set()) for robot in robots))
        members.update(dict.fromkeys(joined, joined))
    return tuple(sorted({tuple(sorted(group)) for group in members.values()}))


def _frame_priors(submaps: Sequence[Submap], model: DriftModel) -> list[PosePrior]:
    """Prior of each robot's first anchor."""
    sigmas = np.repeat([math.radians(model.frame_angle), model.frame_shift], 3)
    firsts = {submap.robot: index for index, submap in reversed(list(enumerate(submaps)))}
    return [PosePrior(index, submaps[index].T_team_anchor, np.diag(sigmas**-2.0)) for index in firsts.values()]


def _odometry_edges(submaps: Sequence[Submap], tracks: Sequence[Track], model: DriftModel) -> Iterable[PoseGraphEdge]:
    """Edges between consecutive submaps of each robot."""
    for index, (first, second) in enumerate(itertools.pairwise(submaps)):
        if first.robot == second.robot:
            yield _odometry_edge(index, first, second, tracks[first.robot], model)


def _odometry_edge(index: int, first: Submap, second: Submap, track: Track, model: DriftModel) -> PoseGraphEdge:
    """Edge between two consecutive submaps with the drift's covariance and the robot's systematic error."""
    between = (track.stamps_ns >= first.stamp_ns) & (track.stamps_ns <= second.stamp_ns)
    positions = track.poses[between, :3, 3]
    motions = np.diff(positions, axis=0)
    ways = np.linalg.norm(motions, axis=1)
    way = float(ways.sum()) + 0.2
    per_metre = np.array([model.percent / 100.0, math.radians(model.degrees / 10.0)])
    shift, angle = per_metre * math.sqrt((1.0 - _SYSTEMATIC_SHARE) * _REFERENCE_WAY * way)
    # Height, roll and pitch are bounded by a barometer and an inertial unit.
    bounded = min(1.0, math.sqrt(2.0 * way / _VERTICAL_WAY))
    height, tilt = per_metre * _VERTICAL_WAY * bounded * (1.0, 0.2)
    sigmas = np.array([tilt, tilt, angle, shift, shift, height]) + np.repeat([_ANGLE_FLOOR, _SHIFT_FLOOR], 3)
    rotation = first.T_team_anchor[:3, :3]
    to_team = np.kron(np.eye(2), rotation)
    information = to_team.T @ np.diag(sigmas**-2.0) @ to_team
    # Effects of a scale error and of a turn per metre on the last pose, for one standard deviation each.
    arms = positions[-1] - (positions[1:] + positions[:-1]) / 2
    turned = (np.cross([0.0, 0.0, 1.0], arms) * ways[:, None]).sum(axis=0)
    effects = np.zeros((6, 2))
    effects[3:, 0] = rotation.T @ (positions[-1] - positions[0])
    effects[:3, 1], effects[3:, 1] = rotation.T @ [0.0, 0.0, ways.sum()], rotation.T @ turned
    bias = Bias(first.robot, -effects * per_metre * math.sqrt(_SYSTEMATIC_SHARE))
    measured = inverse(first.T_team_anchor) @ second.T_team_anchor
    return PoseGraphEdge(index, index + 1, measured, information, is_trusted=True, bias=bias)


@dataclass(frozen=True, eq=False)
class Correction:
    """Correction of one robot's poses: ``transforms`` (k, 4, 4) at ``stamps_ns`` (k,), ascending, k >= 1.

    A transform maps a recorded pose in the team's frame to the corrected one.
    """

    stamps_ns: Int64Array
    transforms: Float64Array

    def corrected(self, stamps_ns: Int64Array, poses: Float64Array) -> Float64Array:
        """Return corrected poses (n, 4, 4) of recorded poses (n, 4, 4) at stamps (n,).

        Between two stamps of the correction, both corrected poses are blended linearly in position and by slerp in
        rotation; before the first and after the last stamp, that correction holds.
        """
        last = len(self.stamps_ns) - 1
        before = np.clip(np.searchsorted(self.stamps_ns, stamps_ns, side="right") - 1, 0, last)
        after = np.minimum(before + 1, last)
        span = np.maximum(self.stamps_ns[after] - self.stamps_ns[before], 1)
        fraction = np.clip((stamps_ns - self.stamps_ns[before]) / span, 0.0, 1.0)[:, None]
        first, second = self.transforms[before] @ poses, self.transforms[after] @ poses
        turn = rotation_logs((inverses(first) @ second)[:, :3, :3])
        result = first.copy()
        result[:, :3, 3] += fraction * (second[:, :3, 3] - first[:, :3, 3])
        result[:, :3, :3] = first[:, :3, :3] @ rotation_exps(fraction * turn)
        return result


def correction_of(robot: int, submaps: Sequence[Submap], poses: Float64Array) -> Correction | None:
    """Return the correction of one robot from the corrected poses (n, 4, 4) of all submaps' anchors.

    A robot without submaps has none.
    """
    own = [index for index, submap in enumerate(submaps) if submap.robot == robot]
    if not own:
        return None
    recorded = np.array([submaps[index].T_team_anchor for index in own]).reshape(-1, 4, 4)
    stamps = np.array([submaps[index].stamp_ns for index in own], np.int64)
    return Correction(stamps, poses[own] @ inverses(recorded))
