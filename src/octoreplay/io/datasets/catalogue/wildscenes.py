"""WildScenes: labelled lidar scans of forests (Vidanapathirana and others 2025)."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from octoreplay.config.class_tables.label_rows import LabelRow, table_of_rows
from octoreplay.config.class_tables.palette import PALETTE
from octoreplay.errors import InputError
from octoreplay.io.datasets.catalogue.folders import Folders
from octoreplay.io.datasets.cloud_files import read_bytes, read_kitti_labels
from octoreplay.io.datasets.frames_folder import write_frames
from octoreplay.io.datasets.pose_files import PoseTable
from octoreplay.io.robots.robot_log_writer import RobotLogWriter
from octoreplay.io.robots.trajectories import TrajectoryRows, trajectory
from octoreplay.io.text_tables import floats, seconds_to_ns
from octoreplay.records import ClassTable, Float64Array
from octoreplay.transforms import normalise

_CLASSES = (
    "bush", "dirt", "fence", "grass", "gravel", "log", "mud", "other-object", "other-terrain", "rock", "sky",
    "structure", "tree-foliage", "tree-trunk", "water",
)  # fmt: skip
"""Classes by their labels from 0 (wildscenes/tools/utils3d.py); 255 is unlabelled."""

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class _Summary:
    """Number of clouds without a pose."""

    num_without_pose: int


def _write_log(
    sequence: Path,
    log: Path,
    *,
    robot_id: str,
    map_frame: str,
    class_table: ClassTable | None,
    every: int,
    progress: Callable[[float], None] | None,
) -> _Summary:
    """Write the log of a sequence."""
    clouds = sorted((_stamp_ns(path), path) for path in (sequence / "Clouds").glob("*.bin"))[::every]
    stamps = [stamp for stamp, _ in clouds]
    if any(later == earlier for earlier, later in pairwise(stamps)):
        raise InputError(f"{sequence / 'Clouds'}: two clouds have the same time in their names")
    poses = _read_poses(sequence / "poses3d.csv")
    with RobotLogWriter(
        log, robot_id, None, class_table, T_body_sensor=np.eye(4), start_ns=stamps[0], map_frame=map_frame
    ) as writer:

        def write(index: int, stamp_ns: int, T_map_sensor: Float64Array) -> None:
            path = clouds[index][1]
            points = _read_points(path)
            labels = read_kitti_labels(sequence / "Labels" / f"{path.stem}.label", len(points))
            usable = np.isfinite(points).all(axis=1)
            writer.write_pose(stamp_ns, T_map_sensor)
            writer.write_cloud(stamp_ns, points[usable], labels=labels[usable])

        num_without_pose = write_frames(stamps, [partial(poses.at, stamp) for stamp in stamps], write, progress)
    if num_without_pose == len(clouds):
        raise InputError(f"{sequence / 'poses3d.csv'}: has no pose at the times of the clouds")
    return _Summary(num_without_pose)


def _stamp_ns(path: Path) -> int:
    """Time in a cloud's name [ns]: seconds, '.' or '-', and nanoseconds without their leading zeros."""
    seconds, _, rest = path.stem.replace("-", ".").partition(".")
    if not (seconds.isdecimal() and rest.isdecimal() and len(seconds) <= 10 and len(rest) <= 9):
        raise InputError(f"{path}: its name is not a time such as 1639438280.765902736.bin")
    return int(seconds) * 1_000_000_000 + int(rest)


def _read_points(path: Path) -> npt.NDArray[np.float32]:
    """Points (P, 3) of a cloud [m]."""
    data = read_bytes(path)
    if not data or len(data) % 12:
        raise InputError(f"{path}: {len(data)} bytes are not points of 12 bytes (x y z as float32); it is cut")
    return np.frombuffer(data, "<f4").reshape(-1, 3).astype(np.float32)


def _read_poses(path: Path) -> PoseTable:
    """Poses of poses3d.csv: a date in quotes, seconds, x, y, z, and the quaternion in the header's order."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            header, *table = [row for row in csv.reader(file, delimiter=" ", skipinitialspace=True) if row]
        columns = [header.index(name) for name in _POSE]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: has no header with the columns {', '.join(_POSE)}, separated by blanks") from error
    stamps, positions, rotations = [], [], []
    for number, row in enumerate(table, start=2):
        where = f"{path} row {number}"
        if len(row) != len(header) or columns[0] < 1:
            raise InputError(f"{where}: expects {len(header)} columns as in the header, got {len(row)}")
        numbers = floats(where, [row[k] for k in columns])
        rotation = normalise(numbers[3:])
        if rotation is not None and np.isfinite(numbers).all():
            stamps.append(seconds_to_ns(where, row[columns[0] - 1]))
            positions.append(numbers[:3])
            rotations.append(rotation)
    if not stamps:
        raise InputError(f"{path}: holds no poses")
    rows = TrajectoryRows(np.array(stamps, np.int64), np.array(positions), np.array(rotations))
    return PoseTable("WildScenes", rows.matrices(), trajectory(np.array(stamps, np.int64), rows), stamps)


DATA_SET = Folders(
    name="wildscenes",
    title="WildScenes",
    holds="WildScenes3d/SEQUENCE with Clouds/*.bin, Labels/*.label and poses3d.csv",
    checked=(
        "the authors' tools (clouds, labels, classes, times in names); readers of users (columns of "
        "poses3d.csv, sensor to world)"
    ),
    sources=("https://github.com/csiro-robotics/WildScenes", "https://doi.org/10.25919/aetq-q420"),
    notes=(
        "The clouds show what the camera sees; the images are not used.",
        "Names of clouds have nanoseconds without leading zeros, as in the authors' tools.",
    ),
    marker="Clouds/*.bin",
    write_log=_write_log,
    classes=lambda _: table_of_rows(
        [*(LabelRow(k, name) for k, name in enumerate(_CLASSES)), LabelRow(255, "unlabelled", None, True)], PALETTE
    ),
    parameters=MappingProxyType({"max_range": 40.0}),
)
