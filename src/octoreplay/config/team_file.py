"""Reading and writing of team files: robots, classes and parameters of a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from octoreplay.config.class_file import CLASSES_KEYS, class_settings, class_to_mapping
from octoreplay.config.fields import as_number, is_number
from octoreplay.config.file_url import FileUrl, InputFile, input_file
from octoreplay.config.network import LinkConfig, ScheduleEntry
from octoreplay.config.parameters import PARAMETERS, SECTIONS, coerced
from octoreplay.config.robot import RobotConfig
from octoreplay.config.robot_sensor import SENSOR_KEYS, RobotSensor
from octoreplay.config.run import RunConfig
from octoreplay.config.yaml_file import dump_yaml, load_yaml, read_text
from octoreplay.errors import ConfigError, suggestion
from octoreplay.records import FilePath

_ROBOT_KEYS = ("id", "log", *(f.name for f in dataclasses.fields(RobotConfig) if f.name not in ("robot_id", "logs")))
_ROBOT_LISTS = ("intrinsics", "pose", "pose_origin", "T_team_map", "T_team_map_sigma", "T_body_sensor", "body_box")
_ROBOT_NUMBERS = ("clock_offset", "depth_unit", "min_range", "max_range", "publish_period", "publish_phase")
_SCHEDULE_KEYS = {"from": "start", "to": "end", **{f.name: f.name for f in dataclasses.fields(ScheduleEntry)[2:]}}
_LINK_KEYS = tuple(f.name for f in dataclasses.fields(LinkConfig))
_TEAM_KEYS = ("robots", *CLASSES_KEYS, "edges", "one_way", "schedule", "links")
"""Keys of a team file that are not parameters."""


def load_team_file(path: FilePath) -> RunConfig:
    """Read a team file. Relative paths in it are relative to its folder.

    Raises ConfigError that names the file and the key for an unreadable file, an unknown key or a wrong value.
    """
    path = Path(path)
    return parse_team(read_text(path, "team"), name=str(path), folder=path.parent)


def parse_team(text: str, *, name: str, folder: Path, defaults: Mapping[str, Any] = MappingProxyType({})) -> RunConfig:
    """Return the configuration of a team file's text. Relative paths in it are relative to ``folder``.

    ``defaults`` are values of parameters that the text does not name. Raises ConfigError that starts with ``name``.
    """
    content = load_yaml(text, name)
    try:
        return _team_from_mapping({**defaults, **content} if isinstance(content, Mapping) else content, folder)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from error


def _team_from_mapping(content: Any, folder: Path) -> RunConfig:
    """Configuration of a team file's content."""
    if not isinstance(content, Mapping):
        raise ConfigError("expects a YAML mapping with the key 'robots'")
    for key in content:
        if key not in _TEAM_KEYS and key not in PARAMETERS:
            raise ConfigError(f"{key}: unknown key{suggestion(str(key), (*_TEAM_KEYS, *PARAMETERS))}")
    if "robots" not in content or not isinstance(content["robots"], list):
        raise ConfigError("robots: expects a list of robots, each with 'id' and 'log'")
    robots = tuple(_robot_from_mapping(entry, folder) for entry in content["robots"])
    changes = coerced({key: value for key, value in content.items() if key in PARAMETERS})
    changes.setdefault("network", {}).update(
        edges=_edges(content.get("edges") or ()),
        one_way=_pairs("one_way", content.get("one_way") or ()),
        schedule=schedule(content.get("schedule") or ()),
    )
    # In one call, because the ranges of some parameters depend on others.
    return RunConfig(
        robots=robots,
        **class_settings(content, folder),
        link_overrides=_link_overrides(content.get("links") or ()),
        **{name: SECTIONS[name].config_type(**fields) for name, fields in changes.items()},
    )


def _robot_from_mapping(entry: Any, folder: Path) -> RobotConfig:
    """Configuration of one entry of 'robots'."""
    if not isinstance(entry, Mapping):
        raise ConfigError("robots: every robot is a mapping with 'id' and 'log'")
    robot_id = str(entry.get("id", ""))
    for key in entry:
        if key not in _ROBOT_KEYS:
            raise ConfigError(f"robot '{robot_id}': {key}: unknown key{suggestion(str(key), _ROBOT_KEYS)}")
    logs = entry.get("log") or ()
    logs = (logs,) if isinstance(logs, str) else logs
    if not isinstance(logs, list | tuple) or not all(isinstance(log, str) for log in logs):
        raise ConfigError(f"robot '{robot_id}': log: expects a path or URL, or a list of them")
    sensors = entry.get("sensors") or ()
    if not isinstance(sensors, list | tuple):
        raise ConfigError(f"robot '{robot_id}': sensors: expects a list of sensors, each with its topics")
    values = {key: value for key, value in entry.items() if key not in ("id", "log", "sensors")}
    return RobotConfig(
        robot_id=robot_id,
        logs=tuple(input_file(log, folder) for log in logs),
        sensors=tuple(_sensor_from_mapping(robot_id, sensor) for sensor in sensors),
        **_robot_values(robot_id, values, folder),
    )


