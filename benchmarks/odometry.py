"""Errors of octoreplay odometry against the truth: real depth images, and simulated LiDARs and depth cameras.

    python benchmarks/odometry.py [--data FOLDER] [-o RESULT.md]

FOLDER holds ``rgbd_seq/tsdf_7scenes/data`` in the layout of 7-Scenes. The errors are computed by evo_ape and evo_rpe
(https://github.com/MichaelGrupp/evo, GPL-3.0), which are called as programs: pip install evo.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from octoreplay.config.team_file import load_team_file
from octoreplay.io.datasets.pose_files import write_tum
from octoreplay.io.robots.discover import resolve
from octoreplay.io.robots.robot_log import RobotLog
from support.lidar_log import MOUNT, Imu, room, swaying_turn, write_drive


def evo(program: str, truth: Path, found: Path, *options: str) -> float:
    """Root mean square error by evo [m]."""
    path = shutil.which(program) or str(Path(sys.executable).with_name(program))
    words = [path, "tum", str(truth), str(found), "--align", "--t_max_diff", "0.001", *options]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    return float(re.search(r"rmse\s+(\S+)", done.stdout)[1])


def write_truth(log: Path, output: Path) -> None:
    """Write the true poses of the sensor at the stamps of its scans, from the poses in the log."""
    team = log.with_suffix(".yaml")
    subprocess.run([sys.executable, "-m", "octoreplay", "init", log, "-o", team, "--force"], check=True, stdout=-3)
    config = resolve(load_team_file(team))
    with RobotLog(config.robots[0], config.time, None) as reader:
        poses = {frame.stamp_ns: frame.T_team_sensor for frame in reader.frames()}
    write_tum(output, list(poses), np.array(list(poses.values())))


def measure(name: str, log: Path, truth: Path, *options: str) -> str:
    """One row of the table: scans, registered share, way, errors and speed."""
    found = log.with_name(f"{name.replace(' ', '_')}.tum")
    start = time.monotonic()
    words = [sys.executable, "-m", "octoreplay", "odometry", log, "-o", found, "--json", "--force", *options]
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False)
    seconds = time.monotonic() - start
    if done.returncode not in (0, 3):
        refused = re.search(r"only (\d+ of \d+) scans", done.stderr)
        return f"| {name} | refused: {refused[1] if refused else done.stderr.strip()} | | | | | |"
    quality = json.loads(done.stdout)["quality"]
    ape = evo("evo_ape", truth, found)
    rpe = evo("evo_rpe", truth, found, "--delta", "1", "--delta_unit", "m", "--all_pairs")
    share = f"{quality['num_registered']} of {quality['num_scans']}"
    return (
        f"| {name} | {share} | {quality['length']:.2f} | {ape:.3f} | {rpe:.3f} | {quality['median_residual']:.4f} | "
        f"{quality['num_scans'] / seconds:.0f} |"
    )


def main() -> None:
    """Measure everything and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    rows = [
        "| recording | scans with a pose | way (m) | ATE (m) | RPE per 1 m (m) | residual (m) | scans per second |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        mount = np.eye(4)
        mount[:3, 3] = MOUNT
        turns = {"pose": swaying_turn, "num_scans": 70}
        for name, fields, words in (
            ("LiDAR, times of points", {}, ()),
            ("LiDAR, no times", {"times": None}, ()),
            ("LiDAR, wheel odometry 3 % off", {"wheels": 0.03}, ()),
            ("LiDAR, turns to and fro, 90 degrees per second", {**turns, "imu": Imu()}, ("--guess", "none")),
            ("LiDAR, the same with an IMU", {**turns, "imu": Imu(bias=(0.0, 0.0, 0.01))}, ()),
            ("laser scanner", {"is_scan": True, "columns": 720}, ()),
        ):
            drive = write_drive(folder / "lidar.mcap", room(), **{"num_scans": 100, **fields})
            write_tum(folder / "truth.tum", drive.stamps_ns, drive.poses @ mount)
            rows.append(measure(name, drive.log, folder / "truth.tum", *words))
        words = ["simulate", folder / "v", "--robots", "1", "--duration", "20", "--rate", "15", "--image", "320x240"]
        subprocess.run([sys.executable, "-m", "octoreplay", *map(str, words)], check=True, stdout=-3)
        write_truth(folder / "v" / "husky_1.mcap", folder / "truth.tum")
        for name, guess in (("depth, village", "none"), ("depth, village, its odometry", "/husky_1/odom")):
            rows.append(measure(name, folder / "v" / "husky_1.mcap", folder / "truth.tum", "--guess", guess,
                                "--max-range", "20"))  # fmt: skip
        if options.data is not None:
            log = folder / "chess.mcap"
            words = ["import-rgbd", options.data / "rgbd_seq/tsdf_7scenes/data", "-o", log, "--rate", "6"]
            subprocess.run([sys.executable, "-m", "octoreplay", *map(str, words)], check=True, stdout=-3)
            write_truth(log, folder / "truth.tum")
            rows.append(measure("depth, 7-Scenes, every 5th image", log, folder / "truth.tum", "--guess", "none"))
    table = "\n".join(rows)
    print(table)
    if options.output is not None:
        options.output.write_text(f"# Odometry\n\nMade by `benchmarks/odometry.py`.\n\n{table}\n")


if __name__ == "__main__":
    main()
