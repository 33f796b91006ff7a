"""Numbers of one run of a sweep, as a flat row (docs/sweeps.md)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from octoreplay.evaluate.checks import ticks_to_consensus
from octoreplay.run_metrics import PAIR_SHARES, RunSummary, TickMetrics

if TYPE_CHECKING:
    from octoreplay.evaluate.records import Evaluation

_ROUNDING = 1e-9

RUN_COLUMNS = (
    "stop_reason", "num_ticks", "num_settling_ticks", "ticks_to_consensus", "log_seconds", "num_known_cells",
    "total_distance", "total_distance_log_end", "total_distance_mean", "total_distance_peak",
    "total_distance_all", "total_distance_all_log_end", "total_distance_all_mean", "total_distance_all_peak",
    "label_disagreement", "label_disagreement_log_end", "label_disagreement_mean",
    "agreement", "agreement_log_end", "agreement_mean",
    "agreement_occupied", "agreement_occupied_log_end", "agreement_occupied_mean",
    "agreement_connected", "agreement_occupied_connected", *PAIR_SHARES,
    "contraction", "entropy_bits", "packet_bytes", "octree_bytes", "grid_bytes", "sent_bytes_per_second",
    "delivered_share", "num_leaves", "memory_bytes",
)  # fmt: skip
"""Columns of every run."""

_SCORES = (
    "mean_iou", "mean_iou_known", "coverage", "world_coverage", "occupied_accuracy", "free_accuracy",
    "calibration_error", "calibration_error_occupied",
)  # fmt: skip

TRUTH_COLUMNS = (*_SCORES, "mean_iou_least", *(f"central_{name}" for name in _SCORES))
"""Additional columns if the ground truth is known."""

TIMING_COLUMNS = ("wall_seconds", "realtime_factor", "peak_rss_bytes")
"""Columns that differ when a run is repeated."""


def run_numbers(summary: RunSummary, metrics: Sequence[TickMetrics]) -> dict[str, Any]:
    """Values of ``RUN_COLUMNS`` from a run's summary and the metrics of all its ticks."""
    last = summary.last
    log_ticks = [tick for tick in metrics if not tick.settling]
    # Agreement is not defined before the first scan.
    seen = [tick for tick in log_ticks if tick.num_known_cells > 0]
    sent_bytes = sum(robot.sent_bytes for tick in log_ticks for robot in tick.robots)
    num_sent = sum(link.num_sent for link in summary.links)
    distances: dict[str, float] = {}
    for name in ("total_distance", "total_distance_all", "label_disagreement"):
        distances |= {
            name: getattr(last, name),
            f"{name}_log_end": getattr(log_ticks[-1], name),
            f"{name}_mean": _mean(getattr(tick, name) for tick in seen),
        }
    agreements: dict[str, float] = {}
    connected = [tick for tick in seen if is_connected(tick)]
    for name in ("agreement", "agreement_occupied"):
        agreements |= {
            name: worst(last, name),
            f"{name}_log_end": worst(log_ticks[-1], name),
            f"{name}_mean": _mean(worst(tick, name) for tick in seen),
            f"{name}_connected": worst(connected[-1], name) if connected else math.nan,
        }
    values = {
        "stop_reason": summary.stop_reason,
        "num_ticks": summary.num_ticks,
        "num_settling_ticks": summary.num_settling_ticks,
        "ticks_to_consensus": ticks_to_consensus(metrics),
        "log_seconds": summary.log_seconds,
        "num_known_cells": last.num_known_cells,
        **distances,
        "total_distance_peak": summary.peak_total_distance,
        "total_distance_all_peak": summary.peak_total_distance_all,
        **agreements,
        **{name: getattr(last, name) for name in PAIR_SHARES},
        "contraction": contraction([tick.total_distance for tick in metrics if tick.settling]),
        "entropy_bits": _mean(robot.entropy_bits for robot in last.robots),
        "packet_bytes": summary.mean_packet_bytes,
        "octree_bytes": summary.mean_octree_bytes,
        "grid_bytes": summary.mean_grid_bytes,
        "sent_bytes_per_second": _ratio(sent_bytes, len(last.robots) * summary.log_seconds),
        "delivered_share": _ratio(sum(link.num_delivered for link in summary.links), num_sent),
        "num_leaves": _mean(robot.num_leaves for robot in last.robots),
        "memory_bytes": max(robot.memory_bytes for robot in last.robots),
    }
    return {name: values[name] for name in RUN_COLUMNS}


def truth_numbers(evaluation: Evaluation) -> dict[str, float]:
    """Values of ``TRUTH_COLUMNS``: means over the robots, and the scores of the centralised map."""
    final = evaluation.final
    central = final.central
    return {
        **{name: final.mean(name) for name in _SCORES},
        "mean_iou_least": final.least("mean_iou"),
        **{f"central_{name}": math.nan if central is None else central.score(name) for name in _SCORES},
    }


def worst(tick: TickMetrics, name: str) -> float:
    """Return the minimum of a metric over the active robots, or over all if none is active."""
    return min((float(getattr(robot, name)) for robot in tick.counted_robots), key=lambda v: (not math.isnan(v), v))


def is_connected(tick: TickMetrics) -> bool:
    """Return True where links that work both ways connect all active robots at a tick."""
    links = {(link.sender, link.receiver) for link in tick.links}
    robots = [robot.robot_id for robot in tick.counted_robots]
    reached, waiting = {robots[0]}, [robots[0]]
    while waiting:
        sender = waiting.pop()
        found = {other for other in robots if {(sender, other), (other, sender)} <= links} - reached
        reached |= found
        waiting.extend(found)
    return len(reached) == len(robots)


def contraction(distances: Sequence[float]) -> float:
    """Factor per tick by which the total distance shrinks: geometric mean over the later half of the ticks.

    ``distances`` are the total distances of the settling ticks, used up to the first one that is at most 1e-9 of the
    first, where rounding dominates. NaN if fewer than four are used.
    """
    num_ticks = next((n for n, value in enumerate(distances) if value <= _ROUNDING * distances[0]), len(distances))
    if num_ticks < 4:
        return math.nan
    later = distances[num_ticks // 2 - 1 : num_ticks]
    return float((later[-1] / later[0]) ** (1.0 / (len(later) - 1)))


def _mean(values: Iterable[float]) -> float:
    """Mean of the values that are not NaN; NaN if there are none."""
    found = [value for value in values if not math.isnan(value)]
    return sum(found) / len(found) if found else math.nan


def _ratio(part: float, whole: float) -> float:
    """Quotient; NaN if ``whole`` is not positive."""
    return part / whole if whole > 0 else math.nan
