"""Alignment of a team: frames of the robots from their own maps, and the configuration that holds them."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.subteam import subteam
from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.sightings import Sightings
from octoreplay.records import TEAM_ORIGIN, Float64Array
from octoreplay.registration.covariance import about_point
from octoreplay.registration.own_map import OwnMap
from octoreplay.registration.pairs import PairAlignment
from octoreplay.registration.placing import PlacedRobot, place_robots
from octoreplay.registration.team import TeamAlignment, align_team
from octoreplay.replay.alignment_notes import (
    difference,
    odd_maps,
    problem,
    refusal_with_remedy,
    tilted,
    unverified,
)
from octoreplay.replay.own_maps import OwnEvidence, own_evidences, own_map_of, own_maps
from octoreplay.replay.priors import Priors
from octoreplay.result import Result
from octoreplay.transforms import inverse, numbers_of, pose_difference, transform_of

Frames = Mapping[str, Sequence[float]]
"""T_team_map (x, y, z, qx, qy, qz, qw) by robot_id."""

_Config = TypeVar("_Config", bound=RunConfig)


@dataclass(frozen=True, eq=False)
class RobotFrame:
    """Frame of one robot in its team.

    Attributes
    ----------
    robot_id : str
        The robot.
    T_team_map : (4, 4) float64 array
        Pose of the robot's map frame in the team's frame.
    covariance : (6, 6) float64 array or None
        Covariance of the rotation about the team's axes [rad] and of the map frame's origin [m], relative to the robot
        whose frame the team's is or whose pose was given; None for such a robot.
    origin : str
        Phrase on the origin of the pose.
    evidence : str
        Numbers behind the accepted pair that gave the pose (docs/frames.md); empty without such a pair.
    partner : str or None
        Robot through whose pair the pose was found; None where it was given or is the team's frame.
    is_given : bool
        True where the T_team_map of the configuration was kept.
    """

    robot_id: str
    T_team_map: Float64Array
    covariance: Float64Array | None
    origin: str
    evidence: str
    partner: str | None
    is_given: bool

    @property
    def sigma(self) -> tuple[float, ...] | None:
        """Standard deviations of the position along x, y, z [m] and of the rotation about x, y, z [rad]."""
        if self.covariance is None:
            return None
        deviations = np.sqrt(np.diag(self.covariance))
        return tuple(round(float(value), 6) for value in (*deviations[3:], *deviations[:3]))


@dataclass(frozen=True, eq=False)
class Alignment:
    """Frames of a team with the numbers behind them.

    Attributes
    ----------
    dof : int
        4 for robots whose map frames have a vertical z axis, 6 for others.
    robot_ids : tuple of str
        All robots.
    maps : tuple of OwnMap
        The robots' own maps, each in the frame that ``T_map_own`` places in the robot's map frame.
    T_map_own : tuple of (4, 4) float64 arrays
        The identity for maps from logs; for evidence of a result, which is in the robot's last frame of that run, the
        inverse of its T_frame_map (``Result.places``).
    T_team_own_before : tuple of (4, 4) float64 arrays
        Poses of the maps before the alignment: as configured, or the identity that is assumed.
    pairs : tuple of PairAlignment
        All pairs, by position in ``robot_ids``, in the frames of ``maps``.
    teams : tuple of tuple of RobotFrame
        Robots whose frames are related, the largest team first. The first is the team that the others are left out of.
    problems : tuple of str
        Sentences on given poses that the maps contradict.
    notes : tuple of str
        Sentences on given poses that no overlap verifies, on empty and equal maps, and on known places in the logs that
        are not used or that disagree with the maps.
    """

    dof: int
    robot_ids: tuple[str, ...]
    maps: tuple[OwnMap, ...] = field(repr=False)
    T_map_own: tuple[Float64Array, ...] = field(repr=False)
    T_team_own_before: tuple[Float64Array, ...] = field(repr=False)
    pairs: tuple[PairAlignment, ...]
    teams: tuple[tuple[RobotFrame, ...], ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...]

    def as_table(self) -> Table:
        """Return the robots' frames as a table, one row per robot, those of the first team first.

        The columns are team (position in ``teams``), the texts and flags of RobotFrame, T_team_map as x, y, z [m], qx,
        qy, qz, qw, and the standard deviations sigma_x, sigma_y, sigma_z [m], sigma_rx, sigma_ry, sigma_rz [rad].
        """
        rows = [(index, frame) for index, team in enumerate(self.teams) for frame in team]
        poses = np.array([numbers_of(frame.T_team_map) for _, frame in rows]).reshape(-1, 7)
        sigmas = np.array([frame.sigma or (np.nan,) * 6 for _, frame in rows]).reshape(-1, 6)
        first = {"team": np.array([index for index, _ in rows], dtype=np.int64)}
        frames = Table.from_records(RobotFrame, [frame for _, frame in rows], first)
        numbers = dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), poses.T, strict=True))
        names = [f"sigma_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")]
        return Table({**frames.columns, **numbers, **dict(zip(names, sigmas.T, strict=True))})

    @property
    def left_out(self) -> tuple[str, ...]:
        """Robots whose frames nothing relates to the first team."""
        team = {frame.robot_id for frame in self.teams[0]}
        return tuple(robot_id for robot_id in self.robot_ids if robot_id not in team)

    @property
    def is_whole(self) -> bool:
        """True where all robots are in one team and the maps contradict no given pose."""
        return not self.left_out and not self.problems

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on robots that are left out, and on given poses that are refused or that no overlap verifies."""
        return (*self.reasons(), *self.problems, *self.notes)

    def best_refused(self, robot_id: str) -> PairAlignment:
        """Return the pair of a robot that came closest to acceptance: that with the largest L, refused or not."""
        index = self.robot_ids.index(robot_id)
        own = [pair for pair in self.pairs if index in (pair.first, pair.second)]
        return max(own, key=lambda pair: pair.verification.score)

    def reasons(self) -> tuple[str, ...]:
        """Return a sentence for each robot that is left out of a team: its best pair and the number that failed."""
        sentences: list[str] = []
        for robot_id in self.left_out if len(self.teams[0]) > 1 else ():
            pair = self.best_refused(robot_id)
            first, second = self.robot_ids[pair.first], self.robot_ids[pair.second]
            reason = self.refusal(pair) or "accepted, and they are a component of their own"
            best = f"its best pair is {first} and {second}: {reason}"
            sentences.append(f"{robot_id} is not connected; {best} (docs/frames.md has remedies)")
        return tuple(sentences)

    def refusal(self, pair: PairAlignment) -> str:
        """Return the refusal of a pair, with a remedy where an option of the alignment may help."""
        return refusal_with_remedy(pair, self.dof, self.maps[pair.first].resolution)


