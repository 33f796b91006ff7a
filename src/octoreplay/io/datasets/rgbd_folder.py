"""Import of folders of depth images with poses.

Three layouts are recognised by the files in the folder:

* 7-Scenes: ``frame-NNNNNN.depth.png`` (millimetres) with ``frame-NNNNNN.pose.txt`` (4x4, camera to world), and the 3x3
  matrix K in ``camera-intrinsics.txt`` here or one folder up; without it fx = fy = 585, cx = 320, cy = 240.
* TUM RGB-D: ``depth.txt`` (stamp, file; 1/5000 m) and ``groundtruth.txt`` (stamp, position, quaternion of the camera),
  fx = fy = 525, cx = 319.5, cy = 239.5. Poses are interpolated at the depth stamps.
* ScanNet: ``depth/N.png`` (millimetres), ``pose/N.txt`` (4x4, camera to world), ``intrinsic/intrinsic_depth.txt`` and,
  if exported, ``label/N.png`` or ``label-filt/N.png``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.frames_folder import (
    check_choice,
    check_folder,
    check_map_frame,
    chosen_frames,
    frame_stamps,
    natural_order,
    read_times,
    robot_name,
    unfinished,
    write_frames,
)
from octoreplay.io.datasets.pose_files import PoseReader, matrix_reader, read_tum_track, track_reader
from octoreplay.io.robots.robot_log_writer import MAP_FRAME, OPTICAL_IN_BODY, RobotLogWriter
from octoreplay.io.text_tables import read_matrix, rows, seconds_to_ns
from octoreplay.records import CameraModel, ClassTable, Float64Array
from octoreplay.transforms import inverse

MILLIMETRE = 0.001

_INVALID = 65535


@dataclass(frozen=True)
class ImportSummary:
    """Summary of an import; ``num_without_pose`` frames were left out because their pose is missing or not finite."""

    path: Path
    robot_id: str
    layout: str
    camera: CameraModel
    depth_unit: float
    num_frames: int
    num_labelled: int
    num_without_pose: int
    duration: float


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame of the folder: its files, its stamp (None without one) and the reader of its pose."""

    depth_file: Path
    label_file: Path | None
    stamp_ns: int | None
    read_pose: PoseReader


@dataclass(frozen=True, eq=False)
class _Layout:
    """Layout of the folder: its frames in order, its camera (fx, fy, cx, cy) and the metres in one unit of depth.

    ``assumed`` is true for the dataset's published intrinsics of 640x480 images, false for the folder's own.
    """

    name: str
    frames: list[_Frame]
    intrinsics: tuple[float, float, float, float]
    assumed: bool
    depth_unit: float


def import_rgbd(
    folder: Path,
    output: Path,
    *,
    rate: float | None = None,
    times: Path | None = None,
    robot_id: str | None = None,
    intrinsics: Sequence[float] | None = None,
    depth_unit: float | None = None,
    labels: Path | None = None,
    class_table: ClassTable | None = None,
    first: int = 0,
    last: int | None = None,
    every: int = 1,
    map_frame: str = MAP_FRAME,
    progress: Callable[[float], None] | None = None,
) -> ImportSummary:
    """Write the depth images and poses of a folder as one robot's log (MCAP).

    - Choice: every ``every``-th frame from ``first`` to ``last`` (included), counted from 0 in the folder's order.
    - Stamps: from 0 at ``rate`` Hz; or the seconds in the text file ``times``, one line per frame of the folder or per
      chosen frame; or, in a TUM folder without both, the frames' own stamps.
    - Depth: millimetres are written as 16UC1 with 0 where nothing was measured (0 or 65535 in the files), other units
      as 32FC1 metres with NaN there.
    - ``intrinsics`` (fx, fy, cx, cy) in pixels and ``depth_unit`` in metres replace the folder's.
    - Labels: ``labels`` is a folder of label PNGs named like the depth images; ``class_table`` names their values.
    - ``robot_id`` defaults to the log's file name. ``map_frame`` names the frame of the poses.

    The same input gives the same bytes. Raises InputError for missing or damaged files, ConfigError for options that do
    not fit, OutputError where the log cannot be written; then no file is left.
    """
    check_choice(rate, times, first, every)
    check_map_frame(map_frame)
    _check_options(intrinsics, depth_unit)
    robot_id = robot_name(robot_id, output)
    layout = _find_layout(folder)
    frames = layout.frames if labels is None else _with_labels(layout.frames, labels)
    chosen = chosen_frames(folder, len(frames), first, last, every)
    own = _own_times([frames[k] for k in chosen]) if times is None else read_times(times, chosen, len(frames))
    stamps = frame_stamps(times or folder, own, rate, len(chosen))
    job = _Import(
        frames=[frames[k] for k in chosen],
        stamps=stamps,
        camera=_camera(
            frames[chosen[0]].depth_file, intrinsics or layout.intrinsics, assumed=layout.assumed and intrinsics is None
        ),
        depth_unit=layout.depth_unit if depth_unit is None else depth_unit,
        map_frame=map_frame,
    )
    with unfinished(output) as partial:
        job.write(partial, robot_id, class_table, progress)
        if job.num_frames == 0:
            raise InputError(f"{folder}: none of the {len(chosen)} frames has a usable pose")
    return ImportSummary(
        output, robot_id, layout.name, job.camera, job.depth_unit, job.num_frames, job.num_labelled,
        job.num_without_pose, (stamps[-1] - stamps[0]) / 1e9,
    )  # fmt: skip


