"""The team of each rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.consensus import Update
from octoreplay.replay.exchange.packet_codec import PacketCodec
from octoreplay.replay.robots.consensus import ConsensusTeam
from octoreplay.replay.robots.flood import FloodTeam
from octoreplay.replay.robots.latest import LatestTeam
from octoreplay.replay.robots.ratio import RatioTeam
from octoreplay.replay.robots.robot import Robot, Team

TEAMS: Mapping[str, Callable[[ResolvedRun, PacketCodec], Team[Any]]] = MappingProxyType(
    {
        "gradient": partial(ConsensusTeam, update=Update.GRADIENT),
        "bayes": partial(ConsensusTeam, update=Update.MIX),
        "natural": partial(ConsensusTeam, update=Update.NATURAL),
        "merge": partial(ConsensusTeam, update=Update.MERGE),
        "weighted": partial(ConsensusTeam, update=Update.WEIGHTED),
        "local": partial(ConsensusTeam, update=Update.COPY),
        "ratio": RatioTeam,
        "flood": FloodTeam,
        "latest": LatestTeam,
    }
)
"""Team of every rule in ``config.rules.RULES``."""


def make_team(config: ResolvedRun, packet_codec: PacketCodec) -> Team[Robot]:
    """The robots of a run, without evidence.

    Raises ConfigError where the rule cannot hold the log-odds of the sensor model.
    """
    return TEAMS[config.consensus.rule](config, packet_codec)
