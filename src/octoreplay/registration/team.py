"""Frames of a team: alignments of all pairs, joined into components in which all maps agree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from octoreplay.mapping.octree import Run
from octoreplay.records import Float64Array
from octoreplay.registration.joint import register_planes, register_together
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import FINE_GATES, TILT_SIGMA, AcceptLimits, PairAlignment, align_pair
from octoreplay.registration.verify import verify
from octoreplay.transforms import inverse, pose_difference

# Largest difference between two chains of poses that join the same robots [m], [rad].
_LARGEST_LOOP_SHIFT, _LARGEST_LOOP_ANGLE = 1.0, math.radians(3.0)


@dataclass(frozen=True, eq=False)
class TeamAlignment:
    """Frames of a team.

    Attributes
    ----------
    pairs : tuple of PairAlignment
        All pairs. A pair that is accepted by itself and contradicts the rest of the team is refused.
    components : tuple of tuples of int
        Robots whose frames are related, by position in the team; the largest component first, robots in their order.
    T_component_map : tuple of (4, 4) float64 arrays
        Pose of each robot's map in the frame of its component's first robot.
    parents : tuple of int or None
        Robot through whose pair each robot got its pose; None for the first robot of a component.
    """

    pairs: tuple[PairAlignment, ...]
    components: tuple[tuple[int, ...], ...]
    T_component_map: tuple[Float64Array, ...]
    parents: tuple[int | None, ...]


def align_team(
    maps: Sequence[OwnMap],
    *,
    dof: int = 4,
    guesses: Mapping[tuple[int, int], Sequence[Float64Array]] | None = None,
    limits: AcceptLimits | None = None,
    names: Sequence[str] | None = None,
    run: Run = map,
) -> TeamAlignment:
    """Return the frames of robots from their maps in their own frames.

    ``dof`` is 4 where the vertical axes of the maps are known and 6 where they are not. ``guesses`` are further
    candidates for T_first_second (4, 4) of pairs (first, second), first < second. ``names`` are the robots' names in
    refusals (default: their numbers from 1). ``run`` aligns the pairs, one call for each; the result does not depend on
    it.
    """
    limits = limits or AcceptLimits()
    known = guesses or {}

    def align(pair: tuple[int, int]) -> PairAlignment:
        return align_pair(maps, *pair, dof=dof, guesses=known.get(pair, ()), limits=limits)

    pairs = tuple(run(align, combinations(range(len(maps)), 2)))
    joined = join_pairs(maps, pairs, limits, names=names, is_upright=dof == 4)
    return refine_components(maps, joined, is_upright=dof == 4, run=run)


def refine_components(
    maps: Sequence[OwnMap], alignment: TeamAlignment, *, is_upright: bool = True, run: Run = map
) -> TeamAlignment:
    """Return an alignment whose poses are registered together in each component.

    The cells of three robots and more are registered first, and then the planes around the measured points where all
    maps have them. The pairs through which robots got their poses are changed with them. ``run`` is that of
    ``align_team``.
    """
    poses = list(alignment.T_component_map)
    for component in alignment.components:
        own = [maps[index] for index in component]
        found = [poses[index] for index in component]
        if len(component) > 2:
            surfaces = [map_.upright_surface if is_upright else map_.surface for map_ in own]
            gates = [gate * own[0].resolution for gate in FINE_GATES]
            found = register_together(surfaces, found, gates=gates, tilt_sigma=TILT_SIGMA if is_upright else None)
        planes = [of_map for of_map in run(lambda map_: map_.planes, own if len(own) > 1 else ()) if of_map is not None]
        if len(planes) == len(component) > 1:
            found = register_planes(planes, found, run=run)
        for index, T in zip(component, found, strict=True):
            poses[index] = T

    def refined(pair: PairAlignment) -> PairAlignment:
        i, j = pair.first, pair.second
        if alignment.parents[i] != j and alignment.parents[j] != i:
            return pair
        return replace(pair, T_first_second=inverse(poses[i]) @ poses[j])

    return replace(alignment, pairs=tuple(refined(pair) for pair in alignment.pairs), T_component_map=tuple(poses))


def join_pairs(
    maps: Sequence[OwnMap],
    pairs: Sequence[PairAlignment],
    limits: AcceptLimits,
    *,
    names: Sequence[str] | None = None,
    is_upright: bool = True,
) -> TeamAlignment:
    """Return the components that the accepted pairs form, best pair first.

    A pair that joins two components is refused where any two maps of both contradict each other under it; a pair within
    a component is refused where its pose differs from the component's.
    """
    num = len(maps)
    names = names or [f"robot {index + 1}" for index in range(num)]
    component = list(range(num))
    members = {index: [index] for index in range(num)}
    poses: list[Float64Array] = [np.eye(4) for _ in range(num)]
    parents: list[int | None] = [None] * num
    judged = {(pair.first, pair.second): pair for pair in pairs}
    for pair in sorted(pairs, key=lambda pair: -pair.verification.score):
        if not pair.is_accepted:
            continue
        i, j = pair.first, pair.second
        if component[i] == component[j]:
            refusal = _loop_refusal(poses[i] @ pair.T_first_second, poses[j])
        else:
            # The frame of j's component in that of i's.
            T = poses[i] @ pair.T_first_second @ inverse(poses[j])
            old, new = component[j], component[i]
            worst = worst_contradiction(maps, poses, members[new], members[old], T, limits, is_upright=is_upright)
            refusal = "" if worst is None else _contradiction(worst, names)
            if not refusal:
                for index in members[old]:
                    poses[index] = T @ poses[index]
                    component[index] = new
                _turn_parents(parents, j)
                parents[j] = i
                members[new] += members.pop(old)
        if refusal:
            judged[i, j] = replace(pair, refusal=refusal)
    groups = sorted((tuple(sorted(group)) for group in members.values()), key=lambda group: (-len(group), group))
    for group in groups:
        _turn_parents(parents, group[0])
        parents[group[0]] = None
        back = inverse(poses[group[0]])
        for index in group:
            poses[index] = back @ poses[index]
    return TeamAlignment(tuple(judged.values()), tuple(groups), tuple(poses), tuple(parents))


def _loop_refusal(one: Float64Array, other: Float64Array) -> str:
    """Reason to refuse a pair that closes a loop; empty where both poses (4, 4) agree."""
    shift, angle = pose_difference(one, other)
    if shift <= _LARGEST_LOOP_SHIFT and angle <= _LARGEST_LOOP_ANGLE:
        return ""
    return f"differs from the chain of better pairs by {shift:.1f} m and {math.degrees(angle):.1f} degrees"


def worst_contradiction(
    maps: Sequence[OwnMap], poses: Sequence[Float64Array], ones: Sequence[int], others: Sequence[int], T: Float64Array,
    limits: AcceptLimits,
    *, is_upright: bool = True,
) -> tuple[int, int, float] | None:  # fmt: skip
    """Return the two robots (first < second) of two groups that contradict each other most, with their share q_c.

    ``poses`` (4, 4) are those of each robot's map in its group's frame; ``T`` (4, 4) maps the frame of ``others`` to
    that of ``ones``. Returns None where no two maps contradict each other clearly.
    """
    found: list[tuple[int, int, float]] = []
    for i in ones:
        for j in others:
            pose = inverse(poses[i]) @ T @ poses[j]
            obstacles = verify(maps[i], maps[j], pose, is_upright=is_upright).obstacles
            if obstacles.total >= limits.min_cells and obstacles.share_contra > limits.max_contra:
                found.append((min(i, j), max(i, j), obstacles.share_contra))
    return max(found, key=lambda entry: entry[2], default=None)


def _contradiction(worst: tuple[int, int, float], names: Sequence[str]) -> str:
    """Reason not to join the groups of two robots that contradict each other."""
    first, second, share = worst
    return f"{names[first]} and {names[second]} would contradict each other (q_c {share:.3f})"


def _turn_parents(parents: list[int | None], root: int) -> None:
    """Make ``root`` the root of its tree: turn the parents on the way to the old root, in place."""
    below: int | None = None
    index: int | None = root
    while index is not None:
        above = parents[index]
        parents[index] = below
        below, index = index, above
