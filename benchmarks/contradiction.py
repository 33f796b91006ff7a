"""Contradiction of evidence with right and with wrong frames, which the warning's limits rest on.

Each scene is a team with known frames: simulated villages, and sequences of depth images split into robots. One robot
of a team is displaced, by a shift in a random direction and a yaw about its mean position, and its evidence is built
again. The floor is the contradiction with no robot displaced. Every pair of robots is a row of the CSV file.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import math
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from octoreplay.config.sensor import MapConfig, SensorConfig
from octoreplay.config.team_file import load_team_file
from octoreplay.io.datasets.rgbd_folder import import_rgbd
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from octoreplay.mapping.contradiction import (
    CLEAR_LIMIT,
    LABEL_LIMIT,
    EvidenceComparer,
    state_limits,
)
from octoreplay.mapping.octree import SemanticOctree
from octoreplay.mapping.sensor import ScanCaster, add_scan, clamped_increments
from octoreplay.records import Float64Array, Frame
from octoreplay.run_metrics import MIN_COMPARED_CELLS, PAIR_SHARES, PairMetrics
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team

SENSOR = SensorConfig()
SHIFTS = (0.3, 0.5, 1.0, 3.0)
YAWS = (2.0, 5.0, 10.0, 45.0)
WRONG = (*((shift, 0.0) for shift in SHIFTS), *((0.0, yaw) for yaw in YAWS), (3.0, 45.0))
"""Wrong frames: shift [m] and yaw [degrees]."""
NOISES = ((0.0, 0.0), (0.2, 0.0), (0.4, 0.0), (0.1, 0.05), (0.1, 0.1), (0.1, 0.2))
"""Share of wrong labels and standard deviation of the poses [m] of the villages' second runs."""
LIMITS = {"clear_contradiction": CLEAR_LIMIT, "label_contradiction": LABEL_LIMIT}
"""Limits of the warnings by share."""
NUM_DISPLACED = 1
"""Number of robots of each team that are displaced, one after the other."""
COLUMNS = (
    "scene", "kind", "resolution", "label_noise", "pose_noise", "seed", "displaced", "shift", "yaw",
    *(item.name for item in dataclasses.fields(PairMetrics)),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scene:
    """Frames of a team: ``kind`` is 'village' or the name of a data set, ``robots`` has the frames of each robot."""

    name: str
    kind: str
    seed: int
    label_noise: float
    pose_noise: float
    num_classes: int
    robots: dict[str, list[Frame]]


def villages(seeds: Sequence[int], folder: Path) -> Iterator[Scene]:
    """Simulated villages: each seed with 10 % label noise and exact poses, and with one of the other noises."""
    for seed in seeds:
        for label_noise, pose_noise in ((0.1, 0.0), NOISES[seed % len(NOISES)]):
            name = f"village {seed}, labels {label_noise:g}, poses {pose_noise:g}"
            with tempfile.TemporaryDirectory(dir=folder) as logs:
                config = SimulationConfig(
                    num_robots=4 + seed % 3, duration=60.0, seed=seed, label_noise=label_noise,
                    pose_noise=pose_noise, world_size=50.0 + 10.0 * (seed % 3),
                )  # fmt: skip
                team = simulate_team(Path(logs) / "village", config).team_file
                yield _scene(name, "village", seed, label_noise, pose_noise, team)


def depth_folders(folder: Path, work: Path) -> Iterator[Scene]:
    """Real depth images without labels: the sequences of `stairs`, and parts of one 7-Scenes sequence that overlap."""
    parts = {
        "stairs": [(folder / f"kapture_7scenes_stairs/stairs/seq-0{n}", 0, None) for n in (1, 2, 3, 4)],
        "7-scenes, 2 parts": [(folder / "tsdf_7scenes/data", first, first + 119) for first in (0, 80)],
        "7-scenes, 4 parts": [(folder / "tsdf_7scenes/data", first, first + 64) for first in (0, 45, 90, 135)],
    }
    for number, (name, robots) in enumerate(parts.items()):
        with tempfile.TemporaryDirectory(dir=work) as logs:
            lines = ["robots:"]
            for index, (images, first, last) in enumerate(robots):
                import_rgbd(images, Path(logs) / f"room_{index}.mcap", rate=5.0, first=first, last=last)
                lines.append(f"- {{id: room_{index}, log: room_{index}.mcap}}")
            team = Path(logs) / "team.yaml"
            team.write_text("\n".join(lines), encoding="utf-8")
            yield _scene(name, name.partition(",")[0], number, 0.0, 0.0, team)


def _scene(name: str, kind: str, seed: int, label_noise: float, pose_noise: float, team_file: Path) -> Scene:
    """Read the frames of a team."""
    config = resolve(load_team_file(team_file))
    robots = {}
    for robot in config.robots:
        with RobotLog(robot, config.time, config.classes) as log:
            robots[robot.robot_id] = list(log.frames())
    return Scene(name, kind, seed, label_noise, pose_noise, config.classes.num_classes, robots)


def evidence(frames: Sequence[Frame], num_classes: int, resolution: float, T: Float64Array) -> SemanticOctree:
    """Evidence of a robot's frames with their poses moved by ``T`` (4, 4)."""
    octree = SemanticOctree(resolution, num_classes)
    caster = ScanCaster(SENSOR, MapConfig(resolution=resolution), num_classes)
    for frame in frames:
        moved = dataclasses.replace(frame, T_team_sensor=T @ frame.T_team_sensor)
        add_scan(octree, caster.cast(moved), clamped_increments(SENSOR), 0)
    return octree


def displacement(frames: Sequence[Frame], shift: float, yaw: float, direction: float) -> Float64Array:
    """Transform (4, 4): a yaw [degrees] about the mean position, then a shift [m] in a direction [radians]."""
    centre = np.mean([frame.T_team_sensor[:3, 3] for frame in frames], axis=0)
    angle = math.radians(yaw)
    T = np.eye(4)
    T[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    T[:3, 3] = centre - T[:3, :3] @ centre + shift * np.array([math.cos(direction), math.sin(direction), 0.0])
    return T


def measure(scene: Scene, resolution: float) -> Iterator[dict[str, Any]]:
    """Yield a row for each pair of robots: with right frames, then with each robot displaced in each way."""
    ids, rng = list(scene.robots), np.random.default_rng(scene.seed)

    def compare(maps: Sequence[SemanticOctree], displaced: str, shift: float, yaw: float) -> Iterator[dict[str, Any]]:
        comparer = EvidenceComparer(ids, scene.num_classes, state_limits(SENSOR))
        for pair in comparer.compare(maps, 0):
            if not displaced or displaced in (pair.first, pair.second):
                yield {
                    "scene": scene.name, "kind": scene.kind, "resolution": resolution, "seed": scene.seed,
                    "label_noise": scene.label_noise, "pose_noise": scene.pose_noise,
                    "displaced": displaced, "shift": shift, "yaw": yaw, **dataclasses.asdict(pair),
                }  # fmt: skip

    right = [evidence(frames, scene.num_classes, resolution, np.eye(4)) for frames in scene.robots.values()]
    yield from compare(right, "", 0.0, 0.0)
    for robot_id in rng.choice(ids, min(NUM_DISPLACED, len(ids)), replace=False).tolist():
        frames = scene.robots[robot_id]
        for shift, yaw in WRONG:
            T = displacement(frames, shift, yaw * rng.choice([-1, 1]), rng.uniform(0, 2 * math.pi))
            maps = list(right)
            maps[ids.index(robot_id)] = evidence(frames, scene.num_classes, resolution, T)
            yield from compare(maps, robot_id, shift, yaw)


def summary(rows: Sequence[Mapping[str, str]]) -> str:
    """Return Markdown: for each frame and resolution the teams' numbers, and how many teams would be warned of.

    A team's number is its largest share over the pairs with enough cells. Numbers are median (least - largest) over the
    teams in per cent; '-' where no team has one. The interval is Wilson's, 95 %.
    """
    teams: dict[tuple[Any, ...], dict[str, float]] = defaultdict(dict)
    for row in rows:
        noise = f", labels {row['label_noise']}, poses {row['pose_noise']}" if row["kind"] == "village" else ""
        frame = f"{row['shift']} m, {row['yaw']} degrees" if row["displaced"] else f"right{noise}"
        team = teams[row["kind"], float(row["resolution"]), bool(row["displaced"]), frame, row["scene"]]
        for name, num_cells in PAIR_SHARES.items():
            if int(row[num_cells]) >= MIN_COMPARED_CELLS:
                team[name] = max(team.get(name, 0.0), float(row[name]))
    groups: dict[tuple[Any, ...], list[dict[str, float]]] = defaultdict(list)
    for key, team in teams.items():
        groups[key[:-1]].append(team)
    heads = ("scenes", "cells [m]", "frame", "teams", *PAIR_SHARES, "warned", "95 % interval")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for (kind, resolution, _, frame), of_teams in sorted(groups.items()):
        warned = sum(any(team.get(name, 0.0) > limit for name, limit in LIMITS.items()) for team in of_teams)
        shares = (_spread([team[name] for team in of_teams if name in team]) for name in PAIR_SHARES)
        low, high = _wilson(warned, len(of_teams))
        cells = (kind, f"{resolution:g}", frame, len(of_teams), *shares, warned, f"{low:.2f} - {high:.2f}")
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def _spread(values: Sequence[float]) -> str:
    """Median, least and largest in per cent."""
    if not values:
        return "-"
    return f"{100 * np.median(values):.1f} ({100 * min(values):.1f} - {100 * max(values):.1f})"


def _wilson(count: int, total: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    z, share = 1.96, count / total
    centre, half = share + z * z / (2 * total), z * math.sqrt(share * (1 - share) / total + z * z / (4 * total**2))
    return (centre - half) / (1 + z * z / total), (centre + half) / (1 + z * z / total)


def main() -> None:
    """Measure all scenes and write one row for each pair, or sum up such rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--csv", type=Path, help="file to write")
    parser.add_argument(
        "--summary", type=Path, nargs="+", metavar="FILE.csv", help="print the summary of files instead"
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(101, 109)), help="seeds of the villages")
    parser.add_argument("--resolutions", type=float, nargs="+", default=[0.2, 0.3, 0.5])
    parser.add_argument("--folder", type=Path, help="folder with kapture_7scenes_stairs and tsdf_7scenes")
    options = parser.parse_args()
    if options.summary:
        rows = [
            row for path in options.summary for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines())
        ]
        sys.stdout.write(summary(rows))
        return
    if options.csv is None:
        parser.error("give --csv or --summary")
    with tempfile.TemporaryDirectory() as work, options.csv.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        scenes = [] if options.folder is None else [depth_folders(options.folder, Path(work))]
        for scene in itertools.chain(*scenes, villages(options.seeds, Path(work))):
            for resolution in options.resolutions:
                rows = list(measure(scene, resolution))
                writer.writerows(rows)
                file.flush()
                print(f"{scene.name}, {resolution:g} m: {len(rows)} pairs", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
