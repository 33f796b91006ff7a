"""Counts of a tick: comparisons of the team's maps and of the robots' evidence, and the radio's counts."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.run import RunConfig
from octoreplay.mapping.consensus import sum_of_evidence
from octoreplay.mapping.contradiction import EvidenceComparer, EvidencePart, state_limits
from octoreplay.mapping.metrics import MapComparer, MapComparison
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.stream_size import StreamPart
from octoreplay.replay.exchange.messages import Receipt
from octoreplay.replay.network.graph import CommunicationGraph, Link, step_size
from octoreplay.replay.network.links import LinkCounts
from octoreplay.replay.num_averaged import NumAveraged
from octoreplay.replay.robots.robot import Publication, Robot, Team
from octoreplay.replay.tick_counts import RobotCounts, TickCounts, TileParts
from octoreplay.run_metrics import LinkMetrics, PairMetrics


@dataclass(frozen=True, eq=False)
class Traffic:
    """Packets of one tick: each robot's publication (None: none), and counts and receipts by (sender, receiver)."""

    published: Sequence[Publication | None]
    counts: Mapping[Link, LinkCounts]
    receipts: Mapping[Link, Receipt]


class _Component:
    """Comparison of the maps and of the evidence of robots in one frame; ``oracle`` is the sum of their evidence.

    ``tile_cells`` is None but for a tile of a run.
    """

    def __init__(self, config: ResolvedRun, members: Sequence[int], threads: Executor, tile_cells: int | None) -> None:
        num_classes = config.classes.num_classes
        ids = [config.robots[index].robot_id for index in members]
        self.oracle = SemanticOctree(config.map.resolution, num_classes)
        self.members = tuple(members)
        self._threads = threads
        self._is_new = True
        self._since = 0
        self._config = config
        self._comparer = MapComparer(len(ids), config.map.prior(num_classes))
        self._evidence_comparer = EvidenceComparer(
            ids, num_classes, state_limits(config.effective_sensor), tile_cells=tile_cells
        )

    def forget(self) -> None:
        """Compare all bricks anew in the next tick: a robot's map and evidence were replaced."""
        self._comparer.forget()
        self._evidence_comparer.forget()

    def published_distance(self, number: int, team: Team[Robot], graph: CommunicationGraph) -> float:
        """Phi of the maps as published in a tick, before the iterations; updates the oracle."""
        robots = [team.robots[index] for index in self.members]
        if self._is_new:
            changed = np.unique(np.concatenate([robot.evidence.octree.codes for robot in robots]))
        else:
            changed = np.unique(np.concatenate([robot.changed_evidence(number) for robot in robots]))
        self._since = 0 if self._is_new else number
        self._is_new = False
        sum_of_evidence(self.oracle, team.evidence(self.members), changed, number)
        maps, links = self._maps_and_links(team, graph)
        return self._comparer.link_distance(maps, links, self._since, self._threads)

    def compare(
        self, team: Team[Robot], graph: CommunicationGraph, num_averaged: Sequence[int]
    ) -> tuple[MapComparison, tuple[PairMetrics, ...]]:
        """Comparison of the maps after a tick, arrays over all robots, and the metrics of the pairs of members.

        ``num_averaged`` (N,) is the number of robots whose mean each robot's map is.
        """
        maps, links = self._maps_and_links(team, graph)
        least_tie = len(team.robots) * rest_difference(self._config, graph)
        comparison = self._comparer.compare(
            maps, self.oracle, links, self._since, self._threads,
            least_tie=least_tie, num_averaged=[num_averaged[index] for index in self.members],
        )  # fmt: skip
        evidence = [team.robots[index].evidence.octree for index in self.members]
        pairs = self._evidence_comparer.compare(evidence, self._since, self._threads)
        return comparison.spread(self.members, len(team.robots)), pairs

    def evidence_part(self) -> EvidencePart:
        """Part of the last comparison of the evidence of a tile that is joined with those of other tiles."""
        return self._evidence_comparer.part()

    def _maps_and_links(
        self, team: Team[Robot], graph: CommunicationGraph
    ) -> tuple[list[SemanticOctree], list[tuple[int, int]]]:
        """The members' maps, and the links between members as positions among them."""
        position = {index: place for place, index in enumerate(self.members)}
        links = [(position[i], position[j]) for i, j in graph.pairs if i in position and j in position]
        return [team.robots[index].map for index in self.members], links


def rest_difference(config: RunConfig, graph: CommunicationGraph) -> float:
    """Largest difference of two neighbours' log-odds at rest: quantum / (2 epsilon A_min) with flows, else 0."""
    weights = graph.weights[graph.weights > 0.0]
    if not config.effective_flow_bits or not weights.size:
        return 0.0
    return config.consensus.effective_quantum / (2.0 * step_size(graph, config.consensus) * float(weights.min()))