def align_logs(
    config: RunConfig,
    *,
    dof: int = 4,
    guesses: Frames | None = None,
    progress: Callable[[float], None] | None = None,
    num_threads: int | None = None,
) -> Alignment:
    """Return the frames of a team's robots from the maps that each one's own logs give.

    The parameters are those of ``align_robots``; ``progress`` counts maps and pairs as one half each. A configuration
    that is not resolved is resolved first. Raises InputError and ConfigError as ``resolve`` and ``align_robots`` do.
    """
    check_alignable(config, guesses or {})

    def show(share: float) -> None:
        if progress is not None:
            progress(share)

    resolved = resolve(config.with_parameters({"strict_frames": False}))
    evidence = own_evidences(resolved, progress=lambda share: show(share / 2), num_threads=num_threads)
    return align_evidence(
        config, evidence, dof=dof, guesses=guesses, progress=lambda share: show((1 + share) / 2),
        num_threads=num_threads,
    )  # fmt: skip


def align_evidence(
    config: RunConfig,
    evidence: Sequence[OwnEvidence],
    *,
    dof: int = 4,
    guesses: Frames | None = None,
    progress: Callable[[float], None] | None = None,
    num_threads: int | None = None,
) -> Alignment:
    """Return the frames of a team's robots from the evidence that their logs give, as ``align_robots`` does."""
    return align_robots(
        config,
        own_maps(config, evidence),
        dof=dof,
        guesses=guesses,
        sightings=[own.sightings for own in evidence],
        progress=progress,
        num_threads=num_threads,
    )


