"""Import of folders of point clouds with poses.

- Clouds: PCD, PLY or KITTI's ``.bin``, one format per folder.
- Labels: a field of the cloud, or KITTI's ``.label`` files.
- Poses: a table (TUM, KITTI), a 4x4 matrix beside every cloud, or the VIEWPOINT of PCD files.
- Times: a table, numbers in the file names, or a rate.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.cloud_files import FORMATS, read_cloud, read_kitti_labels
from octoreplay.io.datasets.frames_folder import (
    check_choice,
    check_folder,
    check_map_frame,
    chosen_frames,
    entries_of_chosen,
    files_in,
    frame_stamps,
    last_number,
    natural_order,
    read_times,
    robot_name,
    write_frames,
)
from octoreplay.io.datasets.pcd import read_viewpoint
from octoreplay.io.datasets.pose_files import (
    PoseReader,
    PoseTable,
    fixed_reader,
    matrix_reader,
    read_keyframe,
    read_pose_graph,
    read_poses,
)
from octoreplay.io.output_file import unfinished
from octoreplay.io.robots.robot_log_writer import MAP_FRAME, RobotLogWriter
from octoreplay.io.sensors.labels import UNLABELLED
from octoreplay.io.text_tables import seconds_to_ns
from octoreplay.records import ClassTable, FilePath, Float64Array
from octoreplay.transforms import pose_matrix, rotation_to_quaternion

CloudFrameName: TypeAlias = Literal["sensor", "world"]
"""Frame of a cloud's points: the sensor's frame, or the frame that the poses are given in."""

_VIEWPOINT = "VIEWPOINT"
# Times in file names: seconds_nanoseconds; seconds with a fraction; seconds, milliseconds, microseconds or nanoseconds
# since 1970, which have 10, 13, 16 or 19 digits after 2001.
_SECONDS_AND_NANOSECONDS = re.compile(r"(?<!\d)([1-9]\d{8,9})_(\d{9})(?!\d)")
_SECONDS = re.compile(r"(?<![\d.])\d+\.\d+(?![\d.])")
_EPOCH = re.compile(r"(?<!\d)[1-9](?:\d{9}|\d{12}|\d{15}|\d{18})(?!\d)")


@dataclass(frozen=True)
class CloudImportSummary:
    """Summary of an import.

    ``poses`` is the source of the poses, ``frame`` the frame of the points. Clouds were left out because their pose is
    missing or not finite (``num_without_pose``) or because they have no finite point (``num_empty``). ``num_frames``
    clouds with ``num_points`` points were written. ``warnings`` are sentences.
    """

    path: Path
    robot_id: str
    layout: str
    poses: str
    frame: CloudFrameName
    num_frames: int
    num_points: int
    num_labelled: int
    num_without_pose: int
    num_empty: int
    duration: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Poses:
    """Source of the poses: a table and its file, or a reader and possibly a stamp for each chosen cloud."""

    name: str
    file: Path
    table: PoseTable | None = None
    readers: tuple[PoseReader, ...] = ()
    stamps: list[int] | None = None


@dataclass(frozen=True, eq=False)
class _Times:
    """Stamps of the chosen clouds, None without any; ``are_of_poses`` where they are the stamps of their poses."""

    source: Path
    stamps: list[int] | None
    are_of_poses: bool = False


def import_clouds(
    folder: FilePath,
    output: FilePath,
    *,
    rate: float | None = None,
    times: FilePath | None = None,
    poses: FilePath | None = None,
    pose_format: str | None = None,
    pose_origin: Sequence[float] | None = None,
    frame: CloudFrameName | None = None,
    labels: FilePath | None = None,
    robot_id: str | None = None,
    class_table: ClassTable | None = None,
    first: int = 0,
    last: int | None = None,
    every: int = 1,
    map_frame: str = MAP_FRAME,
    identity_poses: bool = False,
    progress: Callable[[float], None] | None = None,
) -> CloudImportSummary:
    """Write the point clouds and poses of a folder as one robot's log (MCAP).

    - Choice: every ``every``-th cloud from ``first`` to ``last`` (included), counted from 0 in the folder's order.
    - Stamps: from 0 at ``rate`` Hz; or the seconds in the text file ``times``, one line per cloud of the folder or per
      chosen cloud; or, without both, those of ``times.txt`` here or one folder up, the stamps in the file names, or
      those of a TUM file of poses with one line per cloud.
    - Poses: ``poses``, a trajectory file (``trajectories.read_rows``, with ``pose_format`` and ``pose_origin``), or a
      pose graph (.g2o) whose vertices have the last numbers in the clouds' names; or, without it, matrices in
      ``NAME.pose.txt`` beside the clouds, keyframes of hdl_graph_slam, ``poses.txt`` or ``graph.g2o`` here or one
      folder up, or VIEWPOINT of PCD files. With ``identity_poses`` all poses are the identity; clouds without times are
      then one second apart.
    - Points: ``frame`` is the frame they are given in; None is the sensor's frame, with VIEWPOINT the world's. Points
      that are not finite are left out.
    - Labels: ``labels`` is a folder of KITTI ``.label`` files named like the clouds (default: ``labels/`` beside the
      clouds' folder). ``class_table`` names the labels.
    - ``robot_id`` defaults to the log's file name. ``map_frame`` names the frame of the poses.

    One cloud at a time is in memory. The same input gives the same bytes. Raises InputError for missing or damaged
    files, ConfigError for options that do not fit, OutputError where the log cannot be written; then no file is left.
    """
    folder, output = Path(folder), Path(output)
    times, poses, labels = (None if path is None else Path(path) for path in (times, poses, labels))
    check_choice(rate, times, first, every)
    check_map_frame(map_frame)
    robot_id = robot_name(robot_id, output)
    clouds = _find_clouds(folder)
    chosen = chosen_frames(folder, len(clouds), first, last, every)
    paths = [clouds[k] for k in chosen]
    if identity_poses and poses is not None:
        raise ConfigError("identity_poses and poses: give one of them, not both")
    found = _identity(paths) if identity_poses else _find_poses(paths, poses, pose_format, pose_origin)
    own = _find_times(clouds, chosen, times, found, has_rate=rate is not None)
    if identity_poses and own.stamps is None and rate is None:
        rate = 1.0
    stamps = frame_stamps(own.source, own.stamps, rate, len(paths))
    job = _Import(
        paths=paths,
        stamps=stamps,
        readers=_readers(found, own, chosen, len(clouds)),
        label_files=_find_labels(paths, labels),
        is_in_world=(found.name == _VIEWPOINT) if frame is None else frame == "world",
        map_frame=map_frame,
    )
    with unfinished(output) as path:
        job.write(path, robot_id, class_table, progress)
        if job.num_frames == 0:
            raise InputError(_nothing_usable(folder, job, found, own))
    return CloudImportSummary(
        output, robot_id, FORMATS[paths[0].suffix.lower()], found.name, "world" if job.is_in_world else "sensor",
        job.num_frames, job.num_points, job.num_labelled, job.num_without_pose, job.num_empty,
        (stamps[-1] - stamps[0]) / 1e9, job.warnings(),
    )  # fmt: skip


@dataclass
class _Import:
    """One import in progress, with its counts."""

    paths: Sequence[Path]
    stamps: Sequence[int]
    readers: Sequence[PoseReader]
    label_files: Sequence[Path | None]
    is_in_world: bool
    map_frame: str
    num_frames: int = 0
    num_points: int = 0
    num_labelled: int = 0
    num_without_pose: int = 0
    num_empty: int = 0
    is_labelled: bool | None = None
    with_extra_columns: list[Path] = field(default_factory=list)

    def write(
        self, path: Path, robot_id: str, class_table: ClassTable | None, progress: Callable[[float], None] | None
    ) -> None:
        """Write the log."""
        with RobotLogWriter(
            path, robot_id, None, class_table, T_body_sensor=np.eye(4), start_ns=self.stamps[0],
            map_frame=self.map_frame,
        ) as log:  # fmt: skip
            self.num_without_pose = write_frames(self.stamps, self.readers, partial(self._write_cloud, log), progress)

    def _write_cloud(self, log: RobotLogWriter, index: int, stamp_ns: int, T_map_sensor: Float64Array) -> None:
        """Write one cloud with its pose."""
        path = self.paths[index]
        cloud = read_cloud(path)
        if cloud.num_extra_columns:
            self.with_extra_columns.append(path)
        label_file = self.label_files[index]
        labels = cloud.labels if label_file is None else read_kitti_labels(label_file, len(cloud.points))
        points = cloud.points
        # Points that are not finite, or overflow float32, are left out below.
        with np.errstate(over="ignore", invalid="ignore"):
            if self.is_in_world:
                # The rotation of the log's quaternion is exactly orthogonal; a matrix from a text file is rounded.
                rotation = pose_matrix((0.0, 0.0, 0.0), rotation_to_quaternion(T_map_sensor[:3, :3]))[:3, :3]
                points = (points - T_map_sensor[:3, 3]) @ rotation
            points = points.astype(np.float32)
        usable = np.isfinite(points).all(axis=1)
        if not usable.any():
            self.num_empty += 1
            return
        log.write_pose(stamp_ns, T_map_sensor)
        log.write_cloud(
            stamp_ns,
            points[usable],
            labels=self._labels(path, labels, usable),
            rgb=None if cloud.rgb is None else cloud.rgb[usable],
            intensity=None if cloud.intensity is None else cloud.intensity[usable],
        )
        self.num_frames += 1
        self.num_points += int(np.count_nonzero(usable))
        self.num_labelled += labels is not None

    def _labels(
        self, path: Path, labels: npt.NDArray[np.uint32] | None, usable: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.uint32] | None:
        """Labels to write: for every cloud where the log has any, since readers examine the first cloud only."""
        if self.is_labelled is None:
            self.is_labelled = labels is not None or any(self.label_files)
        if labels is not None and not self.is_labelled:
            raise InputError(f"{path}: has labels, but the clouds before it have none; choose it as 'first'")
        if labels is None:
            return np.full(np.count_nonzero(usable), UNLABELLED[1], np.uint32) if self.is_labelled else None
        return labels[usable]

    def warnings(self) -> tuple[str, ...]:
        """Sentences on clouds that were imported in part."""
        if not self.with_extra_columns:
            return ()
        others = len(self.with_extra_columns) - 1
        files = f"{self.with_extra_columns[0]}{f' and {others:,} more' if others else ''}"
        return (f"{files}: rows have more columns than the header names; those after the named ones were not read",)


def _nothing_usable(folder: Path, job: _Import, found: _Poses, own: _Times) -> str:
    """Error for an import without a cloud."""
    if job.num_empty:
        return f"{folder}: none of the {job.num_empty} clouds with a pose has a finite point"
    sentence = f"{folder}: none of the {len(job.paths)} clouds has a usable pose in {found.name}"
    stamps = None if found.table is None else found.table.stamps
    if not stamps or not own.stamps:
        return sentence
    return (
        f"{sentence}: the clouds' times are {own.stamps[0] / 1e9:.3f} to {own.stamps[-1] / 1e9:.3f} s, the poses' "
        f"{min(stamps) / 1e9:.3f} to {max(stamps) / 1e9:.3f} s; give the clouds' times on the poses' clock"
    )


# --- clouds and labels -----------------------------------------------------------------------------------------------


def _find_clouds(folder: Path) -> list[Path]:
    """Clouds of the folder, or of its ``velodyne/``, in the order of the numbers or times in their names."""
    check_folder(folder)
    for place in (folder, folder / "velodyne"):
        clouds = [p for p in files_in(place) if p.suffix.lower() in FORMATS]
        kinds = sorted({path.suffix.lower() for path in clouds})
        if len(kinds) > 1:
            raise InputError(f"{place}: holds {' and '.join(kinds)} files; keep clouds of one format in it")
        # Some programs write a subfolder for each cloud: 000000/cloud.pcd.
        clouds = clouds or [path for suffix in FORMATS for path in place.glob(f"*/cloud{suffix}")]
        if clouds:
            clouds.sort(key=lambda path: (natural_order(path.parent), natural_order(path)))
            stamps = _name_stamps(clouds)
            return clouds if stamps is None else [path for _, path in sorted(zip(stamps, clouds, strict=True))]
    endings = sorted({path.suffix for path in files_in(folder) if path.suffix})
    found = f"; the folder holds {', '.join(endings[:6])} files" if endings else ""
    raise InputError(f"{folder}: no clouds found; looked for {', '.join(FORMATS)}, also in velodyne/{found}")


def _find_labels(paths: Sequence[Path], labels: Path | None) -> list[Path | None]:
    """Label file of every cloud, None where it has none."""
    folder = paths[0].parent.parent / "labels" if labels is None else labels
    by_name = {path.stem: path for path in files_in(folder) if path.suffix.lower() == ".label"}
    matched = [by_name.get(path.stem) for path in paths]
    if labels is not None and not any(matched):
        raise InputError(f"{labels}: holds no .label file with the name of a cloud such as '{paths[0].name}'")
    return matched


# --- poses -----------------------------------------------------------------------------------------------------------


def _find_poses(
    paths: Sequence[Path], given: Path | None, pose_format: str | None, origin: Sequence[float] | None
) -> _Poses:
    """Source of the poses: a given file, matrices beside the clouds, ``poses.txt``, or VIEWPOINT."""
    folder = paths[0].parent
    if given is not None:
        return _graph(given, paths) if given.suffix.lower() == ".g2o" else _tabled(given, pose_format, origin)
    matrices = [path.with_name(f"{path.stem}.pose.txt") for path in paths]
    if any(path.is_file() for path in matrices):
        return _Poses("*.pose.txt", folder, readers=tuple(matrix_reader(path) for path in matrices))
    if all((path.parent / "data").is_file() for path in paths):
        keyframes = [read_keyframe(path.parent / "data") for path in paths]
        readers = tuple(fixed_reader(T) for _, T in keyframes)
        return _Poses("keyframes of hdl_graph_slam", folder, None, readers, [stamp_ns for stamp_ns, _ in keyframes])
    for place in (folder, folder.parent):
        if (place / "poses.txt").is_file():
            return _tabled(place / "poses.txt", pose_format, origin)
        if (place / "graph.g2o").is_file():
            return _graph(place / "graph.g2o", paths)
    if paths[0].suffix.lower() != ".pcd":
        raise InputError(
            f"{folder}: no poses found; looked for NAME.pose.txt beside the clouds, and poses.txt and graph.g2o here"
            " and one folder up; give a file of poses, or identity_poses (--identity-poses) for clouds in one frame"
        )
    viewpoints = [read_viewpoint(path) for path in paths]
    # Writers without poses store the identity.
    is_unset = [T is None or np.array_equal(T, np.eye(4)) for T in viewpoints]
    if all(T is None for T in viewpoints) or (len(paths) > 1 and all(is_unset)):
        raise InputError(
            f"{folder}: no poses found, and the VIEWPOINT of every cloud is unset; give a file of poses, or"
            " identity_poses (--identity-poses) for clouds in one frame"
        )
    return _Poses(_VIEWPOINT, folder, readers=tuple(fixed_reader(T) for T in viewpoints))


def _identity(paths: Sequence[Path]) -> _Poses:
    """The identity as the pose of every cloud."""
    return _Poses("the identity", paths[0].parent, readers=(fixed_reader(np.eye(4)),) * len(paths))


def _graph(path: Path, clouds: Sequence[Path]) -> _Poses:
    """Poses of the vertices of a pose graph that have the numbers of the clouds."""
    vertices = read_pose_graph(path)
    numbers = [last_number(cloud) for cloud in clouds]
    poses = [None if number is None else vertices.get(number) for number in numbers]
    if all(T is None for T in poses):
        raise InputError(
            f"{path}: none of its {len(vertices)} vertices has the number of a cloud such as '{clouds[0].name}'"
        )
    return _Poses(path.name, path, readers=tuple(map(fixed_reader, poses)))


def _tabled(path: Path, pose_format: str | None, origin: Sequence[float] | None) -> _Poses:
    """Poses of a table."""
    table = read_poses(path, pose_format, origin)
    return _Poses(f"{path.name} ({table.name})", path, table)


def _readers(found: _Poses, own: _Times, chosen: range, total: int) -> Sequence[PoseReader]:
    """Pose reader of each chosen cloud."""
    table = found.table
    if table is None:
        return found.readers
    if table.stamps is None or own.are_of_poses or own.stamps is None:
        return [fixed_reader(T) for T in entries_of_chosen(table.poses, "poses", chosen, total, found.file)]
    return [partial(table.at, stamp_ns) for stamp_ns in own.stamps]


# --- times -----------------------------------------------------------------------------------------------------------


def _find_times(clouds: Sequence[Path], chosen: range, given: Path | None, found: _Poses, *, has_rate: bool) -> _Times:
    """Stamps of the clouds: a given file, ``times.txt``, the file names, or a TUM file with one row per cloud."""
    folder = clouds[0].parent
    pose_stamps = None if found.table is None else found.table.stamps
    if has_rate and pose_stamps is None:
        return _Times(folder, None)
    for path in (given, folder / "times.txt", folder.parent / "times.txt"):
        if path is not None and (path == given or path.is_file()):
            return _Times(path, read_times(path, chosen, len(clouds)))
    names = _name_stamps(clouds)
    if names is not None:
        return _Times(folder, [names[k] for k in chosen])
    if found.stamps is not None:
        return _Times(folder, found.stamps)
    if pose_stamps is not None:
        return _Times(
            found.file, entries_of_chosen(pose_stamps, "poses", chosen, len(clouds), found.file), are_of_poses=True
        )
    return _Times(folder, None)


def _name_stamps(clouds: Sequence[Path]) -> list[int] | None:
    """Stamps in the clouds' names; None unless every name holds one and all differ."""
    stamps = [_name_stamp(path.stem) for path in clouds]
    found = [stamp for stamp in stamps if stamp is not None]
    return found if len(set(found)) == len(clouds) else None


def _name_stamp(name: str) -> int | None:
    """Time in a name [ns]; None unless there is exactly one."""
    pairs = _SECONDS_AND_NANOSECONDS.findall(name)
    if len(pairs) == 1:
        return int(pairs[0][0]) * 1_000_000_000 + int(pairs[0][1])
    fractions = _SECONDS.findall(name)
    if len(fractions) == 1:
        return seconds_to_ns(name, fractions[0])
    numbers = _EPOCH.findall(name)
    # 10 digits are seconds, 19 are nanoseconds.
    return int(numbers[0]) * 10 ** (19 - len(numbers[0])) if len(numbers) == 1 else None
