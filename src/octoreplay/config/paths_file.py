"""Paths files: waypoints of each simulated robot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from octoreplay.config.fields import as_number
from octoreplay.config.yaml_file import load_yaml, read_text
from octoreplay.errors import ConfigError
from octoreplay.records import FilePath

_KEY = "paths"


def load_paths_file(path: FilePath) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Read a paths file: the waypoints (x, y) [m] of the robots husky_1, husky_2 and so on, in this order.

    The file has the single key ``paths`` with a list of waypoints [x, y] for each robot's id. Raises ConfigError that
    names the file and the robot for an unreadable file, an unknown key, other robots or a wrong value.
    """
    path = Path(path)
    content = load_yaml(read_text(path, "paths"), str(path))
    if not isinstance(content, Mapping) or set(content) != {_KEY} or not isinstance(content[_KEY], Mapping):
        raise ConfigError(f"{path}: expects the single key '{_KEY}' with a list of [x, y] for each robot's id")
    given = {str(robot_id): value for robot_id, value in content[_KEY].items()}
    names = [f"husky_{number + 1}" for number in range(len(given))]
    if not given or set(given) != set(names):
        raise ConfigError(
            f"{path}: expects paths of husky_1, husky_2, ..., without gaps, not of {', '.join(given) or 'no robot'}"
        )
    return tuple(_waypoints(path, robot_id, given[robot_id]) for robot_id in names)


def _waypoints(path: Path, robot_id: str, value: Any) -> tuple[tuple[float, float], ...]:
    """The waypoints of one robot."""
    if not isinstance(value, list) or not value:
        raise ConfigError(f"{path}: robot '{robot_id}': expects a list of waypoints [x, y], not {value!r}")
    waypoints = []
    for number, item in enumerate(value, 1):
        try:
            # A text of two digits would also give two numbers.
            x, y = (as_number(coordinate) for coordinate in (item if isinstance(item, list) else ()))
        except (TypeError, ValueError):
            x = y = math.nan
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ConfigError(f"{path}: robot '{robot_id}': waypoint {number}: expects [x, y] in metres, not {item!r}")
        waypoints.append((x, y))
    return tuple(waypoints)
