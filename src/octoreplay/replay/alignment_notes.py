"""Sentences on an alignment: given poses, odd maps, and remedies for refused pairs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from octoreplay.records import Float64Array
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import AcceptLimits, PairAlignment, tilt
from octoreplay.registration.placing import PlacedRobot, Refusal

# Share of the same ground below which the vertical axes may differ.
_LEAST_GROUND_SAME = 0.1


def difference(shift: float, angle: float) -> str:
    """Return the difference of two poses [m], [rad] as text."""
    return f"{shift:.2f} m and {math.degrees(angle):.1f} degrees"


def problem(refusal: Refusal, robot_ids: Sequence[str]) -> str:
    """Return a sentence on a given pose that the maps contradict."""
    robot_id, other = robot_ids[refusal.index], robot_ids[refusal.other]
    if refusal.share_contra is None:
        return (
            f"the T_team_map given for {robot_id} is not used: it disagrees with that of {other}, from which the maps"
            f" place {robot_id} {difference(refusal.shift, refusal.angle)} elsewhere"
        )
    return (
        f"the T_team_map given for {robot_id} is not used: under it the maps of {robot_id} and {other} contradict each"
        f" other (q_c {refusal.share_contra:.3f})"
    )


def unverified(
    team: Sequence[PlacedRobot], given: Mapping[int, Float64Array], robot_ids: Sequence[str]
) -> Iterator[str]:
    """Yield sentences on robots of the team with given poses that no overlap verifies."""
    for robot in team:
        is_alone = not any(other.anchor == robot.index != other.index for other in team)
        if robot.index in given and robot.partner is None and is_alone and not robot.is_verified:
            yield f"{robot_ids[robot.index]} keeps its given T_team_map, which no overlap with other maps verifies"


def odd_maps(maps: Sequence[OwnMap], robot_ids: Sequence[str]) -> Iterator[str]:
    """Yield sentences on empty and on equal maps."""
    for own, robot_id in zip(maps, robot_ids, strict=True):
        if not own.states.any():
            yield f"the map of {robot_id} is empty: check max_range, body_box and the poses"
    for i, j in combinations(range(len(maps)), 2):
        is_equal = np.array_equal(maps[i].low, maps[j].low) and np.array_equal(maps[i].states, maps[j].states)
        if is_equal and maps[i].states.any():
            yield f"{robot_ids[i]} and {robot_ids[j]} have equal maps: are their logs the same?"


def tilted(given: Mapping[int, Float64Array], robot_ids: Sequence[str]) -> Iterator[str]:
    """Yield sentences on given poses (4, 4) whose z axis is not vertical, for robots with vertical axes."""
    for index, T in given.items():
        if tilt(T) > AcceptLimits().max_tilt:
            yield (
                f"the T_team_map given for {robot_ids[index]} tilts its z axis by {math.degrees(tilt(T)):.0f} degrees;"
                " --dof 4 expects vertical axes"
            )


def refusal_with_remedy(pair: PairAlignment, dof: int, resolution: float) -> str:
    """Return the refusal of a pair, with the option that may help where maps of this resolution [m] share little."""
    if not pair.refusal.startswith("overlap:"):
        return pair.refusal
    if dof == 6:
        return f"{pair.refusal}; finer cells may give enough (--resolution {resolution / 2:g})"
    if pair.verification.ground.share_same < _LEAST_GROUND_SAME:
        return f"{pair.refusal}; where the z axis of a map is not vertical, use --dof 6"
    return pair.refusal