def align_robots(
    config: RunConfig,
    maps: Sequence[OwnMap],
    *,
    dof: int = 4,
    T_map_own: Sequence[Float64Array] | None = None,
    guesses: Frames | None = None,
    sightings: Sequence[Sightings] | None = None,
    progress: Callable[[float], None] | None = None,
    num_threads: int | None = None,
) -> Alignment:
    """Return the frames of a team's robots from their own maps, in the order of ``config.robots``.

    ``dof`` is 4 for robots whose map frames have a vertical z axis, 6 for others. A ``T_team_map`` of the configuration
    that no command computed is trusted: it places its robot unless the maps contradict it. ``guesses`` are verified and
    refined like every other candidate, and are not used where no overlap verifies them. So are transforms that follow
    from ``sightings``, the known places in each robot's logs, for maps in map frames. ``T_map_own`` (4, 4) places each
    map in its robot's map frame (default: it is in that frame). ``progress`` is called with the finished share of
    pairs, 0 to 1. ``num_threads`` does not change the result. Raises ConfigError for fewer than two robots, and for
    guesses of other robots.
    """
    robot_ids = tuple(robot.robot_id for robot in config.robots)
    check_alignable(config, guesses or {})
    placed = tuple(T_map_own) if T_map_own is not None else tuple(np.eye(4) for _ in robot_ids)
    guessed = _guessed(robot_ids, placed, guesses or {})
    priors = Priors(robot_ids, maps, sightings, guessed, is_upright=dof == 4)
    candidates = _candidates(config, placed, guessed, priors)
    aligned = _align_pairs(maps, robot_ids, dof, candidates, progress, num_threads)
    given = _given(config)
    placement = place_robots(maps, aligned, {index: T @ placed[index] for index, T in given.items()}, dof=dof)
    for refusal in placement.refusals:
        given.pop(refusal.index, None)
    pairs = {(pair.first, pair.second): pair for pair in aligned.pairs}

    def frames(team: Sequence[PlacedRobot]) -> tuple[RobotFrame, ...]:
        first = team[0].anchor
        # Without a given pose the team's frame is the map frame of the first robot.
        T_team_own = np.eye(4) if first in given else placed[first]
        return tuple(
            _robot_frame(robot, robot_ids, T_team_own, placed[robot.index], given, pairs, priors, dof) for robot in team
        )

    return Alignment(
        dof,
        robot_ids,
        tuple(maps),
        placed,
        tuple(T @ own for T, own in zip(_configured(config), placed, strict=True)),
        aligned.pairs,
        tuple(frames(team) for team in placement.teams),
        tuple(problem(refusal, robot_ids) for refusal in placement.refusals),
        (
            *(tilted(_given(config), robot_ids) if dof == 4 else ()),
            *unverified(placement.teams[0], given, robot_ids),
            *odd_maps(maps, robot_ids),
            *priors.notes(aligned.pairs, [robot.index for robot in placement.teams[0]]),
        ),
    )


def _align_pairs(
    maps: Sequence[OwnMap],
    robot_ids: Sequence[str],
    dof: int,
    candidates: Mapping[tuple[int, int], Sequence[Float64Array]],
    progress: Callable[[float], None] | None,
    num_threads: int | None,
) -> TeamAlignment:
    """The alignment of all pairs, in threads."""
    num_pairs = math.comb(len(maps), 2)
    with ThreadPoolExecutor(num_threads or min(num_pairs, os.cpu_count() or 1)) as threads:
        done = itertools.count(1)

        def run(function: Callable[[Any], Any], items: Any) -> Iterator[Any]:
            for found in threads.map(function, items):
                if progress is not None:
                    # The pairs come first; the joint registration after them is the short part.
                    progress(min(next(done) / num_pairs, 1.0))
                yield found

        try:
            return align_team(maps, dof=dof, guesses=candidates, names=robot_ids, run=run)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise


def check_alignable(config: RunConfig, guesses: Frames) -> None:
    """Raise ConfigError for fewer than two robots, and for guesses of robots that are not in the team."""
    robot_ids = [robot.robot_id for robot in config.robots]
    if len(robot_ids) < 2:
        raise ConfigError(f"align: needs at least two robots; the team has one, {robot_ids[0]}")
    for robot_id in guesses:
        if robot_id not in robot_ids:
            raise ConfigError(f"guess: robot '{robot_id}' is not in the team: {', '.join(sorted(robot_ids))}")


def stored_maps(
    result: Result, *, progress: Callable[[float], None] | None = None
) -> tuple[list[OwnMap], list[Float64Array]]:
    """Return the maps of a result's robots from their stored evidence, and T_map_own (4, 4) of each.

    The evidence is in the frame that the robot had at the end of the run. Raises InputError where the result holds
    none.
    """
    config, maps = result.config, []
    for number, robot in enumerate(config.robots, start=1):
        maps.append(own_map_of(config, result.evidence(robot.robot_id).octree))
        if progress is not None:
            progress(number / len(config.robots))
    return maps, [inverse(transform_of(result.places[robot.robot_id].T_frame_map)) for robot in config.robots]


def aligned_config(config: _Config, team: Sequence[RobotFrame]) -> _Config:
    """Return the configuration of a team's robots with their frames; other robots are left out.

    ``T_team_map_sigma`` and ``T_team_map_from`` say how exact each frame is and which pair gave it.
    """
    frames = {frame.robot_id: frame for frame in team}
    robots = [_aligned_robot(robot, frames[robot.robot_id]) for robot in config.robots if robot.robot_id in frames]
    return subteam(config, robots)


