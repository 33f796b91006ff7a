"""Metrics of a whole run from the counts of its tiles."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping.joined_contradiction import JoinedEvidence
from octoreplay.mapping.stream_size import joined_size, joined_unpruned_size
from octoreplay.records import RobotPose
from octoreplay.replay.network.graph import CommunicationGraph
from octoreplay.replay.robots.robot import MapSizes
from octoreplay.replay.tick_counts import RobotCounts, TickCounts, TileParts, tick_metrics
from octoreplay.run_metrics import LinkMetrics, TickMetrics
from octoreplay.study.tiles.geometry import Tile
from octoreplay.study.tiles.stage import TileFiles
from octoreplay.study.tiles.work import read_ticks


class JoinedTick(NamedTuple):
    """Tick of a whole run: its metrics, graph and poses."""

    metrics: TickMetrics
    graph: CommunicationGraph
    poses: tuple[RobotPose, ...]


def joined_ticks(config: ResolvedRun, tiles: Sequence[Tile], folder: Path) -> Iterator[JoinedTick]:
    """Yield the ticks of a run whose tiles have all settled with the same number of ticks.

    Raises InputError where work files are damaged.
    """
    joiner = _CountsJoiner(config)
    for row in zip(*(read_ticks(TileFiles(folder, tile).ticks) for tile in tiles), strict=True):
        first, counts = row[0], joiner.joined([of_tile.counts for of_tile in row])
        metrics = tick_metrics(config, first.number, first.stamp_ns, counts, settling=first.settling)
        yield JoinedTick(metrics, first.graph, first.poses)


class _CountsJoiner:
    """Join of the counts of tiles, tick by tick."""

    def __init__(self, config: ResolvedRun) -> None:
        self._period_ns = round(config.network.publish_period * 1e9)
        self._robot_ids = [robot.robot_id for robot in config.robots]
        self._evidence = JoinedEvidence(self._robot_ids, config.classes.num_classes)

    def joined(self, tiles: Sequence[TickCounts]) -> TickCounts:
        """Counts of the whole team in one tick."""
        parts = [_parts(counts) for counts in tiles]
        robots = zip(*(counts.robots for counts in tiles), strict=True)
        return TickCounts(
            published_distance=sum(counts.published_distance for counts in tiles),
            comparison=functools.reduce(operator.add, (counts.comparison for counts in tiles)),
            max_change=max(counts.max_change for counts in tiles),
            robots=tuple(_joined_robot(index, of_tiles, parts) for index, of_tiles in enumerate(robots)),
            links=self._joined_links(tiles),
            pairs=self._evidence.joined([of_tile.evidence for of_tile in parts]),
        )

    def _joined_links(self, tiles: Sequence[TickCounts]) -> tuple[LinkMetrics, ...]:
        """Links with the bytes of all tiles. Each tile sends the packets of the whole run, but its part of them."""
        found: dict[tuple[str, str], LinkMetrics] = {}
        for link in (link for counts in tiles for link in counts.links):
            ends = link.sender, link.receiver
            found[ends] = _added(found[ends], link, self._period_ns) if ends in found else link
        place = self._robot_ids.index
        return tuple(found[ends] for ends in sorted(found, key=lambda ends: (place(ends[0]), place(ends[1]))))


def _parts(counts: TickCounts) -> TileParts:
    assert counts.parts is not None
    return counts.parts


def _joined_robot(index: int, of_tiles: Sequence[RobotCounts], parts: Sequence[TileParts]) -> RobotCounts:
    """Counts of one robot of the whole run."""
    first = of_tiles[0]
    return dataclasses.replace(
        first,
        stream=joined_size([of_tile.streams[index] for of_tile in parts]),
        sizes=_joined_sizes(index, of_tiles, parts),
        memory_bytes=sum(robot.memory_bytes for robot in of_tiles),
        sent_bytes=sum(robot.sent_bytes for robot in of_tiles),
        packet_bytes=sum(robot.packet_bytes for robot in of_tiles),
    )


def _joined_sizes(index: int, of_tiles: Sequence[RobotCounts], parts: Sequence[TileParts]) -> MapSizes | None:
    """Sizes of a published map of the whole run; None where the robot published nothing."""
    published = [
        (robot.sizes, of_tile.published[index])
        for robot, of_tile in zip(of_tiles, parts, strict=True)
    ]  # fmt: skip
    sizes = [size for size, _ in published if size is not None]
    streams = [part for _, part in published if part is not None]
    if not sizes:
        return None
    unpruned = [size.unpruned for size in sizes if size.unpruned is not None]
    return MapSizes(
        joined_size(streams),
        sum(size.num_cells for size in sizes),
        joined_unpruned_size(unpruned, streams) if unpruned else None,
        sum(size.unpruned_compressed_bytes for size in sizes),
    )


def _added(first: LinkMetrics, other: LinkMetrics, period_ns: int) -> LinkMetrics:
    """One link with the bytes of two tiles, and the larger of their counts of packets."""
    values = {name: max(value, getattr(other, name)) for name, value in vars(first).items()}
    values["sent_bytes"] = first.sent_bytes + other.sent_bytes
    values["delivered_bytes"] = first.delivered_bytes + other.delivered_bytes
    values["bytes_per_second"] = values["sent_bytes"] / period_ns * 1e9
    return LinkMetrics(**values)
