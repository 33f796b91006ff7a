"""Known transforms between robots: position fixes and tags in their logs, and guesses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from octoreplay.geodesy import enu_points
from octoreplay.io.robots.sightings import Sightings
from octoreplay.records import Float64Array
from octoreplay.registration.known_places import KnownPose, fit_fixes, fit_tags, tag_place
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.search import climbed_pose
from octoreplay.transforms import inverse, pose_difference

# Difference from a known transform that is always explained [m], [rad], and that beyond it [standard deviations].
_SAME_SHIFT, _SAME_ANGLE, _SAME_SIGMAS = 1.0, math.radians(5.0), 3.0

# Standard deviations that a guess is taken to have [m], [rad].
_GUESS_SHIFT, _GUESS_ANGLE = 0.5, math.radians(3.0)
_GUESSES = "the guesses"


@dataclass(frozen=True, eq=False)
class Prior:
    """Known transform between the map frames of two robots, first < second by position in the team.

    ``pose`` is T_first_second with its standard deviations, ``source`` names the places that it comes from.
    """

    first: int
    second: int
    pose: KnownPose
    source: str

    def explains(self, pair: PairAlignment, maps: Sequence[OwnMap]) -> bool:
        """True where an accepted pair of these robots differs no more than the standard deviations explain."""
        shift, angle = self.difference(pair, maps)
        centres = (maps[index].occupied.points.mean(axis=0) for index in (self.first, self.second))
        T, (first, second) = pair.T_first_second, centres
        arm = float(np.linalg.norm((T[:3, :3] @ second + T[:3, 3] - first)[:2]))
        shift_sigma = self.pose.shift_sigma + self.pose.angle_sigma * arm
        is_near = shift <= max(_SAME_SHIFT, _SAME_SIGMAS * shift_sigma)
        return is_near and angle <= max(_SAME_ANGLE, _SAME_SIGMAS * self.pose.angle_sigma)

    def difference(self, pair: PairAlignment, maps: Sequence[OwnMap]) -> tuple[float, float]:
        """Return the horizontal distance [m], at the second map's centre, and the angle [rad] from a pair's pose."""
        centre = np.append(maps[self.second].occupied.points.mean(axis=0), 1.0)
        _, angle = pose_difference(pair.T_first_second, self.pose.T)
        return float(np.linalg.norm(((pair.T_first_second - self.pose.T) @ centre)[:2])), angle

    def gap(self, maps: Sequence[OwnMap]) -> float:
        """Return a lower limit of the horizontal distance between both maps' occupied cells [m]; 0 if they may overlap.

        It is the distance between circles around the cells, less three standard deviations.
        """
        ones, others = (maps[index].occupied.points[:, :2] for index in (self.first, self.second))
        if not len(ones) or not len(others):
            return 0.0
        centre = np.append(maps[self.second].occupied.points.mean(axis=0), 1.0)
        between = float(np.linalg.norm((self.pose.T @ centre)[:2] - ones.mean(axis=0)))
        radii = sum(float(np.linalg.norm(points - points.mean(axis=0), axis=1).max()) for points in (ones, others))
        return max(0.0, between - radii - _SAME_SIGMAS * self.pose.shift_sigma)


class Priors:
    """Known transforms between a team's robots, from what each robot saw and from guesses.

    ``maps`` are in the robots' map frames, ``sightings`` None where nothing is known. ``guessed`` are poses (4, 4) of
    maps by position of the robot, all in one frame. ``is_upright`` is True where the map frames have a vertical z axis;
    fixes are used only there.
    """

    def __init__(
        self,
        robot_ids: Sequence[str],
        maps: Sequence[OwnMap],
        sightings: Sequence[Sightings] | None,
        guessed: Mapping[int, Float64Array],
        *,
        is_upright: bool,
    ) -> None:
        self._robot_ids, self._maps, self._is_upright = robot_ids, maps, is_upright
        seen = sightings or ()
        fixed, fix_notes = _fixed_frames(robot_ids, seen, is_upright)
        tagged, tag_notes = _tag_priors(robot_ids, seen, is_upright)
        by_fixes = [Prior(i, j, fixed[j].relative_to(fixed[i]), "position fixes") for i, j in combinations(fixed, 2)]
        self._priors = [*by_fixes, *tagged]
        self._guesses = [
            Prior(i, j, KnownPose(inverse(guessed[i]) @ guessed[j], _GUESS_SHIFT, _GUESS_ANGLE), _GUESSES)
            for i, j in combinations(guessed, 2)
        ]
        self._notes = [*(note for robot in seen for note in robot.notes), *fix_notes, *tag_notes]
        if len(guessed) == 1:
            self._notes.append(
                f"the guess for {robot_ids[next(iter(guessed))]} is not used: it needs that of another robot"
            )

    def candidates(self, first: int, second: int) -> list[Float64Array]:
        """Return poses T_first_second (4, 4) to try.

        These are the known ones without guesses, and for maps with a vertical axis the most likely one near each.
        """
        known = [prior.pose.T for prior in self._priors if (prior.first, prior.second) == (first, second)]
        if not self._is_upright:
            return known
        return [T for pose in known for T in (pose, climbed_pose(self._maps[first], self._maps[second], pose))]

    def agreeing(self, pair: PairAlignment) -> list[str]:
        """Return the sources of known transforms that agree with an accepted pair."""
        own = self._of(pair.first, pair.second) if pair.is_accepted else ()
        return [prior.source for prior in own if prior.explains(pair, self._maps)]

    def notes(self, pairs: Sequence[PairAlignment], team: Sequence[int]) -> Iterator[str]:
        """Yield sentences on known places that are not used, that differ from accepted pairs, or that explain refusals.

        Refusals are explained for robots that are not in ``team``.
        """
        yield from self._notes
        refused = []
        for pair in pairs:
            for prior in self._of(pair.first, pair.second):
                if not pair.is_accepted:
                    refused.append(prior)
                elif not prior.explains(pair, self._maps):
                    shift, angle = prior.difference(pair, self._maps)
                    verdict = "they are not used" if prior.source == _GUESSES else "one is wrong"
                    yield (
                        f"{self._robot_ids[pair.second]} is aligned with {self._robot_ids[pair.first]} {shift:.1f} m "
                        f"and {math.degrees(angle):.1f} degrees from where {prior.source} place it: {verdict}"
                    )
        outside = [index for index in range(len(self._robot_ids)) if index not in team]
        nearest = (self._nearest(index, refused) for index in outside)
        for prior in dict.fromkeys(prior for prior in nearest if prior is not None):
            one, other = self._robot_ids[prior.first], self._robot_ids[prior.second]
            gap = prior.gap(self._maps)
            yield (
                f"{prior.source} place {other} at least {gap:.0f} m from {one}: their maps cannot overlap"
                if gap > 0
                else f"{prior.source} place {other} near {one}, but are not used: the maps do not confirm it"
            )

    def _nearest(self, index: int, priors: Sequence[Prior]) -> Prior | None:
        """The known transform of a robot to the nearest other one; None without any."""
        own = [prior for prior in priors if index in (prior.first, prior.second)]
        return min(own, key=lambda prior: prior.gap(self._maps), default=None)

    def _of(self, first: int, second: int) -> list[Prior]:
        """Known transforms between two robots, guesses included."""
        both = (*self._priors, *self._guesses)
        return [prior for prior in both if (prior.first, prior.second) == (first, second)]


def _tag_priors(
    robot_ids: Sequence[str], sightings: Sequence[Sightings], is_upright: bool
) -> tuple[list[Prior], list[str]]:
    """Known transforms from common tags, and sentences on tags that are not used."""
    priors, notes = [], []
    tags: list[dict[str, Float64Array]] = []
    for index, seen in enumerate(sightings):
        places = {name: tag_place(poses) for name, poses in seen.tags.items()}
        tags.append({name: place for name, place in places.items() if place is not None})
        moved = [name for name, place in places.items() if place is None]
        notes += [
            f"tag {name} of {robot_ids[index]} is not used: it was seen at places over 1 m apart" for name in moved
        ]
    for i, j in combinations(range(len(tags)), 2):
        pose = fit_tags(tags[i], tags[j], is_upright=is_upright)
        if pose is not None and pose.refusal:
            notes.append(f"the tags that {robot_ids[i]} and {robot_ids[j]} saw are not used: {pose.refusal}")
        elif pose is not None:
            priors.append(Prior(i, j, pose, f"sightings of tag{'s' * (len(pose.names) > 1)} {', '.join(pose.names)}"))
    return priors, notes


def _fixed_frames(
    robot_ids: Sequence[str], sightings: Sequence[Sightings], is_upright: bool
) -> tuple[dict[int, KnownPose], list[str]]:
    """Map frames that position fixes place east, north and up of the first robot's, and sentences on the others."""
    fixes = {index: seen.fixes for index, seen in enumerate(sightings) if len(seen.fixes)}
    if fixes and not is_upright:
        return {}, ["position fixes are not used: they need map frames with a vertical z axis (--dof 4)"]
    poses, notes = {}, []
    for index, found in fixes.items():
        # The median is no outlier; 'lower' keeps it a value of one fix where longitudes change their sign.
        origin = np.quantile(next(iter(fixes.values())).geodetic, 0.5, axis=0, method="lower")
        pose = fit_fixes(found.points_map, enu_points(found.geodetic, origin), found.sigmas, found.seconds)
        if pose.refusal:
            notes.append(f"the position fixes of {robot_ids[index]} are not used: {pose.refusal}")
        else:
            poses[index] = pose
    return poses, notes
