"""Markers of a result: the communication graph, and maps as cubes.

A message begins with DELETEALL, so that a viewer never shows markers of an earlier message.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.io.results.geometry_messages import (
    CUBE_LIST,
    DELETEALL,
    LINE_LIST,
    TEXT_VIEW_FACING,
    marker,
    point,
    vector,
)
from octoreplay.records import TEAM, ClassTable, RobotPose


def graph_markers(
    stamp_ns: int, links: Sequence[tuple[str, str]], poses: Sequence[RobotPose], robot_ids: Sequence[str]
) -> list[Any]:
    """Return the markers of a tick: links (pairs of robots, each once) as lines, and the robots' names as text."""
    positions = {pose.robot_id: vector(pose.T_team_sensor) for pose in poses}
    frames = {pose.robot_id: pose.frame_id for pose in poses}
    markers = [_clear(stamp_ns, TEAM)]
    # A link joins robots in one frame.
    for number, frame_id in enumerate(dict.fromkeys(frames.values())):
        ends = [end for link in links if positions.keys() >= set(link) for end in link if frames[end] == frame_id]
        if ends:
            markers.append(
                marker(
                    stamp_ns, "links", number, LINE_LIST, points=[point(positions[end]) for end in ends],
                    scale=(0.08, 0.0, 0.0), frame_id=frame_id,
                )
            )  # fmt: skip
    markers += [
        marker(
            stamp_ns, "robots", index, TEXT_VIEW_FACING, text=robot_id, scale=(0.0, 0.0, 0.6),
            position=positions[robot_id] + (0.0, 0.0, 0.8), frame_id=frames[robot_id],
        )
        for index, robot_id in enumerate(robot_ids)
        if robot_id in positions
    ]  # fmt: skip
    return markers


def map_markers(stamp_ns: int, points: npt.NDArray[Any], classes: ClassTable, frame_id: str) -> list[Any]:
    """Return the leaves of a map, ``view_points``, as cubes: a marker per class and size, the class as namespace."""
    markers = [_clear(stamp_ns, frame_id)]
    for label in np.unique(points["label"]).tolist():
        of_class = points[points["label"] == label]
        for number, size in enumerate(np.unique(of_class["size"]).tolist()):
            leaves = of_class[of_class["size"] == size]
            centers = np.column_stack([leaves[axis] for axis in "xyz"]).astype(np.float64)
            markers.append(
                marker(
                    stamp_ns, classes.names[label - 1], number, CUBE_LIST, points=[point(center) for center in centers],
                    scale=(size, size, size), color=classes.classes[label - 1].color, frame_id=frame_id,
                )
            )  # fmt: skip
    return markers


def _clear(stamp_ns: int, frame_id: str) -> Any:
    """Return the marker that deletes all earlier markers of its topic."""
    return marker(stamp_ns, "", 0, LINE_LIST, action=DELETEALL, scale=(0.0, 0.0, 0.0), frame_id=frame_id)
