"""Team files: the robots of a team, their classes and every parameter of a run, read and written."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from octoreplay.config.class_file import CLASSES_KEYS, class_settings, class_to_mapping
from octoreplay.config.fields import as_number, is_number
from octoreplay.config.network import LinkConfig, ScheduleEntry
from octoreplay.config.parameters import PARAMETERS, SECTIONS, coerced
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.yaml_file import load_yaml, read_text
from octoreplay.errors import ConfigError, suggestion

_ROBOT_KEYS = ("id", "log", *(f.name for f in dataclasses.fields(RobotConfig) if f.name not in ("robot_id", "logs")))
_SCHEDULE_KEYS = {"from": "start", "to": "end", **{f.name: f.name for f in dataclasses.fields(ScheduleEntry)[2:]}}
_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_/.-]*")
_WORDS_OF_YAML = ("true", "false", "null", "yes", "no", "on", "off", "y", "n")
_LINK_KEYS = tuple(f.name for f in dataclasses.fields(LinkConfig))
_TEAM_KEYS = ("robots", *CLASSES_KEYS, "edges", "one_way", "schedule", "links")


def load_team_file(path: str | Path) -> RunConfig:
    """Read a team file. Log paths in it are relative to its folder.

    Raises ConfigError with the file and the key for anything that is not understood.
    """
    path = Path(path)
    return parse_team(read_text(path, "team"), source=str(path), folder=path.parent)


def parse_team(text: str, *, source: str, folder: Path) -> RunConfig:
    """A configuration from a team file's text; ``source`` names it in errors. Raises ConfigError."""
    content = load_yaml(text, source)
    try:
        return _team_from_mapping(content, folder)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error


def _team_from_mapping(content: Any, folder: Path) -> RunConfig:
    if not isinstance(content, Mapping):
        raise ConfigError("a team file is a YAML mapping with the key 'robots'")
    if "robots" not in content or not isinstance(content["robots"], list):
        raise ConfigError("robots: expects a list of robots, each with 'id' and 'log'")
    for key in content:
        if key not in _TEAM_KEYS and key not in PARAMETERS:
            raise ConfigError(f"{key}: unknown key{suggestion(str(key), (*_TEAM_KEYS, *PARAMETERS))}")
    robots = tuple(_robot_from_mapping(entry, folder) for entry in content["robots"])
    changes = coerced({key: value for key, value in content.items() if key in PARAMETERS})
    changes.setdefault("network", {}).update(
        edges=_edges(content.get("edges") or ()),
        one_way=_pairs("one_way", content.get("one_way") or ()),
        schedule=schedule(content.get("schedule") or ()),
    )
    # All at once: what one parameter may be depends on others.
    return RunConfig(
        robots=robots,
        **class_settings(content, folder),
        link_overrides=_link_overrides(content.get("links") or ()),
        **{name: SECTIONS[name].config_type(**fields) for name, fields in changes.items()},
    )


def _robot_from_mapping(entry: Any, folder: Path) -> RobotConfig:
    if not isinstance(entry, Mapping):
        raise ConfigError("robots: every robot is a mapping with 'id' and 'log'")
    robot_id = str(entry.get("id", ""))
    for key in entry:
        if key not in _ROBOT_KEYS:
            raise ConfigError(f"robot '{robot_id}': {key}: unknown key{suggestion(str(key), _ROBOT_KEYS)}")
    logs = entry.get("log") or ()
    logs = (logs,) if isinstance(logs, str) else logs
    if not isinstance(logs, list | tuple) or not all(isinstance(log, str) for log in logs):
        raise ConfigError(f"robot '{robot_id}': log: expects a path or a list of paths")
    fields: dict[str, Any] = {}
    for key, value in entry.items():
        if key in ("id", "log") or value is None:
            continue
        try:
            if key in ("intrinsics", "T_team_map", "T_body_sensor", "body_box"):
                fields[key] = tuple(as_number(number) for number in value)
            elif key == "rectified":
                if not isinstance(value, bool):
                    raise TypeError
                fields[key] = value
            elif key in ("clock_offset", "depth_unit", "publish_period", "publish_phase"):
                fields[key] = as_number(value)
            else:
                if not isinstance(value, str):
                    raise TypeError
                fields[key] = folder / value if key in ("pose_file", "pose_times") else value
        except (TypeError, ValueError):
            raise ConfigError(f"robot '{robot_id}': {key}: {value!r} has the wrong type") from None
    return RobotConfig(robot_id=robot_id, logs=tuple(folder / log for log in logs), **fields)


