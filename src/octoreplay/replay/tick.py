"""State of the team after a tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import RobotPose
from octoreplay.replay.network.graph import CommunicationGraph
from octoreplay.replay.robots.robot import Publication
from octoreplay.replay.tick_counts import TickCounts
from octoreplay.run_metrics import TickMetrics


@dataclass(frozen=True, eq=False)
class Tick:
    """The team after one tick.

    ``counts`` are those that the ``metrics`` were computed from. ``maps`` are the robots' octrees h_i - h_0, and
    ``evidence`` their octrees s_i; the next tick changes both. ``num_averaged`` has, for each robot_id and for the
    centralised map, the number of robots whose mean a map is.
    """

    number: int
    stamp_ns: int
    settling: bool
    graph: CommunicationGraph
    published: tuple[Publication | None, ...]
    maps: tuple[SemanticOctree, ...]
    evidence: tuple[SemanticOctree, ...]
    oracle: SemanticOctree
    poses: tuple[RobotPose, ...]
    metrics: TickMetrics
    counts: TickCounts
    num_averaged: Mapping[str, int]


def falls_due(elapsed_ns: int, period_ns: int, every: float) -> bool:
    """True when a multiple of ``every`` seconds lies in the period that ends ``elapsed_ns`` after the start."""
    interval = max(round(every * 1e9), 1)
    return elapsed_ns // interval > (elapsed_ns - period_ns) // interval
