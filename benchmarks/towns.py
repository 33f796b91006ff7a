"""Runs in tiles of simulated towns with LiDAR robots on loops all over the town: time, memory, files, results.

Each town is given as EDGExROBOTS, such as 500x32: edge of the town [m], and number of robots.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from pathlib import Path

import numpy as np
from peaks import octoreplay
from rounds import Report, Row, arguments

from octoreplay.simulate.grid import DrivingGrid, shortest_paths
from octoreplay.simulate.village import make_village

SEED = 0
LOOP = 35.0
"""Edge of the loops that the robots drive [m]."""
MARGIN = 8.0
"""Distance of the loops from the edge of the town [m]."""
ROOM = 1.0
"""Least distance of waypoints from obstacles [m]."""


def main() -> None:
    """Every town, with each edge of the tiles and each number of workers."""
    options = arguments(__doc__ or "", rounds=1, add=_add_options)
    report = Report("towns", vars(options))
    for town in options.town or ["125x8", "250x8", "250x16", "500x32"]:
        edge, robots = (int(number) for number in town.split("x"))
        with tempfile.TemporaryDirectory(dir=options.folder) as name:
            _measure(report, Path(name), edge, robots, options)
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--town", action="append", help="EDGExROBOTS; default: 125x8, 250x8, 250x16 and 500x32")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the logs; default: %(default)s")
    parser.add_argument("--scan-rate", type=float, default=2.0, help="scans per second; default: %(default)s")
    parser.add_argument("--resolution", type=float, default=0.2, help="default: %(default)s")
    parser.add_argument("--tiles", action="append", help="edge of the tiles [m], or 'whole'; default: 100")
    parser.add_argument("--jobs", action="append", type=int, help="tiles at once; default: 1 and 2")
    parser.add_argument("--folder", type=Path, help="folder for logs and results; default: that of temporary files")


def _measure(report: Report, folder: Path, edge: int, robots: int, options: argparse.Namespace) -> None:
    """One town."""
    title, logs, result = f"{edge} m, {robots} robots", folder / "logs", folder / "out.mcap"
    _write_paths(folder / "paths.yaml", float(edge), robots)
    made = octoreplay(
        "simulate", logs, "--paths", folder / "paths.yaml", "--duration", options.seconds, "--rate", options.scan_rate,
        "--sensor", "lidar", "--world-size", edge, "--speed", 2, "--resolution", options.resolution, "--seed", SEED,
    )  # fmt: skip
    size = sum(path.stat().st_size for path in logs.glob("*.mcap")) / 1e6
    report.add(Row(f"{title}: simulation", made.seconds, "s", note=f"{made.own:.0f} MiB, logs of {size:.0f} MB"))
    for tiles in options.tiles or ["100"]:
        for jobs in options.jobs or [1, 2]:
            cut = () if tiles == "whole" else ("--tiles", tiles, "--jobs", jobs)
            found = octoreplay(
                "run", logs / "team.yaml", "-o", result, "--force", "-q", *cut, folder=folder / "out.tiles"
            )
            name = f"{title}: whole run" if tiles == "whole" else f"{title}: tiles of {tiles} m, {jobs} at once"
            report.add(Row(name, found.seconds, "s"))
            report.add(Row(f"{name}, processor time", found.processor_seconds, "s"))
            report.add(Row(f"{name}, memory of the process that joins", found.own, "MiB"))
            report.add(Row(f"{name}, memory of the largest process of a tile", found.child, "MiB"))
            report.add(Row(f"{name}, work files", found.folder, "MB", note=f"result {result.stat().st_size / 1e6:.0f}"))


def _write_paths(path: Path, size: float, robots: int) -> None:
    """Write a loop for each robot; the loops begin on a grid over the town."""
    grid = DrivingGrid(make_village(size, SEED))
    roomy = grid.distance >= ROOM
    free = np.argwhere(roomy)
    center = free[np.argmin(np.abs(grid.center(free)).sum(axis=1))]
    # Waypoints must be reachable from each other.
    cells, distances, _ = shortest_paths(roomy, center)
    places = grid.center(cells[np.isfinite(distances)])
    columns = math.ceil(math.sqrt(robots * 2))
    rows, reach = math.ceil(robots / columns), size / 2 - MARGIN
    lines = ["paths:"]
    for number in range(robots):
        x, y = (
            2 * reach * (place / max(most - 1, 1)) - reach
            for place, most in zip(divmod(number, rows), (columns, rows), strict=True)
        )
        dx, dy = (-LOOP if place > 0 else LOOP for place in (x, y))
        corners = [(x, y), (x + dx, y), (x + dx, y + dy), (x, y + dy)]
        nearest = [places[np.argmin(np.hypot(*(places - corner).T))].tolist() for corner in corners]
        lines.append(f"  husky_{number + 1}: {nearest}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
