"""Recording of a run: metrics and poses in every tick, maps every few seconds, evidence and summary at the end."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from octoreplay.config.resolved import ResolvedRun
from octoreplay.config.rules import Exchanged
from octoreplay.errors import OutputError
from octoreplay.io.results.result_writer import ResultWriter, view_points
from octoreplay.mapping import codec
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.records import CENTRAL, FrameCounts, MapState
from octoreplay.replay.joining import Joining
from octoreplay.replay.network.graph import CommunicationGraph
from octoreplay.replay.tick import Tick, falls_due
from octoreplay.replay.warnings import team_frame_warnings
from octoreplay.run_metrics import LinkTotals, RunSummary, TickMetrics

STATES_PER_KEY_FRAME = 12
"""Number of stored states of a robot from one key frame to the next."""


class _StateSeries:
    """Stored states of some octrees over time: key frames, and deltas with the bricks that changed between them."""

    def __init__(self, threads: Executor) -> None:
        self.last_tick = -1
        self._threads = threads
        self._num_stored = 0
        self._octrees: Sequence[SemanticOctree] = ()

    def encode(
        self, tick: Tick, names: Sequence[str], octrees: Sequence[SemanticOctree], num_robots: Sequence[int]
    ) -> list[MapState]:
        """Next states: octrees of one tick, the means of ``num_robots``; ``names`` are the same in all ticks."""
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

        states = list(self._threads.map(encode, range(len(names))))
        self._num_stored += 1
        self._octrees = tuple(octrees)
        self.last_tick = tick.number
        return states


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
        self._view_tick = -1
        self._num_averaged = np.ones(len(config.robots), np.int64)
        self._num_settling = 0
        self._peak = 0.0
        self._peak_all = 0.0
        self._bytes = np.zeros(3)
        self._num_published = 0
        self._sent_bytes = 0
        self._links = LinkTotals()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        # An error on the way out would hide the first one.
        with contextlib.suppress(OutputError):
            self._queue.wait()

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
        if self._is_due(tick, self._config.output.view_every):
            self._write_views(tick, self._writer)
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
            if self._view_tick < tick.number:
                self._write_views(tick, self._writer)
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
        for state in self._maps.encode(tick, (*tick.graph.robot_ids, CENTRAL), (*tick.maps, tick.oracle), num_robots):
            self._queue.add(writer.write_state, state)

    def _store_evidence(self, tick: Tick, writer: ResultWriter) -> None:
        """Store every robot's evidence."""
        for state in self._evidence.encode(tick, tick.graph.robot_ids, tick.evidence, [1] * len(tick.evidence)):
            self._queue.add(writer.write_evidence, state)

    def _write_views(self, tick: Tick, writer: ResultWriter) -> None:
        """Store every robot's map for viewing."""

        def points_of(octree: SemanticOctree) -> npt.NDArray[Any]:
            return view_points(octree.leaves(self._config.map.prior(octree.num_classes), occupied_only=True), classes)

        classes = self._config.classes
        for robot_id, points in zip(tick.graph.robot_ids, self._threads.map(points_of, tick.maps), strict=True):
            self._queue.add(writer.write_view, robot_id, tick.stamp_ns, points, tick.metrics.frame_of(robot_id))
        self._view_tick = tick.number
