"""Frames of a team's robots, which join one after the other."""

from __future__ import annotations

import dataclasses

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.io.robots.team_frames import frame_groups
from octoreplay.records import TEAM, BoolArray, Float64Array
from octoreplay.run_metrics import FramePlace
from octoreplay.transforms import inverse, numbers_of, transform_of


def without_computed_frames(config: ResolvedRun) -> ResolvedRun:
    """Return the configuration without each ``T_team_map`` that a command computed, which robots find again."""
    robots = tuple(
        robot
        if robot.T_team_map_from is None
        else dataclasses.replace(robot, T_team_map=None, T_team_map_sigma=None, T_team_map_from=None)
        for robot in config.robots
    )
    return dataclasses.replace(config, robots=robots)


class TeamFrames:
    """Frame of each robot, and components of robots in one frame.

    The robots with a given ``T_team_map`` begin in the frame 'team'. Robots that the logs relate begin in the map frame
    of the first one of them, and every other robot in its own map frame.
    """

    def __init__(self, config: ResolvedRun) -> None:
        robots = config.robots
        self._robot_ids = [robot.robot_id for robot in robots]
        self._frame_ids = [""] * len(robots)
        self._T_frame_map: list[tuple[float, ...]] = [()] * len(robots)
        for group in frame_groups(robots, [robot.frame for robot in robots]):
            is_placed = robots[group[0]].T_team_map is not None
            for index in group:
                self._frame_ids[index] = TEAM if is_placed else f"{self._robot_ids[group[0]]}/map"
                self._T_frame_map[index] = robots[index].T_team_map_or_identity

    @property
    def components(self) -> tuple[tuple[int, ...], ...]:
        """Robots in one frame, by position in the team: the largest component first, then in the robots' order."""
        groups: dict[str, list[int]] = {}
        for index, frame_id in enumerate(self._frame_ids):
            groups.setdefault(frame_id, []).append(index)
        return tuple(tuple(group) for group in sorted(groups.values(), key=lambda group: -len(group)))

    @property
    def in_one_frame(self) -> BoolArray:
        """True for each pair of robots in one frame, (N, N)."""
        names = np.array(self._frame_ids)
        same: BoolArray = names[:, None] == names
        return same

    @property
    def places(self) -> tuple[FramePlace, ...]:
        """Frame of each robot."""
        rows = zip(self._robot_ids, self._frame_ids, self._T_frame_map, strict=True)
        return tuple(FramePlace(*row) for row in rows)

    def frame_id(self, index: int) -> str:
        """Return the name of a robot's frame."""
        return self._frame_ids[index]

    def T_frame_map(self, index: int) -> tuple[float, ...]:
        """Return the transform of a robot's map frame to its frame, as the numbers of ``T_team_map``."""
        return self._T_frame_map[index]

    def members(self, index: int) -> tuple[int, ...]:
        """Return the robots in the frame of a robot, itself included."""
        return tuple(other for other, name in enumerate(self._frame_ids) if name == self._frame_ids[index])

    def join(self, first: int, second: int, T_first_second: Float64Array) -> tuple[int, ...]:
        """Join the components of two robots in different frames; return the robots whose frame changed.

        ``T_first_second`` (4, 4) maps the second robot's frame to the first one's. The smaller component gets the
        larger one's frame; of two of equal size that with the first robot keeps its frame. The frame 'team' is kept.
        """

        def rank(index: int) -> tuple[bool, int, int]:
            members = self.members(index)
            return self._frame_ids[index] != TEAM, -len(members), members[0]

        stays, moves, T = first, second, T_first_second
        if rank(second) < rank(first):
            stays, moves, T = second, first, inverse(T_first_second)
        moved = self.members(moves)
        for index in moved:
            self._T_frame_map[index] = numbers_of(T @ transform_of(self._T_frame_map[index]))
            self._frame_ids[index] = self._frame_ids[stays]
        return moved
