"""Configuration of a part of a team."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.subteam import subteam

BOX = (-1.0, -1.0, 0.0, 1.0, 1.0, 1.0)


def test_a_part_of_a_team_keeps_what_concerns_its_robots_alone():
    robots = [RobotConfig(name, (Path(f"{name}.mcap"),)) for name in ("a", "b", "c")]
    robots[2] = dataclasses.replace(robots[2], body_box=BOX)
    schedule = (
        ScheduleEntry(1.0, robots_off=("c",), forget=True),
        ScheduleEntry(2.0, 3.0, groups=(("a", "c"), ("b",)), links_down=(("a", "b"), ("a", "c")), robots_silent=("b",)),
    )
    config = RunConfig(tuple(robots), link_overrides=(("a", "b", (("loss", 0.1),)), ("a", "c", (("loss", 0.2),))))
    config = config.with_parameters({"hide_robots": True, "resolution": 0.4})
    network = dataclasses.replace(
        config.network,
        topology="edges",
        edges=(("a", "b", None), ("b", "c", None)),
        one_way=(("c", "a"),),
        schedule=schedule,
    )
    part = subteam(dataclasses.replace(config, network=network), robots[:2])
    assert part.robots == tuple(robots[:2])
    assert part.network.edges == (("a", "b", None),)
    assert part.network.one_way == ()
    assert part.network.schedule == (
        ScheduleEntry(1.0),
        ScheduleEntry(2.0, 3.0, groups=(("a",), ("b",)), links_down=(("a", "b"),), robots_silent=("b",)),
    )
    assert part.link_overrides == (("a", "b", (("loss", 0.1),)),)
    assert part.map == config.map
    # No robot of the part has a body to hide.
    assert not part.sensor.hide_robots


def test_without_a_remaining_edge_the_topology_is_complete():
    robots = [RobotConfig(name, (Path(f"{name}.mcap"),)) for name in ("a", "b", "c")]
    config = RunConfig(tuple(robots))
    network = dataclasses.replace(config.network, topology="edges", weights="given", edges=(("a", "c", 0.5),))
    part = subteam(dataclasses.replace(config, network=network), robots[:2]).network
    assert (part.topology, part.weights, part.edges) == ("complete", "metropolis", ())