@dataclass
class _Import:
    """One import in progress, with its counts."""

    frames: list[_Frame]
    stamps: list[int]
    camera: CameraModel
    depth_unit: float
    map_frame: str
    num_frames: int = 0
    num_labelled: int = 0
    num_without_pose: int = 0

    def write(
        self, path: Path, robot_id: str, class_table: ClassTable | None, progress: Callable[[float], None] | None
    ) -> None:
        """Write the log."""
        T_body_sensor = np.eye(4)
        T_body_sensor[:3, :3] = OPTICAL_IN_BODY
        T_sensor_body = inverse(T_body_sensor)
        with RobotLogWriter(
            path, robot_id, self.camera, class_table, T_body_sensor=T_body_sensor, start_ns=self.stamps[0],
            map_frame=self.map_frame,
        ) as log:  # fmt: skip

            def write_frame(index: int, stamp_ns: int, T_map_sensor: Float64Array) -> None:
                frame = self.frames[index]
                depth = self._depth_image(frame.depth_file)
                label_image = None if frame.label_file is None else self._label_image(frame.label_file)
                log.write_pose(stamp_ns, T_map_sensor @ T_sensor_body)
                log.write_frame(stamp_ns, depth, label_image)
                self.num_frames += 1
                self.num_labelled += label_image is not None

            readers = [frame.read_pose for frame in self.frames]
            self.num_without_pose = write_frames(self.stamps, readers, write_frame, progress)

    def _depth_image(self, path: Path) -> npt.NDArray[Any]:
        """A depth image as the log holds it: uint16 millimetres, or float32 metres."""
        raw = _read_png(path)
        if raw.dtype != np.uint16:
            raise InputError(f"{path}: a depth image must be a 16-bit grey PNG, this one has {_kind(raw)}")
        self._check_size(path, raw)
        measured = (raw != 0) & (raw != _INVALID)
        if abs(self.depth_unit - MILLIMETRE) < 1e-12:
            return np.where(measured, raw, np.uint16(0))
        metres = (raw * self.depth_unit).astype(np.float32)
        return np.where(measured, metres, np.float32(np.nan))

    def _label_image(self, path: Path) -> npt.NDArray[Any]:
        """A label image, uint8 or uint16."""
        raw = _read_png(path)
        if raw.ndim != 2:
            raise InputError(f"{path}: a label image must be an 8-bit or 16-bit grey PNG, this one has {_kind(raw)}")
        self._check_size(path, raw)
        return raw

    def _check_size(self, path: Path, image: npt.NDArray[Any]) -> None:
        """Raise InputError where an image has another size than the camera."""
        if image.shape != (self.camera.height, self.camera.width):
            raise InputError(
                f"{path}: is {image.shape[1]}x{image.shape[0]} pixels, but the depth images are "
                f"{self.camera.width}x{self.camera.height}; resize it without interpolation"
            )


def _check_options(intrinsics: Sequence[float] | None, depth_unit: float | None) -> None:
    """Raise ConfigError for a camera that is invalid for every folder."""
    if intrinsics is not None and (
        len(intrinsics) != 4 or not np.isfinite(intrinsics).all() or min(intrinsics[:2]) <= 0
    ):
        raise ConfigError("intrinsics: expects 4 numbers fx, fy, cx, cy in pixels, fx and fy greater than 0")
    if depth_unit is not None and not 0 < depth_unit < 1000:
        raise ConfigError(f"depth_unit: {depth_unit:g} must be greater than 0 and below 1000 metres")


# --- layouts ---------------------------------------------------------------------------------------------------------


def _find_layout(folder: Path) -> _Layout:
    """Layout of a folder, recognised by its files."""
    check_folder(folder)
    images = sorted(folder.glob("frame-*.depth.png"), key=natural_order)
    if images:
        return _seven_scenes(folder, images)
    if (folder / "depth.txt").is_file() and (folder / "groundtruth.txt").is_file():
        return _tum(folder)
    images = sorted((folder / "depth").glob("*.png"), key=natural_order)
    if images and (folder / "pose").is_dir():
        return _scannet(folder, images)
    raise InputError(
        f"{folder}: no RGB-D sequence found; looked for frame-*.depth.png with frame-*.pose.txt (7-Scenes), depth.txt "
        "with groundtruth.txt (TUM RGB-D), depth/*.png with pose/*.txt (ScanNet)"
    )