class TickMeasurer:
    """Counts tick by tick, updated where maps changed.

    ``oracle`` is the centralised map: the sum of the evidence of all robots, evidence from before restarts included. Of
    several components of robots, it is that of the first one. For a tile of a run, with an edge of ``tile_cells``, the
    counts have ``parts``.
    """

    def __init__(self, config: ResolvedRun, threads: Executor, tile_cells: int | None = None) -> None:
        self._config = config
        self._threads = threads
        self._tile_cells = tile_cells
        self._robot_ids = tuple(robot.robot_id for robot in config.robots)
        self._period_ns = round(config.network.publish_period * 1e9)
        self._published_parts: list[StreamPart] = []
        self._components: list[_Component] = []
        self._num_averaged = NumAveraged(config)
        self.regroup([range(len(self._robot_ids))])

    @property
    def oracle(self) -> SemanticOctree:
        """The centralised map."""
        return self._components[0].oracle

    @property
    def num_averaged(self) -> dict[str, int]:
        """Number of robots whose mean each map is after the last tick, by robot_id and for the centralised map."""
        return dict(self._num_averaged.by_name)

    def regroup(self, components: Sequence[Sequence[int]]) -> None:
        """Compare robots with those of their component only from the next tick on; each has an oracle of its own."""
        kept = {component.members: component for component in self._components}
        self._components = [
            kept.get(tuple(members)) or _Component(self._config, members, self._threads, self._tile_cells)
            for members in components
        ]

    def forget(self) -> None:
        """Compare all bricks anew in the next tick: a robot's map and evidence were replaced."""
        for component in self._components:
            component.forget()

    def published_distance(self, number: int, team: Team[Robot], graph: CommunicationGraph) -> float:
        """Phi of the maps as published in tick ``number``; ``measure`` must follow after the iterations."""
        if self._tile_cells is not None:
            self._published_parts = [robot.stream_part(self._tile_cells) for robot in team.robots]
        return sum(component.published_distance(number, team, graph) for component in self._components)

    def measure(
        self,
        team: Team[Robot],
        graph: CommunicationGraph,
        traffic: Traffic,
        published_distance: float,
        max_change: float,
    ) -> TickCounts:
        """Counts of the team after a tick. ``max_change`` is the largest change of a log-odds by the iterations."""
        self._num_averaged.update(graph)
        num_averaged = [self._num_averaged.by_name[robot_id] for robot_id in self._robot_ids]
        compared = [component.compare(team, graph, num_averaged) for component in self._components]
        links = self._link_metrics(graph, traffic)
        sent_bytes = dict.fromkeys(self._robot_ids, 0)
        for link in links:
            sent_bytes[link.sender] += link.sent_bytes
        robots = tuple(
            self._robot_counts(
                robot, robot.index in graph.active, traffic.published[robot.index], sent_bytes[robot.robot_id]
            )
            for robot in team.robots
        )
        return TickCounts(
            published_distance=published_distance,
            comparison=functools.reduce(operator.add, (of_maps for of_maps, _ in compared)),
            max_change=max_change,
            robots=robots,
            links=links,
            pairs=tuple(pair for _, pairs in compared for pair in pairs),
            parts=None if self._tile_cells is None else self._parts(team, traffic, self._tile_cells),
        )

    def _parts(self, team: Team[Robot], traffic: Traffic, tile_cells: int) -> TileParts:
        """Parts of the counts of a tile that are joined with those of other tiles."""
        published = (
            part if publication and publication.sizes else None
            for part, publication in zip(self._published_parts, traffic.published, strict=True)
        )  # fmt: skip
        (component,) = self._components
        return TileParts(
            tuple(robot.stream_part(tile_cells) for robot in team.robots), tuple(published), component.evidence_part()
        )

    def _robot_counts(
        self, robot: Robot, is_active: bool, published: Publication | None, sent_bytes: int
    ) -> RobotCounts:
        """One robot's part of the counts; ``sent_bytes`` are those of its links."""
        if published and self._config.effective_packet.cast == "broadcast":
            # One packet reaches all its receivers.
            sent_bytes -= sum((len(receivers) - 1) * message.num_bytes for receivers, message in published.messages)
        return RobotCounts(
            robot_id=robot.robot_id,
            is_active=is_active,
            num_scans=robot.num_scans,
            num_iterations=robot.num_iterations,
            stream=robot.size,
            sizes=published.sizes if published else None,
            memory_bytes=robot.memory_bytes,
            sent_bytes=sent_bytes,
            packet_bytes=published.packet_bytes if published else 0,
        )

    def _link_metrics(self, graph: CommunicationGraph, traffic: Traffic) -> tuple[LinkMetrics, ...]:
        """Metrics of each directed link of the graph, and of every other link with packets in this tick."""
        no_counts, no_receipt, ids = LinkCounts(), Receipt(), self._robot_ids
        entries = []
        for link in sorted(traffic.counts.keys() | graph.links):
            count, receipt = traffic.counts.get(link, no_counts), traffic.receipts.get(link, no_receipt)
            entries.append(
                LinkMetrics(
                    sender=ids[link[0]], receiver=ids[link[1]], **vars(count), num_stale=receipt.num_stale,
                    num_gaps=receipt.num_gaps, num_damaged=receipt.num_damaged,
                    bytes_per_second=count.sent_bytes / self._period_ns * 1e9,
                )
            )  # fmt: skip
        return tuple(entries)
