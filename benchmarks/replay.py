"""Whole replay: six robots with 640x480 depth at 10 Hz, next to only reading and decoding the same logs.

The logs are simulated (docs/simulation.md) with zstd chunks and cached. The replay writes its result and includes the
oracle, all metrics and settling. Both sides use two threads.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rounds import Report, Row, arguments, interleave, measured
from scenes import cache_folder

from octoreplay.config.run import RunConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.io.results.result_writer import ResultWriter
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.mapping.contradiction import EvidenceComparer
from octoreplay.replay.measure import TickMeasurer
from octoreplay.replay.recorder import Recorder
from octoreplay.replay.run import Progress, replay_team
from octoreplay.replay.session import Session
from octoreplay.run_metrics import RunSummary
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team

NUM_THREADS = 2
NESTED = "contradiction of evidence (part of the metrics)"
"""Stage that another stage contains."""
STAGES: tuple[tuple[str, type, tuple[str, ...]], ...] = (
    ("reading, decoding and inserting", Session, ("_integrate",)),
    ("publishing (encode and decode)", Session, ("_publish",)),
    ("iterating", Session, ("_iterate",)),
    ("oracle and metrics", TickMeasurer, ("measure",)),
    (NESTED, EvidenceComparer, ("compare",)),
    ("writing the result", Recorder, ("record", "finish")),
    ("writing the result", ResultWriter, ("complete",)),
)
"""Timed methods of each stage, on the thread that calls them; a missing method is skipped."""


class Stopwatch:
    """Adds up the time in named stages; what runs inside settling ticks counts as settling only.

    ``within_settling`` says what the settling ticks were spent on.
    """

    def __init__(self) -> None:
        self.totals: dict[str, float] = defaultdict(float)
        self.within_settling: dict[str, float] = defaultdict(float)
        self._tick: dict[str, float] = defaultdict(float)
        self._started = 0.0

    def start(self) -> None:
        """Begin a run."""
        self._started = time.perf_counter()

    def end_tick(self, progress: Progress) -> None:
        """Book the tick that is over."""
        now = time.perf_counter()
        if progress.settling:
            self.totals["settling"] += now - self._started
        self._book(self.within_settling if progress.settling else self.totals)
        self._started = now

    def finish(self) -> None:
        """Book what came after the last tick."""
        self._book(self.totals)

    def _book(self, totals: dict[str, float]) -> None:
        for stage, seconds in self._tick.items():
            totals[stage] += seconds
        self._tick.clear()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Time the stages while this lasts."""
        originals: list[tuple[type, str, Any]] = []
        for stage, owner, names in STAGES:
            for name in names:
                method = getattr(owner, name, None)
                if method is not None:
                    originals.append((owner, name, method))
                    setattr(owner, name, self._timed(stage, method))
        try:
            yield
        finally:
            for owner, name, method in originals:
                setattr(owner, name, method)

    def _timed(self, stage: str, method: Callable[..., Any]) -> Callable[..., Any]:
        """The method with its time added to a stage; only the main thread's calls count."""
        main = threading.main_thread()

        def timed(*args: Any, **kwargs: Any) -> Any:
            started = time.perf_counter()
            try:
                return method(*args, **kwargs)
            finally:
                if threading.current_thread() is main:
                    self._tick[stage] += time.perf_counter() - started

        return timed


def main() -> None:
    """Interleaved rounds of reading and replaying."""
    options = arguments(__doc__ or "", rounds=3, add=_add_options)
    report = Report("replay", vars(options))
    config = load_team_file(_logs(options.duration, options.robots) / "team.yaml")
    config = config.with_parameters({"rule": options.rule, "packets": options.packets})
    watch = Stopwatch()
    summaries: list[RunSummary] = []
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "result.mcap"
        _replay(config, output, Stopwatch(), [])  # the kernels are loaded
        result_bytes = output.stat().st_size
        decoding = config.with_parameters({"decode_packets": True})
        times = interleave(
            {
                "read": lambda: _read(config),
                "replay": lambda: _replay(config, output, watch, summaries),
                "decoding": lambda: _replay(decoding, output, Stopwatch(), []),
            },
            options.rounds,
        )
    report.add(measured("reading and decoding, 2 threads", times["read"], "s"))
    report.add(measured("replay, 2 threads", times["replay"], "s"))
    must, goal = (5.0, 4.0) if options.rule == "gradient" else (3.5, 2.5)
    ratios = [whole / read for read, whole in zip(times["read"], times["replay"], strict=True)]
    report.add(measured("replay / reading and decoding", ratios, "", must=must, goal=goal))
    ratios = [decoded / whole for whole, decoded in zip(times["replay"], times["decoding"], strict=True)]
    report.add(measured("replay with decode_packets / replay", ratios, ""))
    speeds = [summaries[0].log_seconds / seconds for seconds in times["replay"]]
    report.add(measured("replay", speeds, "times real time", must=5.5, goal=7.5, more_is_better=True))
    whole = sum(times["replay"])
    for stage, seconds in watch.totals.items():
        report.add(Row(f"share of {stage}", 100 * seconds / whole, "%"))
    for stage, seconds in watch.within_settling.items():
        report.add(Row(f"share of settling: {stage}", 100 * seconds / whole, "%"))
    in_stages = sum(seconds for stage, seconds in watch.totals.items() if stage != NESTED)
    report.add(Row("share of everything else", 100 * (1 - in_stages / whole), "%"))
    frames = sum(counts.used for counts in summaries[0].frame_counts.values())
    report.add(Row("frames", float(frames), ""))
    report.add(Row("ticks, settling included", float(summaries[0].num_ticks), ""))
    report.add(Row("settling ticks", float(summaries[0].num_settling_ticks), ""))
    report.add(Row("result", result_bytes / 1e6, "MB"))
    cells = statistics.mean(robot.num_cells for robot in summaries[0].last.robots)
    report.add(Row("known cells of a robot's last map", cells, ""))
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--duration", type=float, default=30.0, help="of the logs in seconds (default: %(default)s)")
    parser.add_argument("--robots", type=int, default=6, help="default: %(default)s")
    parser.add_argument("--rule", default="bayes", help="default: %(default)s")
    parser.add_argument("--packets", default="delta", help="full or delta (default: %(default)s)")


def _logs(duration: float, num_robots: int) -> Path:
    """The folder with the simulated logs."""
    folder = cache_folder() / f"team-{num_robots}-{duration:g}s"
    if not (folder / "team.yaml").exists():
        simulation = SimulationConfig(
            num_robots=num_robots, duration=duration, rate=10.0, image=(640, 480), resolution=0.2
        )
        simulate_team(folder, simulation)
    return folder


def _read(config: RunConfig) -> float:
    """Seconds of decoding every frame of every robot, two logs at a time."""
    started = time.perf_counter()
    resolved = resolve(config)

    def count(index: int) -> int:
        with RobotLog(resolved.robots[index], resolved.time, resolved.classes) as log:
            return sum(1 for _ in log.frames())

    with ThreadPoolExecutor(NUM_THREADS) as threads:
        list(threads.map(count, range(len(resolved.robots))))
    return time.perf_counter() - started


def _replay(config: RunConfig, output: Path, watch: Stopwatch, summaries: list[RunSummary]) -> float:
    """Seconds of a whole replay."""
    started = time.perf_counter()
    watch.start()
    with watch.watching():
        summaries.append(replay_team(config, output, progress=watch.end_tick, num_threads=NUM_THREADS))
    watch.finish()
    return time.perf_counter() - started


if __name__ == "__main__":
    main()
