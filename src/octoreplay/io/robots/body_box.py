"""Body box of one robot at a stamp."""

from __future__ import annotations

import numpy as np

from octoreplay.config.resolved import ResolvedRobot
from octoreplay.io.robots.pose_source import PoseSource
from octoreplay.records import BodyBox, Float64Array
from octoreplay.transforms import inverse


def body_box_at(
    robot: ResolvedRobot, poses: PoseSource, stamp_ns: int, T_team_sensor: Float64Array, *, is_own: bool
) -> BodyBox | None:
    """Return a robot's ``body_box`` at a stamp; None where TF does not give its frame there.

    ``stamp_ns`` is without the clock offset; ``T_team_sensor`` (4, 4) is the robot's pose at that stamp. ``is_own`` is
    true for the robot whose scan the box goes with.
    """
    T_body_sensor = poses.T_body_sensor_at(stamp_ns)
    if T_body_sensor is None:
        return None
    corners = np.array(robot.body_box, np.float64).reshape(2, 3)
    return BodyBox(corners[0], corners[1], T_body_sensor @ inverse(T_team_sensor), is_own)
