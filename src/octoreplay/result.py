"""The Python API on a stored result: any robot's map at any stored tick as arrays, and what is where.

::

    with open_result(Path("result.mcap")) as result:
        stored = result.map("husky_1")                       # the last map; at_ns=... or tick=... for an earlier one
        leaves = stored.leaves()                             # centres, sizes, log-odds
        answer = stored.query(np.array([[1.0, 2.0, 0.5]]))   # what is there, and how sure
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

from octoreplay.config.run import RunConfig
from octoreplay.errors import InputError, PacketError
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.log_odds import best_labels, class_probabilities, team_log_odds
from octoreplay.mapping.codec import apply_delta, decode_packet
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import (
    CENTRAL,
    BoolArray,
    ClassTable,
    Float32Array,
    Float64Array,
    FloatArray,
    LeafTable,
    MapState,
    RunSummary,
    TickMetrics,
    UInt8Array,
)


@dataclass(frozen=True, eq=False)
class PointQuery:
    """What a map says about P points.

    ``log_odds`` (P, C) float32, log p(c) / p(free), the prior included; ``probabilities`` (P, C + 1) float32, free
    first; ``labels`` (P,) uint8, the most probable class_id, 0 for free; ``known`` (P,) bool, False where the map holds
    nothing and the rest is the prior; ``sizes`` (P,) float64, edge of the leaf around the point in metres, 0 where
    unknown.
    """

    log_odds: Float32Array
    probabilities: Float32Array
    labels: UInt8Array
    known: BoolArray
    sizes: Float64Array


class StoredMap:
    """One robot's map after one tick, or the centralised one (``robot_id`` 'central').

    With ``team_posterior`` the methods give h_0 + N (h - h_0), the posterior of all N robots' evidence that an agreed
    map stands for, in place of the robot's own h.
    """

    def __init__(
        self, octree: SemanticOctree, robot_id: str, tick: int, stamp_ns: int, prior: float, num_robots: int
    ) -> None:
        self.robot_id = robot_id
        self.tick = tick
        self.stamp_ns = stamp_ns
        self.prior = prior
        self.num_robots = num_robots
        self.octree = octree

    @property
    def resolution(self) -> float:
        """Edge of the finest leaf in metres."""
        return float(self.octree.resolution)

    def leaves(self, *, team_posterior: bool = False) -> LeafTable:
        """All leaves, free ones included, in Morton order."""
        table = self.octree.leaves(prior=self.prior)
        return LeafTable(table.centers, table.sizes, self._scaled(table.log_odds, team_posterior))

    def query(self, points: npt.ArrayLike, *, team_posterior: bool = False) -> PointQuery:
        """What is at points (P, 3), metres in the team's frame. Raises ValueError for another shape."""
        coords = np.asarray(points, dtype=np.float64)
        if coords.ndim != 2 or coords.shape[1] != 3:
            raise ValueError(f"points: expects an array (P, 3), got {coords.shape}")
        deviation, known, sizes = self.octree.lookup(coords)
        log_odds = self._scaled((deviation + np.float32(self.prior)).astype(np.float32), team_posterior)
        probabilities = class_probabilities(log_odds).astype(np.float32)
        return PointQuery(log_odds, probabilities, best_labels(log_odds), known, np.where(known, sizes, 0.0))

    def query_box(self, lower: npt.ArrayLike, upper: npt.ArrayLike, *, team_posterior: bool = False) -> LeafTable:
        """The leaves that overlap a box with corners ``lower`` and ``upper`` (3,), metres in the team's frame.

        Raises ValueError where a corner is not three numbers or the corners are in the wrong order.
        """
        low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        if low.shape != (3,) or high.shape != (3,):
            raise ValueError(f"box: expects two corners of three numbers, got {low.shape} and {high.shape}")
        if not (low <= high).all():
            raise ValueError("box: every lower bound must be at most its upper bound")
        table = self.leaves(team_posterior=team_posterior)
        half = table.sizes[:, None] / 2
        inside = ((table.centers + half > low) & (table.centers - half < high)).all(axis=1)
        return LeafTable(table.centers[inside], table.sizes[inside], table.log_odds[inside])

    def _scaled(self, log_odds: Float32Array, team_posterior: bool) -> Float32Array:
        """The robot's log-odds, or the team's."""
        if not team_posterior:
            return log_odds
        scaled: FloatArray = team_log_odds(log_odds, self.prior, self.num_robots)
        return scaled.astype(np.float32)


