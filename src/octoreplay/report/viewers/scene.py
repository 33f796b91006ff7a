"""Facts about a result that a viewer's configuration needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from octoreplay.records import TEAM
from octoreplay.result import Result

_LEAST_EXTENT = 5.0
"""Least extent of a scene [m]."""


@dataclass(frozen=True)
class Scene:
    """Topics and place of a result; the default is a result of unknown robots.

    Attributes
    ----------
    robots : tuple of str
        Robots of the team.
    topics : mapping of str to str
        Message types by topic.
    frame_id : str
        Frame of the first robot's last map.
    resolution : float
        Edge of the finest leaf [m].
    center : (float, float, float)
        Centre of the box around the robots' paths in ``frame_id`` [m].
    extent : float
        Longest edge of this box [m].
    """

    robots: tuple[str, ...] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    frame_id: str = TEAM
    resolution: float = 0.1
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extent: float = 20.0


def scene_of(result: Result) -> Scene:
    """Return the scene of a result. Raises InputError for a result without a tick."""
    poses = result.as_table("poses")
    frame_id = result.metrics[-1].frame_of(result.robots[0])
    coords = np.column_stack([poses[axis] for axis in "xyz"])[poses["frame_id"] == frame_id]
    low, high = (coords.min(axis=0), coords.max(axis=0)) if len(coords) else (np.zeros(3), np.zeros(3))
    x, y, z = ((low + high) / 2).round(2).tolist()
    extent = max(_LEAST_EXTENT, round(float((high - low).max()), 2))
    return Scene(result.robots, result.topics, frame_id, result.config.map.resolution, (x, y, z), extent)
