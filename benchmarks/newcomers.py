"""Robots that join a team late or again: the time until they agree with the others."""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterable

import networkx as nx
import numpy as np
from rounds import Report, Row
from watched_runs import (
    FAULT_RESOLUTION,
    NUM_ROBOTS,
    add_agreement,
    cells_of,
    deviation_of_cells,
    play,
    robot_ids,
    run_config,
    simulated_team,
    sum_of_cells,
)

from octoreplay.config.network import ScheduleEntry
from octoreplay.config.run import RunConfig
from octoreplay.replay.exchange.messages import Source
from octoreplay.replay.session import Session
from octoreplay.replay.tick import Tick

NEWCOMERS = (("off from 0 to 30 s", 0.0, 30.0, False), ("off from 20 to 40 s, forgets", 20.0, 40.0, True))


def add_newcomers(report: Report, options: argparse.Namespace) -> None:
    """A robot that comes late, and one that comes back knowing nothing, in a ring; nothing new is seen meanwhile."""
    del options
    duration = 60.0
    ids = robot_ids(simulated_team(duration))
    for name, start, end, forget in NEWCOMERS:
        schedule = (ScheduleEntry(start, end, robots_off=(ids[0],), forget=forget),)
        for packets in ("full", "delta"):
            config = run_config(
                duration, schedule=schedule, resolution=FAULT_RESOLUTION, topology="ring", rule="flood", packets=packets
            )
            _flood_newcomer(report, f"flood, ring, {packets}, a robot {name}", config, duration, end)
        config = run_config(duration, schedule=schedule, resolution=FAULT_RESOLUTION, topology="ring", rule="ratio")
        _ratio_newcomer(report, f"ratio, ring, a robot {name}", config, duration, end)


def _flood_newcomer(report: Report, title: str, config: RunConfig, duration: float, back: float) -> None:
    """Ticks, its first one included, until robot 0 has what everybody had published when it came back."""
    wanted: dict[Source, int] = {}
    missing: dict[int, list[Source]] = {}
    graphs: list[nx.Graph] = []

    def watch(session: Session, tick: Tick) -> bool:
        robots = session.team.robots
        if tick.number < back:
            return False
        if tick.number == back:
            # Every source's newest version anywhere; the others' versions of this very tick are part of it.
            for source, state in itertools.chain(*(robot.exchange.held.items() for robot in robots[1:])):
                wanted[source] = max(wanted.get(source, 0), state.version)
            graphs.append(nx.Graph(tick.graph.pairs))
        held = robots[0].exchange.held
        own = robots[0].source
        missing[tick.number] = [
            source for source, version in wanted.items()
            if source != own and (source not in held or held[source].version < version)
        ]  # fmt: skip
        return not missing[tick.number]

    run = play(config, duration, watch, blank_after=back)
    left = missing[max(missing)]
    diameter = nx.diameter(graphs[0])
    note = f"diameter {diameter}"
    if left:
        names = ", ".join(f"{config.robots[source.origin].robot_id} (life {source.epoch})" for source in left)
        note = f"not even then: {names}; {note}"
    report.add(Row(f"{title}: ticks until it has everything", len(missing), "", must=diameter, note=note))
    add_agreement(report, f"{title}: agreement then", run.ticks[-1])


def _ratio_newcomer(report: Report, title: str, config: RunConfig, duration: float, back: float) -> None:
    """Ticks, its first one included, until robot 0's map is within 1 % of where it is to go, next to lambda_2's."""
    to_mean: list[float] = []
    to_others: list[float] = []
    rates: list[float] = []

    def watch(session: Session, tick: Tick) -> bool:
        del session
        if tick.number < back:
            return False
        mine, others = cells_of(tick.maps[0]), sum_of_cells(tick.maps[1:])
        oracle = cells_of(tick.oracle)
        if tick.number == back:
            # Before it came back it knew nothing.
            to_mean.append(float(np.linalg.norm(oracle[1] / NUM_ROBOTS)))
            to_others.append(float(np.linalg.norm(others[1] / (NUM_ROBOTS - 1))))
            rates.append(_share_lambda_2(tick.graph.links))
        to_mean.append(float(np.linalg.norm(deviation_of_cells(mine, oracle, NUM_ROBOTS)) / NUM_ROBOTS))
        to_others.append(float(np.linalg.norm(deviation_of_cells(mine, others, NUM_ROBOTS - 1)) / (NUM_ROBOTS - 1)))
        return False

    run = play(config, duration, watch, blank_after=back)
    predicted = math.log(0.01) / math.log(rates[0])
    for name, errors in (("the mean of all evidence", to_mean), ("the mean of the others' maps", to_others)):
        within = [number for number, error in enumerate(errors) if error < 0.01 * errors[0]]
        ticks = within[0] if within else len(errors) - 1
        note = f"log 0.01 / log lambda_2 = {predicted:.1f}; at the end {errors[-1] / errors[0]:.2g} of its start"
        note = note if within else f"not even then; {note}"
        report.add(Row(f"{title}: ticks until within 1 % of {name}", ticks, "", note=note))
    add_agreement(report, f"{title}: agreement, settled", run.ticks[-1])


def _share_lambda_2(links: Iterable[tuple[int, int]]) -> float:
    """The second largest |eigenvalue| of the column-stochastic share matrix: 1 / (1 + D) kept and for each receiver."""
    adjacency = np.zeros((NUM_ROBOTS, NUM_ROBOTS))
    for sender, receiver in links:
        adjacency[receiver, sender] = 1.0
    shares = (np.eye(NUM_ROBOTS) + adjacency) / (1.0 + adjacency.sum(axis=0))
    return float(np.sort(np.abs(np.linalg.eigvals(shares)))[-2])
