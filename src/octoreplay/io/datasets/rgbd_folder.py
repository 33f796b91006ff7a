"""Import of folders of depth images with poses; ``rgbd_layouts`` names their layouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from octoreplay.errors import ConfigError, InputError
from octoreplay.io.datasets.depth_files import kind_of_image, read_png
from octoreplay.io.datasets.frames_folder import (
    check_choice,
    check_map_frame,
    chosen_frames,
    frame_stamps,
    read_times,
    robot_name,
    write_frames,
)
from octoreplay.io.datasets.rgbd_layouts import MILLIMETRE, DepthReader, RgbdFrame, RgbdLayout, find_layout, with_labels
from octoreplay.io.output_file import unfinished
from octoreplay.io.robots.robot_log_writer import MAP_FRAME, OPTICAL_IN_BODY, RobotLogWriter
from octoreplay.records import CameraModel, ClassTable, FilePath, Float64Array
from octoreplay.transforms import inverse

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


CAMERA_AXES = ("optical", "opengl")
"""Axes of a camera in its poses: x right, y down, z forward; or x right, y up, z backward."""


def import_rgbd(
    folder: FilePath,
    output: FilePath,
    *,
    rate: float | None = None,
    times: FilePath | None = None,
    robot_id: str | None = None,
    intrinsics: Sequence[float] | None = None,
    depth_unit: float | None = None,
    labels: FilePath | None = None,
    class_table: ClassTable | None = None,
    first: int = 0,
    last: int | None = None,
    every: int = 1,
    map_frame: str = MAP_FRAME,
    camera_axes: str = "optical",
    T_map_given: Float64Array | None = None,
    progress: Callable[[float], None] | None = None,
) -> ImportSummary:
    """Write the depth images and poses of a folder as one robot's log (MCAP).

    - Choice: every ``every``-th frame from ``first`` to ``last`` (included), counted from 0 in the folder's order.
    - Stamps: from 0 at ``rate`` Hz; or the seconds in the text file ``times``, one line per frame of the folder or per
      chosen frame; or, in a TUM folder without both, the frames' own stamps.
    - Depth: millimetres are written as 16UC1 with 0 where nothing was measured (0 or 65535 in the files), other units
      as 32FC1 metres with NaN there.
    - ``intrinsics`` (fx, fy, cx, cy) in pixels, without lens distortion, and ``depth_unit`` in metres replace the
      folder's.
    - Labels: ``labels`` is a folder of label PNGs named like the depth images; ``class_table`` names their values.
    - ``robot_id`` defaults to the log's file name. ``map_frame`` names the frame of the poses.
    - ``camera_axes`` are those of the poses: 'optical' (x right, y down, z forward), or 'opengl' (x right, y up, z
      backward), as Habitat and Blender write them.
    - ``T_map_given`` (4, 4) is the transform from the frame of the given poses to the log's map frame (default: the
      identity).

    The same input gives the same bytes. Raises InputError for missing or damaged files, ConfigError for options that do
    not fit, OutputError where the log cannot be written; then no file is left.
    """
    folder, output = Path(folder), Path(output)
    times, labels = (None if path is None else Path(path) for path in (times, labels))
    check_choice(rate, times, first, every)
    check_map_frame(map_frame)
    _check_options(intrinsics, depth_unit, camera_axes)
    robot_id = robot_name(robot_id, output)
    layout = find_layout(folder)
    frames = layout.frames if labels is None else with_labels(layout.frames, labels)
    chosen = chosen_frames(folder, len(frames), first, last, every)
    own = _own_times([frames[k] for k in chosen]) if times is None else read_times(times, chosen, len(frames))
    stamps = frame_stamps(times or folder, own, rate, len(chosen))
    job = _Import(
        frames=[frames[k] for k in chosen],
        stamps=stamps,
        camera=_camera(layout, frames[chosen[0]].depth_file, intrinsics),
        depth_unit=layout.depth_unit if depth_unit is None else depth_unit,
        map_frame=map_frame,
        read_depth=layout.read_depth,
        is_opengl=camera_axes == "opengl",
        distortion=layout.distortion if intrinsics is None else None,
        T_map_given=np.eye(4) if T_map_given is None else T_map_given,
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

    frames: list[RgbdFrame]
    stamps: list[int]
    camera: CameraModel
    depth_unit: float
    map_frame: str
    read_depth: DepthReader
    is_opengl: bool
    distortion: tuple[float, ...] | None
    T_map_given: Float64Array
    num_frames: int = 0
    num_labelled: int = 0
    num_without_pose: int = 0

    def write(
        self, path: Path, robot_id: str, class_table: ClassTable | None, progress: Callable[[float], None] | None
    ) -> None:
        """Write the log."""
        T_body_sensor = np.eye(4)
        T_body_sensor[:3, :3] = OPTICAL_IN_BODY
        T_sensor_body = (np.diag([1.0, -1.0, -1.0, 1.0]) if self.is_opengl else np.eye(4)) @ inverse(T_body_sensor)
        with RobotLogWriter(
            path, robot_id, self.camera, class_table, T_body_sensor=T_body_sensor, start_ns=self.stamps[0],
            map_frame=self.map_frame, distortion=self.distortion,
        ) as log:  # fmt: skip

            def write_frame(index: int, stamp_ns: int, T_given_sensor: Float64Array) -> None:
                frame = self.frames[index]
                depth = self._depth_image(frame.depth_file)
                label_image = None if frame.label_file is None else self._label_image(frame.label_file)
                log.write_pose(stamp_ns, self.T_map_given @ T_given_sensor @ T_sensor_body)
                log.write_frame(stamp_ns, depth, label_image)
                self.num_frames += 1
                self.num_labelled += label_image is not None

            readers = [frame.read_pose for frame in self.frames]
            self.num_without_pose = write_frames(self.stamps, readers, write_frame, progress)

    def _depth_image(self, path: Path) -> npt.NDArray[Any]:
        """A depth image as the log holds it: uint16 millimetres, or float32 metres."""
        raw = self.read_depth(path)
        self._check_size(path, raw)
        if raw.dtype == np.float32:
            return np.where(np.isfinite(raw) & (raw > 0), raw, np.float32(np.nan))
        measured = (raw != 0) & (raw != _INVALID)
        if abs(self.depth_unit - MILLIMETRE) < 1e-12:
            return np.where(measured, raw, np.uint16(0))
        metres = (raw * self.depth_unit).astype(np.float32)
        return np.where(measured, metres, np.float32(np.nan))

    def _label_image(self, path: Path) -> npt.NDArray[Any]:
        """A label image, uint8 or uint16."""
        raw = read_png(path)
        if raw.ndim != 2:
            raise InputError(
                f"{path}: a label image must be an 8-bit or 16-bit grey PNG, this one has {kind_of_image(raw)}"
            )
        self._check_size(path, raw)
        return raw

    def _check_size(self, path: Path, image: npt.NDArray[Any]) -> None:
        """Raise InputError where an image has another size than the camera."""
        if image.shape != (self.camera.height, self.camera.width):
            raise InputError(
                f"{path}: is {image.shape[1]}x{image.shape[0]} pixels, but the depth images are "
                f"{self.camera.width}x{self.camera.height}; resize it without interpolation"
            )


def _check_options(intrinsics: Sequence[float] | None, depth_unit: float | None, camera_axes: str) -> None:
    """Raise ConfigError for a camera that is invalid for every folder."""
    if intrinsics is not None and (
        len(intrinsics) != 4 or not np.isfinite(intrinsics).all() or min(intrinsics[:2]) <= 0
    ):
        raise ConfigError("intrinsics: expects 4 numbers fx, fy, cx, cy in pixels, fx and fy greater than 0")
    if depth_unit is not None and not 0 < depth_unit < 1000:
        raise ConfigError(f"depth_unit: {depth_unit:g} must be greater than 0 and below 1000 metres")
    if camera_axes not in CAMERA_AXES:
        raise ConfigError(f"camera_axes: '{camera_axes}' is not one of {', '.join(CAMERA_AXES)}")


def _camera(layout: RgbdLayout, path: Path, given: Sequence[float] | None) -> CameraModel:
    """Camera of a folder, with the size of its first chosen depth image."""
    height, width = layout.read_depth(path).shape
    intrinsics = given or layout.intrinsics
    if intrinsics is None or (given is None and layout.size not in (None, (width, height))):
        raise ConfigError(
            f"{path}: is {width}x{height} pixels, and the folder has no intrinsics; give fx, fy, cx, cy (--intrinsics)"
        )
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    return CameraModel(width, height, fx, fy, cx, cy)


def _own_times(frames: Sequence[RgbdFrame]) -> list[int] | None:
    """Own stamps of the frames; None unless every frame has one."""
    stamps = [frame.stamp_ns for frame in frames if frame.stamp_ns is not None]
    return stamps if len(stamps) == len(frames) else None
