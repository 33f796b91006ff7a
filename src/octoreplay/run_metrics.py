"""Metrics of a run: of robots, links and pairs of robots after each tick, and the run's summary.

Times are integer nanoseconds and end in ``_ns``; lengths are metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from octoreplay.data_table import Table
from octoreplay.records import CENTRAL, TEAM, FrameCounts


@dataclass(frozen=True)
class RobotMetrics:
    """Metrics of one robot at one tick. Bytes are those of the map published in this tick (0 while dormant)."""

    robot_id: str
    active: bool
    num_scans: int
    num_iterations: int
    agreement: float
    agreement_occupied: float
    num_leaves: int
    num_cells: int
    observed_volume: float
    entropy_bits: float
    memory_bytes: int
    sent_bytes: int
    packet_bytes: int
    octree_bytes: int
    grid_bytes: int
    unpruned_bytes: int
    unpruned_compressed_bytes: int


@dataclass(frozen=True)
class LinkMetrics:
    """Packets of one directed link in one tick, by outcome. Acknowledgements count in bytes only."""

    sender: str
    receiver: str
    num_sent: int
    sent_bytes: int
    num_delivered: int
    delivered_bytes: int
    num_lost: int
    num_dropped: int
    num_late: int
    num_stale: int
    num_gaps: int
    num_damaged: int
    bytes_per_second: float


MIN_COMPARED_CELLS = 500
"""Number of compared cells from which the contradiction of a pair of robots counts as the team's."""


@dataclass(frozen=True)
class PairMetrics:
    """Contradiction of the evidence of two robots that share known cells; docs/metrics.md defines it.

    Attributes
    ----------
    first, second : str
        The robots, in the team's order.
    overlap_cells : int
        Cells that both know.
    occupied_cells : int
        Of these, cells that one calls occupied and the other occupied or free.
    contradiction : float
        Share of the occupied cells that the other robot calls free; NaN without occupied cells.
    clear_contradiction : float
        Share of the occupied cells that the other robot calls firmly free, and has no occupied cell beside (26
        neighbours); NaN without occupied cells.
    contradiction_of_first, contradiction_of_second : float
        The same over the cells that this robot calls occupied and the other one occupied or free.
    both_occupied_cells : int
        Cells that both call occupied.
    label_contradiction : float
        Share of these with different labels; NaN without such cells.
    """

    first: str
    second: str
    overlap_cells: int
    occupied_cells: int
    contradiction: float
    clear_contradiction: float
    contradiction_of_first: float
    contradiction_of_second: float
    both_occupied_cells: int
    label_contradiction: float


PAIR_SHARES = {
    "contradiction": "occupied_cells",
    "clear_contradiction": "occupied_cells",
    "label_contradiction": "both_occupied_cells",
}
"""Shares of a pair that have a number for the team, and the number of cells that each is a share of."""


def ranked_pairs(pairs: Iterable[PairMetrics], name: str) -> list[PairMetrics]:
    """Return the pairs with at least MIN_COMPARED_CELLS cells for the share ``name``, the largest share first."""
    counted = [pair for pair in pairs if getattr(pair, PAIR_SHARES[name]) >= MIN_COMPARED_CELLS]
    return sorted(counted, key=lambda pair: -float(getattr(pair, name)))


class PairTotals:
    """Team numbers of the pairs of robots: properties of every record with a field ``pairs``."""

    pairs: tuple[PairMetrics, ...]

    @property
    def contradiction(self) -> float:
        """Largest contradiction of a pair; NaN where no pair has enough cells."""
        return self._largest("contradiction")

    @property
    def clear_contradiction(self) -> float:
        """Largest clear contradiction of a pair; NaN where no pair has enough cells."""
        return self._largest("clear_contradiction")

    @property
    def label_contradiction(self) -> float:
        """Largest label contradiction of a pair; NaN where no pair has enough cells."""
        return self._largest("label_contradiction")

    def _largest(self, name: str) -> float:
        """Largest value of a share over the pairs with enough cells."""
        return max((getattr(pair, name) for pair in ranked_pairs(self.pairs, name)), default=math.nan)


@dataclass(frozen=True)
class FramePlace:
    """Frame of one robot's map and poses.

    ``frame_id`` is the name of the frame: 'team', or '<robot>/map' for the map frame of a robot. ``T_frame_map`` maps
    the robot's own map frame to it: x, y, z [m], qx, qy, qz, qw.
    """

    robot_id: str
    frame_id: str
    T_frame_map: tuple[float, ...]


