"""Runs in tiles: time and peak memory of the processes next to those of the whole run, on a simulated team.

Memory is that of the parent process and of the largest worker process. Results must be equal.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from peaks import octoreplay
from rounds import Report, Row, arguments


def main() -> None:
    """Every asked edge of the tiles, in each round after the whole run."""
    options = arguments(__doc__ or "", rounds=1, add=_add_options)
    report = Report("tiles", vars(options))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        octoreplay(
            "simulate", folder / "logs", "--robots", options.robots, "--duration", options.seconds,
            "--image", "320x240", "--world-size", options.world,
        )  # fmt: skip
        team = folder / "logs" / "team.yaml"
        for number in range(options.rounds):
            for resolution in options.resolution or [0.2, 0.1]:
                _measure(report, folder, team, resolution, options.edge or [100.0, 50.0, 25.0], number)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", type=int, default=6, help="default: %(default)s")
    parser.add_argument("--seconds", type=float, default=40.0, help="length of the logs; default: %(default)s")
    parser.add_argument("--world", type=float, default=100.0, help="edge of the world [m]; default: %(default)s")
    parser.add_argument("--resolution", action="append", type=float, help="default: 0.2 and 0.1")
    parser.add_argument("--edge", action="append", type=float, help="edge of the tiles [m]; default: 100, 50 and 25")


def _measure(report: Report, folder: Path, team: Path, resolution: float, edges: list[float], number: int) -> None:
    """The whole run, then tiles of each edge."""
    whole = folder / "whole.mcap"
    run = ("run", team, "--resolution", resolution, "--force", "-q", "-o")
    seconds, own, *_ = octoreplay(*run, whole)
    title = f"{resolution:g} m, round {number + 1}"
    report.add(Row(f"{title}: whole run", seconds, "s"))
    report.add(Row(f"{title}: whole run, memory", own, "MiB"))
    for edge in edges:
        tiled = folder / "tiled.mcap"
        of_tiles, parent, worker, _ = octoreplay(*run, tiled, "--tiles", edge)
        octoreplay("compare", whole, tiled, "--tolerance", 0)
        report.add(
            Row(f"{title}: tiles of {edge:g} m", of_tiles, "s", note=f"{of_tiles / seconds:.2f} of the whole run")
        )
        report.add(
            Row(f"{title}: tiles of {edge:g} m, parent", parent, "MiB", note=f"{parent / own:.2f} of the whole run")
        )
        report.add(
            Row(
                f"{title}: tiles of {edge:g} m, largest worker",
                worker,
                "MiB",
                note=f"{worker / own:.2f} of the whole run",
            )
        )


if __name__ == "__main__":
    main()
