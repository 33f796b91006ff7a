"""Cold start: the command line's help, the first compilation of the kernels ever, and loading them afterwards."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rounds import Report, arguments, measured

REPLAY = """
import logging, sys, time
from pathlib import Path
logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(name)s: %(message)s")
started = time.perf_counter()
from octoreplay.config.team_file import load_team_file
from octoreplay.replay.run import replay_team
imported = time.perf_counter()
replay_team(load_team_file(sys.argv[1]), Path(sys.argv[2]))
print(imported - started, time.perf_counter() - imported)
# Once more in the same process: what is left when all kernels are there.
again = time.perf_counter()
replay_team(load_team_file(sys.argv[1]), Path(sys.argv[2]))
print(time.perf_counter() - again)
"""
"""A tiny replay in a fresh process: seconds of importing, of the first replay, and of the same once more."""


def main() -> None:
    """Help, then a tiny replay with an empty kernel cache and with a filled one."""
    options = arguments(__doc__ or "", rounds=5, add=_add_options)
    report = Report("cold_start", vars(options))
    command = [str(Path(sys.executable).with_name("octoreplay")), "--help"]
    report.add(measured("octoreplay --help", [_seconds(command) for _ in range(options.rounds)], "s", must=0.3))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate = [command[0], "simulate", str(folder / "team"), "--robots", "2", "--duration", "2"]
        simulate += ["--world-size", "30"]
        subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        first, imports, warm = [], [], []
        said: set[str] = set()
        for index in range(options.compilations):
            cache = folder / f"kernels-{index}"
            _, cold, rest, lines = _replay(folder, cache)
            first.append(cold - rest)
            said.update(line for line in lines if "compil" in line.lower())
            for _ in range(max(1, options.rounds // options.compilations)):
                importing, loaded, rest, _ = _replay(folder, cache)
                imports.append(importing)
                warm.append(loaded - rest)
    report.add(measured("first ever compilation of the kernels", first, "s", must=15.0))
    report.remark(f"log lines about it: {'; '.join(sorted(said)) or 'none'}")
    report.add(measured("loading the kernels afterwards", warm, "s", must=0.5, goal=0.4))
    report.add(measured("importing what a replay needs", imports, "s"))
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--compilations", type=int, default=2, help="from an empty cache (default: %(default)s)")


def _seconds(command: list[str]) -> float:
    """Seconds that a command takes."""
    started = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - started


def _replay(folder: Path, cache: Path) -> tuple[float, float, float, list[str]]:
    """The tiny replay with this kernel cache; the seconds that REPLAY prints, and what was logged."""
    command = [sys.executable, "-c", REPLAY, str(folder / "team" / "team.yaml"), str(folder / "result.mcap")]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    importing, first, again = (float(word) for word in done.stdout.split())
    return importing, first, again, done.stderr.splitlines()


if __name__ == "__main__":
    main()
