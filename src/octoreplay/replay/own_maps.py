"""Evidence of robots, each from its own scans alone: the input of the alignment."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.run import RunConfig
from octoreplay.io.robots.sensor_logs import SensorLogs
from octoreplay.io.robots.sightings import Sightings, read_sightings
from octoreplay.mapping.contradiction import EvidenceComparer, state_limits
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments, sensor_reach
from octoreplay.records import FrameCounts
from octoreplay.registration.measured_points import MeasuredPoints
from octoreplay.registration.own_map import OwnMap
from octoreplay.run_metrics import PairMetrics

_OWN_FRAME = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class OwnEvidence(NamedTuple):
    """Evidence of one robot in its own map frame, its measured points, places from its logs, and its frames."""

    octree: SemanticOctree
    measured: MeasuredPoints
    sightings: Sightings
    counts: FrameCounts


def own_maps(config: RunConfig, evidence: Sequence[OwnEvidence]) -> list[OwnMap]:
    """Return the map for registration of each robot's evidence."""
    return [own_map_of(config, own.octree, own.measured) for own in evidence]


def own_evidences(
    config: ResolvedRun, *, progress: Callable[[float], None] | None = None, num_threads: int | None = None
) -> list[OwnEvidence]:
    """Return the evidence of each robot's scans in its own map frame, in the order of ``config.robots``.

    ``progress`` is called with the finished share, 0 to 1. A robot without usable frames has empty evidence. Raises
    InputError as ``RobotLog`` does.
    """
    num_threads = num_threads or min(len(config.robots), os.cpu_count() or 1)
    with ThreadPoolExecutor(num_threads) as threads:
        evidence = []
        try:
            for own in threads.map(lambda robot: own_evidence(config, robot), config.robots):
                evidence.append(own)
                if progress is not None:
                    progress(len(evidence) / len(config.robots))
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return evidence


def own_evidence(config: ResolvedRun, robot: ResolvedRobot) -> OwnEvidence:
    """Return the evidence of one robot's scans in the robot's own map frame, without ``bounds``."""
    num_classes = config.classes.num_classes
    octree, measured = SemanticOctree(config.map.resolution, num_classes), MeasuredPoints(config.map.resolution)
    # The bounds are in the team's frame, which is not known yet.
    region = dataclasses.replace(config.map, bounds=())
    sensor = config.effective_sensor
    caster, increments = ScanCaster(sensor, region, num_classes), clamped_increments(sensor)
    alone = dataclasses.replace(robot, T_team_map=_OWN_FRAME, T_team_map_sigma=None, T_team_map_from=None)
    reach = sensor_reach(sensor, region)
    with SensorLogs(alone, config.time, config.classes, reach=reach) as log:
        for frame in log.frames():
            add_scan(octree, caster.cast(frame), increments, 0)
            measured.add_scan(frame, sensor)
        return OwnEvidence(octree, measured, read_sightings(log, config.time), log.counts)


def overlaid_contradiction(config: ResolvedRun, evidence: Sequence[OwnEvidence]) -> tuple[PairMetrics, ...]:
    """Return the contradiction of the robots' evidence, each in its own map frame, as if these were one frame."""
    robot_ids = [robot.robot_id for robot in config.robots]
    comparer = EvidenceComparer(robot_ids, config.classes.num_classes, state_limits(config.effective_sensor))
    return comparer.compare([own.octree for own in evidence], 0)


def own_map_of(config: RunConfig, evidence: SemanticOctree, measured: MeasuredPoints | None = None) -> OwnMap:
    """Return the map for registration of a robot's evidence. ``measured`` points make its surfaces more accurate."""
    sensor = config.effective_sensor
    return OwnMap.of_evidence(evidence, hit=sensor.hit, miss=sensor.miss, measured=measured)
