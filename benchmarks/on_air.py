"""Robots that find each other's frames during the run, against a run that has these frames from the beginning.

Each team is a simulated village with robots in their own frames. The table has the time from which the team is one, the
errors of the found frames against the truth, the bytes that were sent until then and in total, and the processor time.

    python benchmarks/on_air.py --teams 4:11 6:21 --output benchmarks/results/on-air.md
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from octoreplay.config.frames_file import load_frames_file
from octoreplay.config.team_file import load_team_file
from octoreplay.replay.run import replay_team
from octoreplay.result import open_result
from octoreplay.run_metrics import FramePlace, TickMetrics
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.transforms import inverse, pose_difference, transform_of

COLUMNS = (
    "robots", "seed", "first join [s]", "one team from [s]", "frame error, median", "frame error, largest",
    "sent until then [MB]", "sent in total [MB]", "the same with given frames [MB]", "processor time [s]",
    "with given frames [s]",
)  # fmt: skip


def main() -> None:
    """Run the teams and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--teams", nargs="+", default=["4:11", "6:21"], metavar="ROBOTS:SEED")
    parser.add_argument("--duration", type=float, default=60.0, help="length of the logs [s]")
    parser.add_argument("--output", type=Path, help="Markdown file to write")
    options = parser.parse_args()
    rows = [f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    for team in options.teams:
        robots, seed = (int(part) for part in team.split(":"))
        with tempfile.TemporaryDirectory() as folder:
            rows.append(f"| {' | '.join(measured(Path(folder), robots, seed, options.duration))} |")
        print(rows[-1], flush=True)
    if options.output is not None:
        options.output.write_text("\n".join(rows) + "\n", encoding="utf-8")


def measured(folder: Path, num_robots: int, seed: int, duration: float) -> list[str]:
    """Return the cells of one team's row."""
    logs = folder / "logs"
    simulate_team(logs, SimulationConfig(num_robots=num_robots, seed=seed, duration=duration, own_frames=True))
    config = load_team_file(logs / "team.yaml").with_parameters({"rule": "bayes", "align": "on-air"})
    # Compiles the kernels, which is not part of the measured time.
    replay_team(config.with_parameters({"duration": 2.0}), None)
    started = time.process_time()
    summary = replay_team(config, folder / "air.mcap")
    seconds = time.process_time() - started
    with open_result(folder / "air.mcap") as result:
        places, metrics = result.places, result.metrics
    given = dataclasses.replace(
        config,
        robots=tuple(
            dataclasses.replace(robot, T_team_map=places[robot.robot_id].T_frame_map) for robot in config.robots
        ),
    ).with_parameters({"align": "off"})
    started = time.process_time()
    plain = replay_team(given, None)
    plain_seconds = time.process_time() - started
    shifts, angles = errors(places, load_frames_file(logs / "frames.yaml"))
    together = [tick for tick in metrics if tick.num_components == 1]
    joined = f"{summary.joins[-1].seconds:g}" if together else "never"
    return [
        str(num_robots), str(seed), f"{summary.joins[0].seconds:g}" if summary.joins else "never", joined,
        f"{np.median(shifts):.2f} m, {math.degrees(np.median(angles)):.1f} degrees",
        f"{max(shifts):.2f} m, {math.degrees(max(angles)):.1f} degrees",
        f"{sent(tick for tick in metrics if tick.num_components > 1):.1f}", f"{sent(metrics):.0f}",
        f"{plain.total_sent_bytes / 1e6:.0f}", f"{seconds:.0f}", f"{plain_seconds:.0f}",
    ]  # fmt: skip


def sent(metrics: Iterable[TickMetrics]) -> float:
    """Return the bytes that all robots sent in some ticks [MB]."""
    return sum(robot.sent_bytes for tick in metrics for robot in tick.robots) / 1e6


def errors(places: Mapping[str, FramePlace], truth: Mapping[str, Sequence[float]]) -> tuple[list[float], list[float]]:
    """Return distance [m] and angle [rad] between found and true frames, of robots in the frame of another one."""
    shifts, angles = [], []
    for place in places.values():
        root = place.frame_id.removesuffix("/map")
        if root != place.robot_id:
            expected = inverse(transform_of(truth[root])) @ transform_of(truth[place.robot_id])
            shift, angle = pose_difference(transform_of(place.T_frame_map), expected)
            shifts.append(shift)
            angles.append(angle)
    return shifts or [math.nan], angles or [math.nan]


if __name__ == "__main__":
    main()
