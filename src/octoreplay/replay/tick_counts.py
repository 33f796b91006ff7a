"""Counts of one tick, from which its metrics are computed; counts of different tiles of the space are joined.

A tile's counts know its own cells only. Sums of numbers of cells, distances and bytes add up; sizes of streams and the
contradiction of evidence are joined by the functions of ``mapping`` that measured them.
"""

from __future__ import annotations

from dataclasses import dataclass

from octoreplay.config.resolved import ResolvedRun
from octoreplay.mapping import codec
from octoreplay.mapping.contradiction import EvidencePart
from octoreplay.mapping.metrics import MapComparison
from octoreplay.mapping.stream_size import StreamPart
from octoreplay.mapping.streams import StreamSize
from octoreplay.replay.robots.robot import MapSizes
from octoreplay.run_metrics import LinkMetrics, PairMetrics, RobotMetrics, TickMetrics


@dataclass(frozen=True, eq=False)
class RobotCounts:
    """Counts of one robot in one tick.

    ``sizes`` are those of the map that it published (None: none), and ``packet_bytes`` the mean length of its packets.
    ``stream`` is the size of the map's stream after the tick.
    """

    robot_id: str
    is_active: bool
    num_scans: int
    num_iterations: int
    stream: StreamSize
    sizes: MapSizes | None
    memory_bytes: int
    sent_bytes: int
    packet_bytes: int


@dataclass(frozen=True, eq=False)
class TileParts:
    """Parts of the counts of a tile that are joined with those of other tiles by functions of ``mapping``.

    ``streams`` are the sizes of the robots' maps after the tick, and ``published`` those of the maps that they
    published (None: none).
    """

    streams: tuple[StreamPart, ...]
    published: tuple[StreamPart | None, ...]
    evidence: EvidencePart


@dataclass(frozen=True, eq=False)
class TickCounts:
    """Counts of the team after one tick. ``parts`` are None but for a tile."""

    published_distance: float
    comparison: MapComparison
    max_change: float
    robots: tuple[RobotCounts, ...]
    links: tuple[LinkMetrics, ...]
    pairs: tuple[PairMetrics, ...]
    parts: TileParts | None = None


def tick_metrics(config: ResolvedRun, number: int, stamp_ns: int, counts: TickCounts, *, settling: bool) -> TickMetrics:
    """Return the metrics of a tick (docs/metrics.md) from its counts, without ``places``."""
    comparison = counts.comparison
    num_leaves = sum(robot.stream.num_leaves for robot in counts.robots)
    return TickMetrics(
        tick=number,
        stamp_ns=stamp_ns,
        settling=settling,
        total_distance_published=counts.published_distance,
        total_distance=comparison.total_distance,
        total_distance_all=comparison.total_distance_all,
        distance_per_leaf=comparison.total_distance / max(num_leaves, 1),
        distance_per_cell_and_link=comparison.total_distance / max(comparison.num_link_cells, 1),
        num_known_cells=comparison.num_known_cells,
        label_disagreement=comparison.label_disagreement,
        max_change=counts.max_change,
        robots=tuple(_robot_metrics(config, index, robot, comparison) for index, robot in enumerate(counts.robots)),
        links=counts.links,
        pairs=counts.pairs,
    )


def _robot_metrics(config: ResolvedRun, index: int, robot: RobotCounts, comparison: MapComparison) -> RobotMetrics:
    """Metrics of one robot."""
    num_cells, num_classes, sizes = int(comparison.num_cells[index]), config.classes.num_classes, robot.sizes
    unpruned = sizes.unpruned if sizes else None
    return RobotMetrics(
        robot_id=robot.robot_id,
        active=robot.is_active,
        num_scans=robot.num_scans,
        num_iterations=robot.num_iterations,
        agreement=float(comparison.agreement[index]),
        agreement_occupied=float(comparison.agreement_occupied[index]),
        num_leaves=robot.stream.num_leaves,
        num_cells=num_cells,
        observed_volume=num_cells * config.map.resolution**3,
        entropy_bits=float(comparison.entropy_bits[index]),
        memory_bytes=robot.memory_bytes,
        sent_bytes=robot.sent_bytes,
        packet_bytes=robot.packet_bytes,
        octree_bytes=codec.HEADER_BYTES + sizes.stream.num_bytes(num_classes) if sizes else 0,
        grid_bytes=codec.grid_bytes(sizes.num_cells, num_classes) if sizes else 0,
        unpruned_bytes=codec.HEADER_BYTES + unpruned.num_bytes(num_classes) if unpruned else 0,
        unpruned_compressed_bytes=sizes.unpruned_compressed_bytes if sizes else 0,
    )
