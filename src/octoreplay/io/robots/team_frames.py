"""Relations between the map frames of a team's robots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np

from octoreplay.config.resolved import MapFrame
from octoreplay.config.robot import RobotConfig

_COMMON_FRAMES = ("earth", "ecef", "map", "mocap", "utm", "world")
"""Names of frames that do not belong to one robot (REP 105: map, earth), without their namespaces."""


def frames_warning(robots: Sequence[tuple[RobotConfig, MapFrame]]) -> str | None:
    """Return a sentence on robots whose map frames nothing relates; None where all are related.

    A robot with a ``T_team_map`` is placed in the team's frame. The others need one frame between them, which is then
    the team's:

    - Two robots in one TF tree share its root.
    - Robots that TF places by different constant transforms below a frame of the same name share that frame. Equal
      transforms are placeholders, such as an identity that stands for a missing localisation.
    - Robots whose poses are given in a frame of the same name share it if the name is that of a common frame: map,
      world, earth, ecef, utm or mocap. An odometry frame, or a frame of any other name, begins where its robot started.
    - A map frame right above a correction belongs to the robot whose SLAM or localisation publishes it.
    """
    unplaced = [(robot, frame) for robot, frame in robots if robot.T_team_map is None]
    groups = _groups(unplaced)
    if len(groups) < 2:
        return None
    parts = [f"{', '.join(robot.robot_id for robot, _ in group)} ({_described(group[0][1])})" for group in groups]
    return (
        f"nothing relates the map frames of {', '.join(parts[:-1])} and {parts[-1]}, so their maps are overlaid as if "
        f"these were one frame; find T_team_map with 'octoreplay align', or give it in the team file"
    )


def frame_origins(robots: Sequence[tuple[RobotConfig, MapFrame | None]]) -> dict[str, str]:
    """Return a phrase on the origin of each robot's place in the team's frame, by robot_id.

    A ``T_team_map`` is given, or computed as its ``T_team_map_from`` says. The map frames of the other robots are the
    team's frame: a shared frame where the logs relate them all, else an assumption.
    """
    unplaced = [(robot, frame) for robot, frame in robots if robot.T_team_map is None and frame is not None]
    is_related = len(_groups(unplaced)) == 1 and (len(robots) == 1 or len(unplaced) > 1)
    origins = {}
    for robot, frame in robots:
        if robot.T_team_map is not None:
            origins[robot.robot_id] = robot.T_team_map_from or "given in the team file"
        elif is_related and frame is not None and frame.name is not None:
            origins[robot.robot_id] = f"frame '{frame.name}' of the logs"
        else:
            origins[robot.robot_id] = "assumed: the map frame is taken for the team's frame"
    return origins


def frame_groups(robots: Sequence[RobotConfig], frames: Sequence[MapFrame | None]) -> list[list[int]]:
    """Return the robots, by position, in groups with one frame from the beginning; the placed robots are the first one.

    A robot is placed by its ``T_team_map``. The logs relate others as ``frames_warning`` says; a robot with an unknown
    frame is a group of its own.
    """
    placed = [i for i, robot in enumerate(robots) if robot.T_team_map is not None]
    others = [i for i in range(len(robots)) if i not in placed]
    position = {robots[i].robot_id: i for i in others}
    known = [(robots[i], frame) for i in others if (frame := frames[i]) is not None]
    groups = [[position[robot.robot_id] for robot, _ in group] for group in _groups(known)]
    groups += [[i] for i in others if frames[i] is None]
    return [group for group in (placed, *sorted(groups)) if group]


def _described(frame: MapFrame) -> str:
    """Map frame as a warning names it."""
    if frame.name is None:
        return "poses that name no frame"
    return f"'{frame.name}'" + (f": {frame.origin}" if frame.origin else "")


def _groups(robots: Sequence[tuple[RobotConfig, MapFrame]]) -> list[list[tuple[RobotConfig, MapFrame]]]:
    """Robots grouped by related frames, in the order of the robots."""
    anchor_of = _anchors([frame for _, frame in robots])
    group_of = list(range(len(robots)))
    for a, b in combinations(range(len(robots)), 2):
        if _is_related(robots[a], robots[b], anchor_of):
            old, new = max(group_of[a], group_of[b]), min(group_of[a], group_of[b])
            group_of = [new if group == old else group for group in group_of]
    return [[robots[i] for i, found in enumerate(group_of) if found == group] for group in sorted(set(group_of))]


def _anchors(frames: Sequence[MapFrame]) -> Callable[[MapFrame], str | None]:
    """Function that gives the name of the frame that a robot shares with other logs; None for a frame of its own."""
    stated = {frame.name for frame in frames if not frame.origin and _is_common(frame.name)}
    places: dict[str | None, list[tuple[float, ...]]] = {}
    for frame in frames:
        if frame.place is not None:
            places.setdefault(frame.name, []).append(frame.place)
    placing = stated | {
        name
        for name, found in places.items()
        if not any(np.allclose(a, b, rtol=0.0, atol=1e-6) for a, b in combinations(found, 2))
    }

    def anchor_of(frame: MapFrame) -> str | None:
        if frame.place is not None and frame.name in placing:
            return frame.name
        if frame.is_corrected:
            return None
        name = frame.name if frame.pose_frame is None else frame.pose_frame
        return name if _is_common(name) else None

    return anchor_of


def _is_common(name: str | None) -> bool:
    """True for the name of a frame that does not belong to one robot."""
    return name is not None and name.rsplit("/", 1)[-1].lower() in _COMMON_FRAMES


def _is_related(
    one: tuple[RobotConfig, MapFrame], other: tuple[RobotConfig, MapFrame], anchor_of: Callable[[MapFrame], str | None]
) -> bool:
    """True where the map frames of two robots are one frame."""
    (robot_a, a), (robot_b, b) = one, other
    if anchor_of(a) is not None and anchor_of(a) == anchor_of(b):
        return True
    if a.name != b.name:
        return False
    # One tree holds the frames of both robots, which differ; equal names in two logs say nothing.
    is_one_tree = a.body.isdisjoint(b.body) and not (a.tree.isdisjoint(b.body) and b.tree.isdisjoint(a.body))
    is_same_log = robot_a.logs == robot_b.logs and robot_a.pose_topic == robot_b.pose_topic is not None
    return is_one_tree or is_same_log
