"""Records of a run from the messages of its result."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from octoreplay.io.messages.ros_types import stamp_to_ns
from octoreplay.records import MapState
from octoreplay.run_metrics import (
    FramePlace,
    LinkMetrics,
    LinkTotals,
    PairMetrics,
    RobotMetrics,
    RunSummary,
    TickMetrics,
    log_sent_bytes,
)


def frame_place(value: Any) -> FramePlace:
    """Return a FramePlace from its message."""
    position, turn = value.pose.position, value.pose.orientation
    numbers = (position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w)
    return FramePlace(value.robot_id, value.frame_id, tuple(float(number) for number in numbers))


def tick_metrics(value: Any, pairs: tuple[PairMetrics, ...], places: tuple[FramePlace, ...]) -> TickMetrics:
    """Return TickMetrics from its message, the metrics of the pairs and the frames of the robots."""
    plain = ("tick", "settling", "total_distance", "total_distance_all", "distance_per_leaf",
             "distance_per_cell_and_link", "num_known_cells", "label_disagreement", "max_change")  # fmt: skip
    return TickMetrics(
        stamp_ns=stamp_to_ns(value.header.stamp),
        robots=tuple(RobotMetrics(**fields_of(RobotMetrics, robot)) for robot in value.robots),
        links=tuple(LinkMetrics(**fields_of(LinkMetrics, link)) for link in value.links),
        pairs=pairs,
        places=places,
        total_distance_published=getattr(value, "total_distance_published", math.nan),
        **{name: getattr(value, name) for name in plain},
    )


def fields_of(kind: Any, value: Any) -> dict[str, Any]:
    """Return the fields of the dataclass ``kind`` from the fields of a message with the same names."""
    return {item.name: getattr(value, item.name) for item in dataclasses.fields(kind)}


def map_state(value: Any) -> MapState:
    """Return a MapState from its message."""
    return MapState(
        robot_id=value.robot_id,
        stamp_ns=stamp_to_ns(value.header.stamp),
        tick=int(value.tick),
        sequence=int(value.sequence),
        base_sequence=int(value.base_sequence),
        is_key_frame=bool(value.is_key_frame),
        data=value.data.tobytes(),
        frame_id=value.header.frame_id,
        num_robots=getattr(value, "num_robots", None),
    )


def summary_from_metrics(metrics: Sequence[TickMetrics], stop_reason: str) -> RunSummary:
    """Compute the summary of an interrupted run from its metrics."""
    published = [robot for tick in metrics for robot in tick.robots if robot.packet_bytes]

    def mean(name: str) -> float:
        return float(np.mean([getattr(robot, name) for robot in published])) if published else 0.0

    links = LinkTotals()
    for tick in metrics:
        links.add(tick.links)
    return RunSummary(
        num_ticks=len(metrics),
        num_settling_ticks=sum(tick.settling for tick in metrics),
        stop_reason=stop_reason,
        log_seconds=(metrics[-1].stamp_ns - metrics[0].stamp_ns) / 1e9,
        wall_seconds=math.nan,
        last=metrics[-1],
        peak_total_distance=max(tick.total_distance for tick in metrics),
        peak_total_distance_all=max(tick.total_distance_all for tick in metrics),
        mean_packet_bytes=mean("packet_bytes"),
        mean_octree_bytes=mean("octree_bytes"),
        mean_grid_bytes=mean("grid_bytes"),
        total_sent_bytes=sum(robot.sent_bytes for tick in metrics for robot in tick.robots),
        log_sent_bytes=log_sent_bytes(metrics),
        links=links.totals(),
        frame_counts={},
        warnings=(),
    )