def _seven_scenes(folder: Path, images: list[Path]) -> _Layout:
    """Layout of a 7-Scenes folder."""
    intrinsics, assumed = (585.0, 585.0, 320.0, 240.0), True
    for place in (folder, folder.parent):
        if (place / "camera-intrinsics.txt").is_file():
            intrinsics, assumed = _read_camera_matrix(place / "camera-intrinsics.txt"), False
            break
    frames = [_Frame(image, None, None, matrix_reader(image.with_name(f"{_stem(image)}.pose.txt"))) for image in images]
    return _Layout("7-Scenes", frames, intrinsics, assumed, MILLIMETRE)


def _scannet(folder: Path, images: list[Path]) -> _Layout:
    """Layout of a ScanNet folder."""
    path = folder / "intrinsic" / "intrinsic_depth.txt"
    if not path.is_file():
        raise InputError(f"{path}: not found; a ScanNet folder holds the depth camera's matrix there")
    frames = [_Frame(p, None, None, matrix_reader(folder / "pose" / f"{p.stem}.txt")) for p in images]
    for name in ("label", "label-filt"):
        if (folder / name).is_dir():
            frames = _with_labels(frames, folder / name)
            break
    return _Layout("ScanNet", frames, _read_camera_matrix(path), False, MILLIMETRE)


def _tum(folder: Path) -> _Layout:
    """Layout of a TUM RGB-D folder."""
    track = read_tum_track(folder / "groundtruth.txt")
    frames = []
    for where, fields in rows(folder / "depth.txt"):
        if len(fields) != 2:
            raise InputError(f"{where}: expects a stamp and a file name, got {len(fields)} words")
        stamp_ns = seconds_to_ns(where, fields[0])
        frames.append(_Frame(folder / fields[1], None, stamp_ns, track_reader(track, stamp_ns)))
    if not frames:
        raise InputError(f"{folder / 'depth.txt'}: lists no depth images")
    frames.sort(key=lambda frame: frame.stamp_ns or 0)
    return _Layout("TUM RGB-D", frames, (525.0, 525.0, 319.5, 239.5), True, 1 / 5000)


def _own_times(frames: list[_Frame]) -> list[int] | None:
    """Own stamps of the frames; None unless every frame has one."""
    stamps = [frame.stamp_ns for frame in frames if frame.stamp_ns is not None]
    return stamps if len(stamps) == len(frames) else None


def _with_labels(frames: list[_Frame], folder: Path) -> list[_Frame]:
    """The frames with the label images of the same name; a frame may have none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder of label images")
    by_name = {_stem(path): path for path in sorted(folder.glob("*.png"))}
    matched = [
        _Frame(frame.depth_file, by_name.get(_stem(frame.depth_file)), frame.stamp_ns, frame.read_pose)
        for frame in frames
    ]
    if all(frame.label_file is None for frame in matched):
        raise InputError(
            f"{folder}: no label image has the name of a depth image such as '{frames[0].depth_file.name}'"
        )
    return matched


def _stem(path: Path) -> str:
    """An image's name without its suffixes: frame-000001.depth.png -> frame-000001."""
    return re.sub(r"(\.(depth|label|labels))?\.png$", "", path.name)


# --- files -----------------------------------------------------------------------------------------------------------


def _read_camera_matrix(path: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy from a camera matrix."""
    K = read_matrix(path, (3, 4))
    if not np.isfinite(K[:3, :3]).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(f"{path}: is not a camera matrix; its focal lengths must be greater than 0")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _camera(path: Path, intrinsics: Sequence[float], *, assumed: bool) -> CameraModel:
    """Camera of a folder, with the size of its first chosen depth image."""
    image = _read_png(path)
    height, width = image.shape[:2]
    if assumed and (width, height) != (640, 480):
        raise ConfigError(f"{path}: is {width}x{height} pixels, and the folder has no intrinsics; give fx, fy, cx, cy")
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    return CameraModel(width, height, fx, fy, cx, cy)


def _read_png(path: Path) -> npt.NDArray[Any]:
    """Pixels of an image: (H, W) uint8 or uint16 for grey ones."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            if image.mode.startswith("I"):
                # Older Pillow opens 16-bit grey as 32-bit integers.
                return np.asarray(image).astype(np.uint16)
            return np.asarray(image)
    except FileNotFoundError as error:
        raise InputError(f"{path}: not found") from error
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: is not an image") from error
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path}: is damaged: {error}") from error


def _kind(image: npt.NDArray[Any]) -> str:
    """Type of an image, as a clause of an error."""
    return f"{image.dtype.itemsize * 8} bits in {1 if image.ndim == 2 else image.shape[2]} channels"