def check_aligned(alignment: Alignment) -> None:
    """Raise InputError with the reasons where no two robots' frames are related."""
    if len(alignment.teams[0]) < 2:
        best = max(alignment.pairs, key=lambda pair: pair.verification.score)
        first, second = alignment.robot_ids[best.first], alignment.robot_ids[best.second]
        raise InputError(
            f"no two of the {len(alignment.robot_ids)} robots could be aligned; the best pair is {first} and {second}:"
            f" {alignment.refusal(best)} (docs/frames.md has remedies)"
        )


def _aligned_robot(robot: RobotConfig, frame: RobotFrame) -> Any:
    """The robot's configuration with its frame."""
    if frame.is_given:
        return robot
    return dataclasses.replace(
        robot,
        T_team_map=numbers_of(frame.T_team_map),
        T_team_map_sigma=frame.sigma,
        T_team_map_from=f"{frame.origin} ({frame.evidence})" if frame.evidence else frame.origin,
    )


def _given(config: RunConfig) -> dict[int, Float64Array]:
    """T_team_map (4, 4) of the robots whose configuration gives one that no command computed."""
    return {
        index: transform_of(robot.T_team_map)
        for index, robot in enumerate(config.robots)
        if robot.T_team_map is not None and robot.T_team_map_from is None
    }


def _configured(config: RunConfig) -> list[Float64Array]:
    """T_team_map (4, 4) of each robot, the identity where it is not configured."""
    return [transform_of(robot.T_team_map_or_identity) for robot in config.robots]


def _guessed(robot_ids: Sequence[str], T_map_own: Sequence[Float64Array], guesses: Frames) -> dict[int, Float64Array]:
    """Guessed poses (4, 4) of the maps, by position of the robot."""
    return {
        index: transform_of(guesses[robot_id]) @ T_map_own[index]
        for index, robot_id in enumerate(robot_ids)
        if robot_id in guesses
    }


def _candidates(
    config: RunConfig, T_map_own: Sequence[Float64Array], guessed: Mapping[int, Float64Array], priors: Priors
) -> dict[tuple[int, int], list[Float64Array]]:
    """Known transforms between the maps of pairs: those of the configuration, guesses, and those of the logs."""
    configured = [T @ own for T, own in zip(_configured(config), T_map_own, strict=True)]
    # A robot with a frame and one without are not related by the identity.
    is_known = [robot.T_team_map is not None for robot in config.robots]
    found: dict[tuple[int, int], list[Float64Array]] = {}
    for i, j in itertools.combinations(range(len(config.robots)), 2):
        poses = [inverse(configured[i]) @ configured[j]] if is_known[i] == is_known[j] else []
        if i in guessed and j in guessed:
            poses.append(inverse(guessed[i]) @ guessed[j])
        found[i, j] = [*poses, *priors.candidates(i, j)]
    return found


def _robot_frame(
    robot: PlacedRobot, robot_ids: Sequence[str], T_team_own: Float64Array, T_map_own: Float64Array,
    given: Mapping[int, Float64Array], pairs: Mapping[tuple[int, int], PairAlignment], priors: Priors, dof: int,
) -> RobotFrame:  # fmt: skip
    """The frame of a placed robot; ``T_team_own`` maps the frame that it is placed in to the team's."""
    T = T_team_own @ robot.T_team_map @ inverse(T_map_own)
    robot_id = robot_ids[robot.index]
    if robot.partner is None:
        is_given = robot.index in given
        verified = " and verified by its overlaps" if robot.is_verified else ""
        origin = f"given in the team file{verified}" if is_given else TEAM_ORIGIN
        return RobotFrame(robot_id, T, None, origin, "", None, is_given)
    turn = np.kron(np.eye(2), T_team_own[:3, :3])
    # From the origin of the map to that of the map frame.
    arm = T[:3, 3] - (T_team_own @ robot.T_team_map)[:3, 3]
    covariance = about_point(turn @ robot.covariance @ turn.T, arm)
    partner = robot_ids[robot.partner]
    first, second = sorted((robot.index, robot.partner))
    pair = pairs[first, second]
    origin = f"aligned with {partner}"
    if agreeing := priors.agreeing(pair):
        origin += f"; agrees with {' and '.join(agreeing)}"
    if robot.index in given:
        origin += f"; the given pose differs by {difference(*pose_difference(T, given[robot.index]))}"
    return RobotFrame(robot_id, T, covariance, origin, _evidence(pair, dof), partner, False)


def _evidence(pair: PairAlignment, dof: int) -> str:
    """Numbers behind the verdict on a pair, as text."""
    agreement = pair.verification
    same, contra = agreement.obstacles.share_same, agreement.obstacles.share_contra
    shares = f"overlap {100 * agreement.overlap:.1f} %, q {same:.3f}, q_c {contra:.3f}"
    return f"L {agreement.score:.0f}, {shares}" if dof == 4 else shares
