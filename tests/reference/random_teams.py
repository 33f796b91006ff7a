"""Random teams of a few cells, without ray casting: evidence, graphs with failures, step sizes and flows."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np

from octoreplay.config.network import NetworkConfig, ScheduleEntry
from octoreplay.config.run import RunConfig
from reference.evidence import IndexedScan
from reference.hand_made import START_NS, team_config
from reference.twin import Recording

NUM_CLASSES = 3
NUM_CELLS = 5
PERIOD_NS = 10**9


def random_recording(rng: np.random.Generator, num_robots: int, num_ticks: int, last_evidence: int) -> Recording:
    """Return scans of random cells up to tick ``last_evidence``, and a last scan of the first robot without cells.

    Robots start and end at random times; the first one starts the run.
    """
    scans = [_random_scan(rng, 0, START_NS), _empty_scan(0, START_NS + (num_ticks - 2) * PERIOD_NS)]
    for robot in range(num_robots):
        first, last = sorted(rng.integers(0, last_evidence, 2).tolist())
        for tick in range(first, last + 1):
            stamps = START_NS + tick * PERIOD_NS + rng.integers(1, PERIOD_NS, rng.integers(0, 3))
            scans += [_random_scan(rng, robot, stamp) for stamp in stamps.tolist()]
    keys = np.stack([np.arange(NUM_CELLS), np.zeros(NUM_CELLS, int), np.zeros(NUM_CELLS, int)], axis=1)
    return Recording(keys, tuple(sorted(scans, key=lambda scan: (scan.stamp_ns, scan.robot))), NUM_CLASSES)


def _random_scan(rng: np.random.Generator, robot: int, stamp_ns: int) -> IndexedScan:
    """Return a scan that hits, frees or leaves out each cell, with certain and uncertain labels."""
    state = rng.integers(0, 3, NUM_CELLS)
    hit = np.flatnonzero(state == 2)
    strengths = np.where(rng.random(len(hit)) < 0.5, 255, rng.integers(1, 256, len(hit)))
    classes = rng.integers(1, NUM_CLASSES + 1, len(hit))
    return IndexedScan(robot, stamp_ns, np.flatnonzero(state == 1), hit, classes, strengths)


def _empty_scan(robot: int, stamp_ns: int) -> IndexedScan:
    """Return a scan that touches no cell."""
    nothing = np.zeros(0, dtype=np.int64)
    return IndexedScan(robot, stamp_ns, nothing, nothing, nothing, nothing)


def random_config(
    rng: np.random.Generator, num_robots: int, num_ticks: int, *, has_failures: bool, **parameters: Any
) -> RunConfig:
    """Return a team on a random connected graph with symmetric weights.

    With failures, links and robots are off at random times, and robots that have ended may leave.
    """
    config = team_config("abcdefgh"[:num_robots], NUM_CLASSES, **parameters)
    robot_ids = [robot.robot_id for robot in config.robots]
    network: dict[str, Any] = {"weights": str(rng.choice(["metropolis", "max-degree"]))}
    if has_failures:
        network["after_end"] = str(rng.choice(["stay", "leave"]))
        network["schedule"] = _random_schedule(rng, robot_ids, num_ticks)
    edges = {(robot_ids[rng.integers(0, i)], robot_ids[i]) for i in range(1, num_robots)}
    edges |= {pair for pair in itertools.combinations(robot_ids, 2) if rng.random() < 0.3}
    network["edges"] = tuple((a, b, None) for a, b in sorted(edges))
    return dataclasses.replace(config, network=NetworkConfig(topology="edges", **network))


def _random_schedule(rng: np.random.Generator, robot_ids: list[str], num_ticks: int) -> tuple[ScheduleEntry, ...]:
    """Return partitions, links down and up, and robots off, one after the other."""
    entries = []
    times = np.sort(rng.choice(np.arange(2, num_ticks), 8, replace=False)).tolist()
    for start, end in zip(times[::2], times[1::2], strict=True):
        first, second = rng.permutation(robot_ids)[:2].tolist()
        kinds: list[dict[str, Any]] = [
            {"groups": ((first,), (second,))}, {"links_down": ((first, second),)}, {"links_up": ((first, second),)},
            {"robots_off": (first,)},
        ]  # fmt: skip
        entries.append(ScheduleEntry(float(start), float(end), **kinds[rng.integers(0, len(kinds))]))
    return tuple(entries)
