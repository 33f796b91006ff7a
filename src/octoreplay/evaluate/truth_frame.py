"""Frame of a ground truth against that of a result's maps."""

from __future__ import annotations

import math
from pathlib import Path

from octoreplay.config.frames_file import load_frames_file
from octoreplay.errors import ConfigError
from octoreplay.records import TEAM, TEAM_ORIGIN
from octoreplay.result import Result
from octoreplay.transforms import pose_difference, transform_of

FRAMES_FILE = "frames.yaml"
"""File beside a simulated team's truth with the true T_team_map of each robot."""

# A team is in the frame of the truth where a robot's frame differs from its true one by at most this [m], [rad].
_SAME_SHIFT, _SAME_ANGLE = 2.0, math.radians(10.0)


def truth_frame_warning(result: Result, truth: Path) -> str | None:
    """Return a sentence where the maps of a result are not in the frame of a truth; None where nothing says so.

    ``truth`` is a file or a folder, with or without a ``frames.yaml`` beside or in it. The frames agree where the frame
    of any robot is near its true one.
    """
    path = (truth if truth.is_dir() else truth.parent) / FRAMES_FILE
    try:
        true = load_frames_file(path)
    except ConfigError:
        return None
    places = {robot_id: place for robot_id, place in result.places.items() if robot_id in true}
    for robot_id, place in places.items():
        shift, angle = pose_difference(transform_of(place.T_frame_map), transform_of(true[robot_id]))
        if shift <= _SAME_SHIFT and angle <= _SAME_ANGLE:
            return None
    if not places:
        return None
    frame_ids = {place.frame_id for place in places.values()}
    origins = result.summary.frame_origins
    first = next((robot_id for robot_id in places if origins.get(robot_id) == TEAM_ORIGIN), next(iter(places)))
    is_own = origins.get(first) == TEAM_ORIGIN or frame_ids != {TEAM}
    here = f"the map frame of {first}" if is_own else "another frame"
    return (
        f"the maps are in {here}, the truth is in the village's frame, so the scores mean nothing: give {first} its"
        f" T_team_map from {path}, then align and run again"
    )