class Result:
    """A stored result; a context manager. ``open_result`` makes one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = ResultReader(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    @property
    def robots(self) -> tuple[str, ...]:
        """The team's robots in their order."""
        return self._reader.robots

    @property
    def class_table(self) -> ClassTable:
        """The occupied classes with their names and colours."""
        return self._reader.class_table

    @property
    def config(self) -> RunConfig:
        """The configuration of the run."""
        return self._reader.config

    @property
    def is_complete(self) -> bool:
        """False for what an interrupted run left."""
        return self._reader.is_complete

    @property
    def inputs(self) -> dict[str, tuple[int, str, str]]:
        """Size in bytes, method and fingerprint of every input file by its path, in the order of the robots."""
        return self._reader.inputs

    @cached_property
    def metrics(self) -> list[TickMetrics]:
        """The metrics of all ticks, in order."""
        return self._reader.metrics()

    @cached_property
    def summary(self) -> RunSummary:
        """What the run came to; the wall time is not stored and is NaN."""
        return self._reader.summary(self.metrics)

    @cached_property
    def start_ns(self) -> int:
        """t_0, the time of tick 0. Raises InputError where no tick is stored."""
        if not self.metrics:
            raise InputError(f"{self.path}: holds no tick; the run was interrupted before its first one")
        first = self.metrics[0]
        return first.stamp_ns - first.tick * round(self.config.network.publish_period * 1e9)

    def seconds(self, stamp_ns: int) -> float:
        """Seconds from the run's start to a time."""
        return (stamp_ns - self.start_ns) / 1e9

    def time_ns(self, seconds: float) -> int:
        """The time so many seconds after the run's start."""
        return self.start_ns + round(seconds * 1e9)

    def stored_ticks(self, robot_id: str) -> list[int]:
        """The ticks at which a robot's map is stored. Raises InputError for an unknown robot."""
        return [tick for tick, _ in self._reader.state_times(robot_id)]

    def map(self, robot_id: str, *, at_ns: int | None = None, tick: int | None = None) -> StoredMap:
        """A robot's last map stored at or before ``at_ns``, or exactly at ``tick``; with neither, its last map.

        ``robot_id`` 'central' gives the centralised map: the sum of all robots' evidence up to then.

        Raises InputError for an unknown robot, a tick at which no map is stored, or a time before the first stored map.
        Raises PacketError where a stored map is damaged, or of a version that is not read.
        """
        if at_ns is not None and tick is not None:
            raise ValueError("give at_ns or tick, not both")
        until_ns = at_ns if tick is None else self._stamp_of(robot_id, tick)
        states = self._reader.states(robot_id, until_ns)
        try:
            octree = decode_packet(states[0].data)
            for state in states[1:]:
                apply_delta(octree, state.data)
        except PacketError as error:
            raise PacketError(f"{self.path}: robot '{robot_id}': {error}; run the logs again") from error
        return self._stored_map(octree, states[-1])

    def history(self) -> Iterator[dict[str, StoredMap]]:
        """All maps at every stored tick in turn, by robot_id; with 'central' where the result holds it.

        The octrees are changed in place by the next step. Raises as ``map`` does.
        """
        octrees: dict[str, SemanticOctree] = {}
        maps: dict[str, StoredMap] = {}
        tick: int | None = None
        for state in self._reader.all_states():
            if tick is not None and state.tick != tick:
                yield maps
            tick = state.tick
            try:
                if state.is_key_frame:
                    octrees[state.robot_id] = decode_packet(state.data)
                elif state.robot_id in octrees:
                    apply_delta(octrees[state.robot_id], state.data)
                else:
                    raise PacketError("its first state is a delta")
            except PacketError as error:
                raise PacketError(f"{self.path}: robot '{state.robot_id}': {error}; run the logs again") from error
            maps[state.robot_id] = self._stored_map(octrees[state.robot_id], state)
        if maps:
            yield maps

    def _stored_map(self, octree: SemanticOctree, state: MapState) -> StoredMap:
        """A map as it is after a state; the centralised one is the posterior of all evidence already."""
        num_robots = 1 if state.robot_id == CENTRAL else len(self.robots)
        return StoredMap(octree, state.robot_id, state.tick, state.stamp_ns, self._reader.prior, num_robots)

    def _stamp_of(self, robot_id: str, tick: int) -> int:
        """The time of a robot's map stored at a tick."""
        stamp_ns = self._reader.state_stamp(robot_id, tick)
        if stamp_ns is None:
            near = sorted(sorted(self.stored_ticks(robot_id), key=lambda stored: abs(stored - tick))[:6])
            raise InputError(
                f"{self.path}: no map of robot '{robot_id}' is stored at tick {tick}; stored nearby:"
                f" {', '.join(map(str, near)) or 'none'}"
            )
        return stamp_ns


def open_result(path: str | Path) -> Result:
    """A result file to ask. Raises InputError for a file that is missing, damaged or no octoreplay result."""
    return Result(Path(path))
