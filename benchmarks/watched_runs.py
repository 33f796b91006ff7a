"""Runs of a simulated team whose ticks are watched, and numbers of their maps: shared by the benchmarks of packets."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
import scenes
from rounds import Report, Row

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.mapping.octree import KEY_BITS, SemanticOctree
from octoreplay.mapping.streams import leaf_list, leaf_values
from octoreplay.records import DepthFrame, Float64Array, Frame, Int64Array
from octoreplay.replay.session import Session
from octoreplay.replay.tick import Tick
from octoreplay.run_metrics import TickMetrics
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team

NUM_ROBOTS = 6
FAULT_RESOLUTION = 0.4
"""Edge of the finest cells in the measurements of faults [m]."""


@dataclass(frozen=True)
class Watched:
    """The metrics of a run's ticks, and why it stopped."""

    ticks: tuple[TickMetrics, ...]
    stop_reason: str

    @property
    def log_ticks(self) -> tuple[TickMetrics, ...]:
        """The ticks while the logs last."""
        return tuple(tick for tick in self.ticks if not tick.settling)

    @property
    def num_settling(self) -> int:
        """Number of settling ticks."""
        return len(self.ticks) - len(self.log_ticks)

    @property
    def peak(self) -> float:
        """The largest Phi_all."""
        return max(tick.total_distance_all for tick in self.ticks)

    @property
    def end(self) -> float:
        """The last Phi_all."""
        return self.ticks[-1].total_distance_all

    @property
    def sent_megabytes(self) -> float:
        """All that was sent."""
        return sum(robot.sent_bytes for tick in self.ticks for robot in tick.robots) / 1e6


class _Stored:
    """Frames that are in memory."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames

    def frames(self) -> Iterator[Frame]:
        """The frames from the beginning."""
        return iter(self._frames)


Watcher = Callable[[Session, Tick], bool]
"""Is shown every tick; True ends the run."""


def play(config: RunConfig, duration: float, watch: Watcher | None = None, blank_after: float = math.inf) -> Watched:
    """Run a team; its sensors see nothing from ``blank_after`` [s] on."""
    frames = recorded_frames(duration)
    start_ns = min(of_robot[0].stamp_ns for of_robot in frames)
    if blank_after < math.inf:
        frames = tuple(tuple(_blanked(f, start_ns + round(blank_after * 1e9)) for f in part) for part in frames)
    session = Session(config, [_Stored(part) for part in frames], ThreadPoolExecutor(2))
    ticks = []
    for tick in session.ticks():
        ticks.append(tick.metrics)
        if watch is not None and watch(session, tick):
            break
    return Watched(tuple(ticks), session.stop_reason)


def _blanked(frame: Frame, since_ns: int) -> Frame:
    """The frame without anything measured, if it is that late."""
    if frame.stamp_ns < since_ns or not isinstance(frame, DepthFrame):
        return frame
    return dataclasses.replace(frame, depth_image=np.zeros_like(frame.depth_image))


@functools.cache
def simulated_team(duration: float) -> RunConfig:
    """The team with logs of a length, simulated when they are first asked for."""
    folder = scenes.cache_folder() / f"village-{NUM_ROBOTS}-{duration:g}s"
    if not (folder / "team.yaml").exists():
        simulate_team(folder, SimulationConfig(num_robots=NUM_ROBOTS, duration=duration))
    return resolve(load_team_file(folder / "team.yaml"))


@functools.lru_cache(maxsize=1)
def recorded_frames(duration: float) -> tuple[tuple[Frame, ...], ...]:
    """Every robot's frames, decoded once for many runs."""
    config = simulated_team(duration)
    with ExitStack() as stack:
        logs = [stack.enter_context(RobotLog(robot, config.time, config.classes)) for robot in config.robots]
        return tuple(tuple(log.frames()) for log in logs)


def run_config(
    duration: float,
    *,
    schedule: Iterable[ScheduleEntry] = (),
    one_way: Iterable[tuple[str, str]] = (),
    **parameters: Any,
) -> RunConfig:
    """The team's configuration with a schedule and flat parameters."""
    config = simulated_team(duration).with_parameters(parameters)
    network = dataclasses.replace(config.network, schedule=tuple(schedule), one_way=tuple(one_way))
    return dataclasses.replace(config, network=network)


@functools.cache
def clean_run(rule: str, resolution: float, duration: float, packets: str, content: str) -> Watched:
    """A run on the complete graph without faults."""
    config = run_config(duration, rule=rule, resolution=resolution, packets=packets, content=content)
    return play(config, duration)


def robot_ids(config: RunConfig) -> tuple[str, ...]:
    """Ids of the team's robots."""
    return tuple(robot.robot_id for robot in config.robots)


def worst_agreement(tick: TickMetrics) -> tuple[float, float]:
    """The worst robot's agreement: all cells, occupied cells."""
    return min(robot.agreement for robot in tick.robots), min(robot.agreement_occupied for robot in tick.robots)


def add_agreement(report: Report, title: str, tick: TickMetrics, must: float | None = None, note: str = "") -> None:
    """Both numbers of the worst robot."""
    for cells, value in zip(("all cells", "occupied"), worst_agreement(tick), strict=True):
        report.add(Row(f"{title}, {cells}", value, "", must=must, more_is_better=True, note=note))


# --- cells ------------------------------------------------------------------------------------------------------------


def cells_of(octree: SemanticOctree) -> tuple[Int64Array, Float64Array]:
    """Every known finest cell, one by one: Morton codes (n,), ascending, and deviations (n, C)."""
    streams = octree.streams()
    codes, depths, is_vector = leaf_list(streams)
    spans = np.int64(1) << (3 * (KEY_BITS - depths.astype(np.int64)))
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(spans)[:-1]])
    cells = np.repeat(codes - starts, spans) + np.arange(spans.sum())
    values = np.repeat(leaf_values(streams, is_vector, octree.num_classes), spans, axis=0)
    return cells, values.astype(np.float64)


def sum_of_cells(octrees: Sequence[SemanticOctree]) -> tuple[Int64Array, Float64Array]:
    """The sum over octrees, cell by cell, as ``cells_of``."""
    parts = [cells_of(octree) for octree in octrees]
    codes = np.unique(np.concatenate([cells for cells, _ in parts]))
    total = np.zeros((codes.size, octrees[0].num_classes))
    for cells, values in parts:
        total[np.searchsorted(codes, cells)] += values
    return codes, total


def deviation_of_cells(
    one: tuple[Int64Array, Float64Array], other: tuple[Int64Array, Float64Array], scale: float = 1.0
) -> Float64Array:
    """|scale x one - other| over the cells that either knows, (n, C); what one does not know counts as 0."""
    codes = np.union1d(one[0], other[0])
    difference = np.zeros((codes.size, other[1].shape[1]))
    difference[np.searchsorted(codes, one[0])] += scale * one[1]
    difference[np.searchsorted(codes, other[0])] -= other[1]
    return np.abs(difference)
