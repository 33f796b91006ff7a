"""Frames files: the transform T_team_map of each robot, by robot id."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from octoreplay.config.fields import as_number, transform_problem
from octoreplay.config.yaml_file import dump_yaml, load_yaml, read_text
from octoreplay.errors import ConfigError
from octoreplay.records import FilePath

_KEY = "T_team_map"


def load_frames_file(path: FilePath) -> dict[str, tuple[float, ...]]:
    """Read a frames file, such as the ``frames.yaml`` of a simulated team with ``own_frames``.

    Returns T_team_map by robot id, as in team files: the transform from the robot's map frame to the team's frame,
    x, y, z [m] and a unit quaternion x, y, z, w. Raises ConfigError that names the file and the robot for an unreadable
    file, an unknown key or a wrong value.
    """
    path = Path(path)
    content = load_yaml(read_text(path, "frames"), str(path))
    if not isinstance(content, Mapping) or set(content) != {_KEY} or not isinstance(content[_KEY], Mapping):
        raise ConfigError(f"{path}: expects the single key '{_KEY}' with [x, y, z, qx, qy, qz, qw] for each robot's id")
    return {str(robot_id): _numbers(path, str(robot_id), value) for robot_id, value in content[_KEY].items()}


def dump_frames(frames: Mapping[str, tuple[float, ...]]) -> str:
    """Return the text of a frames file with T_team_map by robot id; ``load_frames_file`` reads the same numbers."""
    return dump_yaml({_KEY: {robot_id: list(numbers) for robot_id, numbers in frames.items()}})


def _numbers(path: Path, robot_id: str, value: Any) -> tuple[float, ...]:
    """The seven numbers of one robot."""
    try:
        numbers = tuple(as_number(number) for number in value)
    except (TypeError, ValueError):
        raise ConfigError(f"{path}: robot '{robot_id}': {_KEY}: {value!r} has the wrong type") from None
    problem = transform_problem(_KEY, numbers)
    if problem is not None:
        raise ConfigError(f"{path}: robot '{robot_id}': {problem}")
    return numbers
