"""A team of four robots with mixed sensors, for runs whose links, packets and robots fail."""

from __future__ import annotations

import dataclasses
import functools
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from octoreplay.replay.session import Session
from reference.scenarios import TeamShape, make_scenario
from reference.twin import record
from support.sessions import frame_lists

SHAPE = TeamShape(num_robots=4, num_ticks=14, image=(12, 9), resolution=0.4, scan_period=0.5, sensors="mixed")
"""The log of the last robot starts in tick 4, and the log of the last but one ends in tick 8."""
PERIOD_NS = 10**9
FLOOD_TOLERANCE = 1e-4
RATIO_TOLERANCE = 1e-3
PACKETS = {
    "full": {"packets": "full"},
    "full, broadcast": {"packets": "full", "cast": "broadcast"},
    "delta": {"packets": "delta"},
    "delta, broadcast": {"packets": "delta", "cast": "broadcast"},
    "key frames": {"packets": "delta", "acknowledge": False, "key_frame_every": 4},
    "key frames, broadcast": {"packets": "delta", "acknowledge": False, "key_frame_every": 4, "cast": "broadcast"},
}
ONE_WAY_RING = tuple((f"robot_{i}", f"robot_{(i + 1) % 4}") for i in range(4))


@functools.cache
def scenario():
    return make_scenario(1, SHAPE)


@functools.cache
def recording():
    return record(scenario().base_config, scenario().frames)


def configured(*, robots=None, link_overrides=(), **parameters):
    """Return the configuration of the team; ``robots`` gives fields of some robots by id."""
    config = scenario().config(**parameters)
    of_robots = tuple(dataclasses.replace(r, **(robots or {}).get(r.robot_id, {})) for r in config.robots)
    return dataclasses.replace(config, robots=of_robots, link_overrides=link_overrides)


def session_of(config, num_threads=1):
    """Return a session of the scenario's frames."""
    frames = scenario().frames
    sources = frame_lists([robot.robot_id for robot in config.robots], frames)
    return Session(config, sources, ThreadPoolExecutor(num_threads))


def finished_run(**parameters):
    """Run a session; return it and its last tick."""
    session = session_of(configured(**parameters))
    for tick in session.ticks():
        last = tick
    return session, last


def dense(octree):
    """Return the deviations of an octree in every observed cell of the team, (M, C) float64."""
    return octree.lookup((recording().keys + 0.5) * octree.resolution)[0].astype(np.float64)


def known_cells(octree):
    """Return whether an octree knows each observed cell of the team, (M,) bool."""
    return octree.lookup((recording().keys + 0.5) * octree.resolution)[1]


def team_sums(tick):
    """Return N h_i of every robot, (N, M, C) float64."""
    return len(tick.maps) * np.array([dense(octree) for octree in tick.maps])


def oracle_errors(tick):
    """Return the largest |N h_i - oracle| of each robot, (N,) float64."""
    return np.abs(team_sums(tick) - dense(tick.oracle)).max(axis=(1, 2))


def assert_all_have_the_oracle(tick, tolerance):
    """Check that every robot knows the cells of the oracle, and that N h_i equals it within a tolerance."""
    assert oracle_errors(tick).max() < tolerance
    for octree in tick.maps:
        assert (known_cells(octree) == known_cells(tick.oracle)).all()


def own_evidence(session):
    """Return the own evidence of every robot, (N, M, C) float64."""
    return np.array([dense(robot.evidence.octree) for robot in session.team.robots])
