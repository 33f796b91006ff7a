"""Flows of rule bayes with and without a gate: bytes sent and agreement over the log, several teams per graph.

Robots of `octoreplay simulate` explore a village each team. Settling is left out: there the gate is off.
"""

from __future__ import annotations

import argparse
import statistics
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import scenes
from rounds import Report, Row, arguments

from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.replay.session import Session
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team

GRAPHS: dict[str, tuple[int, float, dict[str, object]]] = {
    "complete, 6": (6, 30.0, {"topology": "complete"}),
    "ring, 6": (6, 30.0, {"topology": "ring"}),
    "line, 6": (6, 30.0, {"topology": "line"}),
    "nearest 3, 16": (16, 20.0, {"topology": "nearest", "num_nearest": 3}),
    "nearest 3, 32": (32, 15.0, {"topology": "nearest", "num_nearest": 3}),
}
"""Number of robots, length of the logs [s] and network of each graph."""
VARIANTS: dict[str, dict[str, object]] = {
    "4 bits": {},
    "6 bits, gate 0.5": {"flow_bits": 6, "flow_gate": 0.5},
    "6 bits, gate 1": {"flow_bits": 6, "flow_gate": 1.0},
}


def main() -> None:
    """Run every variant on every graph and team."""
    options = arguments(__doc__ or "", rounds=5, add=_add_options)
    report = Report("flows", vars(options))
    for graph in options.only or GRAPHS:
        num_robots, duration, network = GRAPHS[graph]
        teams = [_team(num_robots, duration, seed).with_parameters(network) for seed in range(options.rounds)]
        runs = {name: [_run(team, values) for team in teams] for name, values in VARIANTS.items()}
        first = next(iter(runs.values()))
        for name, of_teams in runs.items():
            _add_rows(report, f"{graph}: {name}", of_teams, first)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", action="append", choices=tuple(GRAPHS), help="run only these graphs")


def _team(num_robots: int, duration: float, seed: int) -> RunConfig:
    """Simulated team, from the cache where it is there."""
    folder = scenes.cache_folder() / f"flows-{num_robots}-{duration:g}s-{seed}"
    if not (folder / "team.yaml").exists():
        simulate_team(folder, SimulationConfig(num_robots=num_robots, duration=duration, seed=seed))
    return resolve(load_team_file(folder / "team.yaml"))


def _run(team: RunConfig, parameters: dict[str, object]) -> tuple[float, float, float]:
    """Bytes sent per robot and second, and the worst robot's agreement while all are active: all cells, occupied."""
    config = team.with_parameters({**parameters, "settle": 0})
    with ExitStack() as stack:
        logs = [stack.enter_context(RobotLog(robot, config.time, config.classes)) for robot in config.robots]
        ticks = [tick.metrics for tick in Session(config, logs, ThreadPoolExecutor(1)).ticks()]
    robots = [tick.robots for tick in ticks]
    sent = sum(robot.sent_bytes for of_tick in robots for robot in of_tick)
    active = [of_tick for of_tick in robots if all(robot.active for robot in of_tick)]
    return (
        sent / len(config.robots) / (len(ticks) - 1),
        statistics.mean(min(robot.agreement for robot in of_tick) for of_tick in active),
        statistics.mean(min(robot.agreement_occupied for robot in of_tick) for of_tick in active),
    )


def _add_rows(
    report: Report, title: str, runs: list[tuple[float, float, float]], first: list[tuple[float, float, float]]
) -> None:
    """Means over the teams, and the range of the differences to the first variant, team by team."""
    for number, (what, unit, scale) in enumerate(
        (("sent", "kB/s per robot", 1e-3), ("agreement, all", "", 1.0), ("agreement, occupied", "", 1.0))
    ):
        values = [scale * run[number] for run in runs]
        differences = [value - scale * run[number] for value, run in zip(values, first, strict=True)]
        note = f"against the first variant {min(differences):+.4f} to {max(differences):+.4f}" if runs != first else ""
        report.add(Row(f"{title}: {what}", statistics.mean(values), unit, min(values), max(values), note=note))


if __name__ == "__main__":
    main()
