"""Configuration of a part of a team."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TypeVar

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig

_Config = TypeVar("_Config", bound=RunConfig)


def subteam(config: _Config, robots: Sequence[RobotConfig]) -> _Config:
    """Return the configuration with these robots only, whose ids are among those of ``config``.

    Edges, one-way links, schedule entries and link parameters of other robots are left out. Where an edge list has no
    edge left, the topology is complete.
    """
    kept = {robot.robot_id for robot in robots}

    def is_kept(link: Sequence[object]) -> bool:
        return link[0] in kept and link[1] in kept

    edges = tuple(filter(is_kept, config.network.edges))
    has_topology = bool(edges) or config.network.topology != "edges"
    network = dataclasses.replace(
        config.network,
        topology=config.network.topology if has_topology else "complete",
        weights=config.network.weights if has_topology or config.network.weights != "given" else "metropolis",
        edges=edges,
        one_way=tuple(filter(is_kept, config.network.one_way)),
        schedule=tuple(_entry(entry, kept) for entry in config.network.schedule),
    )
    has_boxes = any(robot.body_box is not None for robot in robots)
    return dataclasses.replace(
        config,
        robots=tuple(robots),
        network=network,
        link_overrides=tuple(filter(is_kept, config.link_overrides)),
        sensor=dataclasses.replace(config.sensor, hide_robots=config.sensor.hide_robots and has_boxes),
    )


def _entry(entry: ScheduleEntry, kept: set[str]) -> ScheduleEntry:
    """A schedule entry for the robots that are kept."""

    def robots(names: Iterable[str]) -> tuple[str, ...]:
        return tuple(name for name in names if name in kept)

    off = robots(entry.robots_off)
    return dataclasses.replace(
        entry,
        groups=tuple(robots(group) for group in entry.groups),
        links_down=tuple(link for link in entry.links_down if kept.issuperset(link)),
        links_up=tuple(link for link in entry.links_up if kept.issuperset(link)),
        robots_off=off,
        robots_silent=robots(entry.robots_silent),
        forget=entry.forget and bool(off),
    )
