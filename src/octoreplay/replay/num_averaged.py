"""Number of robots whose evidence a robot's map is the mean of (docs/algorithm.md)."""

from __future__ import annotations

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.records import CENTRAL
from octoreplay.replay.network.graph import CommunicationGraph


class NumAveraged:
    """Number N of robots whose evidence each map is the mean of.

    ``by_name`` has it for each robot and for the centralised map.
    """

    def __init__(self, config: ResolvedRun) -> None:
        self._consensus = config.consensus
        self.by_name = dict.fromkeys((*(robot.robot_id for robot in config.robots), CENTRAL), 1)

    def update(self, graph: CommunicationGraph) -> None:
        """Update N of each active robot: the robots that reach it, or the team where evidence goes by origin.

        The map of a dormant robot stays as it is, and so does its N.
        """
        if not self._consensus.map_is_mean:
            return
        ids, is_by_origin = graph.robot_ids, self._consensus.traits.exchanges is Exchanged.EVIDENCE
        for index in range(len(ids)) if is_by_origin else graph.active:
            self.by_name[ids[index]] = len(ids) if is_by_origin else int(graph.num_reaching[index])
