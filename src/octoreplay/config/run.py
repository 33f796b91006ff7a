"""Configuration of a run.

Every parameter has one name: in the team file (a flat key), on the command line (``--name-with-dashes``) and here.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

from octoreplay.config.alignment import ON_AIR, AlignmentConfig
from octoreplay.config.class_tables.edits import Merges
from octoreplay.config.consensus import FLOW_BITS, ConsensusConfig
from octoreplay.config.file_url import FileUrl
from octoreplay.config.network import POSITION_TOPOLOGIES, LinkConfig, NetworkConfig
from octoreplay.config.output import OutputConfig
from octoreplay.config.packets import PacketConfig
from octoreplay.config.parameters import coerced
from octoreplay.config.robot import RobotConfig
from octoreplay.config.sensor import MapConfig, SensorConfig, rounded_sensor
from octoreplay.config.time import TimeConfig
from octoreplay.errors import ConfigError
from octoreplay.records import ClassTable

MAX_ROBOTS = 1_000
"""Largest number of robots of a team: links, weights and pairs are N x N, and packets hold a robot's index in 16 bits.
"""


@dataclass(frozen=True)
class RunConfig:
    """Configuration of a run.

    Raises ConfigError for values that are out of range or do not fit together.

    Attributes
    ----------
    robots : tuple of RobotConfig
        The team.
    classes : ClassTable or None
        Class table; None where the logs contain it.
    merge_classes, ignore_hits : tuple
        Classes of the logs' class table to merge, and classes that free their rays and are not mapped.
    link_overrides : tuple of (sender, receiver, values)
        Values that differ from ``link`` in one direction of a link.
    """

    robots: tuple[RobotConfig, ...]
    classes: ClassTable | None = None
    merge_classes: Merges = ()
    ignore_hits: tuple[str, ...] = ()
    sensor: SensorConfig = field(default_factory=SensorConfig)
    map: MapConfig = field(default_factory=MapConfig)
    consensus: ConsensusConfig = field(default_factory=ConsensusConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    link: LinkConfig = field(default_factory=LinkConfig)
    packet: PacketConfig = field(default_factory=PacketConfig)
    link_overrides: tuple[tuple[str, str, tuple[tuple[str, Any], ...]], ...] = ()
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    time: TimeConfig = field(default_factory=TimeConfig)
    output: OutputConfig = field(default_factory=OutputConfig)

    def __post_init__(self) -> None:
        if not self.robots:
            raise ConfigError("robots: a team needs at least one robot")
        if len(self.robots) > MAX_ROBOTS:
            raise ConfigError(
                f"robots: {len(self.robots):,} robots are more than {MAX_ROBOTS:,}, the largest team of a run; replay"
                " parts of the team"
            )
        ids = [robot.robot_id for robot in self.robots]
        for robot_id, number in Counter(ids).items():
            if number > 1:
                raise ConfigError(f"robots: '{robot_id}' is listed twice")
        self._check_urls()
        self._check_edges(ids)
        for key, robot_id in _named_robots(self):
            if robot_id not in ids:
                raise ConfigError(f"{key}: robot '{robot_id}' is not in the team: {', '.join(sorted(ids))}")
        self._check_link_overrides()
        self._check_publish_times()
        for view in (view for robot in self.robots for view in robot.views):
            if view.max_range is not None and view.max_range > self.sensor.max_range:
                raise ConfigError(
                    f"robot '{view.robot_id}': max_range {view.max_range:g} m is above the team's max_range "
                    f"{self.sensor.max_range:g} m; raise the team's, which is the limit of all sensors"
                )
            if (view.min_range or 0.0) >= self.sensor.max_range or (
                view.max_range or math.inf
            ) <= self.sensor.min_range:
                raise ConfigError(
                    f"robot '{view.robot_id}': its own range and the team's, {self.sensor.min_range:g} - "
                    f"{self.sensor.max_range:g} m, leave no measured point"
                )
        if self.sensor.hide_robots and all(robot.body_box is None for robot in self.robots):
            raise ConfigError("hide_robots: no robot has a body_box; give it in the team file")
        _check_rule(self)
        _ = self.effective_sensor  # raises ConfigError
        if self.alignment.is_on_air:
            _check_on_air(self)

    def _check_urls(self) -> None:
        """Raise ConfigError for two URLs that results, which do not store queries, could not tell apart."""
        urls = {path for robot in self.robots for path in robot.files if isinstance(path, FileUrl)}
        for name, number in Counter(map(str, urls)).items():
            if number > 1:
                raise ConfigError(
                    f"robots: {number} URLs of '{name}' differ only in what results do not store (user, password and"
                    " query); download these files"
                )

    def _check_edges(self, ids: Sequence[str]) -> None:
        """Raise ConfigError for an edge with an unknown robot, to itself, or with an invalid weight."""
        for sender, receiver, weight in self.network.edges:
            for robot_id in (sender, receiver):
                if robot_id not in ids:
                    raise ConfigError(f"edges: robot '{robot_id}' is not in the team: {', '.join(sorted(ids))}")
            if sender == receiver:
                raise ConfigError(f"edges: '{sender}' cannot have a link to itself")
            if weight is not None and not 0 <= weight < math.inf:
                raise ConfigError(f"edges: the weight of {sender} - {receiver} must be finite and at least 0")

    def _check_link_overrides(self) -> None:
        """Raise ConfigError for a link to itself, and for values that do not fit together."""
        for sender, receiver, _ in self.link_overrides:
            if sender == receiver:
                raise ConfigError(f"links: '{sender}' cannot have a link to itself")
            try:
                self.link_config(sender, receiver)
            except ConfigError as error:
                raise ConfigError(f"links: {sender} -> {receiver}: {error}") from error

    def _check_publish_times(self) -> None:
        """Raise ConfigError where a robot's period or phase is not a multiple of the team's period."""
        for robot in self.robots:
            for name, value in (("publish_period", robot.publish_period), ("publish_phase", robot.publish_phase)):
                ticks = (value or 0.0) / self.network.publish_period
                if abs(ticks - round(ticks)) > 1e-6 or (value and round(ticks) == 0):
                    raise ConfigError(
                        f"robot '{robot.robot_id}': {name} {value:g} s is not a multiple of the team's publish_period"
                        f" {self.network.publish_period:g} s, the length of a tick"
                    )

    def link_config(self, sender: str, receiver: str) -> LinkConfig:
        """Link configuration from one robot to another."""
        values = [changes for a, b, changes in self.link_overrides if (a, b) == (sender, receiver)]
        if not values:
            return self.link
        return dataclasses.replace(self.link, **{name: value for changes in values for name, value in changes})

    @cached_property
    def effective_sensor(self) -> SensorConfig:
        """Sensor model of the run: increments and clamps are multiples of the run's quantum."""
        return rounded_sensor(self.sensor, self.consensus.effective_quantum)

    @cached_property
    def effective_packet(self) -> PacketConfig:
        """Packets of the run: ``packets`` is the kind that the rule sends by default where none is given."""
        return dataclasses.replace(self.packet, packets=self.packet.packets or self.consensus.traits.packets[0])

    @property
    def has_exact_packets(self) -> bool:
        """True where packets hold the published maps unchanged."""
        return self.packet.is_exact and self.map.prune_tolerance == 0.0

    @property
    def effective_flow_bits(self) -> int:
        """Bits of the flows; 0 for rules without flows and runs without a quantum.

        The default is FLOW_BITS with exact packets and 0 with others: maps that differ by the packets' rounding would
        exchange flows for ever.
        """
        if not self.consensus.traits.has_flows or self.consensus.effective_quantum == 0.0:
            return 0
        if self.consensus.flow_bits is not None:
            return self.consensus.flow_bits
        return FLOW_BITS if self.has_exact_packets else 0

    def with_parameters(self, values: Mapping[str, Any]) -> Self:
        """Return the configuration with flat parameters replaced.

        Raises ConfigError for a name that is no parameter, a value of the wrong type or one out of range.
        """
        changes = coerced(values)
        sections = {name: dataclasses.replace(getattr(self, name), **fields) for name, fields in changes.items()}
        return dataclasses.replace(self, **sections)


