"""Settings, numbers and names that several questions share."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from octoreplay.evaluate.evaluation import truth_beside_logs
from octoreplay.evaluate.morton_intervals import Region
from octoreplay.evaluate.scores import TruthCounts, truth_counts
from octoreplay.evaluate.truth import Truth, load_truth
from octoreplay.report.comparisons import KILOBYTES, Measure, Row
from octoreplay.result import Result
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.stored_map import StoredMap
from octoreplay.study.experiments import SimulatedTeam

RADIO_RANGE = 25.0
"""Radio range [m] with which six robots in the village, a square of 70 m, separate into groups and reconnect."""
SHORT_SETTLING: Mapping[str, Any] = MappingProxyType({"settle_max": 60})
"""Settings that end settling after a minute; slow links and sparse graphs would need hundreds of ticks."""
LAST_MAPS: Mapping[str, Any] = MappingProxyType({"state_every": 1e6, "view_every": 1e6})
"""Settings that store only the last maps, the only ones that are read."""

DURING = Measure("agreement during the logs, occupied", "agreement_occupied_mean")
SETTLED = Measure("agreement settled, occupied", "agreement_occupied")
MEAN_IOU = Measure("mean IoU", "mean_iou")
AGREEMENTS = (DURING, SETTLED, MEAN_IOU, KILOBYTES)


def villages(duration: float, num_villages: int, **settings: Any) -> dict[str, SimulatedTeam]:
    """Teams of six robots by label, each in a village of its own, with these settings of the simulation."""
    return {
        f"village_{seed}": SimulatedTeam(SimulationConfig(duration=duration, seed=seed, **settings))
        for seed in range(num_villages)
    }


def small_village(duration: float, seed: int, **settings: Any) -> SimulationConfig:
    """Four robots in a village of 32 m, in which their ways cross within 40 s, with frames of their own by default."""
    usual = {"num_robots": 4, "world_size": 32.0, "rate": 2.0, "own_frames": True}
    return SimulationConfig(duration=duration, seed=seed, **{**usual, **settings})


def village_of(result: Result) -> Truth:
    """Truth of a result of a simulated team: the world beside its logs."""
    world = truth_beside_logs(result.path)
    assert world is not None
    return load_truth(world, result.class_table, result.config.map.resolution)


def folder_of_logs(result: Result) -> Path:
    """Folder of a result's logs."""
    return Path(result.config.robots[0].logs[0].parent)


def counts_of(stored: StoredMap, truth: Truth, region: Region) -> TruthCounts:
    """Counts of a map's posterior against the truth in a region."""
    return truth_counts(stored.shown_octree().spans(), stored.prior, truth, region, region.holds(truth.codes))


def rule_name(row: Row) -> str:
    """Name of a run's rule."""
    return str(row["rule"])


def graph_name(row: Row) -> str:
    """Name of a run's graph."""
    return str(row["topology"])
