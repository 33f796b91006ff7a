"""Python API of a stored result: any robot's map at any stored tick as arrays, and queries at points and in boxes.

::

    with open_result(Path("result.mcap")) as result:
        stored = result.map("husky_1")                       # the last map; at_ns=... or tick=... for an earlier one
        leaves = stored.leaves()                             # centres, sizes, log-odds
        answer = stored.query(np.array([[1.0, 2.0, 0.5]]))   # labels and probabilities
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self
from weakref import WeakSet

import numpy as np
import numpy.typing as npt

from octoreplay.config.rules import Exchanged
from octoreplay.config.run import RunConfig
from octoreplay.data_table import Table
from octoreplay.errors import ConfigError, InputError, PacketError
from octoreplay.io.results.result_reader import ResultReader
from octoreplay.log_odds import best_labels, class_probabilities, label_probabilities
from octoreplay.mapping.codec import apply_delta, decode_packet, max_memory
from octoreplay.mapping.consensus import scaled_map
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.metric_tables import METRIC_TABLES, POSES, metrics_table, pose_table
from octoreplay.records import (
    CENTRAL,
    MAP_KINDS,
    MEAN,
    POSTERIOR,
    TEAM,
    BoolArray,
    ClassTable,
    FilePath,
    Float32Array,
    Float64Array,
    LeafTable,
    MapState,
    UInt8Array,
    public_names,
)
from octoreplay.run_metrics import FramePlace, RunSummary, TickMetrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class PointQuery:
    """State of a map at P points.

    Attributes
    ----------
    log_odds : (P, C) float32
        log p(c) / p(free), including the prior.
    probabilities : (P, C + 1) float32
        Probabilities, free first.
    labels : (P,) uint8
        Most probable class_id, 0 for free.
    known : (P,) bool
        False in unknown space, where the other fields are those of the prior.
    sizes : (P,) float64
        Edge of the leaf around the point in metres, 0 in unknown space.
    """

    log_odds: Float32Array
    probabilities: Float32Array
    labels: UInt8Array
    known: BoolArray
    sizes: Float64Array

    def as_table(self) -> Table:
        """Return the columns label, known, size [m] and probability_0 (free) to probability_C, one row per point."""
        columns = {"label": self.labels, "known": self.known, "size": self.sizes}
        return Table(columns | {f"probability_{c}": values for c, values in enumerate(self.probabilities.T)})


class StoredMap:
    """Map of one robot after one tick, or the centralised map (``robot_id`` 'central').

    ``frame_id`` is the name of its frame: 'team', or '<robot>/map' for the map frame of a robot where robots find each
    other's frames during the run.

    A map on which robots agree is the mean over ``num_robots`` robots, N: those that reached it over links at the time,
    or all with rule 'flood'. ``map_kind`` 'posterior' (the default of all methods) gives h_0 + N (h - h_0), the
    posterior of the evidence of these robots, and 'mean' the map h as the robot holds it. Both are the same where N is
    1: for a robot without links, for the centralised map, for evidence, for rules whose map is no mean ('local',
    'merge'), and where ``evidence`` is an average. ``octree`` holds h - h_0.
    """

    def __init__(
        self,
        octree: SemanticOctree,
        robot_id: str,
        tick: int,
        stamp_ns: int,
        prior: float,
        num_robots: int,
        frame_id: str = TEAM,
        most_bytes: int | None = None,
    ) -> None:
        self.robot_id = robot_id
        self.tick = tick
        self.stamp_ns = stamp_ns
        self.prior = prior
        self.num_robots = num_robots
        self.frame_id = frame_id
        self.octree = octree
        self._most_bytes = most_bytes

    def __dir__(self) -> list[str]:
        return public_names(self)

    @property
    def resolution(self) -> float:
        """Edge of the finest leaf in metres."""
        return float(self.octree.resolution)

    def shown_octree(self, map_kind: str = POSTERIOR) -> SemanticOctree:
        """Return the octree of a form of the map: N (h - h_0) or h - h_0. Raises ValueError for another form."""
        if map_kind not in MAP_KINDS:
            raise ValueError(f"map_kind: '{map_kind}' is not one of {', '.join(MAP_KINDS)}")
        if map_kind == MEAN or self.num_robots == 1:
            return self.octree
        return scaled_map(self.octree, float(self.num_robots))

    def title(self, map_kind: str = POSTERIOR) -> str:
        """Return a phrase that says which form of the map is shown."""
        if self.num_robots == 1:
            return "centralised map" if self.robot_id == CENTRAL else "own map"
        return f"{'mean' if map_kind == MEAN else 'posterior'} of {self.num_robots} robots"

    def leaves(self, *, map_kind: str = POSTERIOR) -> LeafTable:
        """Return all leaves, including free ones, in Morton order.

        Raises InputError where they would take more memory than a map in a file of the result's size can.
        """
        octree = self.shown_octree(map_kind)
        try:
            return octree.leaves(prior=self.prior, most_bytes=self._most_bytes)
        except ValueError as error:
            raise InputError(f"map of robot '{self.robot_id}': {error}; the result is damaged") from error

    def as_table(self, *, map_kind: str = POSTERIOR) -> Table:
        """Return all leaves as a table, one row per leaf, in Morton order. Raises as ``leaves``.

        The columns are x, y, z, size [m], label (0 for free), probability of that label, and log_odds_1 to log_odds_C.
        """
        leaves = self.leaves(map_kind=map_kind)
        columns = dict(leaves.as_table().columns)
        place = {name: columns.pop(name) for name in ("x", "y", "z", "size")}
        labels = {"label": best_labels(leaves.log_odds), "probability": label_probabilities(leaves.log_odds)}
        return Table({**place, **labels, **columns})

    def query(self, points: npt.ArrayLike, *, map_kind: str = POSTERIOR) -> PointQuery:
        """Return the state at points (P, 3), in metres in the team's frame. Raises ValueError for another shape."""
        coords = np.asarray(points, dtype=np.float64)
        if coords.ndim != 2 or coords.shape[1] != 3:
            raise ValueError(f"points: expects an array (P, 3), got {coords.shape}")
        deviation, known, sizes = self.shown_octree(map_kind).lookup(coords)
        log_odds = (deviation + np.float32(self.prior)).astype(np.float32)
        probabilities = class_probabilities(log_odds).astype(np.float32)
        return PointQuery(log_odds, probabilities, best_labels(log_odds), known, np.where(known, sizes, 0.0))

    def query_box(self, lower: npt.ArrayLike, upper: npt.ArrayLike, *, map_kind: str = POSTERIOR) -> LeafTable:
        """Return the leaves that overlap a box with corners ``lower`` and ``upper`` (3,), metres in the team's frame.

        Raises ValueError where a corner does not have three numbers, or a lower bound is above its upper bound.
        """
        low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        if low.shape != (3,) or high.shape != (3,):
            raise ValueError(f"box: expects two corners of three numbers, got {low.shape} and {high.shape}")
        if not (low <= high).all():
            raise ValueError("box: every lower bound must be at most its upper bound")
        table = self.leaves(map_kind=map_kind)
        half = table.sizes[:, None] / 2
        inside = ((table.centers + half > low) & (table.centers - half < high)).all(axis=1)
        return LeafTable(table.centers[inside], table.sizes[inside], table.log_odds[inside])