def _sensor_from_mapping(robot_id: str, entry: Any) -> RobotSensor:
    """Configuration of one entry of a robot's 'sensors'."""
    if not isinstance(entry, Mapping):
        raise ConfigError(f"robot '{robot_id}': sensors: every sensor is a mapping with its topics")
    for key in entry:
        if key not in SENSOR_KEYS:
            raise ConfigError(f"robot '{robot_id}': sensors: {key}: unknown key{suggestion(str(key), SENSOR_KEYS)}")
    return RobotSensor(**_robot_values(robot_id, entry, Path()))


def _robot_values(robot_id: str, entry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Values of a robot's or sensor's keys, with their types."""
    fields: dict[str, Any] = {}
    for key, value in entry.items():
        if value is None:
            continue
        try:
            if key in _ROBOT_LISTS:
                fields[key] = tuple(as_number(number) for number in value)
            elif key == "rectified":
                if not isinstance(value, bool):
                    raise TypeError
                fields[key] = value
            elif key in _ROBOT_NUMBERS:
                fields[key] = as_number(value)
            else:
                if not isinstance(value, str):
                    raise TypeError
                fields[key] = input_file(value, folder) if key in ("pose_file", "pose_times") else value
        except (TypeError, ValueError):
            raise ConfigError(f"robot '{robot_id}': {key}: {value!r} has the wrong type") from None
    return fields


def _edges(entries: Any) -> tuple[tuple[str, str, float | None], ...]:
    """Edges from lists [a, b] or [a, b, weight]."""
    if not isinstance(entries, list | tuple):
        raise ConfigError("edges: expects a list of edges, each [robot, robot] or [robot, robot, weight]")
    edges = []
    for entry in entries:
        if not isinstance(entry, list | tuple) or len(entry) not in (2, 3):
            raise ConfigError("edges: every edge is a list [robot, robot] or [robot, robot, weight]")
        if len(entry) == 3 and not is_number(entry[2]):
            raise ConfigError(f"edges: the weight of {entry[0]} - {entry[1]} is not a number")
        edges.append((str(entry[0]), str(entry[1]), float(entry[2]) if len(entry) == 3 else None))
    return tuple(edges)


def _pairs(key: str, entries: Any) -> tuple[tuple[str, str], ...]:
    """Pairs of robots from lists [a, b]."""
    if not isinstance(entries, list | tuple) or not all(isinstance(e, list | tuple) and len(e) == 2 for e in entries):
        raise ConfigError(f"{key}: expects a list of pairs [robot, robot]")
    return tuple((str(a), str(b)) for a, b in entries)


def load_schedule(path: FilePath) -> tuple[ScheduleEntry, ...]:
    """Read a schedule file: a YAML list of entries. Raises ConfigError with the file and the entry."""
    path = Path(path)
    content = load_yaml(read_text(path, "schedule"), str(path))
    try:
        return schedule(content)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def schedule(entries: Any) -> tuple[ScheduleEntry, ...]:
    """Return the schedule of a file's list of entries. Raises ConfigError for an unknown key or a wrong type."""
    if not isinstance(entries, list | tuple):
        raise ConfigError("schedule: expects a list of entries, each with 'from' and the robots or links affected")
    found = []
    for entry in entries:
        if not isinstance(entry, Mapping) or "from" not in entry:
            raise ConfigError("schedule: every entry is a mapping with 'from' [s] and the robots or links affected")
        values: dict[str, Any] = {}
        for key, value in entry.items():
            if key not in _SCHEDULE_KEYS:
                raise ConfigError(f"schedule: {key}: unknown key{suggestion(str(key), _SCHEDULE_KEYS)}")
            if key in ("from", "to"):
                if not is_number(value):
                    raise ConfigError(f"schedule: {key}: {value!r} is not a number of seconds")
                value = float(value)
            elif key == "forget":
                if not isinstance(value, bool):
                    raise ConfigError(f"schedule: {key}: expects true or false, got {value!r}")
            elif key in ("links_down", "links_up"):
                value = _pairs(f"schedule: {key}", value)
            elif key == "groups":
                if not isinstance(value, list | tuple) or not all(isinstance(group, list | tuple) for group in value):
                    raise ConfigError("schedule: groups: expects a list of lists of robots")
                value = tuple(tuple(str(robot_id) for robot_id in group) for group in value)
            else:
                names = [value] if isinstance(value, str) else value
                if not isinstance(names, list | tuple):
                    raise ConfigError(f"schedule: {key}: expects a list of robots")
                value = tuple(str(robot_id) for robot_id in names)
            values[_SCHEDULE_KEYS[key]] = value
        found.append(ScheduleEntry(**values))
    return tuple(found)


def _link_overrides(entries: Any) -> tuple[tuple[str, str, tuple[tuple[str, Any], ...]], ...]:
    """Link overrides (sender, receiver, values) from mappings; 'between' stands for both directions."""
    if not isinstance(entries, list | tuple):
        raise ConfigError("links: expects a list of links, each with 'from' and 'to' or 'between', and link parameters")
    found = []
    for entry in entries:
        named = {"between", "from", "to"}.intersection(entry) if isinstance(entry, Mapping) else set()
        if named not in ({"between"}, {"from", "to"}):
            raise ConfigError("links: every link needs 'from' and 'to', or 'between' for both directions")
        changes = {key: value for key, value in entry.items() if key not in ("between", "from", "to")}
        for key in changes:
            if key not in _LINK_KEYS:
                raise ConfigError(f"links: {key}: unknown key{suggestion(str(key), _LINK_KEYS)}")
        try:
            values = tuple((key, PARAMETERS[key].coerce(value)) for key, value in changes.items())
        except ConfigError as error:
            raise ConfigError(f"links: {error}") from error
        if "between" in entry:
            pair = entry["between"]
            if not isinstance(pair, list | tuple) or len(pair) != 2:
                raise ConfigError(f"links: between: expects [robot, robot], got {pair!r}")
            a, b = (str(robot_id) for robot_id in pair)
            found += [(a, b, values), (b, a, values)]
        else:
            found.append((str(entry["from"]), str(entry["to"]), values))
    return tuple(found)


def dump_team(config: RunConfig, folder: Path | None = None, *, with_defaults: bool = False) -> str:
    """Return the text of a team file: the robots, and every parameter that differs from its default, or all of them.

    Log paths below ``folder`` are written relative to it. ``parse_team`` returns the same configuration.
    """
    return dump_yaml(team_to_mapping(config, folder, with_defaults=with_defaults))


def team_to_mapping(config: RunConfig, folder: Path | None, *, with_defaults: bool = False) -> dict[str, Any]:
    """Return the content of a configuration's team file, by key."""
    content: dict[str, Any] = {"robots": [robot_to_mapping(robot, folder) for robot in config.robots]}
    if config.classes is not None:
        content["classes"] = [class_to_mapping(item) for item in config.classes.classes]
        if config.classes.ignored_raw_labels:
            content["ignored_raw_labels"] = list(config.classes.ignored_raw_labels)
        if config.classes.ignored_raw_colors:
            content["ignored_raw_colors"] = [list(color) for color in config.classes.ignored_raw_colors]
    if config.merge_classes:
        content["merge_classes"] = {new: list(names) for new, names in config.merge_classes}
    if config.ignore_hits:
        content["ignore_hits"] = list(config.ignore_hits)
    if config.network.edges:
        content["edges"] = [[e for e in edge if e is not None] for edge in config.network.edges]
    if config.network.one_way:
        content["one_way"] = [list(pair) for pair in config.network.one_way]
    if config.network.schedule:
        content["schedule"] = [_entry_to_mapping(entry) for entry in config.network.schedule]
    if config.link_overrides:
        content["links"] = [{"from": a, "to": b, **dict(values)} for a, b, values in config.link_overrides]
    for name, parameter in PARAMETERS.items():
        value = getattr(getattr(config, parameter.section), name)
        if with_defaults or value != parameter.default:
            content[name] = list(value) if isinstance(value, tuple) else value
    return content


def _entry_to_mapping(entry: ScheduleEntry) -> dict[str, Any]:
    """Content of one schedule entry in a file."""

    def plain(value: Any) -> Any:
        return [plain(part) for part in value] if isinstance(value, tuple) else value

    defaults = ScheduleEntry(start=0.0)
    values = {key: getattr(entry, name) for key, name in _SCHEDULE_KEYS.items()}
    return {
        key: plain(value)
        for key, value in values.items()
        if key == "from" or value != getattr(defaults, _SCHEDULE_KEYS[key])
    }


def robot_to_mapping(robot: RobotConfig, folder: Path | None) -> dict[str, Any]:
    """Return the content of one robot's entry in a team file, by key."""

    def text(path: InputFile) -> str:
        if isinstance(path, FileUrl):
            return path.url
        return str(path.relative_to(folder) if folder is not None and path.is_relative_to(folder) else path)

    logs = [text(path) for path in robot.logs]
    entry: dict[str, Any] = {"id": robot.robot_id, "log": logs[0] if len(logs) == 1 else logs}
    for item in dataclasses.fields(RobotConfig):
        if item.name in ("robot_id", "logs"):
            continue
        value = getattr(robot, item.name)
        if isinstance(value, Path | FileUrl):
            value = text(value)
        if item.name == "sensors":
            value = [_set_values(sensor) for sensor in robot.sensors] or item.default
        if value != item.default:
            entry[item.name] = list(value) if isinstance(value, tuple) else value
    return entry


def _set_values(sensor: RobotSensor) -> dict[str, Any]:
    """Content of one entry of 'sensors'."""
    values = {name: getattr(sensor, name) for name in SENSOR_KEYS}
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in values.items() if value is not None
    }
