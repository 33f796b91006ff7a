"""Run configuration from the options of a command; docs/cli.md has the precedence of settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import click

from octoreplay.commands.console import terminal
from octoreplay.commands.options import RareOption, numbers
from octoreplay.config.file_url import InputFile
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.errors import ConfigError, suggestion
from octoreplay.io.output_file import write_whole

if TYPE_CHECKING:
    from octoreplay.io.robots.survey import LogSurveys


def is_team_file(inputs: Sequence[InputFile]) -> TypeGuard[Sequence[Path]]:
    """True if an input is a team file, not a log."""
    return any(isinstance(path, Path) and path.suffix.lower() in (".yaml", ".yml") for path in inputs)


static_pose_option = click.option(
    "--static-pose", "static_poses", cls=RareOption, multiple=True, metavar="[ROBOT=]X,Y,Z,QX,QY,QZ,QW",
    help="pose of a sensor that stands still, instead of poses from the log; name the robot where there are several",
)  # fmt: skip


def base_config(
    inputs: tuple[InputFile, ...], config_from: Path | None, surveys: LogSurveys, static_poses: Sequence[str] = ()
) -> RunConfig:
    """Return the configuration before options: from a stored result, from a team file, or detected in logs.

    ``static_poses`` are texts as --static-pose takes them; they replace the pose sources of their robots.
    """
    config = _config_of(inputs, config_from, surveys, static_poses)
    return dataclasses.replace(config, robots=tuple(with_static_poses(config.robots, static_poses)))


def with_static_poses(robots: Sequence[RobotConfig], static_poses: Sequence[str]) -> list[RobotConfig]:
    """Return robots with the poses of sensors that stand still. Raises ConfigError for an unknown or unnamed robot."""
    found = {robot.robot_id: robot for robot in robots}
    for text in static_poses:
        name, separator, values = text.rpartition("=")
        if not separator and len(found) > 1:
            raise ConfigError(f"static_pose: name the robot, one of {', '.join(found)}: {next(iter(found))}={text}")
        robot = found.get(name) if separator else next(iter(found.values()))
        if robot is None:
            raise ConfigError(f"static_pose: there is no robot '{name}'{suggestion(name, found)}")
        pose = numbers("static_pose", values, 7)
        found[robot.robot_id] = robot.with_poses(pose=pose)
    return list(found.values())


def _config_of(
    inputs: tuple[InputFile, ...], config_from: Path | None, surveys: LogSurveys, static_poses: Sequence[str]
) -> RunConfig:
    """Configuration from a stored result, from a team file, or detected in logs with some static poses."""
    from octoreplay.config.team_file import load_team_file
    from octoreplay.io.results.result_reader import ResultReader
    from octoreplay.io.robots import discover

    if config_from is not None:
        if inputs:
            raise click.UsageError(f"--config-from {config_from} also sets the logs; leave out {inputs[0]}")
        with ResultReader(config_from) as reader:
            for sentence in reader.changed_inputs():
                terminal().warn(sentence)
            return reader.config
    if not inputs:
        raise click.UsageError("name a team file or logs: octoreplay run TEAM.yaml -o OUT.mcap")
    if is_team_file(inputs):
        if len(inputs) > 1:
            raise click.UsageError("name one team file or several logs, not both")
        return load_team_file(inputs[0])
    for path in inputs:
        if isinstance(path, Path) and (path / "team.yaml").is_file():
            raise ConfigError(f"{path}: contains a team file; name {path / 'team.yaml'}, or its logs one by one")
    robots = discover.discover(inputs, surveys, edit=lambda robots: with_static_poses(robots, static_poses))
    return RunConfig(robots=robots)


def with_network(config: RunConfig, one_way: str | None, schedule: Path | None) -> RunConfig:
    """Return the configuration with one-way links and a schedule, if given."""
    from octoreplay.config.team_file import load_schedule

    changes: dict[str, Any] = {}
    if one_way is not None:
        changes["one_way"] = tuple(_pair(entry) for entry in one_way.split(","))
    if schedule is not None:
        changes["schedule"] = load_schedule(schedule)
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **changes))


def _pair(text: str) -> tuple[str, str]:
    """One-way link of a text A:B."""
    sender, _, receiver = text.strip().partition(":")
    if not sender or not receiver or ":" in receiver:
        raise ConfigError(f"one_way: '{text}' is not A:B")
    return sender, receiver


def save_team_file(config: RunConfig, path: Path) -> None:
    """Write a team file with log paths relative to its own folder, or absolute if elsewhere."""
    from octoreplay.config.team_file import dump_team

    robots = tuple(robot.with_absolute_paths() for robot in config.robots)
    write_whole(path, dump_team(dataclasses.replace(config, robots=robots), path.parent.resolve()))
