"""Metrics of a tick: comparisons of the team's maps and of the robots' evidence, and the radio's counts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.consensus import sum_of_evidence
from octoreplay.mapping.contradiction import EvidenceComparer, state_limits
from octoreplay.mapping.metrics import MapComparer, MapComparison
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import LinkMetrics, RobotMetrics, TickMetrics
from octoreplay.replay.exchange.messages import Receipt
from octoreplay.replay.network.graph import CommunicationGraph, Link
from octoreplay.replay.network.links import LinkCounts
from octoreplay.replay.robots.robot import MapSizes, Publication, Robot, Team


@dataclass(frozen=True, eq=False)
class Traffic:
    """Packets of one tick: each robot's publication (None: none), and counts and receipts by (sender, receiver)."""

    published: Sequence[Publication | None]
    counts: Mapping[Link, LinkCounts]
    receipts: Mapping[Link, Receipt]


class TickMeasurer:
    """Metrics tick by tick, updated where maps changed.

    ``oracle`` is the centralised map: the sum of the evidence of all robots, evidence from before restarts included.
    """

    def __init__(self, config: ResolvedRun, threads: Executor) -> None:
        num_classes = config.classes.num_classes
        self.oracle = SemanticOctree(config.map.resolution, num_classes)
        self._config = config
        self._threads = threads
        self._robot_ids = tuple(robot.robot_id for robot in config.robots)
        self._comparer = MapComparer(len(self._robot_ids), config.map.prior(num_classes))
        self._evidence_comparer = EvidenceComparer(self._robot_ids, num_classes, state_limits(config.sensor))
        self._period_ns = round(config.network.publish_period * 1e9)

    def forget(self) -> None:
        """Compare all bricks anew in the next tick: a robot's map and evidence were replaced."""
        self._comparer.forget()
        self._evidence_comparer.forget()

    def measure(
        self,
        number: int,
        stamp_ns: int,
        team: Team[Robot],
        graph: CommunicationGraph,
        traffic: Traffic,
        max_change: float,
        *,
        settling: bool,
    ) -> TickMetrics:
        """Metrics of the team after tick ``number`` (docs/metrics.md).

        ``max_change`` is the largest change of a log-odds in the tick.
        """
        changed = np.unique(np.concatenate([robot.changed_evidence(number) for robot in team.robots]))
        sum_of_evidence(self.oracle, team.evidence(), changed, number)
        maps = [robot.map for robot in team.robots]
        comparison = self._comparer.compare(maps, self.oracle, graph.pairs, number, self._threads)
        evidence = [robot.evidence.octree for robot in team.robots]
        pairs = self._evidence_comparer.compare(evidence, number, self._threads)
        links = self._link_metrics(graph, traffic)
        robots = tuple(
            self._robot_metrics(robot, robot.index in graph.active, traffic.published[robot.index], links, comparison)
            for robot in team.robots
        )
        num_leaves = sum(robot.num_leaves for robot in robots)
        return TickMetrics(
            tick=number,
            stamp_ns=stamp_ns,
            settling=settling,
            total_distance=comparison.total_distance,
            total_distance_all=comparison.total_distance_all,
            distance_per_leaf=comparison.total_distance / max(num_leaves, 1),
            distance_per_cell_and_link=comparison.total_distance / max(comparison.num_link_cells, 1),
            num_known_cells=comparison.num_known_cells,
            label_disagreement=comparison.label_disagreement,
            max_change=max_change,
            robots=robots,
            links=links,
            pairs=pairs,
        )

    def _robot_metrics(
        self,
        robot: Robot,
        active: bool,
        published: Publication | None,
        links: Sequence[LinkMetrics],
        comparison: MapComparison,
    ) -> RobotMetrics:
        """One robot's part of the metrics."""
        num_cells = int(comparison.num_cells[robot.index])
        sizes = published.sizes if published else MapSizes()
        sent_bytes = sum(link.sent_bytes for link in links if link.sender == robot.robot_id)
        if published and self._config.packet.cast == "broadcast":
            # One packet reaches all its receivers.
            sent_bytes -= sum((len(receivers) - 1) * message.num_bytes for receivers, message in published.outbox)
        return RobotMetrics(
            robot_id=robot.robot_id,
            active=active,
            num_scans=robot.num_scans,
            num_iterations=robot.num_iterations,
            agreement=float(comparison.agreement[robot.index]),
            agreement_occupied=float(comparison.agreement_occupied[robot.index]),
            num_leaves=robot.streams.num_leaves,
            num_cells=num_cells,
            observed_volume=num_cells * robot.map.resolution**3,
            entropy_bits=float(comparison.entropy_bits[robot.index]),
            memory_bytes=robot.memory_bytes,
            sent_bytes=sent_bytes,
            packet_bytes=published.packet_bytes if published else 0,
            octree_bytes=sizes.octree_bytes,
            grid_bytes=sizes.grid_bytes,
            unpruned_bytes=sizes.unpruned_bytes,
            unpruned_compressed_bytes=sizes.unpruned_compressed_bytes,
        )

    def _link_metrics(self, graph: CommunicationGraph, traffic: Traffic) -> tuple[LinkMetrics, ...]:
        """Metrics of each directed link of the graph, and of every other link with packets in this tick."""
        used = {link for link, count in traffic.counts.items() if count != LinkCounts()}
        entries = []
        for sender, receiver in sorted(used.union(graph.links)):
            count = traffic.counts.get((sender, receiver), LinkCounts())
            receipt = traffic.receipts.get((sender, receiver), Receipt())
            entries.append(
                LinkMetrics(
                    sender=self._robot_ids[sender], receiver=self._robot_ids[receiver],
                    **dataclasses.asdict(count), num_stale=receipt.num_stale, num_gaps=receipt.num_gaps,
                    num_damaged=receipt.num_damaged, bytes_per_second=count.sent_bytes / self._period_ns * 1e9,
                )
            )  # fmt: skip
        return tuple(entries)
