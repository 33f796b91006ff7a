"""Recording of a run: metrics and poses in every tick, maps every few seconds, evidence and summary at the end."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from octoreplay.config.output import OutputConfig
from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.errors import OutputError
from octoreplay.io.results.map_views import view_points
from octoreplay.io.results.occupancy_grid import Grid, grid_of
from octoreplay.io.results.octomap_trees import binary_tree
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.mapping import codec
from octoreplay.mapping.consensus import scaled_map
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import CENTRAL, FrameCounts, LeafTable, MapState
from octoreplay.replay.joining import Joining
from octoreplay.replay.network.graph import CommunicationGraph
from octoreplay.replay.tick import Tick, falls_due
from octoreplay.replay.warnings import team_frame_warnings
from octoreplay.run_metrics import LinkTotals, RunSummary, TickMetrics, log_sent_bytes

_log = logging.getLogger(__name__)

STATES_PER_KEY_FRAME = 12
"""Number of stored states of a robot from one key frame to the next."""


MAPS_AT_ONCE = 4
"""Number of maps whose stored forms wait for the writer at the same time; those of a large team may exceed its maps."""

_NOT_STATE = ("_config", "_writer", "_threads", "_queue")
"""Attributes of a recorder that do not change from tick to tick."""


def _view(octree: SemanticOctree, _: int, config: ResolvedRun) -> npt.NDArray[Any]:
    """Points of the occupied leaves of a map as the robot holds it."""
    prior = config.map.prior(octree.num_classes)
    return view_points(octree.leaves(prior, occupied_only=True), config.classes)


def _posterior(octree: SemanticOctree, num_robots: int, config: ResolvedRun) -> LeafTable:
    """Leaves of the posterior of the robots that a map is the mean of."""
    shown = octree if num_robots == 1 else scaled_map(octree, float(num_robots))
    return shown.leaves(config.map.prior(octree.num_classes))


def _grid(octree: SemanticOctree, num_robots: int, config: ResolvedRun) -> Grid | None:
    """Occupancy grid of a map, None where nothing lies in its heights."""
    leaves, output = _posterior(octree, num_robots, config), config.output
    low = -math.inf if output.grid_low is None else output.grid_low
    high = math.inf if output.grid_high is None else output.grid_high
    leaves = leaves.taken(leaves.between(low, high))
    return grid_of(leaves, config.map.resolution) if len(leaves) else None


def _octomap(octree: SemanticOctree, num_robots: int, config: ResolvedRun) -> bytes | None:
    """Nodes of the OctoMap tree of a map, None for an empty one."""
    leaves = _posterior(octree, num_robots, config)
    return binary_tree(leaves, config.map.resolution) if len(leaves) else None


class _Form(NamedTuple):
    """Form of the maps for other programs: its period in the configuration, its encoder and its method to write."""

    period: str
    encode: Callable[[SemanticOctree, int, ResolvedRun], Any]
    write: str


_SHOWN: Mapping[str, _Form] = {
    "view": _Form("view_every", _view, "write_view"),
    "cubes": _Form("markers_every", _view, "write_cubes"),
    "occupancy grid": _Form("grid_every", _grid, "write_grid"),
    "OctoMap tree": _Form("octomap_every", _octomap, "write_octomap"),
}
"""Forms of the maps for other programs by name."""


def shown_periods(output: OutputConfig) -> dict[str, float]:
    """Return the period [s] of each form of the maps that is stored for other programs."""
    periods = {name: getattr(output, form.period) for name, form in _SHOWN.items()}
    return {name: every for name, every in periods.items() if every is not None}


def map_periods(output: OutputConfig) -> tuple[float, ...]:
    """Return the periods [s] at which maps are stored in any form."""
    return (output.state_every, *shown_periods(output).values())


class _StateSeries:
    """Stored states of some octrees over time: key frames, and deltas with the bricks that changed between them."""

    def __init__(self, threads: Executor) -> None:
        self.last_tick = -1
        self._threads = threads
        self._num_stored = 0
        self._octrees: Sequence[SemanticOctree] = ()

    def encode(
        self, tick: Tick, names: Sequence[str], octrees: Sequence[SemanticOctree], num_robots: Sequence[int]
    ) -> Iterator[list[MapState]]:
        """Yield the next states, those of some octrees at a time: octrees of one tick, the means of ``num_robots``.

        ``names`` are the same in all ticks.
        """
        sequence = self._num_stored

        def encode(index: int) -> MapState:
            octree = octrees[index]
            # A robot that restarted has another octree, and a delta cannot remove bricks.
            is_key_frame = sequence % STATES_PER_KEY_FRAME == 0 or self._octrees[index] is not octree
            if is_key_frame:
                data = codec.encode_packet(octree)
            else:
                data = codec.encode_delta(octree, np.flatnonzero(octree.revisions > self.last_tick))
            base = sequence if is_key_frame else sequence - 1
            frame_id = tick.metrics.frame_of(names[index])
            return MapState(
                names[index], tick.stamp_ns, tick.number, sequence, base, is_key_frame, data, frame_id,
                num_robots[index],
            )  # fmt: skip

        for first in range(0, len(names), MAPS_AT_ONCE):
            yield list(self._threads.map(encode, range(len(names))[first : first + MAPS_AT_ONCE]))
        self._num_stored += 1
        self._octrees = tuple(octrees)
        self.last_tick = tick.number


class _WriteQueue:
    """Calls that one thread makes in their order while the replay goes on.

    An error of a call is raised by the next ``start`` or ``wait``.
    """

    def __init__(self, threads: Executor) -> None:
        self._threads = threads
        self._calls: list[Callable[[], None]] = []
        self._started: Future[None] | None = None

    def add(self, write: Callable[..., None], *arguments: Any) -> None:
        """Add a call, whose arguments do not change any more."""
        self._calls.append(partial(write, *arguments))

    def start(self) -> None:
        """Wait for the calls before, and start those that were added since."""
        self.wait()
        calls, self._calls = self._calls, []
        self._started = self._threads.submit(_call_all, calls)

    def wait(self) -> None:
        """Wait for the calls that were started."""
        started, self._started = self._started, None
        if started is not None:
            started.result()


def _call_all(calls: Sequence[Callable[[], None]]) -> None:
    """Make some calls in their order."""
    for call in calls:
        call()


class Recorder:
    """Writer of ticks to a result (None: no result) and of their summary; a context manager.

    Maps are encoded in parallel ``threads``. What a tick writes is compressed and written beside the next tick.
    """

    def __init__(self, config: ResolvedRun, writer: ResultWriter | None, threads: Executor) -> None:
        self.start_ns = 0
        self.last: Tick | None = None
        self.num_known_cells = 0
        self._config = config
        self._writer = writer
        self._threads = threads
        self._queue = _WriteQueue(threads)
        self._maps = _StateSeries(threads)
        self._evidence = _StateSeries(threads)
        self._shown_ticks = dict.fromkeys(_SHOWN, -1)
        self._num_averaged = np.ones(len(config.robots), np.int64)
        self._num_settling = 0
        self._peak = 0.0
        self._peak_all = 0.0
        self._bytes = np.zeros(3)
        self._num_published = 0
        self._sent_bytes = 0
        self._log_sent_bytes = 0
        self._links = LinkTotals()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        # An error on the way out would hide the first one.
        with contextlib.suppress(OutputError):
            self._queue.wait()

    def state(self) -> dict[str, Any]:
        """Wait until all ticks are written; return what ``restore`` needs to continue after the last one."""
        self._queue.wait()
        return {name: value for name, value in vars(self).items() if name not in _NOT_STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue a new recorder after the last tick of a ``state``."""
        vars(self).update(state)

    def frame_warnings(self) -> tuple[str, ...]:
        """Sentences on the frames of the robots with evidence after the last tick; empty before the first tick."""
        if self.last is None:
            return ()
        evidence = zip(self.last.graph.robot_ids, self.last.evidence, strict=True)
        num_cells = {name: octree.num_cells for name, octree in evidence if octree.num_cells}
        return team_frame_warnings(self.last.metrics, num_cells)

    def record(self, tick: Tick) -> None:
        """Record one tick."""
        if self.last is None:
            self.start_ns = tick.stamp_ns
        # Without the messages, which keep versions of maps.
        self.last = dataclasses.replace(tick, published=())
        self._add_up(tick.metrics)
        self._count_averaged(tick.graph)
        if self._writer is None:
            return
        self._queue.add(self._writer.write_metrics, tick.metrics)
        self._queue.add(self._writer.write_poses, tick.stamp_ns, tick.poses)
        ids = tick.graph.robot_ids
        links = [(ids[a], ids[b]) for a, b in tick.graph.pairs]
        self._queue.add(self._writer.write_graph, tick.stamp_ns, links, tick.poses)
        if self._config.output.keep_packets:
            for robot_id, published in zip(ids, tick.published, strict=True):
                for _, message in published.messages if published else ():
                    data = b"".join(part.data for part in message.parts)
                    self._queue.add(self._writer.write_packet, robot_id, tick.stamp_ns, tick.number, data)
        if self._is_due(tick, self._config.output.state_every):
            self._store_maps(tick, self._writer)
        if self._config.output.evidence_every and self._is_due(tick, self._config.output.evidence_every):
            self._store_evidence(tick, self._writer)
        for name, every in shown_periods(self._config.output).items():
            if self._is_due(tick, every):
                self._write_shown(name, tick, self._writer)
        self._queue.start()

    def finish(
        self,
        stop_reason: str,
        counts: Mapping[str, FrameCounts],
        warnings: tuple[str, ...],
        wall_seconds: float,
        joining: Joining | None = None,
    ) -> RunSummary:
        """Store the last maps and evidence and return the summary; at least one tick was recorded.

        ``joining`` has the frames that robots found during the run.
        """
        tick = self.last
        assert tick is not None
        if self._writer is not None:
            if self._maps.last_tick < tick.number:
                self._store_maps(tick, self._writer)
            if self._evidence.last_tick < tick.number:
                self._store_evidence(tick, self._writer)
            for name in shown_periods(self._config.output):
                if self._shown_ticks[name] < tick.number:
                    self._write_shown(name, tick, self._writer)
            self._queue.start()
            self._queue.wait()
        means = self._bytes / max(self._num_published, 1)
        return RunSummary(
            num_ticks=tick.number + 1,
            num_settling_ticks=self._num_settling,
            stop_reason=stop_reason,
            log_seconds=(tick.stamp_ns - self.start_ns) / 1e9
            - self._num_settling * self._config.network.publish_period,
            wall_seconds=wall_seconds,
            last=tick.metrics,
            peak_total_distance=self._peak,
            peak_total_distance_all=self._peak_all,
            mean_packet_bytes=float(means[0]),
            mean_octree_bytes=float(means[1]),
            mean_grid_bytes=float(means[2]),
            total_sent_bytes=self._sent_bytes,
            log_sent_bytes=self._log_sent_bytes,
            links=self._links.totals(),
            frame_counts=counts,
            warnings=warnings,
            frame_origins=joining.origins()
            if joining
            else {robot.robot_id: robot.frame_origin for robot in self._config.robots},
            joins=tuple(joining.joins) if joining else (),
        )

    def _add_up(self, metrics: TickMetrics) -> None:
        """Update the sums and peaks over the ticks."""
        self.num_known_cells = metrics.num_known_cells
        self._num_settling += metrics.settling
        self._peak = max(self._peak, metrics.total_distance)
        self._peak_all = max(self._peak_all, metrics.total_distance_all)
        for robot in metrics.robots:
            if robot.packet_bytes:
                self._bytes += (robot.packet_bytes, robot.octree_bytes, robot.grid_bytes)
                self._num_published += 1
        self._links.add(metrics.links)
        self._sent_bytes += sum(robot.sent_bytes for robot in metrics.robots)
        self._log_sent_bytes += log_sent_bytes([metrics])

    def _count_averaged(self, graph: CommunicationGraph) -> None:
        """Update N of each active robot: the robots that reach it, or the team where evidence goes by origin.

        The map of a dormant robot stays as it is, and so does its N.
        """
        consensus = self._config.consensus
        if not consensus.map_is_mean:
            return
        if consensus.traits.exchanges is Exchanged.EVIDENCE:
            self._num_averaged[:] = len(graph.robot_ids)
            return
        active = list(graph.active)
        self._num_averaged[active] = graph.num_reaching[active]

    def _is_due(self, tick: Tick, every: float) -> bool:
        """True when a multiple of ``every`` seconds of log time lies in the period that ends with this tick."""
        period_ns = round(self._config.network.publish_period * 1e9)
        return falls_due(tick.stamp_ns - self.start_ns, period_ns, every)

    def _store_maps(self, tick: Tick, writer: ResultWriter) -> None:
        """Store all maps, the centralised map included."""
        num_robots = (*self._num_averaged.tolist(), 1)
        names = (*tick.graph.robot_ids, CENTRAL)
        for states in self._maps.encode(tick, names, (*tick.maps, tick.oracle), num_robots):
            self._write_each(writer.write_state, ((state,) for state in states))

    def _store_evidence(self, tick: Tick, writer: ResultWriter) -> None:
        """Store every robot's evidence."""
        for states in self._evidence.encode(tick, tick.graph.robot_ids, tick.evidence, [1] * len(tick.evidence)):
            self._write_each(writer.write_evidence, ((state,) for state in states))

    def _write_shown(self, name: str, tick: Tick, writer: ResultWriter) -> None:
        """Store every robot's map in a form for other programs; maps that the form cannot hold are left out."""
        form = _SHOWN[name]

        def encode(robot: tuple[str, SemanticOctree, int]) -> Any:
            robot_id, octree, num_robots = robot
            try:
                return form.encode(octree, num_robots, self._config)
            except ValueError as error:
                # A map that cannot be encoded must not end a long run.
                _log.warning("warning: robot '%s': no %s is stored: %s", robot_id, name, error)
                return None

        robots = list(zip(tick.graph.robot_ids, tick.maps, self._num_averaged.tolist(), strict=True))
        for first in range(0, len(robots), MAPS_AT_ONCE):
            some = robots[first : first + MAPS_AT_ONCE]
            rows = (
                (robot_id, tick.stamp_ns, content, tick.metrics.frame_of(robot_id))
                for (robot_id, *_), content in zip(some, self._threads.map(encode, some), strict=True)
                if content is not None
            )
            self._write_each(getattr(writer, form.write), rows)
        self._shown_ticks[name] = tick.number

    def _write_each(self, write: Callable[..., None], rows: Iterable[tuple[Any, ...]]) -> None:
        """Start calls of ``write`` with the arguments of each row, after waiting for the calls before."""
        for row in rows:
            self._queue.add(write, *row)
        self._queue.start()