@dataclass(frozen=True)
class TickMetrics(PairTotals):
    """Metrics of the team after one tick; docs/metrics.md defines them.

    ``total_distance_published`` is NaN in results that were written before it was measured. ``pairs`` are the pairs of
    robots that share known cells, in the robots' order; they are empty in results that were written before the
    contradiction of evidence was measured. ``places`` are the frames of all robots where they find them during the run,
    else empty.
    """

    tick: int
    stamp_ns: int
    settling: bool
    total_distance_published: float
    total_distance: float
    total_distance_all: float
    distance_per_leaf: float
    distance_per_cell_and_link: float
    num_known_cells: int
    label_disagreement: float
    max_change: float
    robots: tuple[RobotMetrics, ...]
    links: tuple[LinkMetrics, ...]
    pairs: tuple[PairMetrics, ...] = ()
    places: tuple[FramePlace, ...] = ()

    @property
    def components(self) -> tuple[tuple[str, ...], ...]:
        """Robots with a common frame, the largest group first, then in the robots' order."""
        groups: dict[str, list[str]] = {}
        for robot in self.robots:
            groups.setdefault(self.frame_of(robot.robot_id), []).append(robot.robot_id)
        return tuple(tuple(group) for group in sorted(groups.values(), key=lambda group: -len(group)))

    @property
    def num_components(self) -> int:
        """Number of groups of robots with a common frame."""
        return len(self.components)

    def frame_of(self, robot_id: str) -> str:
        """Return the name of the frame of a robot's map, or of the centralised map."""
        frames = {place.robot_id: place.frame_id for place in self.places}
        if robot_id == CENTRAL and frames:
            robot_id = self.components[0][0]
        return frames.get(robot_id, TEAM)

    @property
    def counted_robots(self) -> tuple[RobotMetrics, ...]:
        """Robots over which team figures are computed: the active ones, or all where none is active."""
        return tuple(robot for robot in self.robots if robot.active) or self.robots


class LinkTotals:
    """Totals of each directed link over many ticks: sums, and the mean of ``bytes_per_second``."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, str], list[float]] = {}
        self._num_ticks: dict[tuple[str, str], int] = {}

    def add(self, links: Iterable[LinkMetrics]) -> None:
        """Add the links of one tick."""
        for link in links:
            ends = (link.sender, link.receiver)
            values = list(vars(link).values())[2:]
            sums = self._sums.get(ends, [0] * len(values))
            self._sums[ends] = [a + b for a, b in zip(sums, values, strict=True)]
            self._num_ticks[ends] = self._num_ticks.get(ends, 0) + 1

    def totals(self) -> tuple[LinkMetrics, ...]:
        """Return the totals of the links in the order in which they first occurred."""
        names = [item.name for item in fields(LinkMetrics)]

        def total(ends: tuple[str, str], sums: list[float]) -> LinkMetrics:
            values: list[Any] = [*ends, *map(int, sums[:-1]), sums[-1] / self._num_ticks[ends]]
            return LinkMetrics(**dict(zip(names, values, strict=True)))

        return tuple(total(ends, sums) for ends, sums in self._sums.items())


@dataclass(frozen=True)
class Join:
    """Event of a run in which two groups of robots got one frame.

    Attributes
    ----------
    tick : int
        First tick in the common frame.
    seconds : float
        Its log time since the run's start [s].
    first, second : str
        Robots between whose maps the pose was found; ``second`` is among those whose frame changed.
    moved : tuple of str
        Robots whose frame changed.
    frame_id : str
        The common frame.
    score : float
        Log-likelihood ratio L of the pose.
    """

    tick: int
    seconds: float
    first: str
    second: str
    moved: tuple[str, ...]
    frame_id: str
    score: float


def log_sent_bytes(metrics: Iterable[TickMetrics]) -> int:
    """Return the bytes that all robots sent before settling."""
    return sum(robot.sent_bytes for tick in metrics if not tick.settling for robot in tick.robots)


@dataclass(frozen=True)
class RunSummary:
    """Summary of a run.

    ``links`` are the directed links over all ticks. ``frame_origins`` are phrases on the origin of each robot's place
    in the team's frame, by robot_id; empty in results without them. ``joins`` are the events in which robots found a
    common frame during the run. ``log_sent_bytes`` is the part of ``total_sent_bytes`` before settling. The wall time
    is not stored in the result.
    """

    num_ticks: int
    num_settling_ticks: int
    stop_reason: str
    log_seconds: float
    wall_seconds: float
    last: TickMetrics
    peak_total_distance: float
    peak_total_distance_all: float
    mean_packet_bytes: float
    mean_octree_bytes: float
    mean_grid_bytes: float
    total_sent_bytes: int
    log_sent_bytes: int
    links: tuple[LinkMetrics, ...]
    frame_counts: Mapping[str, FrameCounts]
    warnings: tuple[str, ...]
    frame_origins: Mapping[str, str] = field(default_factory=dict)
    joins: tuple[Join, ...] = ()

    @property
    def sent_bytes_per_second(self) -> float:
        """Bytes that a robot sent per second of the logs, mean over the robots; NaN for a run of no length."""
        duration = self.log_seconds * len(self.last.robots)
        return self.log_sent_bytes / duration if duration > 0 else math.nan

    def as_table(self) -> Table:
        """Return the numbers and texts of the summary as a table of one row, in the order of the fields.

        The last column is sent_bytes_per_second.
        """
        table = Table.from_records(RunSummary, [self])
        return Table({**table.columns, "sent_bytes_per_second": np.array([self.sent_bytes_per_second])})

    @property
    def lost_data(self) -> bool:
        """True where any log was cut or any frame could not be used."""
        return any(counts.lost_data for counts in self.frame_counts.values())
