"""Check that the frames, clocks and logs of a team's robots fit together, for ``info``, ``init`` and ``run``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from octoreplay.config.file_url import InputFile
from octoreplay.config.resolved import MapFrame
from octoreplay.config.robot import RobotConfig
from octoreplay.errors import ConfigError
from octoreplay.io.robots.log_groups import LogGroup
from octoreplay.io.robots.pose_frames import find_map_frame
from octoreplay.io.robots.team_clocks import RobotClock, clock_of, clock_warning
from octoreplay.io.robots.team_frames import frame_origins, frames_warning


@dataclass(frozen=True)
class TeamMember:
    """One robot of a team with its map frame and its clock, each None where the logs do not give it."""

    robot: RobotConfig
    frame: MapFrame | None
    clock: RobotClock | None


def team_member(robot: RobotConfig, group: LogGroup, *, use_log_time: bool = False) -> TeamMember:
    """Return a robot with the frame and the clock that its logs give it.

    Raises InputError for poses from TF where the sensor's frame is unknown or has no parent.
    """
    # The map frame and the clock are the same for all sensors of a robot.
    first = robot.views[0]
    frame = find_map_frame(first, group) if robot.has_poses else None
    return TeamMember(robot, frame, clock_of(first, group, use_log_time=use_log_time))


def check_team(
    members: Sequence[TeamMember], *, strict_frames: bool, need_common_frame: bool = True
) -> tuple[str, ...]:
    """Return a sentence for each way in which the robots of a team do not fit together.

    Without ``need_common_frame`` the robots may begin in frames that nothing relates. Raises ConfigError with
    ``strict_frames`` where nothing relates the map frames of two robots that need a common one.
    """
    frames = [(m.robot, m.frame) for m in members if m.frame is not None]
    unrelated = frames_warning(frames) if need_common_frame else None
    if unrelated is not None and strict_frames:
        raise ConfigError(f"strict_frames: {unrelated}")
    clocks = clock_warning({m.robot.robot_id: m.clock for m in members if m.clock is not None})
    found = (unrelated, clocks, *_shared_messages([member.robot for member in members]))
    return tuple(sentence for sentence in found if sentence is not None)


def team_frame_origins(members: Sequence[TeamMember]) -> dict[str, str]:
    """Return a phrase on the origin of each robot's place in the team's frame, by robot_id."""
    return frame_origins([(member.robot, member.frame) for member in members])


def _shared_messages(robots: Sequence[RobotConfig]) -> Iterator[str]:
    """Sentences on robots that map the same messages."""
    owners: dict[tuple[InputFile, str], str] = {}
    for view in (view for robot in robots for view in robot.views):
        topic = view.depth_topic or view.cloud_topic
        for key in ((path.resolve(), topic) for path in view.logs if topic):
            other = owners.setdefault(key, view.robot_id)
            if other != view.robot_id:
                pair = f"{other} and {view.robot_id}"
                yield f"{pair} map the same messages of {key[0]}, which count twice; leave one of them out"