class Result:
    """Stored result, opened by ``open_result``; a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = ResultReader(path)
        self._most_bytes = max_memory(path.stat().st_size)
        self._octrees: WeakSet[SemanticOctree] = WeakSet()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __dir__(self) -> list[str]:
        return public_names(self)

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def plot(
        self, what: str, *, label: str | None = None, beside: Mapping[str, Result] | None = None, style: str = "screen",
        robot: str | None = None, at: float | None = None, color: str | None = None,
    ) -> Figure:  # fmt: skip
        """Return a matplotlib figure of the run, as ``octoreplay plot`` draws it.

        ``what`` is 'phi', 'packets', 'agreement', 'coverage', 'links', 'contradiction' or 'map'. ``label`` is the name
        of this result in the figure, by default that of its file; ``beside`` are further results by label. ``style`` is
        'screen', 'one-column', 'two-column' or 'talk'. Of a map, ``robot`` is its robot (default: the first one),
        ``at`` its time since the run's start in seconds (default: the end), and ``color`` as in ``export_map``.

        Raises ConfigError for an unknown name, and InputError for a result without what the figure shows.
        """
        # Figures are made in a room above this one, which only those who draw need.
        from octoreplay.report.result_figures import result_figure

        results = {label or self.path.stem: self, **(beside or {})}
        return result_figure(what, results, style, robot=robot, at=at, color=color)

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots of the team in their order."""
        return self._reader.robots

    @property
    def class_table(self) -> ClassTable:
        """Occupied classes with their names and colours."""
        return self._reader.class_table

    @property
    def config(self) -> RunConfig:
        """Configuration of the run."""
        return self._reader.config

    @property
    def topics(self) -> dict[str, str]:
        """Message type of each topic of the file, by topic."""
        return self._reader.topics

    @property
    def is_complete(self) -> bool:
        """False for the result of an interrupted run."""
        return self._reader.is_complete

    @property
    def extent(self) -> str:
        """Clause on the last tick of an incomplete result and its log time."""
        return self._reader.extent

    @property
    def inputs(self) -> dict[str, tuple[int, str, str]]:
        """Size in bytes, fingerprint method and fingerprint of every input file by path, in the order of the robots."""
        return self._reader.inputs

    @cached_property
    def metrics(self) -> list[TickMetrics]:
        """Metrics of all ticks, in order."""
        return self._reader.metrics()

    @cached_property
    def summary(self) -> RunSummary:
        """Summary of the run; the wall time is not stored and is NaN."""
        return self._reader.summary(self.metrics)

    def as_table(self, kind: str = "ticks") -> Table:
        """Return numbers of the run as a table.

        Parameters
        ----------
        kind : str
            - 'ticks': metrics of the team, one row per tick
            - 'robots', 'links', 'pairs': metrics of each robot, directed link and pair of robots, one row per tick and
              robot, link or pair
            - 'poses': pose of each robot's sensor in the frame ``frame_id``: x, y, z [m], qx, qy, qz, qw, one row per
              tick and robot

            All have the columns ``tick``, ``stamp_ns`` and ``seconds`` since the run's start.

        Raises
        ------
        ConfigError
            ``kind`` is unknown.
        InputError
            The result holds no tick.
        """
        if kind == POSES:
            poses = {robot_id: self._reader.poses(robot_id) for robot_id in self.robots}
            return pose_table(poses, self.metrics, self.start_ns)
        if kind not in METRIC_TABLES:
            raise ConfigError(f"table: '{kind}' is not one of {', '.join((*METRIC_TABLES, POSES))}")
        return metrics_table(self.metrics, kind, self.start_ns)

    @cached_property
    def start_ns(self) -> int:
        """Time t_0 of tick 0. Raises InputError for a result without a tick."""
        if not self.metrics:
            raise InputError(f"{self.path}: holds no tick; the run was interrupted before its first one")
        first = self.metrics[0]
        return first.stamp_ns - first.tick * round(self.config.network.publish_period * 1e9)

    def seconds(self, stamp_ns: int) -> float:
        """Return the time of a stamp since the run's start in seconds."""
        return (stamp_ns - self.start_ns) / 1e9

    def time_ns(self, seconds: float) -> int:
        """Return the stamp at a time since the run's start in seconds. Raises ConfigError for NaN and infinity."""
        if not math.isfinite(seconds):
            raise ConfigError(f"at: {seconds} is no time; give the seconds since the run's start")
        return self.start_ns + round(seconds * 1e9)

    def stored_ticks(self, robot_id: str) -> list[int]:
        """Return the ticks at which a robot's map is stored. Raises InputError for an unknown robot."""
        return [tick for tick, _ in self._reader.state_times(robot_id)]

    def evidence_ticks(self, robot_id: str) -> list[int]:
        """Return the ticks at which a robot's evidence is stored. Raises InputError for an unknown robot."""
        return [tick for tick, _ in self._reader.state_times(robot_id, evidence=True)]

    def poses(self, robot_id: str) -> tuple[list[int], Float64Array]:
        """Return the poses of a robot's sensor at the ticks: stamps [ns], and (P, 7) x, y, z [m], qx, qy, qz, qw.

        They are in the team's frame, or in the robot's present frame where robots find their frames during the run.
        Raises InputError for an unknown robot.
        """
        return self._reader.poses(robot_id)

    def map(self, robot_id: str, *, at_ns: int | None = None, tick: int | None = None) -> StoredMap:
        """Return a robot's last map stored at or before ``at_ns``, or exactly at ``tick``; with neither, its last map.

        ``robot_id`` 'central' is the centralised map, the sum of all robots' evidence up to then.

        Raises InputError for an unknown robot, a tick without a stored map, or a time before the first stored map.
        Raises PacketError where a stored map is damaged or has another format version.
        Raises ValueError for both ``at_ns`` and ``tick``.
        """
        return self._last_state(robot_id, at_ns, tick, evidence=False)

    def evidence(self, robot_id: str, *, at_ns: int | None = None, tick: int | None = None) -> StoredMap:
        """Return a robot's evidence s_i: the sum of its own scans' log-odds, without anything that others sent.

        ``at_ns`` and ``tick`` are as in ``map``. The evidence at the end of a run is always stored, earlier one every
        ``evidence_every`` seconds. It is that of the robot's current restart epoch, clamped to ``clamp_min`` and
        ``clamp_max`` with ``evidence: sum``, else unclamped.

        The octree of the returned map (``octree``) has the values s_i [log-odds], (C,) in each cell, in the team's
        frame; ``leaves`` and ``query`` return h_0 + s_i, the posterior of the robot's own scans.
        ``config.robots[i].T_team_map`` is the robot's map frame in the team's frame, as the run used it.

        Raises InputError as ``map`` does, and where the result holds no evidence of the robot, which is the case for an
        interrupted run and for results of octoreplay before evidence was stored. Raises PacketError and ValueError as
        ``map`` does.
        """
        return self._last_state(robot_id, at_ns, tick, evidence=True)

    def _last_state(self, robot_id: str, at_ns: int | None, tick: int | None, *, evidence: bool) -> StoredMap:
        """Last map or evidence stored at or before ``at_ns``, or exactly at ``tick``."""
        if at_ns is not None and tick is not None:
            raise ValueError("give at_ns or tick, not both")
        until_ns = at_ns if tick is None else self._stamp_of(robot_id, tick, evidence=evidence)
        states = self._reader.states(robot_id, until_ns, evidence=evidence)
        octree = self._updated(None, states[0])
        for state in states[1:]:
            octree = self._updated(octree, state)
        return self._stored_map(octree, states[-1], is_evidence=evidence)

    def history(self) -> Iterator[dict[str, StoredMap]]:
        """Yield the maps at every stored tick by robot_id, with 'central' if it is stored.

        The next step changes the octrees in place. Raises PacketError as ``map`` does.
        """
        octrees: dict[str, SemanticOctree] = {}
        maps: dict[str, StoredMap] = {}
        tick: int | None = None
        for state in self._reader.all_states():
            if tick is not None and state.tick != tick:
                yield maps
            tick = state.tick
            octrees[state.robot_id] = self._updated(octrees.get(state.robot_id), state)
            maps[state.robot_id] = self._stored_map(octrees[state.robot_id], state)
        if maps:
            yield maps

    def _updated(self, octree: SemanticOctree | None, state: MapState) -> SemanticOctree:
        """Octree after a stored state. All octrees in use have at most the memory that fits the size of the file."""
        room = self._most_bytes - sum(held.memory_bytes for held in self._octrees)
        try:
            if state.is_key_frame:
                octree = decode_packet(state.data, room)
                cells = (self.config.map.resolution, self.class_table.num_classes)
                if (octree.resolution, octree.num_classes) != cells:
                    raise PacketError("damaged: the map has another resolution or number of classes than the run")
                self._octrees.add(octree)
            elif octree is None:
                raise PacketError("damaged: the first stored state is a delta")
            else:
                apply_delta(octree, state.data, most_bytes=room)
        except PacketError as error:
            raise PacketError(f"{self.path}: robot '{state.robot_id}': {error}; replay the logs again") from error
        return octree

    def _stored_map(self, octree: SemanticOctree, state: MapState, *, is_evidence: bool = False) -> StoredMap:
        """Map or evidence after a stored state."""
        num_robots = state.num_robots
        if num_robots is None:
            num_robots = 1 if is_evidence else self._num_averaged(state)
        return StoredMap(
            octree, state.robot_id, state.tick, state.stamp_ns, self._reader.prior, num_robots, state.frame_id,
            self._most_bytes,
        )  # fmt: skip

    def _num_averaged(self, state: MapState) -> int:
        """N of a state in a result without it: the robots in the map's frame, or all with rule 'flood'."""
        consensus = self.config.consensus
        if state.robot_id == CENTRAL or not consensus.map_is_mean:
            return 1
        places = self._places.get(state.tick, ())
        if not places or consensus.traits.exchanges is Exchanged.EVIDENCE:
            return len(self.robots)
        return sum(place.frame_id == state.frame_id for place in places)

    @cached_property
    def places(self) -> dict[str, FramePlace]:
        """Frame of each robot's last map with the place of the robot's own map frame in it, by robot_id."""
        if self._places:
            return {place.robot_id: place for place in self._places[max(self._places)]}
        return {
            robot.robot_id: FramePlace(robot.robot_id, TEAM, robot.T_team_map_or_identity)
            for robot in self.config.robots
        }

    @cached_property
    def _places(self) -> dict[int, tuple[FramePlace, ...]]:
        """Frames of all robots by tick."""
        return self._reader.places()

    def _stamp_of(self, robot_id: str, tick: int, *, evidence: bool) -> int:
        """Stamp of a robot's map or evidence stored at a tick."""
        stamp_ns = self._reader.state_stamp(robot_id, tick, evidence=evidence)
        if stamp_ns is None:
            ticks = self.evidence_ticks(robot_id) if evidence else self.stored_ticks(robot_id)
            near = sorted(sorted(ticks, key=lambda stored: abs(stored - tick))[:6])
            raise InputError(
                f"{self.path}: no {'evidence' if evidence else 'map'} of robot '{robot_id}' is stored at tick {tick};"
                f" stored nearby: {', '.join(map(str, near)) or 'none'}"
            )
        return stamp_ns


def open_result(path: FilePath) -> Result:
    """Open a result file; a warning says where an incomplete one ends.

    Raises InputError for a file that is missing, damaged or not an octoreplay result.
    """
    result = Result(Path(path))
    if not result.is_complete:
        _log.warning("warning: %s: incomplete: the run did not finish, and its result %s", path, result.extent)
    return result
