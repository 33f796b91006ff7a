"""Recording of a run: what concerns the team in every tick, and maps where they are due."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from concurrent.futures import Executor
from typing import Any, Self

from octoreplay.config.resolved import ResolvedRun
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.records import CENTRAL, FrameCounts
from octoreplay.replay.joining import Joining
from octoreplay.replay.map_recorder import MapRecorder, MapTick
from octoreplay.replay.team_recorder import TeamRecorder
from octoreplay.replay.tick import Tick
from octoreplay.replay.warnings import team_frame_warnings
from octoreplay.run_metrics import RunSummary


class Recorder:
    """Writer of ticks to a result (None: no result) and of their summary; a context manager.

    Maps are encoded in parallel ``threads``. What a tick writes is compressed and written beside the next tick.
    """

    def __init__(self, config: ResolvedRun, writer: ResultWriter | None, threads: Executor) -> None:
        self.last: Tick | None = None
        self._config = config
        self._has_result = writer is not None
        self._team = TeamRecorder(config, writer, threads)
        self._maps = MapRecorder(config, self._team.queue, threads)

    def __enter__(self) -> Self:
        self._team.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._team.__exit__(*error)

    @property
    def start_ns(self) -> int:
        """Stamp of the first tick."""
        return self._team.start_ns

    def state(self) -> dict[str, Any]:
        """Wait until all ticks are written; return what ``restore`` needs to continue after the last one."""
        return {"last": self.last, "team": self._team.state(), "maps": self._maps.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue a new recorder after the last tick of a ``state``."""
        self.last = state["last"]
        self._team.restore(state["team"])
        self._maps.restore(state["maps"])

    def frame_warnings(self) -> tuple[str, ...]:
        """Sentences on the frames of the robots with evidence after the last tick; empty before the first tick."""
        if self.last is None:
            return ()
        evidence = zip(self.last.graph.robot_ids, self.last.evidence, strict=True)
        num_cells = {name: octree.num_cells for name, octree in evidence if octree.num_cells}
        return team_frame_warnings(self.last.metrics, num_cells)

    def record(self, tick: Tick) -> None:
        """Record one tick."""
        # Without the messages, which keep versions of maps.
        self.last = dataclasses.replace(tick, published=())
        self._team.record(tick.metrics, tick.graph, tick.poses)
        if not self._has_result:
            return
        if self._config.output.keep_packets:
            for robot_id, published in zip(tick.graph.robot_ids, tick.published, strict=True):
                for _, message in published.messages if published else ():
                    data = b"".join(part.data for part in message.parts)
                    self._team.queue.add("write_packet", robot_id, tick.stamp_ns, tick.number, data)
        self._maps.record(self._map_tick(tick))
        self._team.queue.start()

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
        assert self.last is not None
        if self._has_result:
            self._maps.finish(self._map_tick(self.last))
        return self._team.finish(stop_reason, counts, warnings, wall_seconds, joining)

    def _map_tick(self, tick: Tick) -> MapTick:
        """Maps of a tick."""
        names = tick.graph.robot_ids
        return MapTick(
            tick.number, tick.stamp_ns, tick.stamp_ns - self.start_ns,
            dict(zip((*names, CENTRAL), (*tick.maps, tick.oracle), strict=True)),
            dict(zip(names, tick.evidence, strict=True)), tick.num_averaged,
            {name: tick.metrics.frame_of(name) for name in (*names, CENTRAL)},
        )  # fmt: skip
