"""Small results for the tests of writing, reading and reporting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from octoreplay.config.class_file import class_table
from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.records import FrameCounts, LeafTable, MapState, RobotPose
from octoreplay.run_metrics import (
    LinkMetrics,
    LinkTotals,
    PairMetrics,
    RobotMetrics,
    RunSummary,
    TickMetrics,
    log_sent_bytes,
)

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
ROBOTS = ("alpha", "beta")
CLASSES = class_table([{"name": "ground", "color": [10, 20, 30]}, {"name": "tree", "color": [1, 2, 250]}])


def team(folder: Path) -> ResolvedRun:
    """Two robots whose logs are some bytes."""
    logs = []
    for robot_id in ROBOTS:
        log = folder / f"{robot_id}.bag"
        log.write_bytes(f"log of {robot_id}".encode())
        logs.append(log)
    robots = tuple(
        ResolvedRobot(
            robot_id, (log,), depth_topic="/depth", pose_topic="/odom", T_team_map=(1.0, 2.0, 3.0, 0, 0, 0, 1)
        )
        for robot_id, log in zip(ROBOTS, logs, strict=True)
    )
    return ResolvedRun(robots=robots, classes=CLASSES)


def tick_metrics(tick: int, *, settling: bool = False, links: bool = True) -> TickMetrics:
    """Metrics whose every number differs from the others, and from tick to tick."""
    robots = tuple(
        RobotMetrics(
            robot_id=robot_id, active=index == 0 or tick > 1, num_scans=4 * tick + index, num_iterations=tick,
            agreement=0.9 + index / 100, agreement_occupied=0.8 - index / 300, num_leaves=100 + tick,
            num_cells=1000 + tick, observed_volume=1.25 * tick, entropy_bits=0.1 + 0.2 * index, memory_bytes=12345,
            sent_bytes=100 * tick,
            packet_bytes=100 * tick + 40 * index, octree_bytes=200 * tick + 50 * index,
            grid_bytes=4000 * tick + 60 * index, unpruned_bytes=3000 * tick, unpruned_compressed_bytes=900 * tick,
        )
        for index, robot_id in enumerate(ROBOTS)
    )  # fmt: skip
    directed = (("alpha", "beta"), ("beta", "alpha")) if links else ()
    return TickMetrics(
        tick=tick, stamp_ns=START + tick * SECOND, settling=settling, total_distance_published=2.0 + tick,
        total_distance=1.0 / 3.0 + tick,
        total_distance_all=0.1 + 2 * tick, distance_per_leaf=1e-7 * tick, distance_per_cell_and_link=2e-300,
        num_known_cells=2000 + tick, label_disagreement=0.25, max_change=float(tick) ** -2 if tick else 0.0,
        robots=robots,
        links=tuple(LinkMetrics(a, b, 1, 100 * tick, *range(2, 10), 100.0 * tick) for a, b in directed),
        pairs=(PairMetrics("alpha", "beta", 5000 + tick, 1000, 0.2, tick / 100, 0.17, 0.13, 800, 0.125),),
    )  # fmt: skip


def summary(metrics: Sequence[TickMetrics]) -> RunSummary:
    """Summary of a run over some ticks."""
    links = LinkTotals()
    for tick in metrics:
        links.add(tick.links)
    return RunSummary(
        num_ticks=len(metrics), num_settling_ticks=sum(tick.settling for tick in metrics), stop_reason="it was over",
        log_seconds=12.5, wall_seconds=3.25, last=metrics[-1], peak_total_distance=77.0, peak_total_distance_all=88.0,
        mean_packet_bytes=150.5, mean_octree_bytes=250.25, mean_grid_bytes=6000.125, total_sent_bytes=9999,
        log_sent_bytes=log_sent_bytes(metrics), links=links.totals(),
        frame_counts={
            "alpha": FrameCounts(used=7, no_pose=2, unknown_label_pixels={42: 3}, unknown_colors={0xA0B0C: 5}),
            "beta": FrameCounts(used=9, truncated_files=["beta.bag"]),
        },
        warnings=("a warning with [brackets]",),
    )  # fmt: skip


def leaf_table() -> LeafTable:
    """Three occupied leaves of two sizes and a free one."""
    centers = np.array([[0.1, 0.1, 0.1], [0.6, 0.2, 0.2], [1.1, 0.1, 0.3], [2.1, 0.1, 0.1]])
    sizes = np.array([0.2, 0.4, 0.2, 0.2])
    log_odds = np.array([[2.0, 1.0], [-1.0, 3.0], [0.5, 0.25], [-2.0, -3.0]], dtype=np.float32)
    return LeafTable(centers, sizes, log_odds)


def pose(robot_id: str, x: float) -> RobotPose:
    """A robot that looks along y at (x, 2, 3)."""
    transform = np.array([[0.0, -1, 0, x], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    return RobotPose(robot_id, transform)


def state(robot_id: str, sequence: int, tick: int, data: bytes, *, key: bool = False, num_robots: int = 1) -> MapState:
    """A state that builds on the one before, or a key frame; its map is the mean over ``num_robots``."""
    base = sequence if key else sequence - 1
    return MapState(robot_id, START + tick * SECOND, tick, sequence, base, key, data, num_robots=num_robots)


def write_result(folder: Path, fill: Callable[[ResultWriter], None] | None = None, *, num_ticks: int = 4) -> Path:
    """A finished result with metrics, poses and graph of some ticks, the last one settling, and what ``fill`` adds."""
    path = folder / "result.mcap"
    metrics = [tick_metrics(tick, settling=tick == num_ticks) for tick in range(1, num_ticks + 1)]
    with ResultWriter(path, team(folder)) as writer:
        for tick in metrics:
            poses = [pose("alpha", float(tick.tick)), pose("beta", 0.0)]
            writer.write_metrics(tick)
            writer.write_poses(tick.stamp_ns, poses)
            writer.write_graph(tick.stamp_ns, [("alpha", "beta")], poses)
        if fill is not None:
            fill(writer)
        writer.complete(summary(metrics))
    return path


def write_until(error: type[BaseException], path: Path, metrics: Sequence[TickMetrics]) -> None:
    """Write some ticks, then raise an error in the middle of the run."""
    with ResultWriter(path, team(path.parent)) as writer:
        for tick in metrics:
            writer.write_metrics(tick)
        raise error


def write_killed(path: Path, metrics: Sequence[TickMetrics]) -> Path:
    """Leave what a killed process leaves after some ticks: an unfinished file. Return its path."""
    with ResultWriter(path, team(path.parent)) as writer:
        for tick in metrics:
            writer.write_metrics(tick)
        left = writer.partial_path.read_bytes()
    writer.partial_path.write_bytes(left)
    return writer.partial_path