def _edges(entries: Any) -> tuple[tuple[str, str, float | None], ...]:
    """Edges from lists [a, b] or [a, b, weight]."""
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


def load_schedule(path: str | Path) -> tuple[ScheduleEntry, ...]:
    """Read a schedule file: a YAML list of entries. Raises ConfigError with the file and the entry."""
    path = Path(path)
    content = load_yaml(read_text(path, "schedule"), str(path))
    try:
        return schedule(content)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def schedule(entries: Any) -> tuple[ScheduleEntry, ...]:
    """A schedule from the list that a file holds: mappings with from, to and what is up or down.

    Raises ConfigError for an unknown key or a wrong type.
    """
    if not isinstance(entries, list | tuple):
        raise ConfigError("schedule: expects a list of entries, each with 'from' and what is up or down")
    found = []
    for entry in entries:
        if not isinstance(entry, Mapping) or "from" not in entry:
            raise ConfigError("schedule: every entry is a mapping with 'from' [s] and what is up or down")
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
    """Links that differ, from mappings with 'from' and 'to', or 'between' for both directions, and link parameters."""
    if not isinstance(entries, list | tuple):
        raise ConfigError("links: expects a list of links, each with 'from' and 'to' or 'between', and what differs")
    found = []
    for entry in entries:
        named = {"between", "from", "to"}.intersection(entry) if isinstance(entry, Mapping) else set()
        if named not in ({"between"}, {"from", "to"}):
            raise ConfigError("links: every link names 'from' and 'to', or 'between' two robots for both directions")
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


def dump_team(config: RunConfig, folder: Path | None = None) -> str:
    """The team file's text of a configuration: everything that differs from the defaults, and every robot.

    Log paths are written relative to ``folder`` where they lie below it. ``parse_team`` gives the same configuration.
    """
    from ruamel.yaml import YAML

    buffer = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    # The library knows this attribute as None only.
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.width = 110
    yaml.dump(_content(config, folder), buffer)
    return buffer.getvalue()


def _content(config: RunConfig, folder: Path | None) -> dict[str, Any]:
    """What a team file of a configuration holds."""
    content: dict[str, Any] = {"robots": [_robot_to_mapping(robot, folder) for robot in config.robots]}
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
        if value != parameter.default:
            content[name] = list(value) if isinstance(value, tuple) else value
    return content


def _entry_to_mapping(entry: ScheduleEntry) -> dict[str, Any]:
    """One entry of a schedule as a file holds it."""

    def plain(value: Any) -> Any:
        return [plain(part) for part in value] if isinstance(value, tuple) else value

    defaults = ScheduleEntry(start=0.0)
    values = {key: getattr(entry, name) for key, name in _SCHEDULE_KEYS.items()}
    return {
        key: plain(value)
        for key, value in values.items()
        if key == "from" or value != getattr(defaults, _SCHEDULE_KEYS[key])
    }


def _robot_to_mapping(robot: RobotConfig, folder: Path | None) -> dict[str, Any]:
    """One robot as a team file holds it."""

    def text(path: Path) -> str:
        return str(path.relative_to(folder) if folder is not None and path.is_relative_to(folder) else path)

    logs = [text(path) for path in robot.logs]
    entry: dict[str, Any] = {"id": robot.robot_id, "log": logs[0] if len(logs) == 1 else logs}
    for item in dataclasses.fields(RobotConfig):
        if item.name in ("robot_id", "logs"):
            continue
        value = getattr(robot, item.name)
        if isinstance(value, Path):
            value = text(value)
        if value != item.default:
            entry[item.name] = list(value) if isinstance(value, tuple) else value
    return entry


# --- a file to begin with --------------------------------------------------------------------------------------------

_HEAD = """\
# A team of robots for octoreplay: octoreplay run TEAM.yaml -o OUT.mcap
# Lines with a # before their key hold the default, or an example where there is none: take the # away to change it.
# What everything means is in docs/logs.md, docs/classes.md and docs/communication.md.
"""

_COMMENT_COLUMN = 56


