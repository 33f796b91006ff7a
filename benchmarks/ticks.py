"""Time of a tick against the share of bricks that changed in it, and against the size of the maps.

Six robots replay simulated logs that end with 45 s of silence: while maps come to rest, fewer and fewer bricks change,
and then none. Then the team settles, and its finer flows change almost all bricks. A tick here is publishing,
delivering, iterating and measuring, on one thread; reading and inserting scans is not part of it.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from rounds import Report, arguments, measured
from scenes import cache_folder

from octoreplay.config.resolved import ResolvedRobot, ResolvedRun
from octoreplay.config.team_file import load_team_file
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.records import Frame
from octoreplay.replay.session import Session
from octoreplay.replay.tick import Tick
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team

SILENCE_NS = 45_000_000_000
NUM_SETTLING_TICKS = 3
_STEP = "_exchange"
"""Method of Session with the timed part of a tick."""


class TimedTick(NamedTuple):
    """Share of bricks that changed in a tick, mean number of bricks of a map, and the tick's time [s]."""

    changed: float
    bricks: float
    seconds: float


class Source:
    """Frames of a robot's log, and the last one again after the silence."""

    def __init__(self, robot: ResolvedRobot, config: ResolvedRun) -> None:
        self._robot, self._config = robot, config

    def frames(self) -> Iterator[Frame]:
        """The frames."""
        last = None
        with RobotLog(self._robot, self._config.time, self._config.classes) as log:
            for last in log.frames():
                yield last
        if last is not None:
            yield dataclasses.replace(last, stamp_ns=last.stamp_ns + SILENCE_NS)


def main() -> None:
    """Ticks at several cell sizes."""
    options = arguments(__doc__ or "", rounds=3, add=_add_options)
    report = Report("ticks", vars(options))
    team_file = _logs(options.robots, options.duration) / "team.yaml"
    for resolution in options.resolution:
        values = {"resolution": resolution, "rule": options.rule}
        config = resolve(load_team_file(team_file).with_parameters(values))
        rounds = [_ticks(config) for _ in range(options.rounds + 1)][1:]  # the first loads the kernels
        size = max(tick.bricks for tick in rounds[0])
        name = f"{options.rule}, cells of {resolution:g} m, {size:,.0f} bricks a map"
        shares = {"no brick changed": (0.0, 0.0), "5 to 15 % changed": (0.05, 0.15), "over 90 % changed": (0.9, 1.0)}
        medians = {what: [_median(ticks, size, *bounds) for ticks in rounds] for what, bounds in shares.items()}
        for what, seconds in medians.items():
            if np.isfinite(seconds).all():
                report.add(measured(f"{name}: {what}", [1e3 * value for value in seconds], "ms"))
        full = medians["over 90 % changed"]
        for what, must, goal in (("no brick changed", 1 / 50, None), ("5 to 15 % changed", 0.15, 0.12)):
            ratios = [part / whole for part, whole in zip(medians[what], full, strict=True)]
            if np.isfinite(ratios).all():
                report.add(measured(f"{name}: {what} / over 90 %", ratios, "", must=must, goal=goal))
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", type=int, default=6, help="default: %(default)s")
    parser.add_argument("--duration", type=float, default=20.0, help="of the logs in seconds (default: %(default)s)")
    parser.add_argument("--rule", default="bayes", help="default: %(default)s")
    parser.add_argument(
        "--resolution", type=float, nargs="+", default=[0.3, 0.2, 0.15], help="of the maps (default: %(default)s)"
    )


def _logs(num_robots: int, duration: float) -> Path:
    """The folder with the simulated logs."""
    folder = cache_folder() / f"ticks-{num_robots}-{duration:g}s"
    if not (folder / "team.yaml").exists():
        simulate_team(folder, SimulationConfig(num_robots=num_robots, duration=duration, rate=2.0))
    return folder


def _ticks(config: ResolvedRun) -> list[TimedTick]:
    """The ticks of one replay, with the first settling ticks."""
    ticks: list[TimedTick] = []
    exchange = getattr(Session, _STEP)

    def timed(session: Session, number: int, *arguments: Any) -> Tick:
        started = time.perf_counter()
        tick = exchange(session, number, *arguments)
        seconds = time.perf_counter() - started
        maps = [octree for octree in tick.maps if octree.num_bricks]
        changed = np.mean([np.mean(octree.revisions >= number) for octree in maps]) if maps else 0.0
        size = np.mean([octree.num_bricks for octree in tick.maps])
        ticks.append(TimedTick(float(changed), float(size), seconds))
        return tick

    with patch.object(Session, _STEP, timed), ThreadPoolExecutor(1) as threads:
        session = Session(config, [Source(robot, config) for robot in config.robots], threads)
        num_settling = 0
        for tick in session.ticks():
            num_settling += tick.settling
            if num_settling == NUM_SETTLING_TICKS:
                break
    return ticks


def _median(ticks: list[TimedTick], size: float, least: float, most: float) -> float:
    """Median time of the ticks of full-size maps in which a share of the bricks changed; NaN without any."""
    seconds = [tick.seconds for tick in ticks if tick.bricks == size and least <= tick.changed <= most]
    return float(np.median(seconds)) if seconds else float("nan")


if __name__ == "__main__":
    main()