def _named_robots(config: RunConfig) -> Iterator[tuple[str, str]]:
    """Pairs (parameter, robot) of the robots that the network's parameters name, except in edges."""
    for pair in config.network.one_way:
        yield from (("one_way", robot_id) for robot_id in pair)
    for entry in config.network.schedule:
        for group in (*entry.groups, *entry.links_down, *entry.links_up, entry.robots_off, entry.robots_silent):
            yield from (("schedule", robot_id) for robot_id in group)
    for sender, receiver, _ in config.link_overrides:
        yield from (("links", robot_id) for robot_id in (sender, receiver))


def _check_rule(config: RunConfig) -> None:
    """Raise ConfigError where the rule does not support the mode or the packets."""
    rule, packet = config.consensus.traits, config.packet
    if config.consensus.mode not in rule.modes:
        raise ConfigError(
            f"mode: rule '{rule.name}' does not support '{config.consensus.mode}';"
            f" use {' or '.join(map(repr, rule.modes))}"
        )
    is_unsupported = packet.packets is not None and packet.packets not in rule.packets
    if is_unsupported or (rule.needs_exact_packets and not config.has_exact_packets):
        raise ConfigError(
            f"rule: '{rule.name}' sends {rule.exchanges.value}, which receivers need whole and exact; use packets"
            f" '{rule.packets[0]}', content 'float32' and prune_tolerance 0, without budget and top_classes"
        )


def _check_on_air(config: RunConfig) -> None:
    """Raise ConfigError for settings that need one frame of all robots from the beginning."""
    if config.network.topology in POSITION_TOPOLOGIES:
        raise ConfigError(
            f"align: '{ON_AIR}' has no positions in one frame, which topology '{config.network.topology}' needs; use"
            " another topology, or find the frames first with 'octoreplay align'"
        )
    if len(config.map.bounds) == 6:
        raise ConfigError(
            f"bounds: x and y are in the team's frame, which robots do not know with align '{ON_AIR}'; give ZMIN,ZMAX"
        )
    if config.sensor.hide_robots:
        raise ConfigError(
            f"hide_robots: needs the positions of all robots from the beginning, which align '{ON_AIR}' does not give;"
            " find the frames first with 'octoreplay align'"
        )
    if any(entry.forget for entry in config.network.schedule):
        raise ConfigError(
            f"schedule: 'forget' does not go with align '{ON_AIR}', because a robot without memory has no frame"
        )
