"""Tests of the parameters of network, links, packets and schedule in team files."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import pytest

from octoreplay.config.network import LinkConfig, NetworkConfig, ScheduleEntry
from octoreplay.config.packets import PacketConfig
from octoreplay.config.robot import RobotConfig
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import dump_team, load_schedule, parse_team, schedule
from octoreplay.errors import ConfigError

FOLDER = Path("/team")
ROBOTS = "robots: [{id: husky, log: husky.mcap}, {id: jackal, log: jackal.mcap}, {id: spot, log: spot.mcap}]\n"


def _parsed(text, robots=ROBOTS):
    return parse_team(robots + text, name="team.yaml", folder=FOLDER)


def _robots(**fields):
    """Three robots; ``fields`` are set for the first."""
    first = RobotConfig("husky", (FOLDER / "husky.mcap",), **fields)
    return (first, *(RobotConfig(name, (FOLDER / f"{name}.mcap",)) for name in ("jackal", "spot")))


# --- writing and reading ----------------------------------------------------------------------------------------------

SCHEDULE = (
    ScheduleEntry(0.0, 5.0, groups=(("husky",), ("jackal", "spot"))),
    ScheduleEntry(5.0, 7.5, robots_off=("husky",), forget=True),
    ScheduleEntry(6.0, robots_silent=("spot",)),
    ScheduleEntry(8.0, 9.0, links_down=(("husky", "jackal"), ("jackal", "spot")), links_up=(("husky", "spot"),)),
)

CONFIGS = {
    "network": {
        "network": NetworkConfig(
            topology="nearest", num_nearest=1, one_way=(("husky", "jackal"), ("spot", "jackal")), schedule=SCHEDULE,
            network_seed=7, publish_period=0.25, weights="max-degree", after_end="leave",
        )
    },
    "edges": {
        "network": NetworkConfig(
            topology="edges", weights="given", edges=(("husky", "jackal", 0.25), ("jackal", "spot", 0.5)),
            one_way=(("jackal", "husky"),),
        )
    },
    "range": {"network": NetworkConfig(topology="range", radio_range=12.5, range_hysteresis=0.5)},
    "random": {"network": NetworkConfig(topology="random", prob_link=0.25)},
    "links": {
        "link": LinkConfig(
            latency=0.5, jitter=0.25, loss=0.1, burst_start=0.2, burst_end=0.3, burst_loss=0.9, corruption=0.01,
            rate=2e4, queue="drop-tail", queue_bytes=5000,
        ),
        "link_overrides": (
            ("husky", "jackal", (("loss", 0.5), ("queue", "newest"))), ("jackal", "husky", (("loss", 0.5),)),
            ("spot", "husky", (("rate", 100.0), ("queue_bytes", 77), ("latency", 2.0))),
        ),
    },
    "packets": {
        "packet": PacketConfig(
            packets="delta", content="int8", int8_step=0.1, top_classes=2, packet_compression="none", zstd_level=3,
            budget=5000, cast="broadcast", decode_packets=True,
        )
    },
    "key frames": {"packet": PacketConfig(packets="delta", acknowledge=False, key_frame_every=3, content="float16")},
    "periods": {
        "network": NetworkConfig(publish_period=0.25),
        "robots": _robots(publish_period=0.75, publish_phase=0.25),
    },
}  # fmt: skip


@pytest.mark.parametrize("name", CONFIGS)
def test_a_written_team_file_gives_the_same_configuration(name):
    config = RunConfig(**{"robots": _robots(), **CONFIGS[name]})
    text = dump_team(config, FOLDER)
    assert parse_team(text, name="team.yaml", folder=FOLDER) == config
    assert dump_team(parse_team(text, name="team.yaml", folder=FOLDER), FOLDER) == text


def test_the_configurations_above_set_every_parameter_of_links_and_packets():
    for section, default in (("link", LinkConfig()), ("packet", PacketConfig()), ("network", NetworkConfig())):
        changed = {
            item.name
            for entry in CONFIGS.values()
            if section in entry
            for item in dataclasses.fields(default)
            if getattr(entry[section], item.name) != getattr(default, item.name)
        }
        assert changed == {item.name for item in dataclasses.fields(default)}
    in_schedule = {
        item.name
        for entry in SCHEDULE
        for item in dataclasses.fields(entry)
        if getattr(entry, item.name) not in ((), False)
    }
    assert in_schedule == {item.name for item in dataclasses.fields(ScheduleEntry)}


def test_the_meaning_of_a_team_file():
    config = _parsed(
        "one_way: [[husky, jackal]]\n"
        "loss: 0.1\n"
        "links:\n"
        "- {between: [husky, spot], loss: 0.5}\n"
        "- {from: husky, to: spot, latency: 2, jitter: 1}\n"
        "schedule:\n"
        "- {from: 3, robots_off: husky}\n"
        "- {from: 1, to: 2, links_down: [[husky, spot]]}\n"
    )
    assert config.network.one_way == (("husky", "jackal"),)
    assert config.network.schedule == (
        ScheduleEntry(3.0, math.inf, robots_off=("husky",)), ScheduleEntry(1.0, 2.0, links_down=(("husky", "spot"),)),
    )  # fmt: skip
    assert config.link_config("husky", "spot") == LinkConfig(loss=0.5, latency=2.0, jitter=1.0)
    assert config.link_config("spot", "husky") == LinkConfig(loss=0.5)
    assert config.link_config("husky", "jackal") == config.link == LinkConfig(loss=0.1)


def test_publish_periods_are_multiples_of_a_tick():
    robots = ROBOTS.replace("id: husky,", "id: husky, publish_period: 0.5, publish_phase: 0.25,")
    config = _parsed("publish_period: 0.25\n", robots)
    assert (config.robots[0].publish_period, config.robots[0].publish_phase) == (0.5, 0.25)
    # 0.3 is not an exact multiple of 0.1 in floating point.
    config = _parsed("publish_period: 0.1\n", ROBOTS.replace("id: husky,", "id: husky, publish_period: 0.3,"))
    assert config.robots[0].publish_period == 0.3
    with pytest.raises(ConfigError, match=r"robot 'husky': publish_period 0.3 s is not a multiple"):
        config.with_parameters({"publish_period": 0.2})


def test_a_schedule_file_is_a_list_of_entries(tmp_path):
    path = tmp_path / "schedule.yaml"
    path.write_text("- {from: 5, to: 7.5, robots_off: [husky], forget: true}\n- from: 6\n  robots_silent: spot\n")
    assert load_schedule(path) == SCHEDULE[1:3]
    assert schedule([]) == ()


# --- invalid team files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("links: [{from: husky, to: spot, latancy: 1}]", r"links: latancy: unknown key; did you mean 'latency'\?"),
        ("links: [{from: husky, to: spot, packets: delta}]", "links: packets: unknown key"),
        ("links: [{from: husky, loss: 0.1}]", "links: every link needs 'from' and 'to', or 'between' for both"),
        ("links: [{from: husky, between: [husky, spot]}]", "links: every link needs 'from' and 'to', or 'between'"),
        ("links: [{loss: 0.1}]", "links: every link needs"), ("links: [husky]", "links: every link needs"),
        ("links: {from: husky}", "links: expects a list of links"),
        ("links: [{between: [husky], loss: 0.1}]", r"links: between: expects \[robot, robot\], got \['husky'\]"),
        ("links: [{between: husky, loss: 0.1}]", r"links: between: expects \[robot, robot\], got 'husky'"),
        ("links: [{from: husky, to: rover, loss: 0.1}]", "links: robot 'rover' is not in the team: husky, jackal"),
        ("links: [{from: husky, to: husky, loss: 0.1}]", "links: 'husky' cannot have a link to itself"),
        ("links: [{from: husky, to: spot, loss: 1.5}]", "links: husky -> spot: loss: 1.5 is above the largest value 1"),
        ("links: [{from: husky, to: spot, loss: often}]", "links: loss: expects a number, got 'often'"),
        ("links: [{from: husky, to: spot, jitter: 1}]", "links: husky -> spot: jitter: 1 is above latency 0"),
        ("links: [{from: husky, to: spot, queue: oldest}]", "links: husky -> spot: queue: 'oldest' is not one of"),
        ("one_way: [[husky, rover]]", "one_way: robot 'rover' is not in the team"),
        ("one_way: [husky, spot]", "one_way: expects a list of pairs"), ("one_way: husky", "one_way: expects a list"),
        ("one_way: [[husky, husky]]", "one_way: 'husky' cannot have a link to itself"),
        ("one_way: [[husky, spot], [spot, husky]]", "husky -> spot and spot -> husky are both listed; keep the one"),
        ("topology: edges\nedges: [[husky, rover]]", "edges: robot 'rover' is not in the team"),
        ("topology: edges\nweights: given\nedges: [[husky, spot, -0.1]]", "weight of husky - spot must be finite"),
        ("topology: edges\nweights: given\nedges: [[husky, spot, .inf]]", "weight of husky - spot must be finite"),
        ("schedule: [{from: 1, robots_off: [rover]}]", "schedule: robot 'rover' is not in the team"),
        ("schedule: [{from: 1, groups: [[husky], [rover]]}]", "schedule: robot 'rover' is not in the team"),
        ("schedule: [{from: 1, links_up: [[husky, rover]]}]", "schedule: robot 'rover' is not in the team"),
        ("schedule: [{from: 1, robots_of: [husky]}]", "schedule: robots_of: unknown key; did you mean 'robots_off'"),
        ("schedule: [{to: 1, robots_off: [husky]}]", "schedule: every entry is a mapping with 'from'"),
        ("schedule: {from: 1}", "schedule: expects a list of entries"),
        ("schedule: [{from: soon, robots_off: [husky]}]", "schedule: from: 'soon' is not a number of seconds"),
        ("schedule: [{from: 2, to: 1, robots_off: [husky]}]", "lasts from 2 s to 1 s; 'from' must be first"),
        ("schedule: [{from: -1, robots_off: [husky]}]", "from: -1 s is before the run's start"),
        ("schedule: [{from: .nan, robots_off: [husky]}]", "from: nan s is before the run's start"),
        ("schedule: [{from: 1, robots_silent: [husky], forget: true}]", "'forget' goes with robots_off"),
        ("schedule: [{from: 1, robots_off: [husky], forget: 1}]", "schedule: forget: expects true or false, got 1"),
        ("schedule: [{from: 1, robots_off: 5}]", "schedule: robots_off: expects a list of robots"),
        ("schedule: [{from: 1, groups: [husky]}]", "schedule: groups: expects a list of lists of robots"),
        ("schedule: [{from: 1, links_down: [husky]}]", "schedule: links_down: expects a list of pairs"),
        ("jitter: 0.5", "jitter: 0.5 is above latency 0; a delay cannot be negative"),
        ("budget: 1000\npackets: full", "budget: goes with packets 'delta'; a whole map cannot be sent in parts"),
        ("budget: 1000\nrule: ratio", "rule: 'ratio' sends running sums.*without budget"),
        ("budget: 1000\npackets: delta\nacknowledge: false", "budget: goes with acknowledge"),
        ("budget: 10\npackets: delta", "budget: 10 is below the least value 256"),
        ("top_classes: 0", "top_classes: 0 is below the least value 1"),
        ("rule: ratio\ncontent: int8", "rule: 'ratio' sends running sums.*use packets 'full', content 'float32'"),
        ("rule: ratio\npackets: delta", "rule: 'ratio' sends running sums.*use packets 'full'"),
        ("rule: ratio\nprune_tolerance: 0.1", "rule: 'ratio' sends running sums.*prune_tolerance 0"),
        ("rule: ratio\ntop_classes: 3", "rule: 'ratio' sends running sums.*without budget and top_classes"),
        ("rule: flood\nmode: on-arrival", "mode: rule 'flood' does not support 'on-arrival'; use 'sync'"),
        ("rule: ratio\nmode: on-arrival", "mode: rule 'ratio' does not support 'on-arrival'; use 'sync'"),
        ("int8_step: 0", "int8_step: 0.0 is below the least value 1e-06"),
        ("rate: 0", "rate: 0.0 must be greater than 0"),
        ("burst_end: 0", "burst_end: 0.0 must be greater than 0"), ("zstd_level: 23", "zstd_level: 23 is above"),
        ("key_frame_every: 0", "key_frame_every: 0 is below"), ("cast: multicast", "cast: 'multicast' is not one of"),
        ("acknowledge: 1", "acknowledge: expects true or false, got 1"), ("loss: .nan", "loss: nan is not a finite"),
    ],
)  # fmt: skip
def test_invalid_network_settings_are_reported_in_one_sentence(text, sentence):
    with pytest.raises(ConfigError) as caught:
        _parsed(text + "\n")
    message = str(caught.value)
    assert re.search(sentence, message), message
    assert message.startswith("team.yaml: ")
    assert "\n" not in message


@pytest.mark.parametrize("name", ["loss", "burst_start", "burst_end", "burst_loss", "corruption", "prob_link"])
@pytest.mark.parametrize("value", [-0.1, 1.5, math.nan])
def test_probabilities_are_from_0_to_1(name, value):
    with pytest.raises(ConfigError, match=rf"^{name}: (-0.1|1.5|nan) (is|must be)"):
        RunConfig(robots=_robots()).with_parameters({name: value})
    for good in (0.5, 1.0):
        RunConfig(robots=_robots()).with_parameters({name: good})


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ("publish_period: 1.5", r"publish_period 1.5 s is not a multiple of the team's publish_period 1 s"),
        ("publish_phase: 0.3", r"publish_phase 0.3 s is not a multiple of the team's publish_period 1 s"),
        ("publish_period: 0.5", "publish_period 0.5 s is not a multiple"),
        ("publish_period: 1.0e-9", "publish_period 1e-09 s is not a multiple"),
        ("publish_period: 0", "publish_period must be greater than 0"),
        ("publish_period: often", "publish_period: 'often' has the wrong type"),
        ("publish_phase: -1", "publish_phase must not be negative"),
    ],
)
def test_a_period_that_is_not_a_multiple_is_refused(entry, sentence):
    with pytest.raises(ConfigError, match=rf"^team.yaml: robot 'husky': {sentence}"):
        _parsed("", ROBOTS.replace("id: husky,", f"id: husky, {entry},"))