# Keys that are no parameters, by the section that they stand in front of ('': all): an example, and what they say.
_EXAMPLES: Mapping[str, Mapping[str, tuple[Any, str]]] = {
    "": {
        "classes": ("semantickitti", "what labels mean: a list, a file, or a table that octoreplay brings"),
        "ignored_raw_labels": ([0, 255], "labels that mean nothing"),
        "ignored_raw_colors": ([[0, 0, 0]], "colours that mean nothing"),
        "merge_classes": ({"vehicle": ["car", "truck"]}, "new name: the classes that become it"),
        "ignore_hits": (["person"], "classes that free their rays and are not mapped"),
    },
    "network": {
        "edges": ([["a", "b"], ["b", "c"]], "links of topology edges, with a weight each or without"),
        "one_way": ([["a", "b"]], "links that carry from the first robot to the second only"),
        "schedule": ([{"from": 10, "to": 20, "robots_off": ["a"]}], "what is up or down from when to when [s]"),
    },
    "link": {"links": ([{"between": ["a", "b"], "loss": 0.2}], "links that differ from the others")},
}  # fmt: skip


def team_template(config: RunConfig, missing: Mapping[str, Sequence[str]], folder: Path | None = None) -> str:
    """A team file with every key there is: what ``config`` sets, and as comments everything else, with its default.

    ``missing`` are sentences that say what a robot still lacks, by robot_id ('': the team); they become comments too.
    ``parse_team`` gives ``config``. Log paths are as for ``dump_team``.
    """
    content = _content(config, folder)
    lines = [_HEAD, "robots:"]
    for robot in config.robots:
        lines += _robot_lines(robot, missing.get(robot.robot_id, ()), folder)
    section = ""
    lines += ["", "# Labels", *_missing_lines(missing.get("", ())), *_example_lines(content, section)]
    for name, parameter in PARAMETERS.items():
        if parameter.section != section:
            section = parameter.section
            lines += ["", f"# {SECTIONS[section].title}", *_example_lines(content, section)]
        comment = parameter.help + (f": {', '.join(parameter.choices)}" if parameter.choices else "")
        value = getattr(getattr(config, section), name)
        lines.append(_line(name, value, comment, is_set=name in content))
    return "\n".join(lines) + "\n"


def _example_lines(content: Mapping[str, Any], section: str) -> Iterator[str]:
    """The keys that are no parameters and stand in front of a section."""
    for key, (example, comment) in _EXAMPLES.get(section, {}).items():
        yield from _entry_lines(key, content.get(key), example, comment)


def _entry_lines(key: str, value: Any, example: Any, comment: str) -> list[str]:
    """A key that is no parameter: a list one entry a line, or an example behind a #."""
    if value is None:
        return [_line(key, example, comment, is_set=False)]
    if isinstance(value, list) and value and isinstance(value[0], dict | list):
        return [f"{key}:".ljust(_COMMENT_COLUMN) + f" # {comment}", *(f"  - {_flow(entry)}" for entry in value)]
    return [_line(key, value, comment, is_set=True)]


def _robot_lines(robot: RobotConfig, missing: Sequence[str], folder: Path | None) -> list[str]:
    """One robot's keys."""
    entry = _robot_to_mapping(robot, folder)
    lines = [f"  - id: {_flow(entry['id'])}", f"    log: {_flow(entry['log'])}"]
    lines += (f"    {line}" for line in _missing_lines(missing))
    for item in dataclasses.fields(RobotConfig):
        if item.metadata:
            value = entry.get(item.name, item.default)
            lines.append(_line(item.name, value, item.metadata["help"], is_set=item.name in entry, indent=4))
    return lines


def _missing_lines(missing: Sequence[str]) -> Iterator[str]:
    """Sentences as comments."""
    for sentence in missing:
        first, *rest = sentence.splitlines()
        yield f"# missing: {first}"
        yield from (f"# {line.strip()}" for line in rest)


def _line(name: str, value: Any, comment: str, *, is_set: bool, indent: int = 0) -> str:
    """One key with its value and what it is for; behind a # where it is not set."""
    shown = f"{name}:" if value is None else f"{name}: {_flow(value)}"
    return f"{' ' * indent}{'' if is_set else '# '}{shown}".ljust(_COMMENT_COLUMN) + f" # {comment}"


def _flow(value: Any) -> str:
    """A value in YAML's flow style, on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_flow(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(part) for part in value) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    if isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _WORDS_OF_YAML:
        return value
    # JSON's strings, numbers and truth values are YAML's too.
    return json.dumps(value)
