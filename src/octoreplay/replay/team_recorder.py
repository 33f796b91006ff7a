"""Recording of the team: metrics, poses and graph in every tick, and the summary at the end."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any, Self

import numpy as np

from octoreplay.config.resolved import ResolvedRun
from octoreplay.errors import OutputError
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.records import FrameCounts, RobotPose
from octoreplay.replay.joining import Joining
from octoreplay.replay.network.graph import CommunicationGraph
from octoreplay.run_metrics import LinkTotals, RunSummary, TickMetrics, log_sent_bytes

_NOT_STATE = ("_config", "queue")
"""Attributes of a recorder that do not change from tick to tick."""


class WriteQueue:
    """Calls of a writer that one thread makes in their order while the replay goes on.

    An error of a call is raised by the next ``start`` or ``wait``.
    """

    def __init__(self, writer: ResultWriter | None, threads: Executor) -> None:
        self._writer = writer
        self._threads = threads
        self._calls: list[Callable[[], None]] = []
        self._started: Future[None] | None = None

    def add(self, write: str, *arguments: Any) -> None:
        """Add a call of a method, whose arguments do not change any more."""
        if self._writer is None:
            return
        self._calls.append(partial(getattr(self._writer, write), *arguments))

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


class TeamRecorder:
    """Writer of the team's metrics, poses and graph to a result (None: no result), and of the summary of a run.

    A context manager. What a tick writes is compressed and written in one of the ``threads``, beside the next tick.

    Attributes
    ----------
    queue : WriteQueue
        Calls of the writer.
    start_ns : int
        Stamp of the first tick.
    last : TickMetrics or None
        Metrics of the last tick.
    """

    def __init__(self, config: ResolvedRun, writer: ResultWriter | None, threads: Executor) -> None:
        self.queue = WriteQueue(writer, threads)
        self.start_ns = 0
        self.last: TickMetrics | None = None
        self._config = config
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
            self.queue.wait()

    def state(self) -> dict[str, Any]:
        """Wait until all ticks are written; return what ``restore`` needs to continue after the last one."""
        self.queue.wait()
        return {name: value for name, value in vars(self).items() if name not in _NOT_STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue a new recorder after the last tick of a ``state``."""
        vars(self).update(state)

    def record(self, metrics: TickMetrics, graph: CommunicationGraph, poses: Sequence[RobotPose]) -> None:
        """Record one tick; ``queue.start`` must follow."""
        if self.last is None:
            self.start_ns = metrics.stamp_ns
        self.last = metrics
        self._add_up(metrics)
        self.queue.add("write_metrics", metrics)
        self.queue.add("write_poses", metrics.stamp_ns, poses)
        ids = graph.robot_ids
        links = [(ids[a], ids[b]) for a, b in graph.pairs]
        self.queue.add("write_graph", metrics.stamp_ns, links, poses)

    def finish(
        self,
        stop_reason: str,
        counts: Mapping[str, FrameCounts],
        warnings: tuple[str, ...],
        wall_seconds: float,
        joining: Joining | None = None,
    ) -> RunSummary:
        """Write what waits and return the summary; at least one tick was recorded.

        ``joining`` has the frames that robots found during the run.
        """
        last = self.last
        assert last is not None
        self.queue.start()
        self.queue.wait()
        means = self._bytes / max(self._num_published, 1)
        return RunSummary(
            num_ticks=last.tick + 1,
            num_settling_ticks=self._num_settling,
            stop_reason=stop_reason,
            log_seconds=(last.stamp_ns - self.start_ns) / 1e9
            - self._num_settling * self._config.network.publish_period,
            wall_seconds=wall_seconds,
            last=last,
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
