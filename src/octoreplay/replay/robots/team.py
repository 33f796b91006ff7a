"""The team of each rule."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from octoreplay.config.run import RunConfig
from octoreplay.replay.exchange.encoder import PacketEncoder
from octoreplay.replay.robots.consensus import ConsensusTeam
from octoreplay.replay.robots.flood import FloodTeam
from octoreplay.replay.robots.ratio import RatioTeam
from octoreplay.replay.robots.robot import Robot, Team

TEAMS: Mapping[str, type[Team[Any]]] = MappingProxyType(
    {
        "gradient": ConsensusTeam,
        "bayes": ConsensusTeam,
        "natural": ConsensusTeam,
        "merge": ConsensusTeam,
        "local": ConsensusTeam,
        "ratio": RatioTeam,
        "flood": FloodTeam,
    }
)
"""Team class of every rule in ``config.rules.RULES``."""


def make_team(config: RunConfig, num_classes: int, encoder: PacketEncoder) -> Team[Robot]:
    """The robots of a run, without evidence.

    Raises ConfigError where the rule cannot hold the log-odds of the sensor model.
    """
    return TEAMS[config.consensus.rule](config, num_classes, encoder)
