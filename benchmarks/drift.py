"""Errors of the poses of simulated robots whose odometry drifts, by drift and village."""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rounds import Report, Row, arguments

from octoreplay.config.frames_file import load_frames_file
from octoreplay.io.containers.logs import open_log
from octoreplay.io.datasets.pose_files import read_tum_track
from octoreplay.io.messages.sensor_messages import Transforms
from octoreplay.simulate.settings import SimulationConfig
from octoreplay.simulate.team import simulate_team
from octoreplay.transforms import pose_matrix, transform_of

DRIFTS = ((1.0, 0.5), (1.0, 0.0), (0.0, 0.5))


def main() -> None:
    """Simulate teams with small images and compare the recorded poses with the true ones, in the true frames."""
    options = arguments(__doc__ or "", rounds=1, add=_add_options)
    report = Report("drift", vars(options))
    for drift in DRIFTS:
        errors = np.array([row for seed in range(options.villages) for row in _robots(seed, drift, options.duration)])
        way, end, trajectory, aligned, heading = errors.T
        name = f"drift {drift[0]:g},{drift[1]:g}, {len(errors)} robots"
        report.add(_median(f"{name}: way", way, "m"))
        report.add(Row(f"{name}: error of the last position, root mean square", _rms(end), "m"))
        report.add(Row(f"{name}: the same / way, root mean square", 100 * _rms(end / way), "%"))
        report.add(Row(f"{name}: error of the last heading, root mean square", _rms(heading), "deg"))
        report.add(_median(f"{name}: trajectory error from the true start", trajectory, "m"))
        report.add(_median(f"{name}: trajectory error after the best rigid transform", aligned, "m"))
    report.save(options.json)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--villages", type=int, default=10, help="villages of six robots (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=60.0, help="length of the logs [s] (default: %(default)s)")


def _robots(seed: int, drift: tuple[float, float], duration: float) -> Iterator[tuple[float, ...]]:
    """Way [m], last and root mean square errors of position [m], of the fitted ones [m], last heading [degrees]."""
    config = SimulationConfig(
        duration=duration, seed=seed, image=(8, 6), rate=1.0, own_frames=True, odometry_drift=drift
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate_team(folder, config)
        for robot_id, numbers in load_frames_file(folder / "frames.yaml").items():
            true = read_tum_track(folder / "truth" / f"{robot_id}.tum").positions
            logged = transform_of(numbers) @ _odometry(folder / f"{robot_id}.mcap", robot_id)
            rotations = _rotations(folder / "truth" / f"{robot_id}.tum")
            turn = logged[-1, :3, :3] @ rotations[-1].T
            errors = np.linalg.norm(logged[:, :3, 3] - true, axis=1)
            yield (
                float(np.hypot(*np.diff(true[:, :2], axis=0).T).sum()),
                float(errors[-1]),
                _rms(errors),
                _rms(np.linalg.norm(_fitted(logged[:, :3, 3], true) - true, axis=1)),
                math.degrees(math.atan2(turn[1, 0], turn[0, 0])),
            )


def _odometry(log: Path, robot_id: str) -> npt.NDArray[np.float64]:
    """Recorded poses (T, 4, 4)."""
    with open_log(log) as reader:
        found = [message.sensor_message() for message in reader.messages((f"/{robot_id}/odom",))]
    poses = [pose for item in found if isinstance(item, Transforms) for pose in item.transforms]
    return np.array([pose_matrix(pose.translation, pose.rotation) for pose in poses])


def _rotations(path: Path) -> npt.NDArray[np.float64]:
    """Rotations (T, 3, 3) of a TUM file."""
    track = read_tum_track(path)
    pairs = zip(track.positions, track.rotations.tolist(), strict=True)
    return np.array([pose_matrix(position, rotation)[:3, :3] for position, rotation in pairs])


def _fitted(points: npt.NDArray[np.float64], target: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Points (T, 3) moved rigidly onto a target with the least squares of the distances (Kabsch 1976)."""
    a, b = points - points.mean(axis=0), target - target.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    fitted: npt.NDArray[np.float64] = a @ rotation.T + target.mean(axis=0)
    return fitted


def _median(what: str, values: npt.NDArray[np.float64], unit: str) -> Row:
    """Median and range of the robots."""
    return Row(what, float(np.median(values)), unit, float(values.min()), float(values.max()))


def _rms(values: npt.NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
