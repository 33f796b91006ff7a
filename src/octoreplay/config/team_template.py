"""Commented team files that list every key, written by ``octoreplay init``."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from octoreplay.config.parameters import PARAMETERS, SECTIONS
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import robot_to_mapping, team_to_mapping

_HEAD = """\
# Team file for octoreplay: octoreplay run TEAM.yaml -o OUT.mcap
# A key behind a # has the shown default, or an example value if it has no default. Remove the # to set it.
# The keys are explained in docs/logs.md, docs/classes.md and docs/communication.md.
"""

_COMMENT_COLUMN = 56
_BARE_STRING = re.compile(r"[A-Za-z_/][A-Za-z0-9_/.-]*")
_YAML_WORDS = ("true", "false", "null", "yes", "no", "on", "off", "y", "n")
"""Words that YAML 1.1 or 1.2 reads as another type unless they are quoted."""

_EXAMPLES: Mapping[str, Mapping[str, tuple[Any, str]]] = {
    "": {
        "classes": ("semantickitti", "class table: a list of classes, a file, or the name of a built-in table"),
        "ignored_raw_labels": ([0, 255], "labels without a class"),
        "ignored_raw_colors": ([[0, 0, 0]], "colours without a class"),
        "merge_classes": ({"vehicle": ["car", "truck"]}, "new class: the classes that it replaces"),
        "ignore_hits": (["person"], "classes whose points only mark free space along their rays"),
    },
    "network": {
        "edges": ([["a", "b"], ["b", "c"]], "links of topology edges, each with or without a weight"),
        "one_way": ([["a", "b"]], "links that carry packets from the first robot to the second only"),
        "schedule": ([{"from": 10, "to": 20, "robots_off": ["a"]}], "failures of robots and links, with times [s]"),
    },
    "link": {"links": ([{"between": ["a", "b"], "loss": 0.2}], "links with parameters of their own")},
}  # fmt: skip
"""Example and comment of each key that is not a parameter, by the section that follows the key ('' for the first)."""

_ROBOT_EXAMPLES: Mapping[str, Any] = {
    "pose": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    "T_team_map": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    "sensors": [{"cloud_topic": "/front/points", "max_range": 20.0}, {"cloud_topic": "/rear/points"}],
}
"""Example of keys of a robot that have no default."""


def team_template(
    config: RunConfig,
    missing: Mapping[str, Sequence[str]],
    folder: Path | None = None,
    *,
    notes: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> str:
    """Return the text of a team file with every key: those that ``config`` sets, and the others as comments.

    ``missing`` are sentences that describe missing data, ``notes`` other sentences, both by robot_id ('' for the team);
    they become comments too. ``parse_team`` returns ``config`` again. Log paths are written as by ``dump_team``.
    """
    content = team_to_mapping(config, folder)
    lines = [_HEAD, *(f"# {note}" for note in notes.get("", ())), "robots:"]
    for robot in config.robots:
        comments = [
            *_missing_lines(missing.get(robot.robot_id, ())),
            *(f"# {s}" for s in notes.get(robot.robot_id, ())),
        ]
        lines += _robot_lines(robot, comments, folder)
    section = ""
    lines += ["", "# Labels", *_missing_lines(missing.get("", ())), *_example_lines(content, section)]
    for name, parameter in PARAMETERS.items():
        if parameter.section != section:
            section = parameter.section
            lines += ["", f"# {SECTIONS[section].title}", *_example_lines(content, section)]
        value = getattr(getattr(config, section), name)
        lines.append(_line(name, value, parameter.help, is_set=name in content))
    return "\n".join(lines) + "\n"


def _example_lines(content: Mapping[str, Any], section: str) -> Iterator[str]:
    """Lines of the keys that precede a section's parameters."""
    for key, (example, comment) in _EXAMPLES.get(section, {}).items():
        yield from _entry_lines(key, content.get(key), example, comment)


def _entry_lines(key: str, value: Any, example: Any, comment: str) -> list[str]:
    """Lines of a key that is not a parameter: lists with one entry a line, or the example behind a #."""
    if value is None:
        return [_line(key, example, comment, is_set=False)]
    if isinstance(value, list) and value and isinstance(value[0], dict | list):
        return [f"{key}:".ljust(_COMMENT_COLUMN) + f" # {comment}", *(f"  - {_flow(entry)}" for entry in value)]
    return [_line(key, value, comment, is_set=True)]


def _robot_lines(robot: RobotConfig, comments: Sequence[str], folder: Path | None) -> list[str]:
    """Lines of one robot, with comment lines after its logs."""
    entry = robot_to_mapping(robot, folder)
    lines = [f"  - id: {_flow(entry['id'])}", f"    log: {_flow(entry['log'])}"]
    lines += (f"    {comment}" for comment in comments)
    for item in dataclasses.fields(RobotConfig):
        if item.metadata:
            value = entry.get(item.name, _ROBOT_EXAMPLES.get(item.name, item.default))
            if item.name == "sensors" and robot.sensors:
                lines.append(_line("sensors", None, item.metadata["help"], is_set=True, indent=4))
                lines += (f"      - {_flow(sensor)}" for sensor in value)
                continue
            lines.append(_line(item.name, value, item.metadata["help"], is_set=item.name in entry, indent=4))
    return lines


def _missing_lines(missing: Sequence[str]) -> Iterator[str]:
    """Comment lines of sentences."""
    for sentence in missing:
        first, *rest = sentence.splitlines()
        yield f"# missing: {first}"
        yield from (f"# {line.strip()}" for line in rest)


def _line(name: str, value: Any, comment: str, *, is_set: bool, indent: int = 0) -> str:
    """Line of one key with its value and comment, behind a # unless it is set."""
    shown = f"{name}:" if value is None else f"{name}: {_flow(value)}"
    return f"{' ' * indent}{'' if is_set else '# '}{shown}".ljust(_COMMENT_COLUMN) + f" # {comment}"


def _flow(value: Any) -> str:
    """Value in YAML's flow style, on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_flow(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(part) for part in value) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    if isinstance(value, str) and _BARE_STRING.fullmatch(value) and value.lower() not in _YAML_WORDS:
        return value
    # JSON strings, numbers and booleans are valid YAML.
    return json.dumps(value)
