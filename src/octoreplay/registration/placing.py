"""Places of aligned robots in the frame of their team, with surveyed poses where there are some."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from octoreplay.records import Float64Array
from octoreplay.registration.covariance import chained_frames
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import AcceptLimits
from octoreplay.registration.team import TeamAlignment, worst_contradiction
from octoreplay.transforms import inverse, pose_difference

LARGEST_SURVEY_SHIFT, LARGEST_SURVEY_ANGLE = 1.0, math.radians(3.0)
"""Largest difference [m, rad] between a surveyed pose and the pose that the maps give, up to which both agree."""

# Squared Mahalanobis distance that 1 % of the errors of a pose exceed (chi-squared, six degrees of freedom).
_LARGEST_DISTANCE = 16.81


@dataclass(frozen=True, eq=False)
class PlacedRobot:
    """Place of one robot in its team.

    - ``index``: position of the robot in the input.
    - ``T_team_map`` (4, 4) float64: pose of its map.
    - ``covariance`` (6, 6) float64: rotation about the team's axes [rad], position [m]; relative to ``anchor``.
    - ``partner``: robot through whose pair it got its pose; None for an anchor.
    - ``anchor``: robot with a surveyed pose, or that of the team's frame, from which the pose was found.
    - ``is_verified``: the pair of another robot with a surveyed pose confirms that of this anchor.
    """

    index: int
    T_team_map: Float64Array
    covariance: Float64Array
    partner: int | None
    anchor: int
    is_verified: bool


@dataclass(frozen=True, eq=False)
class Refusal:
    """Surveyed pose of the robot ``index`` that contradicts the maps.

    ``other`` is the robot that it disagrees with. ``share_contra`` is the share q_c of obstacle cells in which their
    maps contradict each other; where both are aligned, it is None and ``shift`` [m] and ``angle`` [rad] are the
    difference between the surveyed and the aligned pose.
    """

    index: int
    other: int
    share_contra: float | None = None
    shift: float = 0.0
    angle: float = 0.0


@dataclass(frozen=True, eq=False)
class Placement:
    """Teams of robots whose frames are related, the largest first, and the surveyed poses that are refused."""

    teams: tuple[tuple[PlacedRobot, ...], ...]
    refusals: tuple[Refusal, ...]


def place_robots(
    maps: Sequence[OwnMap],
    alignment: TeamAlignment,
    surveyed: Mapping[int, Float64Array],
    *,
    dof: int = 4,
    limits: AcceptLimits | None = None,
) -> Placement:
    """Return the place of each robot in its team.

    ``dof`` is 4 where the vertical axes of the maps are known and 6 where they are not. ``surveyed`` are trusted poses
    T_team_map (4, 4) by robot.

    A component without a surveyed robot is a team in the frame of its first robot. All components with one form a
    single team in the surveyed frame. Each is placed by the surveyed pose that agrees with most others of the
    component. Another surveyed pose of the component is kept where it differs from that of the maps by no more than the
    covariance explains (99 %), and is replaced where it differs by more.

    Surveyed poses that the maps contradict are refused: within a component where the aligned pose differs by more than
    ``LARGEST_SURVEY_SHIFT`` or ``LARGEST_SURVEY_ANGLE``, between components where two maps contradict each other
    clearly; then the smaller component is a team of its own.
    """
    limits = limits or AcceptLimits()
    teams: list[tuple[PlacedRobot, ...]] = []
    together: list[PlacedRobot] = []
    refusals: list[Refusal] = []
    for component in alignment.components:
        known = [index for index in component if index in surveyed]
        if not known:
            teams.append(_placed(alignment, {component[0]: np.eye(4)}))
            continue
        anchor, refused = _anchor(alignment, known, surveyed)
        refusals += refused
        placed = _placed(alignment, _kept(alignment, anchor, {index: surveyed[index] for index in known}))
        worst = _worst_between(maps, together, placed, limits, is_upright=dof == 4)
        if worst is None:
            together += placed
        else:
            refusals += [Refusal(index, *worst) for index in known]
            teams.append(_placed(alignment, {component[0]: np.eye(4)}))
    if together:
        teams.insert(0, tuple(sorted(together, key=lambda robot: robot.index)))
    return Placement(tuple(sorted(teams, key=lambda team: -len(team))), tuple(refusals))


def _placed(alignment: TeamAlignment, anchors: Mapping[int, Float64Array]) -> tuple[PlacedRobot, ...]:
    """The robots of a component, from the poses (4, 4) of one or more of them."""
    robots = []
    for index, frame in sorted(chained_frames(alignment, list(anchors)).items()):
        T_team_root = anchors[frame.root]
        turn = np.kron(np.eye(2), T_team_root[:3, :3])
        T, covariance = T_team_root @ frame.T_root_map, turn @ frame.covariance @ turn.T
        robots.append(PlacedRobot(index, T, covariance, frame.partner, frame.root, len(anchors) > 1))
    return tuple(robots)


def _kept(alignment: TeamAlignment, anchor: int, surveyed: Mapping[int, Float64Array]) -> dict[int, Float64Array]:
    """The surveyed poses of a component that the covariances of the maps' poses explain, from that of the anchor on."""
    kept = {anchor: surveyed[anchor]}
    for robot in _placed(alignment, kept):
        if robot.index in surveyed and robot.index != anchor:
            T, given = robot.T_team_map, surveyed[robot.index]
            rotation = Rotation.from_matrix(given[:3, :3] @ T[:3, :3].T).as_rotvec()
            error = np.concatenate([rotation, given[:3, 3] - T[:3, 3]])
            if error @ np.linalg.solve(robot.covariance, error) <= _LARGEST_DISTANCE:
                kept[robot.index] = given
    return kept


def _anchor(
    alignment: TeamAlignment, known: Sequence[int], surveyed: Mapping[int, Float64Array]
) -> tuple[int, list[Refusal]]:
    """The surveyed robot of a component that agrees with most others, and the surveyed poses that disagree with it."""

    def refusals(anchor: int) -> list[Refusal]:
        T = surveyed[anchor] @ inverse(alignment.T_component_map[anchor])
        found = []
        for index in known:
            shift, angle = pose_difference(T @ alignment.T_component_map[index], surveyed[index])
            if shift > LARGEST_SURVEY_SHIFT or angle > LARGEST_SURVEY_ANGLE:
                found.append(Refusal(index, anchor, None, shift, angle))
        return found

    anchor = min(known, key=lambda index: len(refusals(index)))
    return anchor, refusals(anchor)


def _worst_between(
    maps: Sequence[OwnMap], team: Sequence[PlacedRobot], others: Sequence[PlacedRobot], limits: AcceptLimits, *,
    is_upright: bool,
) -> tuple[int, float] | None:  # fmt: skip
    """Robot of the team that contradicts another group most, with the share q_c; None without contradiction."""
    poses = [np.eye(4) for _ in maps]
    for robot in (*team, *others):
        poses[robot.index] = robot.T_team_map
    ones = [robot.index for robot in team]
    apart = [robot.index for robot in others]
    worst = worst_contradiction(maps, poses, ones, apart, np.eye(4), limits, is_upright=is_upright)
    if worst is None:
        return None
    return (worst[0] if worst[0] in ones else worst[1]), worst[2]
