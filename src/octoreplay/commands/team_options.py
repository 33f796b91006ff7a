"""From the options of a command to a configuration: what counts, from weak to strong, is in docs/cli.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octoreplay.commands.options import write_text
from octoreplay.commands.progress import warn
from octoreplay.config import PRESETS, RunConfig
from octoreplay.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console


def is_team_file(inputs: Sequence[Path]) -> bool:
    """True where an input is a team file rather than a log."""
    return any(path.suffix.lower() in (".yaml", ".yml") for path in inputs)


def base_config(inputs: tuple[Path, ...], config_from: Path | None, err: Console) -> RunConfig:
    """The configuration before any option: of a stored result, of a team file, or found in logs."""
    from octoreplay.io.results.result_reader import ResultReader
    from octoreplay.io.robots import discover
    from octoreplay.team_file import load_team_file

    if config_from is not None:
        if inputs:
            raise click.UsageError(f"--config-from {config_from} names the logs too; leave out {inputs[0]}")
        with ResultReader(config_from) as reader:
            for sentence in reader.changed_inputs():
                warn(err, sentence)
            return reader.config
    if not inputs:
        raise click.UsageError("give a team file or logs: octoreplay run TEAM.yaml -o OUT.mcap")
    if is_team_file(inputs):
        if len(inputs) > 1:
            raise click.UsageError("give one team file, or logs, not both")
        return load_team_file(inputs[0])
    return RunConfig(robots=discover.discover(inputs))


def with_options(base: RunConfig, preset: str | None, edges: str | None, given: dict[str, Any]) -> RunConfig:
    """The configuration with preset and options: an option beats the preset, which beats the file."""
    parameters = {**(PRESETS[preset] if preset is not None else {}), **given}
    network: dict[str, Any] = {name: parameters.pop(name) for name in ("topology", "weights") if name in parameters}
    config = base.with_parameters(parameters)
    if edges is not None:
        links = _links(edges)
        weighted = any(weight is not None for *_, weight in links)
        network = {"topology": "edges", "weights": "given" if weighted else "metropolis", **network, "edges": links}
    elif network.get("topology", "edges") != "edges":
        # A topology by name replaces the file's list of edges, and with it the weights given there.
        network["edges"] = ()
        if base.network.weights == "given":
            network.setdefault("weights", "metropolis")
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **network))


def with_network(config: RunConfig, one_way: str | None, schedule: Path | None) -> RunConfig:
    """The configuration with one-way links and a schedule, where they are given."""
    from octoreplay.team_file import load_schedule

    changes: dict[str, Any] = {}
    if one_way is not None:
        changes["one_way"] = tuple(_pair(entry) for entry in one_way.split(","))
    if schedule is not None:
        changes["schedule"] = load_schedule(schedule)
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **changes))


def _pair(text: str) -> tuple[str, str]:
    """A one-way link from A:B."""
    sender, _, receiver = text.strip().partition(":")
    if not sender or not receiver or ":" in receiver:
        raise ConfigError(f"one_way: '{text}' is not A:B")
    return sender, receiver


def _links(text: str) -> tuple[tuple[str, str, float | None], ...]:
    """Edges from A:B[:W],C:D[:W],..."""
    links = []
    for entry in text.split(","):
        ends = entry.strip().split(":")
        if len(ends) not in (2, 3) or not all(ends):
            raise ConfigError(f"edges: '{entry}' is not A:B or A:B:WEIGHT")
        try:
            links.append((ends[0], ends[1], float(ends[2]) if len(ends) == 3 else None))
        except ValueError:
            raise ConfigError(f"edges: the weight in '{entry}' is not a number") from None
    return tuple(links)


def save_team_file(config: RunConfig, path: Path) -> None:
    """Write a team file whose log paths hold from its own folder."""
    from octoreplay.team_file import dump_team

    robots = tuple(robot.with_absolute_paths() for robot in config.robots)
    write_text(path, dump_team(dataclasses.replace(config, robots=robots), path.parent.resolve()))
